"""Marks rows as not scored when they are written into a replay buffer."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from torchrl_caiac._buffer_transform import BufferTransform
from torchrl_caiac._keys import as_key

__all__ = ["MarkUnscored", "mark_later_rows", "set_unscored"]


def set_unscored(
    tensordict: TensorDictBase,
    key: NestedKey,
    feature_shape: tuple[int, ...],
    *,
    dtype: torch.dtype = torch.float32,
) -> TensorDictBase:
    """Sets the scores of transitions to NaN, which means not scored.

    A score is valid for one position in one trajectory. Transitions that are written
    into a storage get NaN even if they have scores, so that an old score is never used
    at a new position.

    Args:
        tensordict (TensorDictBase): transitions ``[*B]``.
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): the shape of the scores of a transition: ``(N,)``,
            or ``(N + 1, N)`` for graphs.

    Keyword Args:
        dtype (torch.dtype): that of the leaf in the storage. Defaults to float32, which
            ``score_buffer`` writes.

    Returns:
        TensorDictBase: the same tensordict, with NaN ``[*B, *feature_shape]`` in
        ``key``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.influence import set_unscored
        >>> td = TensorDict({"score": torch.zeros(1, 2)}, [1])
        >>> set_unscored(td, "score", (2,))["score"]
        tensor([[nan, nan]])
    """
    shape = (*tensordict.batch_size, *feature_shape)
    nan = torch.full(shape, torch.nan, dtype=dtype, device=tensordict.device)
    return tensordict.set(key, nan)


class MarkUnscored(BufferTransform):
    """Sets the scores of all transitions that are written into a buffer to NaN.

    :func:`~torchrl_caiac.influence.score_buffer` appends it to each buffer that it
    scores. Append it yourself to a buffer that was loaded with scores, if you write to
    it before ``score_buffer`` is called in this process. Samples pass it unchanged. See
    :func:`~torchrl_caiac.influence.set_unscored`.

    Args:
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): the shape of the scores of a transition: ``(N,)``,
            or ``(N + 1, N)`` for graphs.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.influence import MarkUnscored
        >>> rb = ReplayBuffer(
        ...     storage=LazyTensorStorage(4),
        ...     transform=MarkUnscored(("caiac", "score"), (2,)),
        ... )
        >>> _ = rb.extend(TensorDict({"observation": torch.zeros(3, 5)}, [3]))
        >>> rb[:]["caiac", "score"].isnan().all()
        tensor(True)
    """

    def __init__(self, key: NestedKey, feature_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.key = as_key(key)
        self.feature_shape = tuple(int(size) for size in feature_shape)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a sample unchanged.

        Args:
            tensordict (TensorDictBase): the sample.

        Returns:
            TensorDictBase: the same sample.
        """
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return set_unscored(tensordict, self.key, self.feature_shape)

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        return f"key={self.key!r}, feature_shape={self.feature_shape}"


def mark_later_rows(
    rb: ReplayBuffer, key: NestedKey, feature_shape: tuple[int, ...]
) -> None:
    """Appends :class:`MarkUnscored` to a buffer, unless it has one for this leaf.

    Args:
        rb (ReplayBuffer): the buffer.
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): as in :class:`MarkUnscored`.
    """
    for transform in rb.transform:
        if isinstance(transform, MarkUnscored) and transform.key == key:
            transform.feature_shape = feature_shape
            return
    rb.append_transform(MarkUnscored(key, feature_shape))
