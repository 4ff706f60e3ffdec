"""Transforms that are for replay buffers only."""

from __future__ import annotations

import os
import warnings
from multiprocessing.reduction import ForkingPickler
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
    that of the buffer's own generator is. A copy in another process goes on from this
    state.

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
        """Warns, once, in a process that draws the numbers of its parent.

        That is one that was forked, or got a transform with a generator. So do its
        siblings, and TorchRL's samplers: all of them would get the same rows, goals and
        donors. A process that was seeded after the fork draws its own.
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
            f"{type(self).__name__} draws the random numbers of the process that made "
            f"it, as it does in all processes that were forked or sent it: {remedy}",
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

    def __init__(self, pid: int | None = None, seed: int | None = None) -> None:
        self.pid = os.getpid() if pid is None else pid
        self.seed = torch.initial_seed() if seed is None else seed

    def __reduce__(self) -> tuple[Any, ...]:
        return _Process, ()  # a copy belongs to the process that makes it


def _reduce_process(process: _Process) -> tuple[Any, ...]:
    # To a process of multiprocessing, which may have siblings.
    return _Process, (process.pid, process.seed)


def _reduce_generator(generator: torch.Generator) -> tuple[Any, ...]:
    # As bytes. The tensor, torch's own way, would be in shared memory that is freed
    # before a process that is spawned can open it.
    state = generator.get_state().numpy().tobytes()
    return _generator, (str(generator.device), state)


def _generator(device: str, state: bytes) -> torch.Generator:
    made = torch.Generator(device)
    return made.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))


ForkingPickler.register(_Process, _reduce_process)
ForkingPickler.register(torch.Generator, _reduce_generator)
