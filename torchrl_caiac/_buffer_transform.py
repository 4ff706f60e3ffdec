"""Transforms that are for replay buffers only."""

from __future__ import annotations

import os
import warnings
from typing import Any, NoReturn

import torch
from torchrl.envs.transforms import Transform

__all__ = ["BufferTransform", "RandomTransform"]


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


class RandomTransform(BufferTransform):
    """A transform of a replay buffer that draws random numbers.

    The state of its generator is part of ``state_dict``, and so of the saved buffer, as
    that of the buffer's own generator is.

    Args:
        generator (torch.Generator, optional): source of randomness; ``None`` for
            torch's default one.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._buffer_transform import RandomTransform
        >>> transform = RandomTransform(torch.Generator().manual_seed(0))
        >>> state = transform.state_dict()
        >>> before = torch.rand(2, generator=transform.generator)
        >>> _ = transform.load_state_dict(state)
        >>> torch.equal(before, torch.rand(2, generator=transform.generator))
        True
    """

    def __init__(self, generator: torch.Generator | None) -> None:
        super().__init__()
        self.generator = generator
        self._origin = _Process()

    def warn_if_forked(self) -> None:
        """Warns, once, in a forked process that draws the numbers of its parent.

        So do its siblings, and TorchRL's samplers: all of them would get the same rows,
        goals and donors. A process that was seeded after the fork draws its own.
        """
        origin = self._origin
        if origin.pid == os.getpid():
            return
        self._origin = _Process()
        if self.generator is not None:
            remedy = "use set_generator, and set_rng of the buffer, in each process"
        elif origin.seed == torch.initial_seed():
            remedy = "call torch.manual_seed(seed + rank) in each process"
        else:
            return
        warnings.warn(
            f"{type(self).__name__} draws in a process that was forked, with the "
            f"random numbers of its parent, as its siblings would: {remedy}",
            stacklevel=2,
        )

    def set_generator(self, generator: torch.Generator | None) -> None:
        """Sets the source of randomness.

        Args:
            generator (torch.Generator, optional): ``None`` for torch's default one.
        """
        self.generator = generator
        self._origin = _Process()

    def get_extra_state(self) -> dict[str, torch.Tensor]:
        """Returns the state of the generator, for ``state_dict``."""
        generator = self.generator
        return {} if generator is None else {"generator": generator.get_state()}

    def set_extra_state(self, state: dict[str, torch.Tensor]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        if self.generator is not None and "generator" in state:
            self.generator.set_state(state["generator"].cpu())


class _Process:
    """The process that a transform was created in, and its seed."""

    def __init__(self) -> None:
        self.pid, self.seed = os.getpid(), torch.initial_seed()

    def __reduce__(self) -> tuple[Any, ...]:
        return _Process, ()  # a copy belongs to the process that makes it
