"""Which tensor columns, leaves or sub-tensordicts belong to which entity."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey, unravel_key

__all__ = ["EntityLayout"]

_FORMAT = "torchrl_caiac.EntityLayout"
_VERSION = 1


class EntityLayout:
    """The factorisation of a state into ``N`` entities (section 2 of the paper).

    A *flat* layout names columns of one observation tensor; a *nested* layout, made
    by :meth:`from_keys`, names tensor leaves or whole sub-tensordicts. Every
    ``[*B, N]`` tensor of the package follows the order of :attr:`names`.

    A layout is immutable, hashable, compared by value and picklable.

    Args:
        entities (mapping of str to iterable of int): the observation columns of each
            entity. Columns are disjoint, in any order; a column that no entity owns
            is never swapped.

    Keyword Args:
        observation_key (NestedKey): the flat observation, ``[*B, D]``. Defaults to
            ``"observation"``.
        goal (mapping of str to iterable of int, optional): the columns of the goal
            vectors that describe each entity. It names every entity that is not
            fixed; an entity that no goal describes gets ``()``.
        achieved (mapping of str to iterable of int, optional): the observation
            columns that an entity's goal columns mirror, in the same order.
        fixed (iterable of str): entities that are never swapped, whatever their
            score (the robot). Defaults to ``()``.
        next_key (NestedKey): where the next state lies. Defaults to ``"next"``.
        desired_goal_key (NestedKey): the desired goal, ``[*B, G]``. Defaults to
            ``"desired_goal"``.
        achieved_goal_key (NestedKey): the achieved goal, ``[*B, G]``. Defaults to
            ``"achieved_goal"``.

    Raises:
        ValueError: columns overlap, are negative or missing; a name in ``goal``,
            ``achieved`` or ``fixed`` is no entity; goal and achieved columns do not
            match.
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
    ) -> None:
        self._set_common(entities, fixed, next_key, desired_goal_key, achieved_goal_key)
        self.observation_key: NestedKey | None = _key(observation_key)
        self.keys: dict[str, NestedKey] = {}
        self.columns = _disjoint_columns(entities, "observation")
        for name, columns in self.columns.items():
            if not columns:
                raise ValueError(
                    f"entity {name!r} has no column: give it at least one column of "
                    f"{self.observation_key!r}, or leave it out"
                )
        self._check_goal_names(goal, achieved)
        self.goal: dict[str, Any] = (
            {} if goal is None else _disjoint_columns(goal, "goal")
        )
        owned = sorted(column for columns in self.goal.values() for column in columns)
        if owned != list(range(len(owned))):
            raise ValueError(
                f"the goal columns must be 0 to {len(owned) - 1} without a gap, got "
                f"{owned}: every column of a goal belongs to one entity"
            )
        self.achieved: dict[str, Any] = {}
        if achieved is not None:
            for name, columns in _disjoint_columns(achieved, "achieved").items():
                if len(columns) != len(self.goal[name]):
                    raise ValueError(
                        f"entity {name!r} has {len(self.goal[name])} goal columns but "
                        f"{len(columns)} achieved columns: they mirror each other one "
                        "by one"
                    )
                foreign = sorted(set(columns) - set(self.columns[name]))
                if foreign:
                    raise ValueError(
                        f"the achieved columns {foreign} of entity {name!r} are not "
                        f"among its observation columns {_ranges(self.columns[name])}"
                    )
                self.achieved[name] = columns

    @classmethod
    def from_keys(
        cls,
        entities: Mapping[str, NestedKey],
        *,
        goal: Mapping[str, NestedKey | None] | None = None,
        achieved: Mapping[str, NestedKey | None] | None = None,
        fixed: Iterable[str] = (),
        next_key: NestedKey = "next",
    ) -> EntityLayout:
        """Makes a nested layout: an entity is a leaf or a whole sub-tensordict.

        Args:
            entities (mapping of str to NestedKey): where each entity lies. No key may
                be equal to another or lie under it.

        Keyword Args:
            goal (mapping of str to NestedKey, optional): the desired-goal leaf of each
                entity that is not fixed, ``None`` for an entity without one.
            achieved (mapping of str to NestedKey, optional): the achieved-goal leaf of
                each entity.
            fixed (iterable of str): entities that are never swapped.
            next_key (NestedKey): where the next state lies. Defaults to ``"next"``.

        Returns:
            EntityLayout: the layout.

        Raises:
            ValueError: two keys overlap, or a name is no entity.

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
        self._set_common(entities, fixed, next_key, None, None)
        self.observation_key = None
        self.columns = {}
        self.keys = {name: _key(key) for name, key in entities.items()}
        self._check_goal_names(goal, achieved)
        self.goal = {n: None if k is None else _key(k) for n, k in (goal or {}).items()}
        self.achieved = {
            n: None if k is None else _key(k) for n, k in (achieved or {}).items()
        }
        for what, keys in (
            ("entity", self.keys),
            ("goal", self.goal),
            ("achieved", self.achieved),
        ):
            paths = sorted(
                (_path(key), name) for name, key in keys.items() if key is not None
            )
            for (path, name), (other_path, other) in pairwise(paths):
                if other_path[: len(path)] == path:
                    raise ValueError(
                        f"the {what} keys of {name!r} {path} and {other!r} "
                        f"{other_path} overlap: an entity owns its key alone"
                    )
        return self

    def _set_common(
        self,
        entities: Mapping[str, Any],
        fixed: Iterable[str],
        next_key: NestedKey,
        desired_goal_key: NestedKey | None,
        achieved_goal_key: NestedKey | None,
    ) -> None:
        if not isinstance(entities, Mapping) or not entities:
            raise ValueError(
                "a layout needs at least one entity: a mapping from its name to its "
                f"columns or key, got {entities!r}"
            )
        for name in entities:
            if not isinstance(name, str) or not name:
                raise TypeError(f"an entity's name is a non-empty str, got {name!r}")
        if isinstance(fixed, str):
            raise TypeError(f"fixed is a sequence of names: write ({fixed!r},)")
        self.names: tuple[str, ...] = tuple(entities)
        self.fixed: tuple[str, ...] = tuple(fixed)
        self._check_known(self.fixed, "fixed")
        self.next_key = _key(next_key)
        self.desired_goal_key = (
            None if desired_goal_key is None else _key(desired_goal_key)
        )
        self.achieved_goal_key = (
            None if achieved_goal_key is None else _key(achieved_goal_key)
        )
        self._tensors: dict[Any, torch.Tensor] = {}
        self._next_keys: dict[NestedKey, NestedKey] = {}

    def _check_known(self, names: Iterable[str], what: str) -> None:
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise ValueError(
                f"{what} names {unknown}, which are no entities of this layout: "
                f"it has {list(self.names)}"
            )

    def _check_goal_names(
        self, goal: Mapping[str, Any] | None, achieved: Mapping[str, Any] | None
    ) -> None:
        if goal is not None:
            self._check_known(goal, "goal")
            missing = [n for n in self.names if n not in goal and n not in self.fixed]
            if missing:
                nothing = "()" if self.is_flat else "None"
                raise ValueError(
                    f"goal lacks {missing}: name the goal of every entity that is not "
                    f"fixed, or give {nothing} to one that no goal describes"
                )
        if achieved is not None:
            if goal is None:
                raise ValueError("achieved needs goal: it says what goals mirror")
            self._check_known(achieved, "achieved")
            unmatched = sorted(set(achieved) ^ set(goal))
            if unmatched:
                raise ValueError(
                    f"goal and achieved must name the same entities, {unmatched} are "
                    "in one of them only"
                )

    # --- names -------------------------------------------------------------------

    @property
    def num_entities(self) -> int:
        """The number of entities, ``N``."""
        return len(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_flat(self) -> bool:
        """Whether entities are columns of one observation, not leaves of their own."""
        return not self.keys

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the state, without their ``next`` counterparts."""
        if self.observation_key is not None:
            return [self.observation_key]
        return list(self.keys.values())

    @property
    def fixed_mask(self) -> torch.Tensor:
        """Bool ``[N]``, on the CPU: which entities are never swapped."""
        return torch.tensor([name in self.fixed for name in self.names])

    @property
    def goal_width(self) -> int:
        """The width ``G`` of the goal vectors of a flat layout, 0 without goals."""
        if not self.is_flat:
            raise ValueError("a nested layout has one goal leaf an entity, no vector")
        return sum(len(columns) for columns in self.goal.values())

    def index(self, name: str) -> int:
        """The position of an entity in every ``[*, N]`` tensor.

        Args:
            name (str): the entity.

        Returns:
            int: its position.

        Raises:
            ValueError: there is no such entity.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0, 1], "cup": [2]}).index("cup")
            1
        """
        self._check_known([name], "index")
        return self.names.index(name)

    # --- columns -----------------------------------------------------------------

    def column_entity(self, width: int) -> torch.Tensor:
        """The entity that owns each column of a flat observation.

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
        self._check_width(width)
        return _owner(self.columns, self.names, width)

    def goal_column_entity(self) -> torch.Tensor:
        """The entity that owns each column of a flat goal.

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
        return _owner(self.goal, self.names, self.goal_width)

    def widths(self, td: TensorDictBase | None = None) -> dict[str, int]:
        """The number of features of each entity.

        Args:
            td (TensorDictBase, optional): an example ``[*B]``, needed by nested
                layouts only, whose leaves are flattened behind the batch dimensions.

        Returns:
            dict of str to int: the widths, in layout order.

        Raises:
            ValueError: the layout is nested and there is no example.
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
                "the widths of a nested layout lie in the data: pass an example "
                "tensordict"
            )
        return {name: x.shape[-1] for name, x in self._entities(td, next=False).items()}

    def slices(self, td: TensorDictBase | None = None) -> dict[str, slice]:
        """Where each entity lies in the last dimension of :meth:`read`.

        Args:
            td (TensorDictBase, optional): as in :meth:`widths`.

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
        """The features of all entities, side by side in layout order.

        Args:
            td (TensorDictBase): transitions ``[*B]``.

        Keyword Args:
            next (bool): read the next state. Defaults to ``False``.

        Returns:
            torch.Tensor: ``[*B, W]``, ``W`` the sum of the widths. It may share memory
            with ``td``: do not write into it.

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
            return torch.cat(list(self._entities(td, next=next).values()), -1)
        observation = self._observation(td, next=next)
        columns = [c for columns in self.columns.values() for c in columns]
        if columns == list(range(observation.shape[-1])):
            return observation
        return observation[..., self._index_tensor("read", columns, observation.device)]

    def achieved_goal(self, td: TensorDictBase, *, next: bool = False) -> torch.Tensor:
        """The goal that a state achieves, read from the observation (flat layouts).

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
        if not self.is_flat or not self.achieved:
            raise ValueError(
                "this layout does not say which observation columns the goal mirrors: "
                "give EntityLayout(..., goal=..., achieved=...)"
            )
        observation = self._observation(td, next=next)
        mirrored = dict(
            pair
            for name, columns in self.goal.items()
            for pair in zip(columns, self.achieved[name], strict=True)
        )
        columns = [mirrored[column] for column in range(self.goal_width)]
        return observation[..., self._index_tensor("goal", columns, observation.device)]

    def check(self, td: TensorDictBase, *, next: bool = False) -> None:
        """Raises when the layout does not fit the data.

        Args:
            td (TensorDictBase): transitions ``[*B]``.

        Keyword Args:
            next (bool): check the next state too. Defaults to ``False``.

        Raises:
            KeyError: a key is missing.
            ValueError: an observation or a goal has the wrong width.
            TypeError: an entity of a flat layout is no tensor.

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
        for after in (False, True) if next else (False,):
            if self.is_flat:
                self._observation(td, next=after)
            else:
                self._entities(td, next=after)
        if not self.is_flat or not self.goal:
            return
        keys = [self.desired_goal_key, self.achieved_goal_key]
        if next:
            keys.append(self.next(self.achieved_goal_key))
        for key in keys:
            goal = td.get(key, None)
            if goal is not None and goal.shape[-1] != self.goal_width:
                raise ValueError(
                    f"{key!r} has {goal.shape[-1]} columns, but the layout's goal has "
                    f"{self.goal_width}: correct `goal`, or the data"
                )

    def next(self, key: NestedKey) -> NestedKey:
        """The key of the same entry in the next state.

        Args:
            key (NestedKey): a key of the state.

        Returns:
            NestedKey: the key below :attr:`next_key`.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> EntityLayout({"arm": [0]}).next("observation")
            ('next', 'observation')
        """
        # Kept: a key is put together in the time of two small tensor operations.
        if key not in self._next_keys:
            self._next_keys[key] = _key((*_path(self.next_key), *_path(key)))
        return self._next_keys[key]

    def _check_width(self, width: int, key: NestedKey | None = None) -> None:
        needed = 1 + max(max(columns) for columns in self.columns.values())
        if width < needed:
            raise ValueError(
                f"{key or self.observation_key!r} has {width} columns, but the layout "
                f"needs at least {needed}: correct the columns of the entities, or "
                "pass the data that they describe"
            )

    def _observation(self, td: TensorDictBase, *, next: bool) -> torch.Tensor:
        key = self.next(self.observation_key) if next else self.observation_key
        observation = self._get(td, key)
        if not isinstance(observation, torch.Tensor):
            raise TypeError(
                f"{key!r} is a {type(observation).__name__}, but a flat layout names "
                "columns of a tensor: use EntityLayout.from_keys for nested entities"
            )
        if observation.ndim <= td.batch_dims:
            raise ValueError(
                f"{key!r} has the shape {list(observation.shape)}, wanted "
                f"[*B, D] with batch dimensions {list(td.batch_size)}"
            )
        self._check_width(observation.shape[-1], key)
        return observation

    def _entities(self, td: TensorDictBase, *, next: bool) -> dict[str, torch.Tensor]:
        return {
            name: _flatten(
                self._get(td, self.next(key) if next else key), td.batch_dims
            )
            for name, key in self.keys.items()
        }

    def _get(self, td: TensorDictBase, key: NestedKey) -> Any:
        value = td.get(key, None)
        if value is None:
            found = sorted(map(str, td.keys(include_nested=True)))
            raise KeyError(
                f"the layout reads {key!r}, which the data lacks; the data has {found}"
            )
        return value

    def _index_tensor(
        self,
        what: Any,
        columns: Sequence[int],
        device: torch.device,
        dtype: torch.dtype = torch.int64,
    ) -> torch.Tensor:
        # Kept per device: an index on the host would synchronise a GPU every time.
        known = self._tensors.get((what, device))
        if known is None or known.dtype != dtype:
            known = torch.tensor(columns, device=device, dtype=dtype)
            self._tensors[what, device] = known
        return known

    # --- saving ------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """The layout as JSON-compatible values.

        Returns:
            dict: what :meth:`from_dict` takes.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 1]})
            >>> EntityLayout.from_dict(layout.to_dict()) == layout
            True
        """

        def jsonable(value: Any) -> Any:
            return list(value) if isinstance(value, tuple) else value

        content: dict[str, Any] = {
            "format": _FORMAT,
            "version": _VERSION,
            "entities": [
                [name, jsonable(value)]
                for name, value in (self.columns if self.is_flat else self.keys).items()
            ],
            "flat": self.is_flat,
            "goal": [[n, jsonable(v)] for n, v in self.goal.items()],
            "achieved": [[n, jsonable(v)] for n, v in self.achieved.items()],
            "fixed": list(self.fixed),
            "next_key": jsonable(self.next_key),
        }
        if self.is_flat:
            content |= {
                key: jsonable(getattr(self, key))
                for key in ("observation_key", "desired_goal_key", "achieved_goal_key")
            }
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> EntityLayout:
        """Makes the layout that :meth:`to_dict` described.

        Args:
            content (mapping): what :meth:`to_dict` returned.

        Returns:
            EntityLayout: the layout.

        Raises:
            ValueError: the content describes no layout, or one of a newer version.
        """
        if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
            raise ValueError(
                "this describes no EntityLayout: expected a mapping with "
                f"'format': {_FORMAT!r}"
            )
        if content.get("version") != _VERSION:
            raise ValueError(
                f"this layout has version {content.get('version')!r}, this package "
                f"reads version {_VERSION}: update torchrl_caiac"
            )

        def key(value: Any) -> Any:
            return tuple(value) if isinstance(value, list) else value

        try:
            named = {
                part: {name: key(value) for name, value in content[part]}
                for part in ("entities", "goal", "achieved")
            }
            kwargs: dict[str, Any] = {
                "goal": named["goal"] or None,
                "achieved": named["achieved"] or None,
                "fixed": content["fixed"],
                "next_key": key(content["next_key"]),
            }
            if not content["flat"]:
                return cls.from_keys(named["entities"], **kwargs)
            for name in ("observation_key", "desired_goal_key", "achieved_goal_key"):
                kwargs[name] = key(content[name])
        except (KeyError, TypeError) as error:
            raise ValueError(f"this layout is incomplete: {error}") from error
        return cls(named["entities"], **kwargs)

    def save(self, path: str | Path) -> None:
        """Writes the layout as JSON; the file appears whole or not at all.

        Args:
            path (str or Path): the file.

        Examples:
            >>> import tempfile
            >>> from pathlib import Path
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 1]})
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     layout.save(Path(folder) / "layout.json")
            ...     EntityLayout.load(Path(folder) / "layout.json") == layout
            True
        """
        path = Path(path)
        handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(self.to_dict(), file, indent=2)
                file.write("\n")
            os.replace(partial, path)
        except BaseException:
            Path(partial).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | Path) -> EntityLayout:
        """Reads a layout that :meth:`save` wrote.

        Args:
            path (str or Path): the file.

        Returns:
            EntityLayout: the layout.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is truncated or describes no layout.
        """
        text = Path(path).read_text(encoding="utf-8")
        try:
            return cls.from_dict(json.loads(text))
        except ValueError as error:  # JSONDecodeError is one
            raise ValueError(f"{path} holds no readable layout: {error}") from error

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
        lines = []
        for name in self.names:
            if self.is_flat:
                where = f"{_text(self.observation_key)}{_ranges(self.columns[name])}"
            else:
                where = _text(self.keys[name])
            line = f"    {name}: {where}"
            if self.is_flat and self.goal.get(name):
                line += f", goal{_ranges(self.goal[name])}"
                if name in self.achieved:
                    line += (
                        f" mirrors {_text(self.observation_key)}"
                        f"{_ranges(self.achieved[name])}"
                    )
            elif not self.is_flat and self.goal.get(name) is not None:
                line += f", goal {_text(self.goal[name])}"
                if self.achieved.get(name) is not None:
                    line += f" mirrors {_text(self.achieved[name])}"
            if name in self.fixed:
                line += ", fixed"
            lines.append(line)
        return "\n".join(["EntityLayout(", *lines, ")"])


def _key(key: Any) -> Any:
    if not isinstance(key, (str, tuple)):
        raise TypeError(f"a key is a str or a tuple of str, got {key!r}")
    return unravel_key(key)


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)


def _text(key: Any) -> str:
    return key if isinstance(key, str) else repr(key)


def _disjoint_columns(
    entities: Mapping[str, Iterable[int]], what: str
) -> dict[str, tuple[int, ...]]:
    owner: dict[int, str] = {}
    result: dict[str, tuple[int, ...]] = {}
    for name, columns in entities.items():
        columns = tuple(columns)
        for column in columns:
            if isinstance(column, bool) or not hasattr(column, "__index__"):
                raise TypeError(
                    f"the {what} columns of entity {name!r} are ints, got {column!r}"
                )
            if column < 0:
                raise ValueError(
                    f"{what} column {column} of entity {name!r} is out of range: "
                    "columns count from 0"
                )
            if column in owner:
                raise ValueError(
                    f"{what} column {column} belongs to both {owner[column]!r} and "
                    f"{name!r}: entities are disjoint"
                )
            owner[int(column)] = name
        result[name] = tuple(int(column) for column in columns)
    return result


def _owner(
    columns: Mapping[str, Sequence[int]], names: Sequence[str], width: int
) -> torch.Tensor:
    owner = torch.full((width,), -1)
    for name, owned in columns.items():
        owner[list(owned)] = names.index(name)
    return owner


def _ranges(columns: Sequence[int]) -> str:
    if len(columns) > 1 and list(columns) == list(range(columns[0], columns[-1] + 1)):
        return f"[{columns[0]}:{columns[-1] + 1}]"
    return str(list(columns))


def _flatten(value: Any, batch_dims: int) -> torch.Tensor:
    if is_tensor_collection(value):
        leaves = [value.get(key) for key in sorted(value.keys(), key=str)]
        return torch.cat([_flatten(leaf, batch_dims) for leaf in leaves], -1)
    value = value if value.is_floating_point() else value.to(torch.get_default_dtype())
    return value.reshape(*value.shape[:batch_dims], -1)
