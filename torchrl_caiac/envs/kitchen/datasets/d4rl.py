"""Kitchen files of the original D4RL as TorchRL transitions."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_caiac._files import UnreadableFileError
from torchrl_caiac.data.minari_checks import check_hdf5_array
from torchrl_caiac.data.write_transitions import check_free, write_transitions

__all__ = ["load_d4rl_kitchen"]

# Shapes of a D4RL kitchen's arrays, without the rows.
_D4RL_ARRAYS: Mapping[str, tuple[int, ...]] = {
    "observations": (60,),
    "actions": (9,),
    "rewards": (),
    "terminals": (),
    "timeouts": (),
}


def load_d4rl_kitchen(
    file: str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
) -> TensorDict:
    """Returns a kitchen file of the original D4RL as TorchRL transitions.

    The keys are those of :func:`~torchrl_caiac.envs.kitchen_transitions`. Such an HDF5
    file contains ``"observations"`` ``[M, 60]`` (robot positions 9, object positions
    21, a goal 30 that is left out), ``"actions"`` ``[M, 9]``, ``"rewards"``,
    ``"terminals"`` and ``"timeouts"`` ``[M]``, episodes in sequence. Next states are
    not stored: an episode's last row has none, so it is left out, and the row before it
    is the trajectory's end (truncated). ``"task"`` is -1.

    Args:
        file (path): the HDF5 file.
        path (path, optional): folder for a memory-mapped result. Defaults to ``None``:
            in memory.

    Keyword Args:
        overwrite (bool): whether to replace what is at ``path``. Defaults to ``False``.

    Returns:
        TensorDict: transitions of batch size ``[T]``.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        FileNotFoundError: there is no file.
        KeyError: the file lacks one of the five arrays.
        ValueError: the file is not an HDF5 file or is truncated; widths or lengths are
            wrong; values are not finite; no episode has two rows.

    Examples:
        >>> import tempfile, h5py, numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with h5py.File(f"{folder}/kitchen.hdf5", "w") as file:
        ...         file["observations"] = np.zeros((5, 60))
        ...         file["actions"] = np.zeros((5, 9))
        ...         file["rewards"] = np.zeros(5)
        ...         file["terminals"] = np.array([0, 1, 0, 0, 0], bool)
        ...         file["timeouts"] = np.array([0, 0, 0, 0, 1], bool)
        ...     rows = load_d4rl_kitchen(f"{folder}/kitchen.hdf5")
        >>> rows["episode"].tolist()
        [0, 1, 1]
    """
    check_free(path, overwrite)
    arrays = _read_d4rl(Path(file))
    over = (arrays["terminals"] | arrays["timeouts"]).copy()
    over[-1:] = True
    kept = np.flatnonzero(~over)
    if not len(kept):
        raise ValueError(f"{file} has no rows that are followed by another")
    # The remaining episodes, numbered without gaps.
    numbers = np.concatenate([[0], np.cumsum(over)[:-1]])[kept]
    last = torch.from_numpy(over[kept + 1]).unsqueeze(-1)
    state = torch.from_numpy(arrays["observations"][:, :30].astype(np.float32))
    rows = TensorDict(
        {
            "observation": state[kept],
            "action": torch.from_numpy(arrays["actions"][kept].astype(np.float32)),
            "episode": torch.from_numpy(np.unique(numbers, return_inverse=True)[1]),
            "task": torch.full((len(kept),), -1),
            "next": {
                "observation": state[kept + 1],
                "reward": torch.from_numpy(
                    arrays["rewards"][kept, None].astype(np.float32)
                ),
                "terminated": torch.zeros_like(last),
                "truncated": last,
                "done": last.clone(),
            },
        },
        batch_size=[len(kept)],
    )
    if path is None:
        return rows
    return write_transitions(rows, path, overwrite=overwrite)


def _read_d4rl(file: Path) -> dict[str, NDArray[Any]]:
    import h5py

    if not file.exists():
        raise FileNotFoundError(f"no file at {file}")
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with h5py.File(file, "r") as stored:
            missing = sorted(set(_D4RL_ARRAYS) - set(stored))
            if missing:
                raise KeyError(
                    f"{file} lacks {missing}, it has {sorted(stored)}: give a kitchen "
                    "file of D4RL"
                )
            for name in _D4RL_ARRAYS:
                check_hdf5_array(stored[name], file)
                arrays[name] = np.asarray(stored[name])
    except OSError as error:
        raise UnreadableFileError(
            f"{file} is not an HDF5 file or is truncated ({error}): download it again"
        ) from error
    length = arrays["observations"].shape[:1]
    for name, shape in _D4RL_ARRAYS.items():
        array = arrays[name]
        if array.shape != (*length, *shape):
            raise ValueError(
                f"{name!r} in {file} has shape {array.shape}, expected "
                f"{(*length, *shape)}"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"{name!r} in {file} has NaN or infinite values, the first in row "
                f"{int((~np.isfinite(array)).nonzero()[0][0])}: leave its episode out"
            )
        if name in ("terminals", "timeouts"):
            arrays[name] = array.astype(np.bool_)
    return arrays
