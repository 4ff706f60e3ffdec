"""What a report says: numbers, problems and figures, before they become a page."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from tensordict.utils import NestedKey

from torchrl_caiac._columns import column_ranges
from torchrl_caiac._keys import path
from torchrl_caiac.check import DatasetReport, check_dataset
from torchrl_caiac.data import action_bounds
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.report.examples import Example, draw_examples
from torchrl_caiac.report.figures import (
    draw_coverage,
    draw_influence,
    draw_lengths,
    draw_scores,
)
from torchrl_caiac.report.pictures import RenderFn
from torchrl_caiac.report.places import entity_places
from torchrl_caiac.report.shares import EntityShares, choose_trajectories, entity_shares
from torchrl_caiac.report.swaps import (
    PairCoverage,
    SampledSwaps,
    choose_examples,
    pair_coverage,
    sample_swaps,
)
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index

__all__ = [
    "Entity",
    "Panel",
    "Problem",
    "ReportContents",
    "ReportSettings",
    "collect_contents",
]

_logger = logging.getLogger("torchrl_caiac.report")
# What ``suggest_thresholds`` says of thresholds.
NEVER_INFLUENCED = "one mode: never influenced"
UNCLEAR = "unclear"
_CHECKED_ROWS = 50_000
_MOST_STRIPS = 12  # entities along one trajectory
_MOST_SCORES = 200_000  # scores in one histogram


@dataclass(frozen=True)
class ReportSettings:
    """How much a report shows; see :func:`~torchrl_caiac.report.write_report`."""

    windows: tuple[int, ...] = (10, 20)
    trajectories: int = 4
    pairs: int = 6
    examples: int = 4
    samples: int = 20_480
    ratio: float = 0.5
    seed: int = 0
    trajectory_key: NestedKey | None = "episode"
    done_key: NestedKey | None = ("next", "done")


@dataclass(frozen=True)
class Entity:
    """A row of the report's tables.

    Attributes:
        name (str): the entity.
        fixed (bool): whether it is never swapped.
        features (str): its observation columns or key.
        places (str): the features that say where it is; ``""`` if unknown.
        floor (str): the layout's variance floor; ``""`` if unknown.
        threshold (float, optional): θ; ``None`` for fixed entities.
        confidence (str): how sure the threshold is.
        reason (str): why.
        shares (EntityShares): how often it may be swapped.
    """

    name: str
    fixed: bool
    features: str
    places: str
    floor: str
    threshold: float | None
    confidence: str
    reason: str
    shares: EntityShares


@dataclass(frozen=True)
class Problem:
    """Something that a reader should know before using the data.

    Attributes:
        severity (str): ``"error"``, ``"warning"`` or ``"note"``.
        text (str): what was found.
        effect (str): what it does; ``""`` if the text says it.
        remedy (str): what to do; ``""`` for nothing.
    """

    severity: Literal["error", "warning", "note"]
    text: str
    effect: str = ""
    remedy: str = ""


@dataclass(frozen=True)
class Panel:
    """A figure with a title.

    Attributes:
        title (str): the title.
        svg (str): the ``<svg>`` element.
        text (str): what is said below the title.
    """

    title: str
    svg: str
    text: str = ""


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
        """The mean share of combinations before and after, over the pairs."""
        if not self.pairs:
            return None
        count = len(self.pairs)
        return (
            sum(pair.share_before for pair in self.pairs) / count,
            sum(pair.share_after for pair in self.pairs) / count,
        )


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
    entities = [
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
    check = check_dataset(
        data,
        layout,
        trajectory_key=settings.trajectory_key,
        done_key=settings.done_key,
        action_spec=action_bounds(data),
        max_rows=_CHECKED_ROWS,
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
    examples, rendered, trouble = draw_examples(
        scored, swaps, chosen, influenced, places, index, render
    )
    problems = [
        *_findings(check),
        *(Problem("warning", text) for text in scored.warnings),
        *_threshold_problems(entities),
    ]
    if swaps.no_donor:
        problems.append(
            Problem(
                "note",
                f"In {swaps.no_donor:,} samples an entity could have been swapped, but "
                "no other sample of the batch could give it another state",
                remedy="give CAIACTransform a donor buffer (donors=rb)",
            )
        )
    if trouble:
        _logger.warning("the examples are not rendered: %s", trouble)
        problems.append(
            Problem(
                "note",
                "The examples are drawn, not rendered, because the simulator could "
                f"not render: {trouble}",
            )
        )
    order = ("error", "warning", "note")
    lengths = index.lengths.numpy()
    panels, hidden = _influence_panels(scored, scores, influenced, index, settings)
    action = data.get("action", None)
    return ReportContents(
        num_rows=len(data),
        num_trajectories=len(lengths),
        lengths=(int(lengths.min()), float(np.median(lengths)), int(lengths.max())),
        num_actions=0 if action is None else int(action[:1].numel()),
        entities=entities,
        problems=sorted(problems, key=lambda p: order.index(p.severity)),
        check=check,
        length_panel=_length_panel(lengths),
        influence_panels=panels,
        hidden_entities=hidden,
        score_panels=_score_panels(entities, scores),
        pairs=pairs,
        pair_panels=[
            _pair_panel(number, pair)
            for number, pair in enumerate(pairs[: settings.pairs])
        ],
        swaps=swaps,
        examples=examples,
        rendered=rendered,
    )


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


def _findings(check: DatasetReport) -> list[Problem]:
    return [
        Problem(
            "error" if finding.severity == "error" else "warning",
            finding.message,
            finding.effect,
            finding.remedy,
        )
        for finding in check.findings
    ]


def _threshold_problems(entities: Sequence[Entity]) -> list[Problem]:
    swappable = [entity for entity in entities if not entity.fixed]
    found = []
    for entity in swappable:
        if entity.confidence != UNCLEAR:
            continue
        found.append(
            Problem(
                "warning",
                f"No clear threshold was found for {entity.name}: {entity.reason}",
                "it is never swapped"
                if entity.shares.rows == 0
                else "it may be swapped while the agent moves it",
                "look at its scores below, and choose a threshold by hand",
            )
        )
    never = [e for e in swappable if e.shares.rows == 0 and e.confidence != UNCLEAR]
    found += [
        Problem(
            "warning",
            f"{e.name} is never swapped: its score is above the threshold in every "
            "transition",
            "no counterfactual changes it",
            "check that it ever rests; if so, the threshold is too low",
        )
        for e in never
    ]
    always = [e for e in swappable if e.shares.rows == 1]
    expected = [e.name for e in always if e.confidence == NEVER_INFLUENCED]
    if expected:
        found.append(
            Problem(
                "note",
                f"Never influenced are {', '.join(expected)}: they may be swapped in "
                "every transition",
            )
        )
    others = [e.name for e in always if e.confidence != NEVER_INFLUENCED]
    if others:
        found.append(
            Problem(
                "warning",
                f"Swapped in every transition may be {', '.join(others)}: the score is "
                "never above the threshold",
                "if the agent does move them, counterfactuals are wrong",
                "look at their scores below",
            )
        )
    return found


def _length_panel(lengths: np.ndarray[Any, Any]) -> Panel | None:
    if lengths.min() == lengths.max():
        return None
    return Panel(
        "Lengths of the trajectories",
        draw_lengths(
            lengths,
            name="lengths",
            description=(
                f"Histogram of the lengths of {len(lengths)} trajectories, from "
                f"{lengths.min()} to {lengths.max()} transitions."
            ),
        ),
    )


def _influence_panels(
    scored: ScoredDataset,
    scores: torch.Tensor,
    influenced: torch.Tensor,
    index: TrajectoryIndex,
    settings: ReportSettings,
) -> tuple[list[Panel], list[str]]:
    layout = scored.layout
    movable = [i for i, name in enumerate(layout.names) if name not in layout.fixed]
    # Those that are influenced most often, in layout order.
    often = influenced[:, movable].sum(0)
    most = min(_MOST_STRIPS, int((often > 0).sum()) or len(movable))
    order = often.argsort(descending=True, stable=True)[:most]
    shown = sorted(movable[i] for i in order.tolist())
    hidden = [layout.names[i] for i in movable if i not in shown]
    names = [layout.names[i] for i in shown]
    panels = []
    for number in choose_trajectories(
        influenced[:, shown], index, settings.trajectories, settings.seed
    ):
        last = int(index.ends[number])
        length = int(index.lengths[number])
        rows = index.rows(torch.arange(last - length + 1, last + 1))
        flags = influenced[rows][:, shown]
        parts = [
            f"{name} in {int(count)} steps"
            for name, count in zip(names, flags.sum(0), strict=True)
            if count
        ]
        said = ", ".join(parts) if parts else "no entity"
        panels.append(
            Panel(
                f"Trajectory {number + 1}",
                draw_influence(
                    scores[rows][:, shown].numpy(),
                    flags.numpy(),
                    names,
                    [scored.thresholds[name] for name in names],
                    name=f"influence{number}",
                    description=(
                        f"Influence scores along trajectory {number + 1}, {length} "
                        f"steps. The agent influences {said}."
                    ),
                ),
                f"{length} steps. Influenced: {said}.",
            )
        )
    return panels, hidden


def _score_panels(entities: Sequence[Entity], scores: torch.Tensor) -> list[Panel]:
    step = -(-len(scores) // _MOST_SCORES)
    panels = []
    for i, entity in enumerate(entities):
        if entity.threshold is None:
            continue
        values = scores[::step, i].numpy()
        panels.append(
            Panel(
                entity.name,
                draw_scores(
                    values,
                    entity.threshold,
                    name=f"scores{i}",
                    description=(
                        f"Histogram of the scores of {entity.name}. In "
                        f"{entity.shares.rows:.1%} of the transitions they are at most "
                        f"the threshold, {entity.threshold:.3g}."
                    ),
                ),
                entity.reason,
            )
        )
    return panels


def _pair_panel(number: int, pair: PairCoverage) -> Panel:
    before, after = f"{pair.share_before:.1%}", f"{pair.share_after:.1%}"
    return Panel(
        f"{pair.names[0]} and {pair.names[1]}",
        draw_coverage(
            pair,
            name=f"pair{number}",
            description=(
                f"Grid of the places of {pair.names[0]} and {pair.names[1]}. Recorded "
                f"are {before} of the combinations, with swaps {after}."
            ),
        ),
    )
