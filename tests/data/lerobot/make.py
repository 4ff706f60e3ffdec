"""Writes the LeRobot datasets beside this file with LeRobot's own writer.

It was run in two environments of their own, because LeRobot needs other versions of
torch, NumPy and pandas than this project. It needs no images here, so an empty module
in the place of torchvision is enough.

    pip install lerobot==0.3.3 "numpy<2.3" "pandas<3"    # codebase v2.1
    python tests/data/lerobot/make.py tests/data/lerobot/v2.1

    pip install lerobot==0.4.4 "numpy<2.3" "pandas<3"    # codebase v3.0
    python tests/data/lerobot/make.py tests/data/lerobot/v3.0

The numbers follow :func:`episode`, which the tests read too.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

LENGTHS = (6, 4, 7, 5)
TASKS = ("Push the cube to the left.", "Push the cube to the right.")
ROOT = Path(__file__).parent


def episode(number: int) -> dict[str, Any]:
    """The frames of an episode: arrays ``[L, *]`` by the name of their feature."""
    length = LENGTHS[number]
    t, random = np.arange(length), np.random.default_rng(number)
    return {
        "observation.state": random.normal(size=(length, 3)).astype(np.float32),
        "observation.environment_state": random.normal(size=(length, 4)).astype(
            np.float32
        ),
        "action": random.uniform(-1, 1, size=(length, 2)).astype(np.float32),
        "next.reward": (10 * number + t).astype(np.float32)[:, None],
        "next.success": (t[:, None] == length - 1) & (number != 1),
        "next.done": t[:, None] == length - 1,
    }


def task(number: int, t: int) -> int:
    """The index of the task of a frame: the last episode changes its task."""
    return (number + (number == 3 and t < 2)) % len(TASKS)


def features() -> dict[str, Any]:
    """The description of the features, as LeRobot wants it."""
    return {
        name: {"dtype": str(array.dtype), "shape": array.shape[1:], "names": None}
        for name, array in episode(0).items()
    }


def main(root: Path) -> None:
    """Writes the dataset to ``root``, which is replaced."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    shutil.rmtree(root, ignore_errors=True)
    dataset = LeRobotDataset.create("example/push", 10, features(), root=root)
    if hasattr(dataset.meta, "update_chunk_settings"):
        # Several files, of more than one episode, in two folders.
        dataset.meta.update_chunk_settings(chunks_size=2, data_files_size_in_mb=0.002)
    for number, length in enumerate(LENGTHS):
        frames = episode(number)
        for t in range(length):
            frame = {name: array[t] for name, array in frames.items()}
            text = TASKS[task(number, t)]
            try:
                dataset.add_frame({**frame, "task": text})
            except TypeError:  # v2.1 takes it apart from the frame
                dataset.add_frame(frame, text)
        dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
