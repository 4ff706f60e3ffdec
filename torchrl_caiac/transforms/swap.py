"""Swapping entities between windows: the inner loop of Algorithm 1.

Everything that depends only on the layout and on the structure of a batch (its leaves,
the owner of every column, the order of columns) is computed once, in a
:class:`SwapPlan`. Notation as in :mod:`torchrl_caiac.transforms.draws`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import (
    TensorDictBase,
    is_leaf_nontensor,
    is_non_tensor,
    is_tensor_collection,
)
from tensordict.utils import NestedKey

from torchrl_caiac._batches import with_leaves
from torchrl_caiac._keys import join
from torchrl_caiac._sampling import Runs, is_native, swap_rows
from torchrl_caiac._torchrl import leaf_of
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import TrajectoryIndex
from torchrl_caiac.transforms.draws import SwapDraw
from torchrl_caiac.transforms.indexing import pick_places, window_starts

__all__ = ["SwapLeaf", "SwapPlan", "SwapPlanner", "apply_swap"]

_MAX_PLANS = 16  # structures of batches that a planner remembers


class SwapLeaf(NamedTuple):
    """A leaf that follows a swap.

    Attributes:
        key (NestedKey): where it is.
        place (int): its place among the leaves that the planner reads.
        owner (int or torch.Tensor): the one entity that it belongs to, or the entity
            of each of its columns, int64 ``[D]``, ``N`` where no entity owns it.
        width (int): its columns ``D``; 1 where it belongs to one entity.
        group (int): leaves of the same owner and width share their index.
        is_desired (bool): whether it is a desired goal.
        runs (Runs): the bytes of each entity in a row.
    """

    key: NestedKey
    place: int
    owner: int | torch.Tensor
    width: int
    group: int
    is_desired: bool
    runs: Runs


class SwapPlan(NamedTuple):
    """The plan of a swap, computed once for each structure of batches.

    Attributes:
        leaves (tuple of SwapLeaf): what follows a swap.
        states (tuple of NestedKey): the floating-point leaves of states and next
            states, those of fixed entities included.
        has_rest (bool): whether there are columns that no entity owns.
    """

    leaves: tuple[SwapLeaf, ...]
    states: tuple[NestedKey, ...]
    has_rest: bool


class _Source(NamedTuple):
    """A key of the layout that a swap affects, if the batch has it."""

    key: NestedKey
    kind: str  # "state" or "goal", of a flat layout
    entity: int
    is_required: bool
    is_desired: bool
    is_swapped: bool


class SwapPlanner:
    """Reads the leaves of batches, and creates the plan of each structure once.

    Args:
        layout (EntityLayout): the entities.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.swap import SwapPlanner
        >>> planner = SwapPlanner(EntityLayout({"arm": [0], "cup": [1]}))
        >>> state = torch.zeros(4, 2)
        >>> td = TensorDict({"observation": state, ("next", "observation"): state}, [4])
        >>> plan, values = planner(td)
        >>> plan.states, plan.leaves[0].owner
        (('observation', ('next', 'observation')), tensor([0, 1]))
        >>> planner(td)[0] is plan
        True
    """

    def __init__(self, layout: EntityLayout) -> None:
        self.layout = layout
        self._sources = _flat_sources(layout) if layout.is_flat else _sources(layout)
        self._plans: dict[Hashable, SwapPlan] = {}

    @property
    def keys(self) -> list[NestedKey]:
        """The keys that a swap reads and writes, if a batch has them."""
        has_goals = bool(self.layout.goal)
        return [s.key for s in self._sources if s.is_required or has_goals]

    def __call__(self, td: TensorDictBase) -> tuple[SwapPlan, list[torch.Tensor]]:
        """Reads a batch.

        Args:
            td (TensorDictBase): the batch ``[B * window]``.

        Returns:
            tuple: the plan, and the leaves that :attr:`SwapLeaf.place` counts.

        Raises:
            KeyError: a leaf is missing.
            ValueError: a leaf has the wrong width.
            TypeError: an entity contains something other than tensors.
        """
        found: list[Any] = [leaf_of(td, source.key) for source in self._sources]
        keys: list[tuple[NestedKey, _Source]] = []
        if self.layout.is_flat:
            signature: Hashable = tuple(map(_signature, found))
        else:
            keys, found, signature = _expanded(self._sources, found)
        plan = self._plans.get(signature)
        if plan is None:
            if len(self._plans) >= _MAX_PLANS:
                self._plans.clear()
            if self.layout.is_flat:
                plan = self._flat_plan(td, found)
            else:
                plan = self._plan(td, keys, found)
            self._plans[signature] = plan
        return plan, found

    def _flat_plan(self, td: TensorDictBase, found: list[Any]) -> SwapPlan:
        layout = self.layout
        leaves: list[SwapLeaf] = []
        owners: dict[Hashable, tuple[int, torch.Tensor]] = {}
        has_rest = False
        for place, (source, value) in enumerate(zip(self._sources, found, strict=True)):
            if source.is_required and not isinstance(value, torch.Tensor):
                layout.check(td, next=True)  # raises
            if value is None:
                continue
            if source.kind == "state":
                if value.ndim != 2:
                    raise ValueError(
                        f"{source.key!r} has shape {list(value.shape)}, expected "
                        f"[{td.shape[0]}, D]: the columns of a flat layout are those "
                        "of a vector"
                    )
            elif not layout.goal:
                if source.is_desired:
                    continue
                raise ValueError(
                    f"the batch has {source.key!r}, which must follow the swapped "
                    "entities, but the layout does not say which entity each column "
                    "belongs to: give EntityLayout(..., goal=..., achieved=...)"
                )
            elif value.ndim != 2 or value.shape[-1] != layout.goal_width:
                raise ValueError(
                    f"{source.key!r} has shape {list(value.shape)}, but the layout's "
                    f"goal has {layout.goal_width} columns: correct `goal`, or the data"
                )
            width = value.shape[-1]
            kind = (source.kind, width, value.device)
            if kind not in owners:
                owner = (
                    layout.column_entity(width)
                    if source.kind == "state"
                    else layout.goal_column_entity()
                )
                has_rest |= bool((owner < 0).any())
                owner = torch.where(owner < 0, len(layout), owner)
                owners[kind] = len(owners), owner.to(value.device)
            group, owner = owners[kind]
            known = [n if n < len(layout) else -1 for n in owner.tolist()]
            runs = Runs.of(known, value.element_size())
            leaves.append(
                SwapLeaf(
                    source.key, place, owner, width, group, source.is_desired, runs
                )
            )
        states = [
            source.key
            for source, value in zip(self._sources, found, strict=True)
            if source.kind == "state" and value.is_floating_point()
        ]
        return SwapPlan(tuple(leaves), tuple(states), has_rest)

    def _plan(
        self,
        td: TensorDictBase,
        keys: list[tuple[NestedKey, _Source]],
        found: list[Any],
    ) -> SwapPlan:
        if any(o.is_required and td.get(o.key, None) is None for o in self._sources):
            self.layout.check(td, next=True)
        leaves, states = [], []
        for place, ((key, source), value) in enumerate(zip(keys, found, strict=True)):
            if not isinstance(value, torch.Tensor):
                if not source.is_swapped:
                    continue  # nothing happens to it
                raise TypeError(
                    f"{key!r} is a {type(value).__name__}, but an entity is made of "
                    "tensors: leave it out of the entity's sub-tensordict"
                )
            if source.is_swapped:
                entity = source.entity
                size = value.shape[1:].numel() * value.element_size()
                runs = Runs.of([entity], size)
                leaves.append(
                    SwapLeaf(key, place, entity, 1, entity, source.is_desired, runs)
                )
            if source.is_required and value.is_floating_point():
                states.append(key)
        return SwapPlan(tuple(leaves), tuple(states), False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_plans": {}}


def _flat_sources(layout: EntityLayout) -> list[_Source]:
    state, achieved, desired = (
        layout.observation_key,
        layout.achieved_goal_key,
        layout.desired_goal_key,
    )
    found = []
    for key, kind, is_desired in (
        (state, "state", False),
        (achieved, "goal", False),
        (desired, "goal", True),
    ):
        for where in (key, layout.next(key)):
            is_required = kind == "state"
            found.append(_Source(where, kind, -1, is_required, is_desired, True))
    return found


def _sources(layout: EntityLayout) -> list[_Source]:
    found = []
    for entity, name in enumerate(layout.names):
        is_swapped = name not in layout.fixed
        keys = [(layout.keys[name], True, False)]
        if is_swapped:
            keys += [
                (layout.achieved.get(name), False, False),
                (layout.goal.get(name), False, True),
            ]
        for key, is_required, is_desired in keys:
            if key is None:
                continue
            for where in (key, layout.next(key)):
                found.append(
                    _Source(where, "", entity, is_required, is_desired, is_swapped)
                )
    return found


def _signature(value: Any) -> Hashable:
    if isinstance(value, torch.Tensor):
        return value.shape[1:], value.dtype, value.device
    return str(type(value))


def _expanded(
    sources: Sequence[_Source], found: list[Any]
) -> tuple[list[tuple[NestedKey, _Source]], list[Any], Hashable]:
    """Returns the leaves of a nested layout, and what plans depend on.

    Keys and values come from the same iteration: lazy stacks order them differently in
    ``keys`` and ``items``.
    """
    keys: list[tuple[NestedKey, _Source]] = []
    values: list[Any] = []
    signature: list[Hashable] = []
    for source, value in zip(sources, found, strict=True):
        if is_tensor_collection(value) and not is_non_tensor(value):
            items = list(value.items(True, True, is_leaf=is_leaf_nontensor))
            keys += [(join(source.key, below), source) for below, _ in items]
            values += [leaf for _, leaf in items]
            signature.append(tuple((k, _signature(leaf)) for k, leaf in items))
        else:
            if value is not None:
                keys.append((source.key, source))
                values.append(value)
            signature.append(_signature(value))
    return keys, values, tuple(signature)


# --- applying ------------------------------------------------------------------------


def apply_swap(
    td: TensorDictBase,
    plan: SwapPlan,
    values: Sequence[torch.Tensor],
    draw: SwapDraw,
    *,
    window: int = 1,
    sources: Sequence[torch.Tensor] | None = None,
    trajectories: TrajectoryIndex | None = None,
    goals: Callable[[SwapLeaf], torch.Tensor] | None = None,
) -> TensorDictBase:
    """Replaces entities by those of their donors.

    The states, next states, achieved goals and desired goals of the last ``C`` windows
    follow the swap. Everything else, and all other windows, stay.

    Args:
        td (TensorDictBase): the batch, ``[B * window]``. It is not changed.
        plan (SwapPlan): its plan.
        values (sequence of torch.Tensor): its leaves, both of :class:`SwapPlanner`.
        draw (SwapDraw): what was drawn.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        sources (sequence of torch.Tensor, optional): for each leaf of the plan what
            ``draw.donors`` are rows of, ``[T, ...]``; by default the batch itself.
        trajectories (TrajectoryIndex, optional): which row follows which in
            ``sources``; by default the next one.
        goals (callable, optional): reads the desired goals ``[C, ...]`` of a leaf from
            elsewhere.

    Returns:
        TensorDictBase: a shallow copy with new leaves.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.draws import SwapDraw
        >>> from torchrl_caiac.transforms.swap import SwapPlanner, apply_swap
        >>> state = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
        >>> td = TensorDict(
        ...     {"observation": state, ("next", "observation"): state + 10}, [2]
        ... )
        >>> draw = SwapDraw(
        ...     donors=torch.tensor([[0, 0]]),
        ...     swapped=torch.tensor([[False, True]]),
        ...     no_donor=torch.tensor([0, 0]),
        ... )
        >>> planner = SwapPlanner(EntityLayout({"arm": [0], "cup": [1]}))
        >>> out = apply_swap(td, *planner(td), draw)
        >>> out["observation"], out["next", "observation"]
        (tensor([[0., 1.],
                [2., 1.]]), tensor([[10., 11.],
                [12., 11.]]))
    """
    changed = draw.swapped.shape[0]
    if not changed:
        return td.copy()
    if goals is None and (window == 1 or trajectories is None):
        swapped = _swapped(plan, values, draw, window, sources)
        if swapped is not None:
            return with_leaves(td, swapped)
    first = td.shape[0] - changed * window
    device, donors = draw.swapped.device, draw.donors
    own = window_starts(changed, window, device).unsqueeze(-1)
    read = None  # the rows of the donors, if each of them is read once
    if sources is None:
        own = own + first if first else own
    elif window == 1 and {x.device.type for x in (draw.swapped, *sources)} == {"cpu"}:
        # Behind the last rows of the batch.
        read = donors.masked_select(draw.swapped)
        donors = draw.swapped.flatten().cumsum(0).view_as(donors) + (changed - 1)
    else:
        own = torch.zeros_like(own)
    has_own = sources is None or read is not None
    # Where nothing is swapped, a row of the batch is its own donor.
    rows = torch.where(draw.swapped, donors, own)
    if plan.has_rest:  # one more entity, which is never swapped
        rows = torch.cat([rows, own], -1)
    length = td.shape[0] + rows.numel()
    if not has_own:
        length = max(map(len, sources or ()), default=0)
    outside = (rows < 0) | (rows >= length)
    if trajectories is not None and window > 1:
        steps = torch.arange(window, device=device).view(-1, 1)
        # A row of no trajectory has no later ones; it becomes `length` below.
        rows = trajectories.later(rows.masked_fill(outside, 0).unsqueeze(1), steps)
        outside = outside.unsqueeze(1)
    rows = rows.masked_fill(outside, length)  # reading it raises
    width = max((leaf.width for leaf in plan.leaves), default=0)
    if (length + window) * width < 1 << 31:  # with rows after `length`, in windows
        rows = rows.int()  # half as much to write and to read
    places: dict[int, torch.Tensor] = {}
    masks: dict[tuple[int, int], torch.Tensor] = {}
    leaves: dict[NestedKey, torch.Tensor] = {}
    for number, leaf in enumerate(plan.leaves):
        value = values[leaf.place]
        is_complete = has_own
        if goals is not None and leaf.is_desired:
            new, is_complete = goals(leaf).unsqueeze(1), False
        else:
            source = value if sources is None else sources[number]
            if read is not None:
                own_rows = value[first:] if first else value
                source = torch.cat([own_rows, source.index_select(0, read)])
            if leaf.group not in places:
                found = _places(rows, leaf, window)
                places[leaf.group] = found.to(source.device)
            new = _read(source, places[leaf.group], leaf)
        if not is_complete:
            kind = leaf.group, value.ndim
            if kind not in masks:
                masks[kind] = _mask(draw.swapped, leaf, value.ndim, plan.has_rest)
            tail = value[first:].unflatten(0, (changed, window))
            each = 1 if goals is not None and leaf.is_desired else window
            new = new.to(tail.device).view(changed, each, *tail.shape[2:])
            new = torch.where(masks[kind], new, tail).flatten(0, 1)
        leaves[leaf.key] = torch.cat([value[:first], new]) if first else new
    return with_leaves(td, leaves)


def _swapped(
    plan: SwapPlan,
    values: Sequence[torch.Tensor],
    draw: SwapDraw,
    window: int,
    sources: Sequence[torch.Tensor] | None,
) -> dict[NestedKey, torch.Tensor] | None:
    """Returns the new leaves, by C or CUDA; ``None`` if these tensors need torch."""
    own = [values[leaf.place] for leaf in plan.leaves]
    found = own if sources is None else sources
    if not own:
        return {}
    donors, swapped = draw.donors.contiguous(), draw.swapped.contiguous()
    if not is_native(donors, swapped, *own, sources=found):
        return None
    is_as_drawn = (
        (donors.dtype, swapped.dtype) == (torch.int64, torch.bool)
        and donors.shape == swapped.shape
        and donors.ndim == 2
        and all(max(leaf.runs.owners) < swapped.shape[1] for leaf in plan.leaves)
        and all(len(value) >= len(swapped) * window for value in own)
        and all(
            (value.dtype, value.shape[1:]) == (source.dtype, source.shape[1:])
            for value, source in zip(own, found, strict=True)
        )
    )
    if not is_as_drawn:  # the operations of torch say what is wrong
        return None
    runs = [leaf.runs for leaf in plan.leaves]
    new = swap_rows(own, found, runs, donors, swapped, window)
    return {leaf.key: value for leaf, value in zip(plan.leaves, new, strict=True)}


@lru_cache(maxsize=64)
def _inside(
    window: int, width: int, device: torch.device, dtype: torch.dtype
) -> torch.Tensor:
    """Returns the places of a window's values from its first, ``[window, width]``."""
    places = torch.arange(window * width, device=device, dtype=dtype)
    return places.view(window, width)


def _places(rows: torch.Tensor, leaf: SwapLeaf, window: int) -> torch.Tensor:
    """Finds the values of each donor window in a source.

    Args:
        rows (torch.Tensor): the first row of each entity's donor window, ``[C, N]``, or
            all of its rows, ``[C, window, N]``.
        leaf (SwapLeaf): what is read.
        window (int): rows in a window.

    Returns:
        torch.Tensor: rows ``[C * window]`` for one entity's leaf; for columns, places
        ``[C * window * D]`` in the source as one vector.
    """
    if isinstance(leaf.owner, int):
        place = rows[..., leaf.owner : leaf.owner + 1]
    else:
        owner = leaf.owner.to(rows.device)
        place = rows.gather(-1, owner.expand(*rows.shape[:-1], -1))
    if rows.ndim == 3:
        window = 1
    elif window > 1:
        place = place.unsqueeze(1)
    inside = _inside(window, leaf.width, rows.device, place.dtype)
    return torch.add(inside, place, alpha=leaf.width).flatten()


def _mask(
    swapped: torch.Tensor, leaf: SwapLeaf, ndim: int, has_rest: bool
) -> torch.Tensor:
    """Returns which values are swapped, to broadcast with ``[C, window, ...]``."""
    if isinstance(leaf.owner, int):
        return swapped[:, leaf.owner].view(-1, *(1,) * ndim)
    owner = leaf.owner.to(swapped.device).expand(swapped.shape[0], -1)
    if has_rest:
        swapped = F.pad(swapped, (0, 1))
    return swapped.gather(1, owner).unsqueeze(1)


def _read(source: torch.Tensor, places: torch.Tensor, leaf: SwapLeaf) -> torch.Tensor:
    """Reads the values of donor windows, ``[C * window, ...]``."""
    if isinstance(leaf.owner, int):
        return source.index_select(0, places)
    return pick_places(source, places).view(-1, leaf.width)
