"""A replay buffer over an existing dataset."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_caiac.data.add_leaf import store_leaves

__all__ = ["offline_buffer", "offline_storage"]


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


def offline_storage(data: TensorDictBase) -> TensorStorage:
    """Creates the storage of :func:`offline_buffer`, without copying the data.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.

    Returns:
        TensorStorage: a storage of them.

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
    return TensorStorage(data, device=device)
