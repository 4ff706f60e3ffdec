"""What a report says: numbers, problems and figures, before they become a page."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from torchrl_caiac._columns import column_ranges
from torchrl_caiac._keys import path
from torchrl_caiac.check import DatasetReport, check_dataset
from torchrl_caiac.data import action_bounds
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.report.examples import Example, draw_examples
from torchrl_caiac.report.panels import (
    Panel,
    influence_panels,
    length_panel,
    pair_panel,
    score_panels,
)
from torchrl_caiac.report.pictures import RenderFn
from torchrl_caiac.report.places import Place, entity_places
from torchrl_caiac.report.problems import Problem, find_problems
from torchrl_caiac.report.settings import Entity, ReportSettings
from torchrl_caiac.report.shares import EntityShares, entity_shares, trajectory_ids
from torchrl_caiac.report.swaps import (
    PairCoverage,
    SampledSwaps,
    choose_examples,
    pair_coverage,
    sample_swaps,
)
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["ReportContents", "collect_contents"]

_logger = logging.getLogger("torchrl_caiac.report")


@dataclass(frozen=True)
class ReportContents:
    """Everything that a report shows.

    Attributes:
        num_rows (int): the number of transitions.
        num_trajectories (int): the number of trajectories.
        lengths (tuple of float): the shortest, the median and the longest trajectory.
        num_actions (int): the width of the action; 0 if there is none.
        entities (list of Entity): in layout order.
        problems (list of Problem): the worst first.
        check (DatasetReport): the check of the dataset.
        length_panel (Panel, optional): the distribution of lengths; ``None`` if all
            are the same.
        influence_panels (list of Panel): one for each trajectory shown.
        hidden_entities (list of str): what the influence panels leave out.
        score_panels (list of Panel): one for each entity that is not fixed.
        pairs (list of PairCoverage): those that gain most first.
        pair_panels (list of Panel): the first of these.
        swaps (SampledSwaps): the samples behind pairs and examples.
        examples (list of Example): counterfactual samples.
        rendered (bool): whether the examples are pictures of a simulator.
    """

    num_rows: int
    num_trajectories: int
    lengths: tuple[float, float, float]
    num_actions: int
    entities: list[Entity]
    problems: list[Problem]
    check: DatasetReport
    length_panel: Panel | None
    influence_panels: list[Panel]
    hidden_entities: list[str]
    score_panels: list[Panel]
    pairs: list[PairCoverage]
    pair_panels: list[Panel]
    swaps: SampledSwaps
    examples: list[Example]
    rendered: bool

    @property
    def swappable(self) -> list[Entity]:
        """The entities that are not fixed."""
        return [entity for entity in self.entities if not entity.fixed]

    @property
    def share_swapped(self) -> float:
        """The share of counterfactual samples in which an entity was swapped."""
        flags = self.swaps.swapped[self.swaps.counterfactual]
        return flags.any(-1).double().mean().item() if len(flags) else 0.0

    @property
    def mean_coverage(self) -> tuple[float, float] | None:
        """The mean share of combinations before and after, over pairs of positions."""
        pairs = [pair for pair in self.pairs if pair.known]
        if not pairs:
            return None
        return (
            sum(pair.share_before for pair in pairs) / len(pairs),
            sum(pair.share_after for pair in pairs) / len(pairs),
        )

    @property
    def unplaced(self) -> list[str]:
        """The entities of pairs whose positions the layout does not name."""
        cells = [cell for pair in self.pairs for cell in pair.cells]
        unknown = {cell.name for cell in cells if not cell.known}
        return [entity.name for entity in self.entities if entity.name in unknown]


def collect_contents(
    scored: ScoredDataset,
    settings: ReportSettings,
    render: RenderFn | Literal["auto"] | None,
) -> ReportContents:
    """Computes everything that a report shows.

    Args:
        scored (ScoredDataset): the scored dataset.
        settings (ReportSettings): how much to show.
        render (callable, "auto" or None): as in
            :func:`~torchrl_caiac.report.write_report`.

    Returns:
        ReportContents: the contents.

    Raises:
        ValueError: rows have no score, or no entity may be swapped.
    """
    data, layout = scored.data, scored.layout
    scores = _complete_scores(scored)
    index = trajectory_index(
        data, trajectory_key=settings.trajectory_key, done_key=settings.done_key
    )
    influenced = ~scored.is_free
    shares = entity_shares(influenced, index, settings.windows)
    places = entity_places(layout, data)
    entities = _entities(scored, places, shares)
    check = check_dataset(
        data,
        layout,
        trajectory_key=settings.trajectory_key,
        done_key=settings.done_key,
        action_spec=action_bounds(data),
        variance_floor=layout.variance_floor or None,
    )
    swaps = sample_swaps(
        data,
        layout,
        {e.name: e.threshold for e in entities if e.threshold is not None},
        score_key=scored.score_key,
        rows=settings.samples,
        ratio=settings.ratio,
        seed=settings.seed,
    )
    pairs = pair_coverage(swaps, places, layout.fixed)
    chosen = choose_examples(
        swaps, influenced, places, layout.fixed, index, settings.examples
    )
    ids = trajectory_ids(data, index, settings.trajectory_key)
    examples, rendered, trouble = draw_examples(
        scored, swaps, chosen, influenced, places, index, ids, render
    )
    if trouble:
        _logger.warning("the examples are not rendered: %s", trouble)
    lengths = index.lengths.numpy()
    panels, hidden = influence_panels(scored, scores, influenced, index, settings, ids)
    action = data.get("action", None)
    return ReportContents(
        num_rows=len(data),
        num_trajectories=len(lengths),
        lengths=(int(lengths.min()), float(np.median(lengths)), int(lengths.max())),
        num_actions=0 if action is None else int(action[:1].numel()),
        entities=entities,
        problems=find_problems(check, scored.warnings, entities, swaps, trouble),
        check=check,
        length_panel=length_panel(lengths),
        influence_panels=panels,
        hidden_entities=hidden,
        score_panels=score_panels(entities, scores),
        pairs=pairs,
        pair_panels=[
            pair_panel(number, pair)
            for number, pair in enumerate(pairs[: settings.pairs])
        ],
        swaps=swaps,
        examples=examples,
        rendered=rendered,
    )


def _entities(
    scored: ScoredDataset, places: Mapping[str, Place], shares: Sequence[EntityShares]
) -> list[Entity]:
    layout = scored.layout
    return [
        Entity(
            name=name,
            fixed=name in layout.fixed,
            features=_features(layout, name),
            places=places[name].text if places[name].known else "",
            floor=_floor(layout, name),
            threshold=None if name in layout.fixed else scored.thresholds[name],
            confidence=scored.confidence.get(name, ""),
            reason=scored.reasons.get(name, ""),
            shares=shares[i],
        )
        for i, name in enumerate(layout.names)
    ]


def _complete_scores(scored: ScoredDataset) -> torch.Tensor:
    layout = scored.layout
    scores = scored.scores.as_subclass(torch.Tensor)
    expected = (len(scored.data), len(layout))
    if tuple(scores.shape) != expected:
        raise ValueError(
            f"the scores {scored.score_key!r} have shape {list(scores.shape)}, "
            f"expected {list(expected)}: score the dataset with this layout"
        )
    swappable = [name for name in layout.names if name not in layout.fixed]
    if not swappable:
        raise ValueError(
            "all entities of the layout are fixed, so nothing can be swapped: leave "
            "the objects out of EntityLayout(fixed=...)"
        )
    lacking = sorted(set(swappable) - set(scored.thresholds))
    if lacking:
        raise ValueError(
            f"thresholds lack {lacking}: give one for each entity that is not fixed"
        )
    missing = int((~scores.isfinite()).any(-1).sum())
    if missing:
        raise ValueError(
            f"{missing} of {len(scores)} rows of {scored.score_key!r} have no finite "
            "score: score the dataset again"
        )
    return scores


def _features(layout: EntityLayout, name: str) -> str:
    if layout.is_flat:
        key = "/".join(path(layout.in_keys[0]))
        return f"{key}{column_ranges(layout.columns[name])}"
    return "/".join(path(layout.keys[name]))


def _floor(layout: EntityLayout, name: str) -> str:
    floor: Any = layout.variance_floor.get(name)
    if floor is None:
        return ""
    values = sorted(set(floor)) if isinstance(floor, Sequence) else [floor]
    if len(values) == 1:
        return f"{values[0]:.4g}"
    return f"{values[0]:.4g} to {values[-1]:.4g}"
