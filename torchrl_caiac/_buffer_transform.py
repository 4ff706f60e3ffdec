"""Transforms that are for replay buffers only."""

from __future__ import annotations

from typing import Any, NoReturn

from torchrl.envs.transforms import Transform

__all__ = ["BufferTransform"]


class BufferTransform(Transform):
    """A transform that raises an error when it is appended to an environment.

    It would do nothing there. Subclasses override ``forward``, which a replay buffer
    calls.

    Raises:
        RuntimeError: an environment calls it.

    Examples:
        >>> from torchrl_caiac._buffer_transform import BufferTransform
        >>> class Nothing(BufferTransform):
        ...     def forward(self, tensordict):
        ...         return tensordict
        >>> Nothing()._call(None)
        Traceback (most recent call last):
        ...
        RuntimeError: Nothing can only be appended to a ReplayBuffer, not to an ...
    """

    def _refuse(self) -> NoReturn:
        raise RuntimeError(
            f"{type(self).__name__} can only be appended to a ReplayBuffer, not to an "
            "environment: use rb.append_transform(...)"
        )

    def _call(self, next_tensordict: Any) -> NoReturn:
        self._refuse()

    def _step(self, tensordict: Any, next_tensordict: Any) -> NoReturn:
        self._refuse()

    def _reset(self, tensordict: Any, tensordict_reset: Any) -> NoReturn:
        self._refuse()
