"""The policy of Latent Motor Plans for (batched) environments."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from torchrl_caiac._keys import join
from torchrl_caiac._random import draw_numbers
from torchrl_caiac.modules.lmp import LMPModel, read_leaf
from torchrl_caiac.modules.lmp_parts import gaussian_plan, plan_is_sampled

__all__ = ["LMPActor"]


class LMPActor(TensorDictModuleBase):
    """Draws a plan from the prior every κ steps and plays its actions.

    A window starts in an environment (a row of the batch) when κ actions have been
    played since the last start, or when ``"is_init"`` is true. A plan is then drawn
    from p(z | s, g). The open-loop decoder turns it into κ actions at once, one for
    each step; the closed-loop decoder gives an action for the plan and each new state.
    Environments are independent: one may reset in the middle of its window while the
    others continue theirs.

    Plan, actions and step counter are carried in the tensordict, as the hidden states
    of TorchRL's recurrent modules are: the actor reads them at the root and writes them
    under ``"next"``, and the environment steps them. The specs of the environment must
    include these leaves: append :meth:`make_tensordict_primer` to it, and
    :class:`~torchrl.envs.InitTracker` for ``"is_init"``.

    Args:
        model (LMPModel): the model with prior and decoder.

    Keyword Args:
        sample (bool): whether plans are sampled (as in the paper) or the prior's mean,
            if no exploration type is set. An exploration type takes precedence:
            ``ExplorationType.RANDOM`` samples, any other plays the mean. Defaults to
            ``True``.
        generator (torch.Generator, optional): the generator of the noise, on any
            device. Defaults to the global one.
        observation_key (NestedKey, optional): the states. Defaults to the model's.
        goal_key (NestedKey, optional): the goals. Defaults to the model's.
        action_key (NestedKey, optional): where the action is written. Defaults to the
            model's.
        is_init_key (NestedKey): the flag of the first step of an episode. Defaults to
            ``"is_init"``.
        plan_key (NestedKey): where the plan is carried. Defaults to
            ``("lmp", "plan")``.
        actions_key (NestedKey): where the decoded actions are carried (open loop).
            Defaults to ``("lmp", "actions")``.
        step_key (NestedKey): where the number of steps since the start of the window
            is carried. Defaults to ``("lmp", "step")``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.modules import LMPActor, LMPModel
        >>> model = LMPModel(observation_dim=5, goal_dim=2, action_dim=3, window=10)
        >>> actor = LMPActor(model)
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.zeros(4, 5),
        ...         "desired_goal": torch.zeros(4, 2),
        ...         "is_init": torch.ones(4, 1, dtype=torch.bool),
        ...     },
        ...     batch_size=[4],
        ... )
        >>> td = actor(td)
        >>> td["action"].shape
        torch.Size([4, 3])
        >>> td["next", "lmp", "step"].flatten()
        tensor([1, 1, 1, 1])
    """

    def __init__(
        self,
        model: LMPModel,
        *,
        sample: bool = True,
        generator: torch.Generator | None = None,
        observation_key: NestedKey | None = None,
        goal_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
        is_init_key: NestedKey = "is_init",
        plan_key: NestedKey = ("lmp", "plan"),
        actions_key: NestedKey = ("lmp", "actions"),
        step_key: NestedKey = ("lmp", "step"),
    ) -> None:
        super().__init__()
        self.model = model
        self.sample = sample
        self.generator = generator
        self.observation_key = (
            model.observation_key if observation_key is None else observation_key
        )
        self.goal_key = model.goal_key if goal_key is None else goal_key
        self.action_key = model.action_key if action_key is None else action_key
        self.is_init_key = is_init_key
        self.plan_key = plan_key
        self.actions_key = actions_key
        self.step_key = step_key
        self.state_keys: list[NestedKey] = [plan_key, step_key]
        if model.decoder_kind == "open_loop":
            self.state_keys.insert(1, actions_key)
        self.in_keys = [
            self.observation_key,
            self.goal_key,
            is_init_key,
            *self.state_keys,
        ]
        self.out_keys = [self.action_key, *map(_next, self.state_keys)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Chooses one action for each environment.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]``, goals ``[*B, G]``,
                ``"is_init"`` ``[*B, 1]`` (optional if the primer is appended) and the
                leaves that the actor carries.

        Returns:
            TensorDictBase: the same tensordict with the action ``[*B, A]`` and, under
            ``"next"``, the carried leaves.

        Raises:
            KeyError: a leaf is missing. The carried leaves may be missing if
                ``"is_init"`` is true everywhere.
            ValueError: a leaf has the wrong shape, or the state or the goal at the
                start of a window is not finite.
        """
        model = self.model
        observation = read_leaf(tensordict, self.observation_key, model.observation_dim)
        batch = observation.shape[:-1]
        plan, actions, step = self._read_state(tensordict, observation)
        start = step == 0
        if start.any():
            goal = read_leaf(tensordict, self.goal_key, model.goal_dim)
            loc, log_std = self._prior(observation, goal, start)
            noise = self.draw_noise(loc)
            new_plan = loc if noise is None else gaussian_plan(loc, log_std, noise)
            plan = torch.where(start, new_plan, plan)
            if actions is not None:
                new_actions = self._decode(new_plan, observation)
                actions = torch.where(start.unsqueeze(-1), new_actions, actions)

        if actions is None:
            action = self._decode(plan, observation)
        else:
            index = step.unsqueeze(-1)
            action = actions.take_along_dim(index, dim=-2).squeeze(-2)
            tensordict.set(_next(self.actions_key), actions)
        tensordict.set(self.action_key, action.reshape(*batch, model.action_dim))
        tensordict.set(_next(self.plan_key), plan)
        tensordict.set(_next(self.step_key), (step + 1) % model.window)
        return tensordict

    def draw_noise(self, loc: Tensor) -> Tensor | None:
        """Draws the noise of new plans.

        Args:
            loc (torch.Tensor): the mean of the plans, ``[*B, P]``.

        Returns:
            torch.Tensor, optional: standard normal noise ``[*B, P]``, also for rows in
            which no window starts; ``None`` if the mean of the plan is played.
        """
        if not plan_is_sampled(self.sample):
            return None
        return draw_numbers(
            torch.randn,
            loc.shape,
            generator=self.generator,
            dtype=loc.dtype,
            device=loc.device,
        )

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns the transform with which an environment carries the actor's state.

        Returns:
            TensorDictPrimer: the transform. It sets plan, actions and step counter to
            zero at a reset, which starts a window.

        Examples:
            >>> from torchrl_caiac.modules import LMPActor, LMPModel
            >>> actor = LMPActor(LMPModel(5, 2, 3, window=10))
            >>> primer = actor.make_tensordict_primer()
            >>> primer.primers["lmp", "actions"].shape
            torch.Size([10, 3])
        """
        model = self.model
        dtype = model.observation_norm.dtype
        specs = {
            self.plan_key: Unbounded(shape=(model.plan_dim,), dtype=dtype),
            self.step_key: Unbounded(shape=(1,), dtype=torch.int64),
        }
        if model.decoder_kind == "open_loop":
            shape = (model.window, model.action_dim)
            specs[self.actions_key] = Unbounded(shape=shape, dtype=dtype)
        return TensorDictPrimer(specs, expand_specs=True)

    def _read_state(
        self, tensordict: TensorDictBase, observation: Tensor
    ) -> tuple[Tensor, Tensor | None, Tensor]:
        """Returns the carried leaves; the step is zero where an episode starts."""
        model = self.model
        batch = observation.shape[:-1]
        dtype = model.observation_norm.dtype
        is_init = tensordict.get(self.is_init_key, None)
        if is_init is not None:
            if is_init.numel() != batch.numel():
                raise ValueError(
                    f"{self.is_init_key!r} has the shape {list(is_init.shape)}, "
                    f"expected {[*batch, 1]}: one flag for each environment"
                )
            is_init = is_init.reshape(*batch, 1).bool()
        shapes: dict[NestedKey, tuple[int, ...]] = {
            self.plan_key: (model.plan_dim,),
            self.step_key: (1,),
        }
        if model.decoder_kind == "open_loop":
            shapes[self.actions_key] = (model.window, model.action_dim)
        state: dict[NestedKey, Tensor] = {}
        for key, shape in shapes.items():
            value = tensordict.get(key, None)
            if value is None:
                if is_init is None or not is_init.all():
                    raise KeyError(
                        f"{key!r} is missing, and {self.is_init_key!r} is not true "
                        "everywhere: append actor.make_tensordict_primer() to the "
                        "environment, or move the leaves that the actor writes under "
                        "'next' to the root"
                    )
                counter = key == self.step_key
                value = observation.new_zeros(
                    (*batch, *shape), dtype=torch.int64 if counter else dtype
                )
            if value.shape != (*batch, *shape):
                raise ValueError(
                    f"{key!r} has the shape {list(value.shape)}, expected "
                    f"{[*batch, *shape]}: take the primer from this actor"
                )
            state[key] = value
        step = state[self.step_key] % model.window
        if is_init is not None:
            step = step.masked_fill(is_init, 0)
        return state[self.plan_key], state.get(self.actions_key), step

    def _prior(
        self, observation: Tensor, goal: Tensor, start: Tensor
    ) -> tuple[Tensor, Tensor]:
        model = self.model
        if goal.shape[:-1] != observation.shape[:-1]:
            raise ValueError(
                f"{self.goal_key!r} has the shape {list(goal.shape)}, but "
                f"{self.observation_key!r} has {list(observation.shape)}: all "
                "dimensions but the last must agree"
            )
        for key, value in ((self.observation_key, observation), (self.goal_key, goal)):
            if not (value.isfinite() | ~start).all():
                raise ValueError(
                    f"{key!r} is not finite at the start of a window: check the "
                    "environment"
                )
        td = TensorDict(batch_size=observation.shape[:-1])
        td.set(model.observation_key, observation)
        td.set(model.goal_key, goal)
        td = model.prior(td)
        return td.get(model.prior_loc_key), td.get(model.prior_log_std_key)

    def _decode(self, plan: Tensor, observation: Tensor) -> Tensor:
        model = self.model
        td = TensorDict(batch_size=plan.shape[:-1])
        td.set(model.plan_key, plan)
        td.set(model.observation_key, observation)
        actions: Tensor = model.decoder(td).get(model.actions_key)
        return actions


def _next(key: NestedKey) -> NestedKey:
    """Returns the key under ``"next"``."""
    return join("next", key)
