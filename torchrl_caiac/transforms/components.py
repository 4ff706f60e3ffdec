"""Connected components of local graphs, and drawing donors for them (CoDA).

A component is an int64 bit mask with bit ``i`` set for entity ``i``, so that there are
at most 64 entities. Notation as in :mod:`torchrl_caiac.transforms.draws`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import torch

from torchrl_caiac._random import draw_integers, draw_numbers
from torchrl_caiac.trajectories import TrajectoryIndex
from torchrl_caiac.transforms.donors import BufferDonors, scan_donors
from torchrl_caiac.transforms.draws import SwapDraw
from torchrl_caiac.transforms.indexing import pick_rows, window_max

__all__ = [
    "MAX_ENTITIES",
    "ComponentDonors",
    "ComponentIndex",
    "component_starts",
    "components",
    "draw_batch_components",
    "draw_buffer_components",
]

MAX_ENTITIES = 64

# Rows, and elements of graphs, that are read together while an index is built.
_CHUNK_ROWS = 1 << 17
_CHUNK_ELEMENTS = 1 << 24


class ComponentIndex(NamedTuple):
    """The rows of a storage at which donor windows may start, component by component.

    Attributes:
        masks (torch.Tensor): int64 ``[U]``, ascending, the components that occur.
        starts (torch.Tensor): integer ``[M]``, the rows for the first component, then
            for the second, and so on.
        offset (torch.Tensor): int64 ``[U]``, where a component's rows begin.
        size (torch.Tensor): int64 ``[U]``, the number of its rows.
    """

    masks: torch.Tensor
    starts: torch.Tensor
    offset: torch.Tensor
    size: torch.Tensor


# --- bit masks -----------------------------------------------------------------------


@lru_cache(maxsize=64)
def _bits(entities: int, device: torch.device) -> torch.Tensor:
    """Returns the bit of each entity, int64 ``[N]``."""
    bits = [1 << i if i < 63 else -(1 << 63) for i in range(entities)]
    return torch.tensor(bits, dtype=torch.int64, device=device)


@lru_cache(maxsize=64)
def _lower_bits(entities: int, device: torch.device) -> torch.Tensor:
    """Returns the bits of the entities before each one, int64 ``[N]``."""
    lower = [(1 << i) - 1 for i in range(entities)]
    return torch.tensor(lower, dtype=torch.int64, device=device)


def _packed(chosen: torch.Tensor) -> torch.Tensor:
    """Returns the bit mask of bools ``[*, N]``, int64 ``[*]``."""
    return (chosen * _bits(chosen.shape[-1], chosen.device)).sum(-1)


def _links(graphs: torch.Tensor, threshold: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the links of each entity, ``[R, N]``, and of the action, ``[R]``."""
    entities = graphs.shape[-1]
    # NaN, that is not scored, links everything: nothing may be swapped.
    linked = ~(graphs <= threshold)
    among, action = linked[:, :entities], linked[:, entities]
    return _packed(among | among.mT), _packed(action)


def _joined(links: torch.Tensor, held: torch.Tensor) -> torch.Tensor:
    """Returns each entity's component, 0 if it touches ``held``, int64 ``[R, N]``."""
    entities = links.shape[-1]
    # Warshall's closure of all graphs at once: what reaches k reaches what k does.
    masks = links.t().contiguous() | _bits(entities, links.device).unsqueeze(-1)
    for k in range(entities):
        masks |= -((masks >> k) & 1) & masks[k]
    return torch.where(masks & held == 0, masks, 0).t().contiguous()


def _leads(masks: torch.Tensor) -> torch.Tensor:
    """Returns whether an entity is the first one of its component, bool ``[R, N]``."""
    lower = _lower_bits(masks.shape[-1], masks.device)
    return (masks & lower == 0) & (masks != 0)


def _leader(masks: torch.Tensor) -> torch.Tensor:
    """Returns the first entity of each component, int64 ``[R, N]``, 0 for none."""
    # As a power of two in float64, which is exact, bit 63 (the sign) included.
    lowest = (masks & -masks).double().abs()
    return (torch.frexp(lowest).exponent - 1).clamp_min(0).long()


def components(
    graphs: torch.Tensor,
    threshold: float,
    *,
    window: int = 1,
    fixed: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns the component of each entity in each window's graph (CoDA).

    Two entities belong together where, in any row of the window and in any direction,
    one influences the other by more than ``threshold``, or by a chain of such links.
    The action's links only decide which components contain it.

    Args:
        graphs (torch.Tensor): ``[B * window, N + 1, N]``, from the row (the entities,
            then the action) to the column; NaN, not scored, counts as a link.
        threshold (float): scores above it are links, θ.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        fixed (torch.Tensor, optional): bool ``[N]``, entities that are never swapped.

    Returns:
        torch.Tensor: int64 ``[B, N]``, the component as a bit mask; 0 where it contains
        the action or a fixed entity.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.components import components
        >>> graph = torch.zeros(1, 5, 4)
        >>> graph[0, 1, 2] = graph[0, 4, 0] = 1.0  # entity 1 to 2, action to entity 0
        >>> components(graph, 0.2)
        tensor([[0, 6, 6, 8]])
    """
    links, held = _links(window_max(graphs, window), threshold)
    if fixed is not None:
        held = held | _packed(fixed.to(held.device))
    return _joined(links, held)


# --- drawing -------------------------------------------------------------------------


def _shared(
    masks: torch.Tensor,
    swap_prob: float,
    chosen: torch.Tensor | None,
    generator: torch.Generator | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draws what a component shares: leader, random number, whether it is chosen."""
    leader, device = _leader(masks), masks.device
    is_chosen = masks != 0
    if chosen is not None:
        is_chosen = is_chosen & chosen.unsqueeze(-1)
    if swap_prob < 1.0:
        chance = draw_numbers(
            torch.rand, masks.shape, device=device, generator=generator
        )
        is_chosen = is_chosen & (chance < swap_prob).gather(1, leader)
    pick = draw_integers(masks.shape, device=device, generator=generator)
    return leader, pick.gather(1, leader), is_chosen


def draw_batch_components(
    masks: torch.Tensor,
    num_windows: int,
    *,
    window: int = 1,
    swap_prob: float = 1.0,
    chosen: torch.Tensor | None = None,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the windows of the batch itself.

    Each component of each chosen window draws one of the *other* windows that
    have the same component, all with the same probability and independently of the
    other components.

    Args:
        masks (torch.Tensor): int64 ``[B, N]``, of :func:`components`.
        num_windows (int): the number of windows that donors are drawn for, ``C``: the
            last ones of the batch.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        swap_prob (float): probability of swapping a component. Defaults to 1.
        chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
            counterfactual. Defaults to all of them.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the batch, the same for all entities of a
        component.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.components import draw_batch_components
        >>> masks = torch.tensor([[3, 3, 0], [1, 2, 4], [3, 3, 4]])
        >>> draw = draw_batch_components(masks, 1)
        >>> draw.donors, draw.swapped
        (tensor([[0, 0, 1]]), tensor([[True, True, True]]))
    """
    count, entities = masks.shape
    first = count - num_windows
    tail = masks[first:]
    leader, pick, is_chosen = _shared(tail, swap_prob, chosen, generator)
    # Sorted, the windows of each component are consecutive, each once, by its leader.
    keys, order = torch.where(_leads(masks), masks, 0).flatten().sort(stable=True)
    places = torch.arange(order.shape[0], device=masks.device)
    place = torch.empty_like(order).scatter_(0, order, places)
    begin = torch.searchsorted(keys, tail)
    others = torch.searchsorted(keys, tail, right=True) - begin - 1
    pick = begin + pick % others.clamp_min(1)
    # A window is among those of its own component: skip it.
    place = place.view(count, entities)[first:]
    pick += pick >= place.gather(1, leader)
    donors = pick_rows(order, pick.clamp_max(order.shape[0] - 1)) // entities
    swapped = is_chosen & (others > 0)
    no_donor = (is_chosen ^ swapped).sum(0)
    return SwapDraw(donors * window, swapped, no_donor, chosen=chosen)


def draw_buffer_components(
    masks: torch.Tensor,
    index: ComponentIndex,
    *,
    swap_prob: float = 1.0,
    chosen: torch.Tensor | None = None,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the windows of a donor storage that have the same component.

    Args:
        masks (torch.Tensor): int64 ``[C, N]``, of :func:`components`.
        index (ComponentIndex): the components of the storage's windows.

    Keyword Args:
        swap_prob (float): probability of swapping a component. Defaults to 1.
        chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
            counterfactual. Defaults to all of them.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the storage, the same for all entities of a
        component.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.components import (
        ...     ComponentIndex,
        ...     draw_buffer_components,
        ... )
        >>> index = ComponentIndex(*torch.tensor([[3], [7], [0], [1]]))
        >>> draw = draw_buffer_components(torch.tensor([[3, 3, 4]]), index)
        >>> draw.donors[draw.swapped]
        tensor([7, 7])
    """
    device, home = masks.device, index.masks.device
    _, pick, is_chosen = _shared(masks, swap_prob, chosen, generator)
    place = torch.searchsorted(index.masks, masks.to(home))
    place = place.clamp_max(index.masks.shape[0] - 1)
    found = (pick_rows(index.masks, place) == masks.to(home)).to(device)
    size, offset = pick_rows(index.size, place), pick_rows(index.offset, place)
    pick = pick.to(home) % size.clamp_min(1) + offset
    donors = pick_rows(index.starts, pick).to(device, torch.int64)
    swapped = is_chosen & found
    return SwapDraw(donors, swapped, (is_chosen ^ swapped).sum(0), chosen=chosen)


# --- what may be drawn from a storage ------------------------------------------------


def _slid(links: torch.Tensor, window: int) -> torch.Tensor:
    """Returns all links of each row and of the ``window - 1`` rows after it."""
    size = 1
    while size < window:
        step = min(size, window - size)
        links = links[:-step] | links[step:]
        size += step
    return links


def component_starts(
    graphs: torch.Tensor,
    threshold: float,
    fixed: torch.Tensor,
    *,
    window: int = 1,
    trajectories: TrajectoryIndex | None = None,
) -> ComponentIndex:
    """Finds the rows at which windows start, by the components that they have.

    All rows of such a window belong to one trajectory, and in none of them the
    component contains the action or a fixed entity. The index takes 4 bytes for each
    pair of row and component.

    Args:
        graphs (torch.Tensor): ``[T, N + 1, N]``, NaN where a row was not scored.
        threshold (float): scores above it are links, θ.
        fixed (torch.Tensor): bool ``[N]``, entities that are never swapped.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        trajectories (TrajectoryIndex, optional): needed for windows of several rows.

    Returns:
        ComponentIndex: the rows of every component.

    Raises:
        ValueError: a score is infinite.
        RuntimeError: the graphs were written to meanwhile.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.components import component_starts
        >>> graphs = torch.zeros(3, 3, 2)
        >>> graphs[0, 0, 1] = 1.0  # the entities 0 and 1 are one component
        >>> index = component_starts(graphs, 0.2, torch.tensor([False, False]))
        >>> index.masks, index.starts
        (tensor([1, 2, 3]), tensor([1, 2, 1, 2, 0], dtype=torch.int32))
    """
    length, _, entities = graphs.shape
    device = graphs.device
    never = _packed(fixed.to(device))
    step = min(_CHUNK_ROWS, max(window, _CHUNK_ELEMENTS // (entities * (entities + 1))))

    def found() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yields the rows of each part, and their components, sorted by component."""
        for rows, part in scan_donors(graphs, step, window, trajectories, "graphs"):
            links, held = _links(part, threshold)
            joined = _joined(_slid(links, window), _slid(held, window) | never)
            rows = rows[: joined.shape[0]]
            leads = _leads(joined)
            if window > 1 and trajectories is not None:
                leads &= (trajectories.remaining(rows) >= window - 1).unsqueeze(-1)
            own, order = joined[leads].sort(stable=True)
            yield rows.unsqueeze(-1).expand_as(leads)[leads][order], own

    # Read twice, first to count: a list of all parts would need as much as the index.
    counted = [own.unique_consecutive(return_counts=True) for _, own in found()]
    empty = torch.empty(0, dtype=torch.int64, device=device)
    masks, place = torch.cat([empty, *(own for own, _ in counted)]).unique(
        return_inverse=True
    )
    if not len(masks):  # the index needs at least one component; 0 is none
        one = torch.ones(1, dtype=torch.int64, device=device)
        return ComponentIndex(one - 1, (one - 1).int(), one - 1, one)
    counts = torch.cat([count for _, count in counted])
    size = torch.zeros_like(masks).index_add_(0, place, counts)
    offset = size.cumsum(0) - size
    dtype = torch.int32 if length < 1 << 31 else torch.int64
    starts = torch.empty(int(size.sum()), dtype=dtype, device=device)
    following = offset.clone()
    parts = place.split([len(own) for own, _ in counted])
    for own, (_, count), (rows, now) in zip(parts, counted, found(), strict=True):
        if not torch.equal(masks[own].repeat_interleave(count), now):
            raise RuntimeError(
                "the graphs of the donors were written to while they were indexed: "
                "sample again when no other process or thread scores the donors"
            )
        shift = following[own] - (count.cumsum(0) - count)
        here = shift.repeat_interleave(count) + torch.arange(len(rows), device=device)
        starts[here] = rows.to(dtype)
        following[own] += count
    return ComponentIndex(masks, starts, offset, size)


class ComponentDonors(BufferDonors):
    """A replay buffer whose windows are donors of components.

    As :class:`~torchrl_caiac.transforms.donors.BufferDonors`, with graphs in
    ``score_key`` and bit masks instead of free entities.
    """

    scores_name: ClassVar[str] = "graphs"
    key_argument: ClassVar[str] = "graph_key"

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's graph, ``(N + 1, N)``."""
        return len(self.layout) + 1, len(self.layout)

    def eligible(
        self, scores: torch.Tensor, trajectories: TrajectoryIndex | None
    ) -> ComponentIndex:
        """Finds the windows that may donate, see :func:`component_starts`."""
        return component_starts(
            scores,
            self.thresholds.number,
            self.layout.fixed_mask,
            window=self.window,
            trajectories=trajectories,
        )

    def choose(self, free: torch.Tensor, index: Any, **kwargs: Any) -> SwapDraw:
        """Draws among the windows of :meth:`eligible`."""
        return draw_buffer_components(free, index, **kwargs)

    def draw(
        self,
        free: torch.Tensor,
        *,
        swap_prob: float = 1.0,
        chosen: torch.Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> SwapDraw:
        """Draws donors, and the goals of donor windows.

        Args:
            free (torch.Tensor): int64 ``[C, N]``, the components that may be swapped.

        Keyword Args:
            swap_prob (float): probability of swapping a component. Defaults to 1.
            chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
                counterfactual. Defaults to all of them.
            generator (torch.Generator, optional): source of randomness.

        Returns:
            SwapDraw: donors and goals as rows of the donor storage, the same for all
            entities of a component.
        """
        draw = super().draw(
            free, swap_prob=swap_prob, chosen=chosen, generator=generator
        )
        if draw.goal_rows is None:
            return draw
        leader = _leader(free).to(draw.goal_rows.device)
        return draw._replace(goal_rows=draw.goal_rows.gather(1, leader))
