"""A buffer that samples offline and online transitions in fixed shares."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.data import OfflineToOnlineReplayBuffer, ReplayBuffer

from torchrl_caiac._torchrl import set_online_buffer

__all__ = ["offline_to_online_buffer"]


def offline_to_online_buffer(
    offline: ReplayBuffer,
    online: ReplayBuffer,
    *,
    offline_fraction: float = 0.5,
    batch_size: int | None = None,
) -> OfflineToOnlineReplayBuffer:
    """Combines two buffers that augment their own samples.

    TorchRL's constructor makes the online buffer itself, of a storage, so that it has
    no ``sample_unit``. But :class:`~torchrl_caiac.transforms.HindsightGoal` needs one,
    which reads the storage that is sampled, and so does ``lookahead`` of
    :class:`~torchrl_caiac.CAIACTransform`. Here both buffers come with their own
    transforms. Donors and goals of a row are from its own buffer.

    Args:
        offline (ReplayBuffer): the offline transitions.
        online (ReplayBuffer): the online ones, perhaps empty. Its samples have the same
            entries as those of ``offline``.

    Keyword Args:
        offline_fraction (float): the share of each batch that is offline, in (0, 1).
            Defaults to 0.5.
        batch_size (int, optional): the number of rows in a sample. Defaults to
            ``None``: passed to every call of ``sample``.

    Returns:
        OfflineToOnlineReplayBuffer: its batches have offline rows first. ``sample``
        raises a ``KeyError`` with the entries that only one buffer has.

    Raises:
        TypeError: one of them is not a replay buffer.
        ValueError: both are the same, or ``offline_fraction`` is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.data import offline_to_online_buffer
        >>> offline, online = (
        ...     ReplayBuffer(storage=LazyTensorStorage(10)) for _ in range(2))
        >>> _ = offline.extend(TensorDict({"action": torch.zeros(10, 1)}, [10]))
        >>> rb = offline_to_online_buffer(offline, online, batch_size=4)
        >>> _ = rb.extend(TensorDict({"action": torch.ones(10, 1)}, [10]))
        >>> rb.sample()["action"].flatten()
        tensor([0., 0., 1., 1.])
    """
    for name, rb in (("offline", offline), ("online", online)):
        if not isinstance(rb, ReplayBuffer):
            raise TypeError(
                f"{name} must be a ReplayBuffer, got {type(rb).__name__}: give the "
                "buffer itself"
            )
    if offline is online:
        raise ValueError("offline and online are the same buffer: give two")
    return _OfflineToOnlineReplayBuffer(offline, online, offline_fraction, batch_size)


class _OfflineToOnlineReplayBuffer(OfflineToOnlineReplayBuffer):
    def __init__(
        self,
        offline: ReplayBuffer,
        online: ReplayBuffer,
        offline_fraction: float,
        batch_size: int | None,
    ) -> None:
        super().__init__(
            offline,
            online_storage=online.storage,
            offline_fraction=offline_fraction,
            batch_size=batch_size,
        )
        set_online_buffer(self, online)
        self._default = batch_size

    def sample(self, batch_size: int | None = None) -> TensorDictBase:
        try:
            return super().sample(batch_size)
        except KeyError as error:
            if "incompatible" not in str(error):  # raised by one of the buffers
                raise
            buffers = (self.offline_buffer, self.online_buffer)
            own, other = (
                set(rb.sample(batch_size or self._default).keys(True, True))
                for rb in buffers
            )
            raise KeyError(
                f"only the offline buffer's samples have {sorted(own - other, key=str)}"
                f", and only those of the online one {sorted(other - own, key=str)}: "
                "append the same transforms to both, and score both, with score_buffer "
                "or ScoreOnWrite"
            ) from error
