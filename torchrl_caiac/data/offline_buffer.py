"""A replay buffer over a finished dataset."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler

__all__ = ["offline_buffer"]


def offline_buffer(
    data: TensorDictBase,
    batch_size: int | None = None,
    sampler: Sampler | None = None,
    **kwargs: Any,
) -> TensorDictReplayBuffer:
    """Makes a replay buffer over rows that are already there; nothing is copied.

    The buffer cannot be extended. Scores written by :func:`score_buffer` go into
    ``data``: to its folder, when it is memory-mapped.

    Args:
        data (TensorDictBase): the rows, ``[T]``, in memory, memory-mapped (from
            :func:`load_transitions` or :func:`load_minari`), or on a GPU.
        batch_size (int, optional): rows per sample.
        sampler (Sampler, optional): the sampler. Defaults to uniform sampling.
        kwargs: more arguments of ``TensorDictReplayBuffer``.

    Returns:
        TensorDictReplayBuffer: the buffer.

    Raises:
        ValueError: ``data`` has no rows or several batch dimensions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.offline_buffer import offline_buffer
        >>> rows = TensorDict({"action": torch.zeros(10, 2)}, [10])
        >>> offline_buffer(rows, 4).sample()["action"].shape
        torch.Size([4, 2])
    """
    if not isinstance(data, TensorDictBase):
        raise TypeError(f"data is a tensordict of rows, got {type(data).__name__}")
    if data.batch_dims != 1 or not len(data):
        raise ValueError(
            f"data has the batch size {list(data.batch_size)}, wanted [T] with at "
            "least one row: flatten trajectories, and tell them apart by an id"
        )
    # Where the rows are drawn: rows of a GPU from the host would have to be sent there.
    device = data.device or next(iter(data.values(True, True))).device
    arguments: dict[str, Any] = {
        "storage": TensorStorage(data, device=device),
        "writer": ImmutableDatasetWriter(),
        "batch_size": batch_size,
        **kwargs,
    }
    if sampler is not None:
        arguments["sampler"] = sampler
    return TensorDictReplayBuffer(**arguments)
