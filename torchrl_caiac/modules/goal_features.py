"""The input of goal-conditioned networks: states, goals and their differences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey

from torchrl_caiac._keys import as_key, floating, get_leaf
from torchrl_caiac._layout_reading import check_width
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.running_norm import RunningNorm, gather_statistics

__all__ = ["GoalFeatures"]


def read_leaves(
    tensordict: TensorDictBase, keys: Sequence[NestedKey]
) -> list[torch.Tensor]:
    """Reads leaves, all of which must be present.

    Args:
        tensordict (TensorDictBase): the data.
        keys (sequence of NestedKey): the leaves.

    Returns:
        list of torch.Tensor: the leaves, in the order of the keys.

    Raises:
        KeyError: a leaf is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.modules.goal_features import read_leaves
        >>> read_leaves(TensorDict({"a": 1}), ["a"])
        [tensor(1)]
    """
    remedy = "add it, or give the key of its leaf"
    return [get_leaf(tensordict, key, "the data lack", remedy) for key in keys]


class GoalFeatures(TensorDictModuleBase):
    """Concatenates a state, a goal and, optionally, the differences between them.

    The ``F`` features are, in this order, the ``W`` columns of all entities
    (:meth:`~torchrl_caiac.EntityLayout.read`; columns that no entity owns are left
    out), the ``G`` columns of the desired goal and, if ``relative``, for each goal
    column the achieved goal minus the position of the reference (if there is one), and
    the desired goal minus the achieved one. The relative features are computed from the
    state after a swap. Stored relative features would still describe the entity that
    was swapped out.

    All features are normalised by fixed statistics, which :meth:`fit_statistics`
    computes from data; until then they are returned unchanged. Call it before networks
    are created with this module: networks copy it.

    Args:
        layout (EntityLayout): a flat layout with ``goal`` and ``achieved`` columns.

    Keyword Args:
        relative (bool): whether to add the relative features. Defaults to ``True``.
        reference (str, optional): the entity to take positions relative to, such as
            the gripper. Defaults to ``None``, which leaves these features out.
        reference_columns (iterable of int, optional): the observation columns that say
            where the reference is, in the order of the goal columns of each entity.
            Defaults to the layout's ``positions`` of the reference or, if there are
            none, to its first columns, as many as an entity has goal columns.
        floor (float): the smallest standard deviation to divide by, in the units of
            the data. Defaults to ``0.02``.
        out_key (NestedKey): where the features are written, ``[*B, F]``. Defaults to
            ``"features"``.

    Attributes:
        norm (RunningNorm): the normalisation of the features.

    Raises:
        ValueError: the layout is nested or has no goals; the reference or its columns
            do not fit it; an entity has another number of goal columns than the
            reference has positions; the floor is not positive.

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
        reference_columns: Iterable[int] | None = None,
        floor: float = 0.02,
        out_key: NestedKey = "features",
    ) -> None:
        super().__init__()
        if not layout.is_flat or not layout.achieved:
            raise ValueError(
                "GoalFeatures needs a flat layout with the observation columns that "
                "the goal describes: give EntityLayout(..., goal=..., achieved=...)"
            )
        if not 0.0 < floor < float("inf"):
            raise ValueError(f"floor must be positive and finite, got {floor!r}")
        if reference is not None and not relative:
            raise ValueError(
                f"reference={reference!r} is used by relative features only: leave it "
                "out, or give relative=True"
            )
        if reference_columns is not None and reference is None:
            raise ValueError(
                "reference_columns are columns of the reference: name it, "
                "reference=..., or leave them out"
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
            self._columns["reference"] = _reference_columns(
                layout, reference, reference_columns
            )
        self._whole = self._columns["state"] == list(range(self.state_dim))
        self._tensors: dict[tuple[str, torch.device], torch.Tensor] = {}
        blocks = 1 + relative + (reference is not None)
        self.width = self.state_dim + layout.goal_width * blocks
        self.norm = RunningNorm(self.width, floor=floor, frozen=True)
        assert layout.observation_key is not None
        assert layout.desired_goal_key is not None
        self.observation_key: NestedKey = layout.observation_key
        self.desired_goal_key: NestedKey = layout.desired_goal_key
        self.in_keys = [self.observation_key, self.desired_goal_key]
        self.out_keys = [as_key(out_key)]

    @property
    def state_dim(self) -> int:
        """The number ``W`` of the features that are columns of the state."""
        return len(self._columns["state"])

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the normalised features.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.

        Returns:
            TensorDictBase: the same tensordict, with the features ``[*B, F]``.

        Raises:
            KeyError: the state or the goal is missing.
            ValueError: one of them has the wrong width.
        """
        features = self.forward_tensors(*read_leaves(tensordict, self.in_keys))
        return tensordict.set(self.out_keys[0], features)

    def forward_tensors(
        self,
        observation: torch.Tensor,
        goal: torch.Tensor,
        params: TensorDictBase | None = None,
    ) -> torch.Tensor:
        """Returns the normalised features of tensors.

        Args:
            observation (torch.Tensor): ``[*B, D]``.
            goal (torch.Tensor): ``[*B, G]``.
            params (TensorDictBase, optional): buffers to use instead of the module's
                own. Those of ``C`` modules may be stacked; ``*B`` then begins with
                ``C``, or with 1 for one input of all. Defaults to the module's own.

        Returns:
            torch.Tensor: ``[*B, F]``, in the dtype of the statistics; ``[C, ..., F]``
            for one input of all.

        Raises:
            ValueError: a tensor has the wrong width.
        """
        features = self._join(observation, goal)
        if params is None:
            return self.norm(features)
        shift, divisor = (params.get(("norm", name)) for name in ("shift", "divisor"))
        if shift.ndim > 1:
            shape = (len(shift), *[1] * (features.ndim - 2), -1)
            shift, divisor = shift.reshape(shape), divisor.reshape(shape)
        return ((features - shift) / divisor).to(shift.dtype)

    def fit_statistics(self, tensordict: TensorDictBase) -> GoalFeatures:
        """Computes the mean and the standard deviation of every feature from data.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]`` with the goals that the
                networks will read, such as a large sample of the replay buffer that
                relabels goals.

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
        observation, goal = read_leaves(tensordict, self.in_keys)
        for key, value in zip(self.in_keys, (observation, goal), strict=True):
            if not value.isfinite().all():
                raise ValueError(
                    f"{key!r} has {int((~value.isfinite()).sum())} non-finite values "
                    f"in a batch of shape {list(value.shape)}: remove or repair them"
                )
        self.norm.replace(gather_statistics(self._join(observation, goal), "features"))
        return self

    def _join(self, observation: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        layout = self.layout
        check_width(layout, observation.shape[-1], self.observation_key)
        if goal.shape[-1] != layout.goal_width:
            raise ValueError(
                f"{self.desired_goal_key!r} has {goal.shape[-1]} columns, expected "
                f"{layout.goal_width}: correct the layout's goal, or the data"
            )
        observation, goal = floating(observation), floating(goal)
        whole = self._whole and observation.shape[-1] == self.state_dim
        parts = [observation if whole else self._pick(observation, "state"), goal]
        if self.relative:
            achieved = self._pick(observation, "achieved")
            if self.reference is not None:
                parts.append(achieved - self._pick(observation, "reference"))
            parts.append(goal - achieved)
        return torch.cat(parts, -1)

    def _pick(self, observation: torch.Tensor, what: str) -> torch.Tensor:
        # Cached for each device. As buffers, a loss would copy them for each critic.
        device = observation.device
        if (what, device) not in self._tensors:
            index = torch.tensor(self._columns[what], device=device)
            self._tensors[what, device] = index
        return observation.index_select(-1, self._tensors[what, device])


def _by_goal_column(
    layout: EntityLayout, columns: dict[str, tuple[int, ...]]
) -> list[int]:
    """Returns the observation columns of all entities in the order of the goal's."""
    pairs = [
        pair
        for name, goal in layout.goal.items()
        for pair in zip(goal, columns[name], strict=True)
    ]
    return [column for _, column in sorted(pairs)]


def _reference_columns(
    layout: EntityLayout, reference: str, given: Iterable[int] | None
) -> list[int]:
    if reference not in layout.names:
        raise ValueError(
            f"reference is {reference!r}, which is not an entity of this layout: "
            f"expected one of {list(layout.names)}"
        )
    own = layout.columns[reference]
    position = layout.positions.get(reference) if given is None else tuple(given)
    first = position is None  # of which any entity takes as many as it needs
    position = own if position is None else position
    foreign = [column for column in position if column not in own]
    if foreign or len(set(position)) != len(position):
        raise ValueError(
            f"reference_columns are {list(position)}, expected columns of "
            f"{reference!r}, each at most once: some of {list(own)}"
        )
    columns = {}
    for name, goal in layout.goal.items():
        fits = len(goal) <= len(position) if first else len(goal) == len(position)
        if goal and not fits:
            raise ValueError(
                f"entity {name!r} has {len(goal)} goal columns, but the reference "
                f"{reference!r} has {'only ' if first else ''}{len(position)} columns "
                f"{list(position)} to take its position from: give reference_columns, "
                "as many as each entity has goal columns, name another reference, or "
                "None"
            )
        columns[name] = position[: len(goal)]
    return _by_goal_column(layout, columns)
