"""Short datasets of OGBench's environments, each made once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.envs.ogbench.names import NAMES, STEPS
from torchrl_caiac.envs.ogbench import OGBenchSimulator, create_ogbench_play


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> dict[str, Path]:
    """A file of two short episodes for each environment."""
    folder = tmp_path_factory.mktemp("ogbench")
    return {
        name: create_ogbench_play(
            folder / f"{name}.npz",
            name,
            episodes=2,
            steps=STEPS,
            seed=3,
            num_workers=1,
            progress=False,
        )
        for name in NAMES
    }


@pytest.fixture(scope="session")
def arrays(files) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of each file."""
    result = {}
    for name, path in files.items():
        with np.load(path, allow_pickle=False) as file:
            result[name] = {key: file[key] for key in file.files}
    return result


@pytest.fixture(scope="session")
def states(arrays) -> dict[str, np.ndarray]:
    """The simulator's states of each file, float64 ``[T, S]``."""
    return {
        name: np.concatenate(
            [own[k] for k in ("qpos", "qvel", "button_states") if k in own], 1
        ).astype(np.float64)
        for name, own in arrays.items()
    }


@pytest.fixture(scope="session")
def simulators():
    """A simulator of each environment."""
    made = {name: OGBenchSimulator(name) for name in NAMES}
    yield made
    for simulator in made.values():
        simulator.close()
