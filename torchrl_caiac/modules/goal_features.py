"""What goal-conditioned networks read: states, goals and the way between them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key

from torchrl_caiac._layout_reading import check_width
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.lmp import Standardize, _moments

__all__ = ["GoalFeatures"]


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> list[torch.Tensor]:
    """The leaves of some keys, all of which must be there.

    Args:
        tensordict (TensorDictBase): where to read.
        keys (sequence of NestedKey): the leaves.

    Returns:
        list of torch.Tensor: the leaves, in the order of the keys.

    Raises:
        KeyError: a leaf is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> read(TensorDict({"a": 1}), ["a"])
        [tensor(1)]
    """
    values = [tensordict.get(key, None) for key in keys]
    for key, value in zip(keys, values, strict=True):
        if value is None:
            found = sorted(map(str, tensordict.keys(True, True)))
            raise KeyError(
                f"{key!r} is read, which the data lacks: write it, or name the leaf "
                f"that holds it; the data has {found}"
            )
    return values


class GoalFeatures(TensorDictModuleBase):
    """Joins a state and a goal, and adds where the objects are to go.

    The ``F`` features are, in this order, the ``W`` columns of all entities
    (:meth:`EntityLayout.read`; columns that no entity owns are left out), the ``G``
    columns of the desired goal and, if ``relative``, for each goal column what is
    achieved minus the reference's position (if there is a reference) and the goal
    minus what is achieved. The relative features are computed here, inside the
    network, and so from the state that a swap has left: stored ones would still
    describe the entity that was swapped out.

    All features are standardized by fixed statistics that :meth:`fit_statistics`
    takes from data; until then they pass unchanged. Fit them before networks are
    made of the features, which copy them.

    Args:
        layout (EntityLayout): a flat layout with ``goal`` and ``achieved`` columns.

    Keyword Args:
        relative (bool): whether to add the relative features. Defaults to ``True``.
        reference (str, optional): the entity that the positions are taken relative to
            (the gripper): its first columns, as many as an entity has goal columns.
            ``None``, the default, leaves these features out.
        floor (float): the smallest deviation to divide by, in the units of the data.
            Defaults to 0.02.
        out_key (NestedKey): where the features are written, ``[*B, F]``. Defaults to
            ``"features"``.

    Raises:
        ValueError: the layout is nested or says nothing of goals, the reference does
            not fit it, or the floor is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import GoalFeatures
        >>> layout = EntityLayout(
        ...     {"gripper": [0], "cube": [1, 2]},
        ...     goal={"cube": [0]},
        ...     achieved={"cube": [1]},
        ...     fixed=("gripper",),
        ... )
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.tensor([[1.0, 3.0, 0.5]]),
        ...         "desired_goal": torch.tensor([[10.0]]),
        ...     },
        ...     [1],
        ... )
        >>> GoalFeatures(layout, reference="gripper")(td)["features"]
        tensor([[ 1.0000, 3.0000, 0.5000, 10.0000, 2.0000, 7.0000]])
    """

    def __init__(
        self,
        layout: EntityLayout,
        *,
        relative: bool = True,
        reference: str | None = None,
        floor: float = 0.02,
        out_key: NestedKey = "features",
    ) -> None:
        super().__init__()
        if not layout.is_flat or not layout.achieved:
            raise ValueError(
                "GoalFeatures needs a flat layout that says which observation columns "
                "the goal mirrors: give EntityLayout(..., goal=..., achieved=...)"
            )
        if not 0.0 < floor < float("inf"):
            raise ValueError(f"floor must be positive and finite, got {floor!r}")
        if reference is not None and not relative:
            raise ValueError(
                f"reference={reference!r} is used by relative features only: leave it "
                "out, or give relative=True"
            )
        self.layout = layout
        self.relative = relative
        self.reference = reference
        self._columns: dict[str, list[int]] = {
            "state": [c for name in layout.names for c in layout.columns[name]]
        }
        if relative:
            mirrored = _by_goal_column(layout, dict(layout.achieved))
            self._columns["achieved"] = mirrored
        if reference is not None:
            self._columns["reference"] = _reference_columns(layout, reference)
        self._whole = self._columns["state"] == list(range(self.state_dim))
        self._tensors: dict[tuple[str, torch.device], torch.Tensor] = {}
        blocks = 1 + relative + (reference is not None)
        self.width = self.state_dim + layout.goal_width * blocks
        self.standardize = Standardize(self.width, floor)
        assert layout.observation_key is not None
        assert layout.desired_goal_key is not None
        self.observation_key: NestedKey = layout.observation_key
        self.desired_goal_key: NestedKey = layout.desired_goal_key
        self.in_keys = [self.observation_key, self.desired_goal_key]
        self.out_keys = [unravel_key(out_key)]

    @property
    def state_dim(self) -> int:
        """The number ``W`` of the state's columns among the features."""
        return len(self._columns["state"])

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the standardized features.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.

        Returns:
            TensorDictBase: the same, with the features ``[*B, F]`` set.

        Raises:
            KeyError: the state or the goal is missing.
            ValueError: one of them has the wrong width.
        """
        features = self.forward_tensors(*read(tensordict, self.in_keys))
        return tensordict.set(self.out_keys[0], features)

    def forward_tensors(
        self,
        observation: torch.Tensor,
        goal: torch.Tensor,
        params: TensorDictBase | None = None,
    ) -> torch.Tensor:
        """The standardized features of tensors.

        Args:
            observation (torch.Tensor): ``[*B, D]``.
            goal (torch.Tensor): ``[*B, G]``.
            params (TensorDictBase, optional): statistics to use instead of the
                module's, such as those of ``C`` modules, stacked. ``*B`` begins with
                ``C`` then.

        Returns:
            torch.Tensor: ``[*B, F]``, in the dtype of the statistics.

        Raises:
            ValueError: a tensor has the wrong width.
        """
        features = self._join(observation, goal)
        if params is None:
            return self.standardize(features)
        mean, std = (params.get(("standardize", name)) for name in ("mean", "std"))
        if mean.ndim > 1:
            shape = (len(mean), *[1] * (features.ndim - 2), -1)
            mean, std = mean.reshape(shape), std.reshape(shape)
        return ((features - mean) / std).to(mean.dtype)

    def fit_statistics(self, tensordict: TensorDictBase) -> GoalFeatures:
        """Takes mean and deviation of every feature from data, in float64.

        Args:
            tensordict (TensorDictBase): rows ``[*B]`` with the goals that the networks
                will see, such as a large sample of the relabelling replay buffer.

        Returns:
            GoalFeatures: the module itself.

        Raises:
            KeyError: the state or the goal is missing.
            ValueError: one of them has the wrong width, is empty, or is not finite.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac import EntityLayout
            >>> from torchrl_caiac.modules import GoalFeatures
            >>> layout = EntityLayout(
            ...     {"cube": [0]}, goal={"cube": [0]}, achieved={"cube": [0]}
            ... )
            >>> td = TensorDict(
            ...     {
            ...         "observation": torch.tensor([[0.0], [4.0]]),
            ...         "desired_goal": torch.tensor([[5.0], [5.0]]),
            ...     },
            ...     [2],
            ... )
            >>> GoalFeatures(layout).fit_statistics(td)(td)["features"]
            tensor([[-1., 0., 1.],
                    [ 1., 0., -1.]])
        """
        observation, goal = read(tensordict, self.in_keys)
        for key, value in zip(self.in_keys, (observation, goal), strict=True):
            if not value.isfinite().all():
                raise ValueError(
                    f"{key!r} holds {int((~value.isfinite()).sum())} non-finite values "
                    f"in a batch of shape {list(value.shape)}: remove or repair them"
                )
        self.standardize.set(*_moments(self._join(observation, goal), "features", None))
        return self

    def _join(self, observation: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        layout = self.layout
        check_width(layout, observation.shape[-1], self.observation_key)
        if goal.shape[-1] != layout.goal_width:
            raise ValueError(
                f"{self.desired_goal_key!r} has {goal.shape[-1]} columns, but the "
                f"layout's goal has {layout.goal_width}: correct `goal`, or the data"
            )
        whole = self._whole and observation.shape[-1] == self.state_dim
        parts = [observation if whole else self._pick(observation, "state"), goal]
        if self.relative:
            achieved = self._pick(observation, "achieved")
            if self.reference is not None:
                parts.append(achieved - self._pick(observation, "reference"))
            parts.append(goal - achieved)
        return torch.cat(parts, -1)

    def _pick(self, observation: torch.Tensor, what: str) -> torch.Tensor:
        # Kept per device and not as buffers, of which a loss makes one per critic.
        device = observation.device
        if (what, device) not in self._tensors:
            index = torch.tensor(self._columns[what], device=device)
            self._tensors[what, device] = index
        return observation.index_select(-1, self._tensors[what, device])


def _by_goal_column(
    layout: EntityLayout, columns: dict[str, tuple[int, ...]]
) -> list[int]:
    """The observation columns of all entities in the order of the goal's columns."""
    pairs = [
        pair
        for name, goal in layout.goal.items()
        for pair in zip(goal, columns[name], strict=True)
    ]
    return [column for _, column in sorted(pairs)]


def _reference_columns(layout: EntityLayout, reference: str) -> list[int]:
    if reference not in layout.names:
        raise ValueError(
            f"reference names {reference!r}, which is no entity of this layout: it has "
            f"{list(layout.names)}"
        )
    position = layout.columns[reference]
    columns = {}
    for name, goal in layout.goal.items():
        if len(goal) > len(position):
            raise ValueError(
                f"entity {name!r} has {len(goal)} goal columns, but the reference "
                f"{reference!r} has only {len(position)} columns to take its position "
                "from: name another reference, or None"
            )
        columns[name] = position[: len(goal)]
    return _by_goal_column(layout, columns)
