"""Which tensor columns, leaves or sub-tensordicts belong to which entity."""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac import _columns
from torchrl_caiac._keys import as_key, floating, join
from torchrl_caiac._layout_files import LayoutFiles
from torchrl_caiac._layout_format import layout_arguments, layout_text, layout_to_dict
from torchrl_caiac._layout_reading import (
    check_data,
    check_width,
    read_entities,
    read_observation,
)
from torchrl_caiac._layout_units import FloorArgument, entity_floors, position_columns

__all__ = ["EntityLayout"]


class EntityLayout(LayoutFiles):
    """The factorisation of a state into ``N`` entities (section 2 of the paper).

    A *flat* layout names columns of one observation tensor. A *nested* layout, created
    by :meth:`from_keys`, names tensor leaves or whole sub-tensordicts. Every
    ``[*B, N]`` tensor of the package follows the order of :attr:`names`.

    A layout is immutable, hashable, picklable and compared by value.

    Args:
        entities (mapping of str to iterable of int): the observation columns of each
            entity. Columns are disjoint, in any order. A column that no entity owns is
            never swapped.

    Keyword Args:
        observation_key (NestedKey): the key of the flat observation, ``[*B, D]``.
            Defaults to ``"observation"``.
        goal (mapping of str to iterable of int, optional): the columns of the goal
            vectors that describe each entity. It names every entity that is not fixed;
            an entity without a goal gets ``()``. Defaults to ``None``: no goals.
        achieved (mapping of str to iterable of int, optional): the observation columns
            that the goal columns of each entity mirror, in the same order. Defaults to
            ``None``: goals are not read from observations.
        fixed (iterable of str): entities that are never swapped, whatever their
            scores, such as the robot. Defaults to ``()``.
        next_key (NestedKey): the key of the next state. Defaults to ``"next"``.
        desired_goal_key (NestedKey): the key of the desired goal, ``[*B, G]``. Defaults
            to ``"desired_goal"``.
        achieved_goal_key (NestedKey): the key of the achieved goal, ``[*B, G]``.
            Defaults to ``"achieved_goal"``.
        positions (mapping of str to iterable of int, optional): the columns of some or
            all entities that say where they are: coordinates, joint angles. Influence
            by motion or distance, and reports, read only these columns. Defaults to
            ``None``: unknown.
        variance_floor (float or mapping, optional): the standard deviation below which
            a change of a column is noise, in the units of the data. One number, or for
            each entity one number or one for each of its columns. World models and
            the influence by motion use it unless they are given another. Defaults to
            ``None``: unknown.
        width (int, optional): the number of columns ``D`` of the observation. Data of
            another width raise an error. Defaults to ``None``: any width that contains
            the columns of the entities.

    Raises:
        ValueError: columns overlap, are negative or missing; a name in ``goal``,
            ``achieved`` or ``fixed`` is not an entity; goal and achieved columns do not
            match; a position is not a column of its entity; a floor is missing or not
            positive.
        TypeError: a column is not an integer.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> layout = EntityLayout(
        ...     {"gripper": range(0, 10), "cube": range(10, 22)},
        ...     goal={"cube": range(0, 3)},
        ...     achieved={"cube": range(10, 13)},
        ...     fixed=("gripper",),
        ... )
        >>> layout
        EntityLayout(
            gripper: observation[0:10], fixed
            cube: observation[10:22], goal[0:3] mirrors observation[10:13]
        )
        >>> layout.names
        ('gripper', 'cube')
    """

    def __init__(
        self,
        entities: Mapping[str, Iterable[int]],
        *,
        observation_key: NestedKey = "observation",
        goal: Mapping[str, Iterable[int]] | None = None,
        achieved: Mapping[str, Iterable[int]] | None = None,
        fixed: Iterable[str] = (),
        next_key: NestedKey = "next",
        desired_goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        positions: Mapping[str, Iterable[int]] | None = None,
        variance_floor: FloorArgument = None,
        width: int | None = None,
    ) -> None:
        self._set_common(entities, fixed, next_key)
        self.observation_key: NestedKey | None = as_key(observation_key)
        self.desired_goal_key: NestedKey | None = as_key(desired_goal_key)
        self.achieved_goal_key: NestedKey | None = as_key(achieved_goal_key)
        self.keys: dict[str, NestedKey] = {}
        self.columns = _columns.observation_columns(entities)
        self.width: int | None = _columns.observation_width(width, self.columns)
        _columns.check_goal_names(goal, achieved, self.names, self.fixed, "()")
        self.goal: dict[str, Any] = {}
        self.achieved: dict[str, Any] = {}
        if goal is not None:
            self.goal = _columns.goal_vector_columns(goal)
        if achieved is not None:
            self.achieved = _columns.mirrored_columns(achieved, self.goal, self.columns)
        self._set_units(positions, variance_floor)

    @classmethod
    def from_keys(
        cls,
        entities: Mapping[str, NestedKey],
        *,
        goal: Mapping[str, NestedKey | None] | None = None,
        achieved: Mapping[str, NestedKey | None] | None = None,
        fixed: Iterable[str] = (),
        next_key: NestedKey = "next",
        positions: Mapping[str, Iterable[int]] | None = None,
        variance_floor: FloorArgument = None,
    ) -> EntityLayout:
        """Creates a nested layout: an entity is a leaf or a whole sub-tensordict.

        Args:
            entities (mapping of str to NestedKey): the key of each entity. No key is
                equal to or below another.

        Keyword Args:
            goal (mapping of str to NestedKey, optional): the key of the desired goal of
                each entity that is not fixed, ``None`` for an entity without one.
                Defaults to ``None``: no goals.
            achieved (mapping of str to NestedKey, optional): the key of the achieved
                goal of each entity. Defaults to ``None``.
            fixed (iterable of str): entities that are never swapped. Defaults to
                ``()``.
            next_key (NestedKey): the key of the next state. Defaults to ``"next"``.
            positions (mapping of str to iterable of int, optional): as for flat
                layouts, but places in the flattened features of the entity. Defaults
                to ``None``.
            variance_floor (float or mapping, optional): as for flat layouts, in the
                order of the flattened features. Defaults to ``None``.

        Returns:
            EntityLayout: the layout.

        Raises:
            ValueError: two keys overlap, or a name is not an entity.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout.from_keys(
            ...     {
            ...         "arm": ("observation", "arm"),
            ...         "kettle": ("observation", "kettle"),
            ...     },
            ...     fixed=("arm",),
            ... )
            EntityLayout(
                arm: ('observation', 'arm'), fixed
                kettle: ('observation', 'kettle')
            )
        """
        self = cls.__new__(cls)
        self._set_common(entities, fixed, next_key)
        self.observation_key = self.desired_goal_key = self.achieved_goal_key = None
        self.columns, self.width = {}, None
        self.keys = _columns.disjoint_keys(entities, "entity")
        _columns.check_goal_names(goal, achieved, self.names, self.fixed, "None")
        self.goal = _columns.disjoint_keys(goal or {}, "goal")
        self.achieved = _columns.disjoint_keys(achieved or {}, "achieved")
        self._set_units(positions, variance_floor)
        return self

    def _set_common(
        self, entities: Mapping[str, Any], fixed: Iterable[str], next_key: NestedKey
    ) -> None:
        self.names = _columns.entity_names(entities)
        self.fixed = _columns.fixed_names(fixed, self.names)
        self.next_key = as_key(next_key)
        self._tensors: dict[Any, torch.Tensor] = {}
        self._next_keys: dict[NestedKey, NestedKey] = {}

    def _set_units(
        self,
        positions: Mapping[str, Iterable[int]] | None,
        variance_floor: FloorArgument,
    ) -> None:
        self.positions = position_columns(positions, self.names, self.columns)
        self.variance_floor = entity_floors(variance_floor, self.names, self.columns)

    # --- names -------------------------------------------------------------------

    @property
    def num_entities(self) -> int:
        """The number of entities, ``N``."""
        return len(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_flat(self) -> bool:
        """Whether entities are columns of one observation, not separate entries."""
        return not self.keys

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the state, without their ``next`` counterparts."""
        if self.observation_key is not None:
            return [self.observation_key]
        return list(self.keys.values())

    @property
    def fixed_mask(self) -> torch.Tensor:
        """Which entities are never swapped, bool ``[N]`` on the CPU."""
        return torch.tensor([name in self.fixed for name in self.names])

    @property
    def goal_width(self) -> int:
        """The width ``G`` of the goal vectors, 0 without goals (flat layouts only)."""
        if not self.is_flat:
            raise ValueError(
                "a nested layout has no goal vector, but one goal for each entity: "
                "use layout.goal"
            )
        return sum(len(columns) for columns in self.goal.values())

    def index(self, name: str) -> int:
        """Returns the position of an entity in every ``[*, N]`` tensor.

        Args:
            name (str): the entity.

        Returns:
            int: the position.

        Raises:
            ValueError: the layout has no such entity.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0, 1], "cup": [2]}).index("cup")
            1
        """
        _columns.check_names([name], self.names, "index")
        return self.names.index(name)

    # --- columns -----------------------------------------------------------------

    def column_entity(self, width: int) -> torch.Tensor:
        """Returns the entity that owns each column of a flat observation.

        Args:
            width (int): the width ``D`` of the observation.

        Returns:
            torch.Tensor: int64 ``[D]``, -1 where no entity owns the column.

        Raises:
            ValueError: the layout is nested, or names a column beyond ``width``.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0, 3], "cup": [1]}).column_entity(4)
            tensor([ 0,  1, -1,  0])
        """
        if not self.is_flat:
            raise ValueError("a nested layout has no columns: use its keys")
        check_width(self, width)
        return _columns.column_owner(self.columns, self.names, width)

    def goal_column_entity(self) -> torch.Tensor:
        """Returns the entity that owns each column of a flat goal.

        Returns:
            torch.Tensor: int64 ``[G]``.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout(
            ...     {"arm": [0], "cup": [1, 2]}, goal={"cup": [0, 1]}, fixed=["arm"]
            ... )
            >>> layout.goal_column_entity()
            tensor([1, 1])
        """
        return _columns.column_owner(self.goal, self.names, self.goal_width)

    def widths(self, td: TensorDictBase | None = None) -> dict[str, int]:
        """Returns the number of features of each entity.

        Args:
            td (TensorDictBase, optional): an example ``[*B]``, needed only by nested
                layouts. Its leaves are flattened after the batch dimensions. Defaults
                to ``None``.

        Returns:
            dict of str to int: the widths, in layout order.

        Raises:
            ValueError: the layout is nested and ``td`` is ``None``.
            KeyError: the example lacks an entity.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0, 3], "cup": [1]}).widths()
            {'arm': 2, 'cup': 1}
        """
        if self.is_flat:
            return {name: len(columns) for name, columns in self.columns.items()}
        if td is None:
            raise ValueError(
                "the widths of a nested layout depend on the data: pass an example "
                "tensordict"
            )
        return {name: x.shape[-1] for name, x in read_entities(self, td).items()}

    def slices(self, td: TensorDictBase | None = None) -> dict[str, slice]:
        """Returns the slice of each entity in the last dimension of :meth:`read`.

        Args:
            td (TensorDictBase, optional): an example, as in :meth:`widths`. Defaults
                to ``None``.

        Returns:
            dict of str to slice: the slices, in layout order.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0, 3], "cup": [1]}).slices()["cup"]
            slice(2, 3, None)
        """
        slices, start = {}, 0
        for name, width in self.widths(td).items():
            slices[name] = slice(start, start + width)
            start += width
        return slices

    # --- reading -----------------------------------------------------------------

    def read(self, td: TensorDictBase, *, next: bool = False) -> torch.Tensor:
        """Returns the features of all entities, concatenated in layout order.

        Args:
            td (TensorDictBase): transitions ``[*B]``.

        Keyword Args:
            next (bool): read the next state. Defaults to ``False``.

        Returns:
            torch.Tensor: ``[*B, W]``, where ``W`` is the sum of the widths. Integers
            and booleans become floating point, float64 if they have more than 16
            bits, so that differences do not wrap around. The tensor may share memory
            with ``td``: do not write to it.

        Raises:
            KeyError: a key is missing.
            ValueError: the observation is too narrow.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac import EntityLayout
            >>> td = TensorDict({"observation": torch.arange(8.0).view(2, 4)}, [2])
            >>> EntityLayout({"arm": [0, 3], "cup": [1]}).read(td)
            tensor([[0., 3., 1.],
                    [4., 7., 5.]])
        """
        if not self.is_flat:
            return torch.cat(list(read_entities(self, td, next=next).values()), -1)
        observation = read_observation(self, td, next=next)
        columns = [c for columns in self.columns.values() for c in columns]
        if columns != list(range(observation.shape[-1])):
            where = self.index_tensor("read", columns, observation.device)
            observation = observation[..., where]
        return floating(observation)

    def achieved_goal(self, td: TensorDictBase, *, next: bool = False) -> torch.Tensor:
        """Returns the goal that a state achieves (flat layouts only).

        Args:
            td (TensorDictBase): transitions ``[*B]``.

        Keyword Args:
            next (bool): read the next state. Defaults to ``False``.

        Returns:
            torch.Tensor: ``[*B, G]``.

        Raises:
            ValueError: the layout has no ``achieved`` columns.
            KeyError: the observation is missing.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout(
            ...     {"cup": [1, 2]}, goal={"cup": [0]}, achieved={"cup": [2]}
            ... )
            >>> layout.achieved_goal(TensorDict({"observation": torch.arange(3.0)}))
            tensor([2.])
        """
        columns = self.goal_columns()
        observation = read_observation(self, td, next=next)
        return observation[..., self.index_tensor("goal", columns, observation.device)]

    def goal_columns(self) -> tuple[int, ...]:
        """Returns the observation column that each goal column mirrors.

        Returns:
            tuple of int: ``G`` observation columns.

        Raises:
            ValueError: the layout is nested or has no ``achieved`` columns.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout(
            ...     {"cup": [1, 2]}, goal={"cup": [0]}, achieved={"cup": [2]}
            ... )
            >>> layout.goal_columns()
            (2,)
        """
        if not self.is_flat or not self.achieved:
            raise ValueError(
                "the layout does not say which observation columns the goal mirrors: "
                "pass EntityLayout(..., goal=..., achieved=...)"
            )
        mirrored = {
            goal: observed
            for name, columns in self.goal.items()
            for goal, observed in zip(columns, self.achieved[name], strict=True)
        }
        return tuple(mirrored[column] for column in range(self.goal_width))

    def index_tensor(
        self,
        what: Hashable,
        columns: Sequence[int],
        device: torch.device,
    ) -> torch.Tensor:
        """Returns columns as a tensor, which the layout caches for each device.

        Indexing with a tensor on the host would synchronise a GPU in every call.

        Args:
            what (Hashable): the name of the tensor. The same name always has the same
                columns.
            columns (sequence of int): the columns.
            device (torch.device): the device of the tensor.

        Returns:
            torch.Tensor: the columns, int64 ``[W]``. Do not write to it.

        Examples:
            >>> import torch
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 3]})
            >>> layout.index_tensor("arm", layout.columns["arm"], torch.device("cpu"))
            tensor([0, 3])
        """
        if (what, device) not in self._tensors:
            self._tensors[what, device] = torch.tensor(columns, device=device)
        return self._tensors[what, device]

    def check(self, td: TensorDictBase, *, next: bool = False) -> None:
        """Raises if the layout does not fit the data.

        Args:
            td (TensorDictBase): transitions ``[*B]``.

        Keyword Args:
            next (bool): check the next state too. Defaults to ``False``.

        Raises:
            KeyError: a key is missing.
            ValueError: an observation or a goal has the wrong width.
            TypeError: the observation of a flat layout is not a tensor.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac import EntityLayout
            >>> td = TensorDict({"observation": torch.zeros(5, 2)}, [5])
            >>> EntityLayout({"arm": [0, 3]}).check(td)
            Traceback (most recent call last):
            ...
            ValueError: 'observation' has 2 columns, but the layout needs at least 4...
        """
        check_data(self, td, next=next)

    def next(self, key: NestedKey) -> NestedKey:
        """Returns the key of the same entry in the next state.

        Args:
            key (NestedKey): a key of the state.

        Returns:
            NestedKey: the key below :attr:`next_key`.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0]}).next("observation")
            ('next', 'observation')
        """
        # Cached: joining keys takes as long as two small tensor operations.
        if key not in self._next_keys:
            self._next_keys[key] = join(self.next_key, key)
        return self._next_keys[key]

    # --- saving: save and load are inherited -------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Returns the layout as JSON-compatible values.

        Returns:
            dict: the input of :meth:`from_dict`.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 1]})
            >>> EntityLayout.from_dict(layout.to_dict()) == layout
            True
        """
        return layout_to_dict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> EntityLayout:
        """Creates the layout that :meth:`to_dict` described.

        Args:
            content (mapping): the result of :meth:`to_dict`.

        Returns:
            EntityLayout: the layout.

        Raises:
            TypeError: a name is empty.
            ValueError: the content does not describe a layout, or has another version.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> content = EntityLayout({"arm": [0, 1]}).to_dict()
            >>> EntityLayout.from_dict(content).names
            ('arm',)
        """
        is_flat, arguments = layout_arguments(content)
        return cls(**arguments) if is_flat else cls.from_keys(**arguments)

    # --- comparing and showing ---------------------------------------------------

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, EntityLayout):
            return NotImplemented
        return self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(json.dumps(self.to_dict(), sort_keys=True))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_tensors": {}}

    def __repr__(self) -> str:
        return layout_text(self)
