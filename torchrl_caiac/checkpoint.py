"""Checkpoints from which an interrupted training run resumes."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, GlobalRNGState, StateDictCheckpointAdapter

from torchrl_caiac._files import (
    UnreadableFileError,
    check_archive,
    plain,
    remove_leftovers,
    whole_file,
)
from torchrl_caiac._kernels import UsedKernels, check_kernels, keep_kernels, kernel_mode

__all__ = ["TrainingCheckpoint"]

_CONTENT = "torchrl_caiac.checkpoint/1"
_MANIFEST = "manifest.json"  # TorchRL's
_WHAT = "checkpoint of this run"
_ADVICE = "delete it to start from scratch, or give another path"


class TrainingCheckpoint:
    """Saves the state of a training run in one file, and restores it.

    The file contains the state of every part, the number of steps, the settings of the
    run and, by default, the state of the global random number generators of torch,
    NumPy and Python, and which kernels linear layers have used since the object was
    created (:func:`~torchrl_caiac.modules.linear_kernel`). It is a TorchRL checkpoint
    (:class:`~torchrl.checkpoint.Checkpoint`) in the archive format.

    - A file is written atomically: an interrupted write leaves the old file as it was.
    - Runs that do the same write the same bytes: the file has no date and no random id.
    - Loading is all or nothing: if :meth:`load` raises, no part has changed.
    - Loading executes no code from the file: only tensors and plain containers are
      read.

    One process at a time may use a path.

    Args:
        path (path): the file, such as ``"checkpoint.zip"``.

    Keyword Args:
        settings (Mapping, optional): what the run depends on, JSON-compatible. A file
            with other settings is rejected.
        rng (bool): whether to save the global random number generators too. Defaults
            to ``True``.
        **parts (Any): objects with ``state_dict`` and ``load_state_dict``: models,
            optimizers, schedulers.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_caiac.checkpoint import TrainingCheckpoint
        >>> model = torch.nn.Linear(2, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     checkpoint = TrainingCheckpoint(
        ...         f"{folder}/checkpoint.zip", settings={"lr": 0.1}, model=model
        ...     )
        ...     before = checkpoint.load()
        ...     checkpoint.save(step=10)
        ...     before, checkpoint.load()
        (0, 10)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        settings: Mapping[str, Any] | None = None,
        rng: bool = True,
        **parts: Any,
    ) -> None:
        self.path = Path(path).expanduser().absolute()
        # Through JSON, so that tuples equal lists.
        self._settings = json.loads(json.dumps(plain(settings or {})))
        self._used = UsedKernels()
        self._parts = {**parts, "rng": GlobalRNGState()} if rng else parts
        self._checkpoint = Checkpoint(format="directory")
        for name, part in self._parts.items():
            self._checkpoint.register(name, part, adapter=_TensorsOnly("torch"))

    def save(self, step: int) -> None:
        """Writes the file.

        Args:
            step (int): the number of steps taken so far.
        """
        metadata = {
            "content": _CONTENT,
            "step": step,
            "settings": self._settings,
            "linear_kernels": self._used.state(),
        }
        # TorchRL moves an old file away before it puts the new one in its place.
        with whole_file(self.path) as partial:
            parts = partial.with_name(f"{partial.name}.parts-0")
            try:
                self._checkpoint.save(parts, metadata=metadata)
                _write_archive(parts, partial)
            finally:
                shutil.rmtree(parts, ignore_errors=True)

    def load(self, *, max_step: int | None = None) -> int:
        """Restores all parts if the file exists.

        It also removes the partial files of interrupted writes.

        Keyword Args:
            max_step (int, optional): the requested total number of steps.

        Returns:
            int: the number of steps taken, 0 if there is no file.

        Raises:
            UnreadableFileError: the file is truncated or not a checkpoint of this run.
            ValueError: its settings or its ``linear_kernel`` differ, or it has more
                than ``max_step`` steps.
        """
        remove_leftovers(self.path)
        if not self.path.exists():
            return 0
        check_archive(self.path, _WHAT, _ADVICE)
        try:
            step, settings, kernels = self._read_manifest()
        except Exception as error:
            raise self._unreadable(error) from error
        differences = list(_differences(settings, self._settings))
        if kernels is not None:
            mode = kernel_mode()
            differences += _differences(kernels["kernel"], mode, "linear_kernel")
        if differences:
            raise ValueError(
                f"the checkpoint {self.path} was made with other settings "
                f"({'; '.join(differences)}): repeat the run with the saved settings, "
                f"or {_ADVICE}"
            )
        if max_step is not None and step > max_step:
            raise ValueError(
                f"the checkpoint {self.path} has {step} steps, more than the requested "
                f"{max_step}: request more steps, or {_ADVICE}"
            )
        try:
            # On the CPU: each part moves its state to its own device.
            loaded = self._checkpoint.load(self.path, map_location="cpu")
            self._restore(loaded.values)
        except Exception as error:
            raise self._unreadable(error) from error
        if kernels is not None:
            keep_kernels(kernels)
        return step

    def _read_manifest(self) -> tuple[int, dict[str, Any], dict[str, Any] | None]:
        """Returns steps, settings and kernels of the file, after checking its parts."""
        manifest = Checkpoint.manifest(self.path)
        metadata, parts = manifest["metadata"], sorted(manifest["components"])
        if metadata.get("content") != _CONTENT:
            raise ValueError(
                f"expected the content {_CONTENT!r}, got {metadata.get('content')!r}"
            )
        if parts != sorted(self._parts):
            raise ValueError(f"expected the parts {sorted(self._parts)}, got {parts}")
        step, settings = metadata["step"], metadata["settings"]
        if type(step) is not int or step < 0 or not isinstance(settings, dict):
            raise ValueError(f"the step is {step!r} and the settings are {settings!r}")
        kernels = metadata.get("linear_kernels")  # earlier files have none
        if kernels is not None:
            check_kernels(kernels)
        return step, settings, kernels

    def _restore(self, states: Mapping[str, Any]) -> None:
        """Restores all parts, or none."""
        before = {
            name: copy.deepcopy(p.state_dict()) for name, p in self._parts.items()
        }
        try:
            for name, part in self._parts.items():
                part.load_state_dict(states[name])
        except BaseException:
            # Each, even where another cannot be restored.
            with contextlib.ExitStack() as stack:
                for name, part in self._parts.items():
                    stack.callback(part.load_state_dict, before[name])
            raise

    def _unreadable(self, error: Exception) -> UnreadableFileError:
        return UnreadableFileError(
            f"{self.path} is not a readable {_WHAT}, it may be truncated or damaged "
            f"({error}): {_ADVICE}"
        )


class _TensorsOnly(StateDictCheckpointAdapter):
    """Reads a state dict that was saved in the ``"torch"`` format, and nothing else.

    TorchRL's own adapter takes the format from the file. A file could thereby choose a
    memory-mapped tensordict, whose non-tensor entries are unpickled.
    """

    def load(self, component: Any, path: Path, **kwargs: Any) -> Any:
        """Returns the state; the caller loads it once all states have been read."""
        file = path / self.state_torch
        check_archive(file, "state", "the checkpoint is damaged")
        return torch.load(
            file,
            map_location=kwargs["map_location"],
            weights_only=True,
        )


def _write_archive(parts: Path, archive: Path) -> None:
    """Writes a folder of :class:`Checkpoint` in its archive format.

    TorchRL's own archives have the time of saving and a random id, these have not.
    """
    manifest = parts / _MANIFEST
    files = sorted(file for file in parts.rglob("*") if file.is_file())
    digest = hashlib.sha256()
    with zipfile.ZipFile(archive, "w") as target:
        for file in [file for file in files if file != manifest]:
            name = file.relative_to(parts).as_posix()
            digest.update(name.encode())
            info = zipfile.ZipInfo(name)
            info.file_size = file.stat().st_size  # decides on ZIP64
            with file.open("rb") as source, target.open(info, "w") as sink:
                while chunk := source.read(1 << 20):
                    digest.update(chunk)
                    sink.write(chunk)
        content = json.loads(manifest.read_text(encoding="utf-8"))
        content |= {
            "container": "archive",
            "checkpoint_id": digest.hexdigest()[:32],
            "created_at": "1980-01-01T00:00:00+00:00",
        }
        text = json.dumps(content, indent=2, sort_keys=True)
        target.writestr(zipfile.ZipInfo(_MANIFEST), text + "\n")


def _differences(saved: Any, given: Any, name: str = "") -> Iterator[str]:
    """Describes every setting that differs, by its dotted name."""
    if isinstance(saved, dict) and isinstance(given, dict):
        for key in dict.fromkeys([*given, *saved]):
            inner = f"{name}.{key}" if name else key
            if key not in saved:
                yield f"{inner} is new"
            elif key not in given:
                yield f"{inner} is missing"
            else:
                yield from _differences(saved[key], given[key], inner)
    elif saved != given:
        yield f"{name}: saved {saved!r}, given {given!r}"
