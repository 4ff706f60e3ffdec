"""A replay buffer whose parts are made in the process that contains it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

import torch
from torchrl.data import (
    ImmutableDatasetWriter,
    ReplayBuffer,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import Storage
from torchrl.envs.transforms import Compose, Transform

from torchrl_caiac._buffer_transform import RandomTransform
from torchrl_caiac._torchrl import without_generator
from torchrl_caiac.data import load_transitions
from torchrl_caiac.data.offline_buffer import offline_storage
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.goals.future import FutureGoal
from torchrl_caiac.transforms.goals.window import WindowGoal

__all__ = ["CAIACReplayBuffer"]

Donors = str | Path | Callable[[], ReplayBuffer | TensorStorage]

_OWN = "self"
_ALONE = (
    "a buffer with prefetch draws batches in threads, which belong to the process that "
    "made it: leave out prefetch, or make the buffer in the process that samples"
)
_TAKEN = ("storage", "transform", "transform_factory", "sample_unit", "generator")


class CAIACReplayBuffer(TensorDictReplayBuffer):
    """A replay buffer that makes its storage, goals and augmentation itself.

    A goal transform is both a transform and the sample unit of its buffer, and donors
    are often the buffer's own rows. Such parts cannot be sent to another process one by
    one. So the arguments of this buffer say how to make them, and the process that
    contains the buffer does: this one, or an actor of Ray::

        rb = CAIACReplayBuffer("data", ..., service_backend="ray")
        rb = RayReplayBuffer("data", ..., replay_buffer_cls=CAIACReplayBuffer)

    Both give a :class:`~torchrl.data.RayReplayBuffer`, whose batches are augmented in
    the actor. With Ray, all arguments have to be picklable: use functions of modules
    and :func:`functools.partial`.

    With the same ``seed``, the buffer returns the same batches here and in an actor,
    unless ``prefetch`` is above 1: then several threads draw from one generator.

    Args:
        data (str, Path or callable): the folder of transitions, opened with
            :func:`~torchrl_caiac.data.load_transitions`, which cannot be extended; or a
            function that makes the storage, such as ``partial(LazyMemmapStorage, n)``.

    Keyword Args:
        augmentation (callable, optional): makes the augmentation, such as
            ``partial(CAIACTransform, layout, threshold=0.05)``. Defaults to ``None``:
            none.
        goals (callable, optional): makes the goal transform, such as
            ``partial(HindsightGoal, layout, reward_fn)``. It becomes the sample unit
            and a transform: a :class:`~torchrl_caiac.transforms.WindowGoal` before the
            augmentation, any other after it. Defaults to ``None``: none.
        donors (str, Path or callable, optional): the augmentation's donors: a folder, a
            function that makes a buffer or storage, or ``"self"`` for the rows of this
            buffer; a folder of this name is ``"./self"``. A ``WindowGoal`` draws the
            goals of donor windows. Defaults to ``None``: donors are in the batch.
        transforms (sequence of callable): make further transforms, which follow in this
            order. Defaults to none.
        seed (int, optional): the seed of one generator for rows, goals and
            augmentation; transforms with a generator of their own keep it. Defaults to
            ``None``: torch's default generator.
        **kwargs (Any): further arguments of
            :class:`~torchrl.data.TensorDictReplayBuffer`, such as ``batch_size``,
            ``prefetch``, and functions that make the ``sampler`` and the ``writer``.

    Raises:
        TypeError: an argument is not callable, or makes something else than its name
            says.
        ValueError: there are donors, but no augmentation.

    Examples:
        >>> from functools import partial
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac import CAIACTransform, EntityLayout
        >>> from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
        >>> layout = EntityLayout({"arm": [0], "cup": [1]})
        >>> rb = CAIACReplayBuffer(
        ...     partial(LazyTensorStorage, 100),
        ...     augmentation=partial(CAIACTransform, layout, threshold=0.05),
        ...     batch_size=4,
        ...     seed=0,
        ... )
        >>> rows = TensorDict({
        ...     "observation": torch.rand(8, 2),
        ...     "next": {"observation": torch.rand(8, 2)},
        ...     "caiac": {"score": torch.zeros(8, 2)}}, [8])
        >>> _ = rb.extend(rows)
        >>> int(rb.sample()["caiac", "counterfactual"].sum())
        2
    """

    def __init__(
        self,
        data: str | Path | Callable[[], Storage],
        *,
        augmentation: Callable[..., CounterfactualTransform] | None = None,
        goals: Callable[[], FutureGoal] | None = None,
        donors: Donors | None = None,
        transforms: Sequence[Callable[[], Transform]] = (),
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        taken = [name for name in _TAKEN if kwargs.get(name) is not None]
        if taken:
            raise TypeError(
                f"CAIACReplayBuffer makes what {taken} would give: pass data, "
                "augmentation, goals, transforms and seed instead"
            )
        for name in _TAKEN:
            kwargs.pop(name, None)
        if donors is not None and augmentation is None:
            raise ValueError(
                f"donors is {donors!r}, but there is no augmentation that draws them: "
                "pass augmentation, or leave out donors"
            )
        storage = _storage(data)
        if isinstance(data, (str, Path)):
            kwargs.setdefault("writer", ImmutableDatasetWriter)
        goal = None if goals is None else _made("goals", goals, FutureGoal)
        parts: list[Transform] = []
        if augmentation is not None:
            parts.append(_augmentation(augmentation, donors, storage, goal))
        if goal is not None:
            parts.insert(0 if isinstance(goal, WindowGoal) else len(parts), goal)
        parts += [
            _made(f"transforms[{i}]", f, Transform) for i, f in enumerate(transforms)
        ]
        self._pid, self._prefetches = os.getpid(), bool(kwargs.get("prefetch"))
        self._drawing = [
            part
            for part in parts
            if isinstance(part, RandomTransform) and part.generator is None
        ]
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        super().__init__(
            storage=storage,
            sample_unit=goal,
            transform=Compose(*parts),
            generator=generator,
            **kwargs,
        )

    def set_rng(self, generator: torch.Generator | None) -> None:
        """Sets the source of randomness of rows, goals and augmentation.

        Args:
            generator (torch.Generator, optional): ``None`` for torch's default one.
                Transforms that were made with a generator of their own keep it.
        """
        super().set_rng(generator)
        self._generator = generator
        for part in self._drawing:
            part.set_generator(generator)

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        """Samples a batch, see :meth:`torchrl.data.TensorDictReplayBuffer.sample`.

        Raises:
            RuntimeError: the buffer has ``prefetch``, and this process was forked.
        """
        if self._pid != os.getpid() and self._prefetches:
            raise RuntimeError(_ALONE)
        return super().sample(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        if self._prefetches and get_spawning_popen() is not None:
            raise RuntimeError(_ALONE)
        # The generator is sent by this class: TorchRL would send its state in a tensor,
        # which a process that is spawned cannot open, and not to the transforms.
        return without_generator(super().__getstate__())

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._pid = os.getpid()
        super().set_rng(self._generator)

    def score(self, estimator: Any, **kwargs: Any) -> None:
        """Scores the rows, in the process that contains the buffer.

        With Ray: ``rb.client().score(estimator)``.

        Args:
            estimator (callable): see :func:`~torchrl_caiac.influence.score_buffer`.
            **kwargs (Any): its further arguments.
        """
        score_buffer(self, estimator, **kwargs)


def _made(name: str, make: Any, kind: type) -> Any:
    """Calls a function that makes a part of the buffer."""
    if isinstance(make, kind) or not callable(make):
        raise TypeError(
            f"{name} must be a function that makes a {kind.__name__}, got a "
            f"{type(make).__name__}: pass partial({kind.__name__}, ...), so that it is "
            "made in the process that contains the buffer"
        )
    part = make()
    if not isinstance(part, kind):
        raise TypeError(f"{name} made a {type(part).__name__}, not a {kind.__name__}")
    return part


def _storage(data: Any) -> TensorStorage:
    if isinstance(data, (str, Path)):
        return offline_storage(load_transitions(data))
    storage: TensorStorage = _made("data", data, TensorStorage)
    return storage


def _augmentation(
    make: Callable[..., CounterfactualTransform],
    donors: Any,
    storage: TensorStorage,
    goal: FutureGoal | None,
) -> CounterfactualTransform:
    arguments: dict[str, Any] = {}
    if donors == _OWN and isinstance(donors, str):
        arguments["donors"] = storage
    elif isinstance(donors, (str, Path)):
        arguments["donors"] = _storage(donors)
    elif donors is not None:
        kinds: Any = (ReplayBuffer, TensorStorage)
        if isinstance(donors, kinds) or not callable(donors):
            raise TypeError(
                "donors must be a folder, 'self', or a function that makes a "
                f"ReplayBuffer or its storage, got a {type(donors).__name__}"
            )
        arguments["donors"] = donors()
    if arguments and isinstance(goal, WindowGoal):
        arguments["goals"] = goal

    def made() -> CounterfactualTransform:
        return make(**arguments)

    if isinstance(make, Transform) or not callable(make):
        made = make
    part: CounterfactualTransform = _made("augmentation", made, CounterfactualTransform)
    return part
