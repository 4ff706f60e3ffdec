"""The figures of a report with their titles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchrl_caiac.report.figures import (
    draw_coverage,
    draw_influence,
    draw_lengths,
    draw_scores,
)
from torchrl_caiac.report.settings import Entity, ReportSettings
from torchrl_caiac.report.shares import choose_trajectories
from torchrl_caiac.report.swaps import PairCoverage
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import TrajectoryIndex

__all__ = ["Panel", "influence_panels", "length_panel", "pair_panel", "score_panels"]

_MOST_STRIPS = 12  # entities along one trajectory
_MOST_SCORES = 200_000  # scores in one histogram


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


def length_panel(lengths: np.ndarray[Any, Any]) -> Panel | None:
    """Returns the distribution of the lengths of trajectories.

    Args:
        lengths (numpy.ndarray): int ``[E]``.

    Returns:
        Panel, optional: ``None`` if all are the same.
    """
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


def influence_panels(
    scored: ScoredDataset,
    scores: torch.Tensor,
    influenced: torch.Tensor,
    index: TrajectoryIndex,
    settings: ReportSettings,
    ids: Sequence[int],
) -> tuple[list[Panel], list[str]]:
    """Returns the scores along some trajectories.

    Args:
        scored (ScoredDataset): the scored dataset.
        scores (torch.Tensor): its scores, ``[T, N]``.
        influenced (torch.Tensor): bool ``[T, N]``.
        index (TrajectoryIndex): the trajectories.
        settings (ReportSettings): how many to show.
        ids (sequence of int): the id of each trajectory.

    Returns:
        tuple: the panels, and the entities that they leave out: those that are
        influenced never or less often than others.
    """
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
            f"{name} in {int(count):,} steps"
            for name, count in zip(names, flags.sum(0), strict=True)
            if count
        ]
        said = ", ".join(parts) if parts else "no entity"
        panels.append(
            Panel(
                f"Trajectory {ids[number]}",
                draw_influence(
                    scores[rows][:, shown].numpy(),
                    flags.numpy(),
                    names,
                    [scored.thresholds[name] for name in names],
                    name=f"influence{number}",
                    description=(
                        f"Influence scores along trajectory {ids[number]}, {length} "
                        f"steps. The agent influences {said}."
                    ),
                ),
                f"{length:,} steps. Influenced: {said}.",
            )
        )
    return panels, hidden


def score_panels(entities: Sequence[Entity], scores: torch.Tensor) -> list[Panel]:
    """Returns the distributions of scores.

    Args:
        entities (sequence of Entity): in layout order.
        scores (torch.Tensor): ``[T, N]``.

    Returns:
        list of Panel: one for each entity that is not fixed.
    """
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


def pair_panel(number: int, pair: PairCoverage) -> Panel:
    """Returns the combinations of the places of two entities.

    Args:
        number (int): the number of the panel, for its ids.
        pair (PairCoverage): the combinations.

    Returns:
        Panel: the panel.
    """
    before, after = f"{pair.share_before:.1%}", f"{pair.share_after:.1%}"
    return Panel(
        f"{pair.names[0]} and {pair.names[1]}",
        draw_coverage(
            pair,
            name=f"pair{number}",
            description=(
                f"Grid of the {'places' if pair.known else 'columns'} of "
                f"{pair.names[0]} and {pair.names[1]}. Recorded are {before} "
                f"of the combinations, with swaps {after}."
            ),
        ),
    )
