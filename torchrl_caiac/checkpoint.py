"""Checkpoints from which an interrupted run resumes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, GlobalRNGState, StateDictCheckpointAdapter

from torchrl_caiac._files import whole_file

__all__ = ["TrainingCheckpoint"]


class TrainingCheckpoint:
    """Where a training run goes on after it was killed, in one file.

    Holds the state of every part, and of the global random number generators of torch,
    NumPy and Python. Loaded without pickle; replaced atomically.

    Args:
        path (path): the file, ``checkpoint.zip`` say.

    Keyword Args:
        parts (Any): what has ``state_dict`` and ``load_state_dict``: models,
            optimizers, schedulers.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_caiac.checkpoint import TrainingCheckpoint
        >>> model = torch.nn.Linear(2, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     checkpoint = TrainingCheckpoint(f"{folder}/checkpoint.zip", model=model)
        ...     before = checkpoint.load()
        ...     checkpoint.save(step=10)
        ...     before, checkpoint.load()
        (0, 10)
    """

    def __init__(self, path: str | os.PathLike[str], **parts: Any) -> None:
        self.path = Path(path)
        self._checkpoint = Checkpoint(format="archive")
        for name, part in {**parts, "rng": GlobalRNGState()}.items():
            # As tensordicts optimizers would get views of the file, and write into it.
            adapter = StateDictCheckpointAdapter(payload_format="torch")
            self._checkpoint.register(name, part, adapter=adapter)

    def save(self, step: int) -> None:
        """Writes the file.

        Args:
            step (int): gradient steps that were taken.
        """
        # TorchRL moves an old file away before it puts the new one in its place.
        with whole_file(self.path) as partial:
            self._checkpoint.save(partial, metadata={"step": step})

    def load(self) -> int:
        """Restores all parts, where there is a file.

        Returns:
            int: the steps that were taken, 0 without a file.

        Raises:
            ValueError: the file is truncated, or of something else.
        """
        if not self.path.exists():
            return 0
        try:
            loaded = self._checkpoint.load(self.path)
            return int(loaded.manifest["metadata"]["step"])
        except Exception as error:
            raise ValueError(
                f"{self.path} is no readable checkpoint of this training, it may be "
                f"truncated or foreign ({error}): delete it to begin anew"
            ) from error
