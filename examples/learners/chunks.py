"""A policy that plays the first actions of a chunk, then asks for another one."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    TensorDictModuleBase,
    set_interaction_type,
)
from tensordict.utils import NestedKey
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

__all__ = ["ChunkActor"]

_CHUNK: NestedKey = ("chunk", "actions")
_STEP: NestedKey = ("chunk", "step")


class ChunkActor(TensorDictModuleBase):
    """Plays ``execute`` actions of each chunk of a policy.

    TorchRL's :class:`~torchrl.modules.MultiStepActorWrapper` keeps its chunk at the
    root of the tensordict. This one writes it under ``"next"``, as recurrent policies
    and :class:`~torchrl_caiac.modules.LMPActor` do, so that all loops that play
    episodes carry it.

    Args:
        policy (TensorDictModuleBase): writes ``"chunk"``, ``[*B, size * action_dim]``.

    Keyword Args:
        size (int): the number of actions in a chunk.
        execute (int): how many of them are played, at most ``size``.
        action_dim (int): the size of an action; actions are in [-1, 1].
        sample (bool): whether the policy draws chunks at random, with torch's default
            generator, or returns its deterministic one.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        size: int,
        execute: int,
        action_dim: int,
        sample: bool = False,
    ) -> None:
        super().__init__()
        if not 1 <= execute <= size:
            raise ValueError(
                f"execute is {execute}, expected 1 to {size}, the actions in a chunk"
            )
        self.policy = policy
        self.shape = (size, action_dim)
        self.execute = execute
        self.interaction = (
            InteractionType.RANDOM if sample else InteractionType.DETERMINISTIC
        )
        self.in_keys = [*policy.in_keys, "is_init", _CHUNK, _STEP]
        self.out_keys = ["action", ("next", *_CHUNK), ("next", *_STEP)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes an action, and under ``"next"`` the chunk and the step in it.

        Args:
            tensordict (TensorDictBase): the policy's inputs ``[*B]``, ``"is_init"``
                ``[*B, 1]`` and, except at the start, what the last call wrote.
        """
        batch = tensordict.batch_size
        chunk, step = (tensordict.get(key, None) for key in (_CHUNK, _STEP))
        started = tensordict.get("is_init", None)
        if chunk is None or step is None:
            if started is None or not started.all():
                raise KeyError(
                    f"{_CHUNK!r} is missing, and 'is_init' is not true everywhere: "
                    "append actor.make_tensordict_primer() to the environment, or move "
                    "the leaves that the actor writes under 'next' to the root"
                )
            chunk = torch.zeros(*batch, *self.shape)
            step = torch.zeros(*batch, 1, dtype=torch.int64)
        elif started is not None:
            step = step.masked_fill(started.reshape(step.shape), 0)
        new = (step == 0).squeeze(-1)
        if new.any():
            inputs = tensordict.select(*self.policy.in_keys)[new]
            with set_interaction_type(self.interaction):
                planned = self.policy(inputs)["chunk"].clamp(-1.0, 1.0)
            chunk = chunk.clone()
            chunk[new] = planned.unflatten(-1, self.shape).to(chunk.dtype)
        action = chunk.take_along_dim(step.unsqueeze(-1), -2).squeeze(-2)
        tensordict.set("action", action)
        tensordict.set(("next", *_CHUNK), chunk)
        tensordict.set(("next", *_STEP), (step + 1) % self.execute)
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns the transform with which an environment carries the chunk."""
        specs = {
            _CHUNK: Unbounded(shape=self.shape),
            _STEP: Unbounded(shape=(1,), dtype=torch.int64),
        }
        return TensorDictPrimer(specs, expand_specs=True)
