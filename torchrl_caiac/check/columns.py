"""Checks of columns that are copies, constant, or functions of others."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import path
from torchrl_caiac.check.entries import state_leaves
from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.regression import Regression
from torchrl_caiac.check.report import Finding
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States
from torchrl_caiac.check.values import named
from torchrl_caiac.entities import EntityLayout

__all__ = ["Unowned", "check_columns", "check_goals", "unowned_columns"]

_MAX_COLUMNS = 512  # wider entries, such as images, are left out
_BOOKKEEPING = {"action", "reward", "done", "terminated", "truncated", "step_count"}


@dataclass(frozen=True)
class Unowned:
    """Columns of the state that no entity owns.

    Args:
        key (NestedKey): the entry.
        labels (tuple of str): the name of each column.
        values (torch.Tensor): ``[n, U]``.
    """

    key: NestedKey
    labels: tuple[str, ...]
    values: torch.Tensor


def unowned_columns(
    layout: EntityLayout,
    data: TensorDictBase,
    sample: Sample,
    left_out: Sequence[NestedKey | None],
) -> Iterator[Unowned]:
    """Yields columns of the state that no entity owns, entry by entry.

    An entry belongs to the state if it has a counterpart in the next state.

    Args:
        layout (EntityLayout): the entities.
        data (TensorDictBase): all transitions.
        sample (Sample): the rows.
        left_out (sequence of NestedKey): entries that are not of the state.

    Yields:
        Unowned: the columns of one entry.
    """
    owned = set(state_leaves(layout, data))
    if layout.is_flat:
        assert layout.observation_key is not None  # the layout is flat
        key = layout.observation_key
        width = data.get(key).shape[1]
        columns = (layout.column_entity(width) < 0).nonzero()[:, 0].tolist()
        if 0 < len(columns) <= _MAX_COLUMNS:
            labels = tuple(f"{key!r} (column {c})" for c in columns)
            yield Unowned(key, labels, sample.read(key, columns))
    goals = [layout.desired_goal_key, layout.achieved_goal_key]
    mapped = {path(key) for key in goals if key is not None}
    mapped |= {path(key) for key in left_out if key is not None}
    for key in data.keys(include_nested=True, leaves_only=True):
        parts = path(key)
        if key in owned or parts[0] == path(layout.next_key)[0]:
            continue
        if any(parts[: len(p)] == p for p in mapped) or parts[-1] in _BOOKKEEPING:
            continue
        value, after = data.get(key), data.get(layout.next(key), None)
        if not isinstance(value, torch.Tensor) or not isinstance(after, torch.Tensor):
            continue
        width = value[:1].numel()
        if not value.is_floating_point() or not 0 < width <= _MAX_COLUMNS:
            continue
        labels = tuple(f"{key!r} (column {c})" for c in range(width))
        yield Unowned(key, labels, sample.read(key))


def check_columns(
    layout: EntityLayout,
    sample: Sample,
    states: States,
    regression: Regression | None,
    unowned: Iterator[Unowned],
    still: Collection[str],
) -> list[Finding]:
    """Finds columns that are copies, constant, or linear functions of others.

    Args:
        layout (EntityLayout): the entities.
        sample (Sample): the rows.
        states (States): their states.
        regression (Regression, optional): the linear functions between them. ``None``
            if there are too few rows.
        unowned (iterator of Unowned): the columns that no entity owns.
        still (collection of str): names of columns of entities that never move.

    Returns:
        list of Finding: what was found.
    """
    if len(sample) < 2:
        return []
    findings = []
    owner = states.owners
    constant = (states.now == states.now[:1]).all(0)
    columns = [
        label
        for label, name, is_constant in zip(
            states.labels, owner, constant.tolist(), strict=True
        )
        if is_constant and label not in still and name not in layout.fixed
    ]
    if columns:
        message = f"the same value in all checked rows: {named(columns)}"
        findings.append(finding("constant_columns", message, columns=columns))
    copies = _copies(states, owner, constant, layout)
    if copies:
        message = "equal in all checked rows: " + named(
            [f"{a} and {b}" for a, b in copies]
        )
        columns = sorted({label for pair in copies for label in pair})
        findings.append(finding("duplicate_columns", message, columns=columns))
    if regression is None:
        return findings
    copied = {label for pair in copies for label in pair}
    for part in unowned:
        stale = regression.stale(part.values)
        columns = [part.labels[c] for c in stale.nonzero()[:, 0].tolist()]
        if columns:
            message = (
                "functions of columns that are swapped, but not swapped themselves: "
                f"{named(columns)}"
            )
            findings.append(
                finding("stale_columns", message, key=part.key, columns=columns)
            )
    columns = [
        label
        for c, label in enumerate(states.labels)
        if label not in copied
        and label not in still
        and owner[c] not in layout.fixed
        and regression.is_mixed(c, owner)
    ]
    if columns:
        message = f"functions of another entity's columns too: {named(columns)}"
        findings.append(finding("mixed_columns", message, columns=columns))
    return findings


def check_goals(
    layout: EntityLayout, sample: Sample, data: TensorDictBase
) -> list[Finding]:
    """Finds achieved goals that differ from the columns that they should equal.

    Args:
        layout (EntityLayout): the entities.
        sample (Sample): the rows.
        data (TensorDictBase): all transitions.

    Returns:
        list of Finding: what was found.
    """
    if not layout.is_flat or not layout.achieved or len(sample) < 2:
        return []
    key, state_key = layout.achieved_goal_key, layout.observation_key
    if key is None or state_key is None or data.get(key, None) is None:
        return []
    findings = []
    columns = list(layout.goal_columns())
    for goal, state in ((key, state_key), (layout.next(key), layout.next(state_key))):
        if data.get(goal, None) is None or data.get(state, None) is None:
            continue
        achieved, mirrored = sample.read(goal), sample.read(state, columns)
        scale = mirrored.double().std(0, correction=0)
        error = (achieved.double() - mirrored.double()).abs()
        size = torch.maximum(achieved.abs(), mirrored.abs()).amax(0)
        limit = torch.maximum(0.1 * scale, 1e-3 * size)
        wrong = error > limit
        bad = (wrong.double().mean(0) > 0.05).nonzero()[:, 0].tolist()
        if bad:
            labels = [f"{goal!r} (column {c})" for c in bad]
            pairs = [f"{c} and {columns[c]}" for c in bad[:3]]
            rows = sample.rows[wrong.any(1)]
            message = (
                f"columns of {goal!r} differ from the columns of {state!r} that the "
                f"layout assigns to them, for example {' or '.join(pairs)}"
            )
            findings.append(
                finding(
                    "goal_not_mirrored", message, key=goal, columns=labels, rows=rows
                )
            )
            break
    return findings


def _copies(
    states: States, owner: list[str], constant: torch.Tensor, layout: EntityLayout
) -> list[tuple[str, str]]:
    """Returns pairs of columns of different entities that are equal in all rows."""
    groups: dict[tuple[float, ...], list[int]] = {}
    probe = states.now[:: max(1, len(states.now) // 8)]
    for c in (~constant).nonzero()[:, 0].tolist():
        groups.setdefault(tuple(probe[:, c].tolist()), []).append(c)
    pairs = []
    for columns in groups.values():
        for a, b in pairwise(columns):
            apart = owner[a] != owner[b]
            swapped = owner[a] not in layout.fixed or owner[b] not in layout.fixed
            if apart and swapped and torch.equal(states.now[:, a], states.now[:, b]):
                pairs.append((states.labels[a], states.labels[b]))
    return pairs
