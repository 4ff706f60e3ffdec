"""A replay buffer over an existing dataset."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_caiac._batches import rows_of
from torchrl_caiac._torchrl import (
    lazy_rows,
    sampling_buffer,
    storage_data,
)
from torchrl_caiac.data.add_leaf import store_leaves

__all__ = ["OfflineStorage", "offline_buffer", "offline_storage"]


class OfflineStorage(TensorStorage):
    """A storage that copies whole rows, which takes half of the time on a CPU.

    It returns what a :class:`~torchrl.data.TensorStorage` returns.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.offline_buffer import OfflineStorage
        >>> storage = OfflineStorage(TensorDict({"a": torch.arange(10)}, [10]))
        >>> storage.get(torch.tensor([7, 7, 2]))["a"]
        tensor([7, 7, 2])
    """

    def get(self, index: Any) -> Any:
        """Returns rows, see :class:`~torchrl.data.TensorStorage`.

        Args:
            index (Any): which rows, as for a tensor.

        Returns:
            TensorDictBase: the rows, copied if the index is a tensor.

        Raises:
            IndexError: there are no such rows.
        """
        rows = self._rows(index)
        if rows is not None:
            with suppress(IndexError, RuntimeError):  # negative, or too large
                return rows_of(storage_data(self), rows)
        return super().get(index)

    def __getitem__(self, index: Any) -> Any:
        # Samplers of slices look for flags of the rows that they drew.
        rows = self._rows(index) if isinstance(index, tuple) else None
        if rows is not None and sampling_buffer() is not None:
            return lazy_rows(storage_data(self), rows)
        return super().__getitem__(index)

    def _rows(self, index: Any) -> torch.Tensor | None:
        """Returns the rows ``[B]`` of an index on the CPU, ``None`` of another one."""
        rows = index[0] if isinstance(index, tuple) and len(index) == 1 else index
        if (
            isinstance(rows, torch.Tensor)
            and (rows.ndim, rows.dtype) == (1, torch.int64)
            and {rows.device.type, torch.device(self.device).type} == {"cpu"}
            and self.ndim == 1
            and len(self) == len(storage_data(self))
        ):
            return rows
        return None


def offline_buffer(
    data: TensorDictBase,
    batch_size: int | None = None,
    sampler: Sampler | None = None,
    **kwargs: Any,
) -> TensorDictReplayBuffer:
    """Creates a replay buffer over existing transitions, without copying them.

    The buffer cannot be extended. Scores written by
    :func:`~torchrl_caiac.influence.score_buffer` become leaves of ``data``, in its
    folder if it is memory-mapped. Leaves that were set after ``data.unlock_()`` are
    written to the folder first, see :func:`~torchrl_caiac.data.add_leaf`.

    Args:
        data (TensorDictBase): the transitions, ``[T]``, in memory, memory-mapped (see
            :func:`~torchrl_caiac.data.load_transitions`) or on a GPU.
        batch_size (int, optional): the number of rows in a sample. Defaults to
            ``None``: passed to every call of ``sample``.
        sampler (Sampler, optional): the sampler. Defaults to ``None``: uniform sampling
            with replacement.
        **kwargs (Any): further arguments of ``TensorDictReplayBuffer``.

    Returns:
        TensorDictReplayBuffer: the buffer.

    Raises:
        TypeError: ``data`` is not a tensordict.
        ValueError: ``data`` has no rows or several batch dimensions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.offline_buffer import offline_buffer
        >>> rows = TensorDict({"action": torch.zeros(10, 2)}, [10])
        >>> offline_buffer(rows, 4).sample()["action"].shape
        torch.Size([4, 2])
    """
    arguments: dict[str, Any] = {
        "storage": offline_storage(data),
        "writer": ImmutableDatasetWriter(),
        "batch_size": batch_size,
        **kwargs,
    }
    if sampler is not None:
        arguments["sampler"] = sampler
    return TensorDictReplayBuffer(**arguments)


def offline_storage(data: TensorDictBase) -> OfflineStorage:
    """Creates the storage of :func:`offline_buffer`, without copying the data.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.

    Returns:
        OfflineStorage: a storage of them.

    Raises:
        TypeError: ``data`` is not a tensordict.
        ValueError: ``data`` has no rows or several batch dimensions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.offline_buffer import offline_storage
        >>> len(offline_storage(TensorDict({"action": torch.zeros(10, 2)}, [10])))
        10
    """
    if not isinstance(data, TensorDictBase):
        raise TypeError(f"data must be a tensordict, got {type(data).__name__}")
    if data.batch_dims != 1 or not len(data):
        raise ValueError(
            f"data has batch size {list(data.batch_size)}, expected [T] with at least "
            "one row: flatten trajectories, and add trajectory ids"
        )
    store_leaves(data)
    # Sample on the device of the data, to avoid transfers.
    device = data.device or next(iter(data.values(True, True))).device
    return OfflineStorage(data, device=device)
