"""Transitions as one NumPy archive or HDF5 file, for other libraries."""

from __future__ import annotations

import logging
import os
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from torchrl_caiac._extras import extra
from torchrl_caiac._files import whole_file
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data.write_transitions import check_free

__all__ = ["export_hdf5", "export_npz"]

_LOGGER = logging.getLogger("torchrl_caiac.augment")
_CHUNK = 1 << 14  # rows copied at a time
_NAMES = {
    ("action",): "actions",
    ("episode",): "episodes",
    ("next", "reward"): "rewards",
    ("next", "terminated"): "terminals",
    ("next", "truncated"): "timeouts",
    ("next", "done"): "dones",
    ("caiac", "counterfactual"): "counterfactual",
    ("caiac", "swapped"): "swapped",
}
# What tells of a row, in data of this package and of TorchRL.
_NO_STATES = frozenset(
    {
        "action",
        "caiac",
        "done",
        "hindsight",
        "info",
        "is_init",
        "reward",
        "step_count",
        "terminated",
        "truncated",
    }
)


def export_npz(
    data: TensorDictBase,
    path: str | os.PathLike[str],
    *,
    entities: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Writes transitions as a NumPy archive, with the names that D4RL uses.

    The arrays are ``observations``, ``next_observations``, ``actions``, ``rewards``,
    ``terminals``, ``timeouts``, ``dones`` and ``episodes``, and of augmented data
    ``counterfactual`` and ``swapped``, all with one entry for each transition. Entries
    of a nested observation, and goals, are ``observations/<name>``; then the
    observation vector is ``observations/observation``. Nested actions are
    ``actions/<name>``. The rest, such as scores and ``info``, is left out. Read the
    file with ``numpy.load``.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        path (path): the file. It is written atomically.

    Keyword Args:
        entities (sequence of str): the names of the columns of ``swapped``, written as
            the array ``entities``. Defaults to ``()``: none.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.

    Returns:
        Path: the file.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        OSError: the disk is full.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.augment import export_npz
        >>> rows = TensorDict(
        ...     {"observation": torch.zeros(3, 2), "action": torch.zeros(3, 1)}, [3]
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = export_npz(rows, f"{folder}/rows.npz")
        ...     with np.load(file, allow_pickle=False) as stored:
        ...         sorted(stored)
        ['actions', 'observations']
    """
    check_free(path, overwrite)
    with (
        whole_file(path) as partial,
        zipfile.ZipFile(partial, "w", allowZip64=True) as archive,
    ):
        for name, leaf in _arrays(data):
            kind = np.dtype(_numpy(leaf[:0]).dtype)
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                header = {
                    "descr": np.lib.format.dtype_to_descr(kind),
                    "fortran_order": False,
                    "shape": tuple(leaf.shape),
                }
                np.lib.format.write_array_header_1_0(file, header)
                for part in _parts(leaf):
                    file.write(part.tobytes())
        if entities:
            with archive.open("entities.npy", "w") as file:
                np.lib.format.write_array(file, np.array(entities), allow_pickle=False)
    return Path(path)


def export_hdf5(
    data: TensorDictBase,
    path: str | os.PathLike[str],
    *,
    entities: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Writes transitions as an HDF5 file, with the same names as :func:`export_npz`.

    Read it with ``h5py.File``.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        path (path): the file. It is written atomically.

    Keyword Args:
        entities (sequence of str): the names of the columns of ``swapped``, written as
            the attribute ``entities`` of the file. Defaults to ``()``: none.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.

    Returns:
        Path: the file.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        ImportError: h5py is not installed.
        OSError: the disk is full.

    Examples:
        >>> import tempfile
        >>> import h5py
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.augment import export_hdf5
        >>> rows = TensorDict(
        ...     {"observation": {"arm": torch.ones(3, 2)}, "action": torch.ones(3)}, [3]
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with h5py.File(export_hdf5(rows, f"{folder}/rows.hdf5")) as file:
        ...         file["observations/arm"].shape
        (3, 2)
    """
    with extra("robomimic", str(path)):
        import h5py
    check_free(path, overwrite)
    with whole_file(path) as partial, h5py.File(partial, "w") as file:
        for name, leaf in _arrays(data):
            kind = _numpy(leaf[:0]).dtype
            stored = file.create_dataset(name, shape=tuple(leaf.shape), dtype=kind)
            begin = 0
            for part in _parts(leaf):
                stored[begin : begin + len(part)] = part
                begin += len(part)
        if entities:
            file.attrs["entities"] = list(entities)
    return Path(path)


def _arrays(data: TensorDictBase) -> Iterator[tuple[str, torch.Tensor]]:
    """Yields the names and tensors of the entries that have a name there."""
    keys = sorted((path_of(key) for key in data.keys(True, True)), key=str)
    found = {key: state for key in keys if (state := _state(key))}
    after = {state for key, state in found.items() if key[0] == "next"}
    # What both states have, goals and observations; the rest tells of a row. Data
    # without next states do not tell.
    states = {
        key: state
        for key, state in found.items()
        if not after
        or (state in after and state in found)
        or state[0] == "observation"
        or ("goal" in state[-1] and _is_vector(data.get(key)))
    }
    is_vector = all(state == ("observation",) for state in states.values())
    left_out = []
    for key in keys:
        state = states.get(key)
        if key in _NAMES:
            leaf = data.get(key)
            is_flag = key[0] == "next" and leaf.shape[1:] == (1,)
            yield _NAMES[key], leaf.squeeze(-1) if is_flag or _is_mark(key) else leaf
        elif key[0] == "action":
            yield "/".join(("actions", *key[1:])), data.get(key)
        elif state is None:
            left_out.append(".".join(key))
        else:
            name = "next_observations" if key[0] == "next" else "observations"
            inner = state[1:] if state[0] == "observation" and state[1:] else state
            yield "/".join((name, *(() if is_vector else inner))), data.get(key)
    if left_out:
        _LOGGER.info("%s are left out of the exported arrays", left_out)


def _is_vector(leaf: torch.Tensor) -> bool:
    return leaf.ndim > 1 and leaf.dtype is not torch.bool


def _is_mark(key: tuple[str, ...]) -> bool:
    return key == ("caiac", "counterfactual")


def _state(key: tuple[str, ...]) -> tuple[str, ...] | None:
    """Returns the key of an entry of the state; ``None`` for others."""
    state = key[1:] if key[0] == "next" else key
    none = key in _NAMES or state[0] in _NO_STATES
    return None if none else state


def _parts(leaf: torch.Tensor) -> Iterator[NDArray[Any]]:
    for begin in range(0, len(leaf), _CHUNK):
        yield _numpy(leaf[begin : begin + _CHUNK])


def _numpy(part: torch.Tensor) -> NDArray[Any]:
    part = part.as_subclass(torch.Tensor).detach().cpu()
    if part.dtype == torch.bfloat16:  # which NumPy does not have
        part = part.float()
    array = part.contiguous().numpy()
    return np.ascontiguousarray(array)
