"""Checks that columns which move together belong to one entity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

import torch

from torchrl_caiac._column_motion import motion_correlations, moving_columns
from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.regression import Regression
from torchrl_caiac.check.report import Finding
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States
from torchrl_caiac.check.values import named
from torchrl_caiac.entities import EntityLayout

__all__ = ["check_grouping"]

_ROWS = 50_000  # rows in which motion is compared
_LEAST = 20  # rows in which a column moves: fewer prove nothing
_TOGETHER = 0.7  # correlation of "moves now" with a column of another entity
_APART = 0.5  # the same, at most, with the other columns of its own entity
_ALONE = 0.9  # instead of the first, for the only moving column of an entity
_MAX_COLUMNS = 1024  # wider observations, such as images, are left out


def check_grouping(
    layout: EntityLayout,
    sample: Sample,
    states: States,
    whole: torch.Tensor,
    regression: Regression | None,
    explained: Collection[str],
) -> list[Finding]:
    """Finds columns that move with another entity, or that move and have none.

    A column moves in a transition if it changes by more than a thousandth of its range,
    as in :func:`~torchrl_caiac.inspection.inspect_dataset`.

    Args:
        layout (EntityLayout): the entities.
        sample (Sample): the rows.
        states (States): their states and next states.
        whole (torch.Tensor): the rows whose next state is theirs, bool ``[n]``.
        regression (Regression, optional): the linear functions between columns.
        explained (collection of str): names of columns of which another finding tells
            that they are functions of others.

    Returns:
        list of Finding: what was found.
    """
    chosen = whole.nonzero()[:, 0]
    chosen = chosen[:: max(1, -(-len(chosen) // _ROWS))]
    if not len(chosen):
        return []
    owner, free = states.owners, _free_columns(layout, sample)
    now, after = states.now[chosen], states.next[chosen]
    key = layout.observation_key
    if free and key is not None:
        picked = sample.at(sample.rows[chosen])
        now = torch.cat([now, picked.read(key, free)], 1)
        after = torch.cat([after, picked.read(layout.next(key), free)], 1)
    if now.shape[1] > _MAX_COLUMNS:
        return []
    moving = moving_columns(now.double(), after.double() - now.double())
    moves = (moving.sum(0) >= _LEAST).tolist()
    movable = [c for c in range(len(owner)) if moves[c]]
    together = motion_correlations(moving)
    findings = []
    misplaced = {
        states.labels[c]: name
        for c, name in _misplaced(together, movable, owner, layout.fixed).items()
        if states.labels[c] not in explained
    }
    if misplaced:
        message = "columns that move with another entity than their own: " + named(
            [f"{label} with {other!r}" for label, other in misplaced.items()]
        )
        findings.append(finding("moves_with_other", message, columns=list(misplaced)))
    loose = [c for c, does in zip(free, moves[len(owner) :], strict=True) if does]
    if loose and key is not None and regression is not None:
        # A function of the robot's columns is right after every swap.
        follows = regression.follows(sample.read(key, loose)).tolist()
        loose = [c for c, does in zip(loose, follows, strict=True) if not does]
    if loose:
        columns = [f"{key!r} (column {c})" for c in loose]
        message = f"columns that move, but belong to no entity: {named(columns)}"
        findings.append(
            finding("unowned_columns_move", message, key=key, columns=columns)
        )
    return findings


def _free_columns(layout: EntityLayout, sample: Sample) -> list[int]:
    """Returns the columns of a flat observation that no entity owns."""
    if not layout.is_flat or layout.observation_key is None:
        return []
    width = sample.data.get(layout.observation_key).shape[1]
    if width > _MAX_COLUMNS:
        return []
    free: list[int] = (layout.column_entity(width) < 0).nonzero()[:, 0].tolist()
    return free


def _misplaced(
    together: torch.Tensor,
    columns: list[int],
    owner: list[str],
    fixed: Collection[str],
) -> dict[int, str]:
    """Returns the columns that move with another entity, and that entity."""
    found: dict[int, str] = {}
    for group in _linked(together[columns][:, columns] >= _TOGETHER):
        members = [columns[i] for i in group]
        counts = Counter(owner[c] for c in members)
        for name in counts:
            mine = [c for c in members if owner[c] == name]
            rest = [c for c in columns if owner[c] == name and c not in members]
            others = [(n, count) for n, count in counts.most_common() if n != name]
            # If as many columns are a robot's, it has a column of the object.
            if not others or (others[0][0] in fixed and others[0][1] <= len(mine)):
                continue
            other, count = others[0]
            if rest:  # its columns are elsewhere, and move at other times
                apart = together[mine][:, rest] <= _APART
                is_other = len(rest) >= len(mine) and bool(apart.all())
            else:
                theirs = [c for c in members if owner[c] == other]
                linked = together[mine][:, theirs] >= _ALONE
                is_other = len(mine) == 1 and count > 1 and bool(linked.any())
            if is_other:
                found |= dict.fromkeys(mine, other)
    return dict(sorted(found.items()))


def _linked(pairs: torch.Tensor) -> list[list[int]]:
    """Returns the groups of what pairs ``[n, n]`` link, directly or by others."""
    count = len(pairs)
    number = torch.arange(count)
    pairs = pairs | torch.eye(count, dtype=torch.bool)
    while count:
        lowest = torch.where(pairs, number, count).amin(1)
        if torch.equal(lowest, number):
            return [(number == n).nonzero()[:, 0].tolist() for n in number.unique()]
        number = lowest
    return []
