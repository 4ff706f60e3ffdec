"""Checks of single values: finite ones, padding, and actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.report import Finding
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States

__all__ = ["check_action", "check_finite", "find_padding", "named"]

_NAMED = 5  # columns that a message names
_MASKS: tuple[NestedKey, ...] = ("mask", ("collector", "mask"))
_SLACK = 1e-3  # of the range of an action, for rounding and normalisation


def named(columns: Sequence[str]) -> str:
    """Returns the first columns as text.

    Examples:
        >>> from torchrl_caiac.check.values import named
        >>> named([f"cup (column {i})" for i in range(7)][3:])
        'cup (column 3), cup (column 4), cup (column 5), cup (column 6)'
    """
    more = len(columns) - _NAMED
    text = ", ".join(columns[:_NAMED])
    return f"{text} and {more} more" if more > 0 else text


def check_finite(
    sample: Sample,
    key: Any,
    values: torch.Tensor,
    labels: Sequence[str],
) -> tuple[list[Finding], torch.Tensor]:
    """Finds values that are NaN or infinite.

    Args:
        sample (Sample): the rows.
        key (NestedKey): the key of the values, for messages.
        values (torch.Tensor): ``[n, W]``.
        labels (sequence of str): the name of each column.

    Returns:
        tuple: the findings, and whether each row is finite, bool ``[n]``.
    """
    finite = values.isfinite()
    rows = finite.all(1)
    if bool(rows.all()):
        return [], rows
    columns = [labels[c] for c in (~finite.all(0)).nonzero()[:, 0].tolist()]
    first = int((~rows).nonzero()[0])
    column = int((~finite[first]).nonzero()[0])
    message = (
        f"{key!r} is {values[first, column].item()} in row {int(sample.rows[first])}, "
        f"{labels[column]}; columns with such values: {named(columns)}"
    )
    found = finding(
        "not_finite", message, key=key, columns=columns, rows=sample.rows[~rows]
    )
    return [found], rows


def find_padding(
    data: TensorDictBase, sample: Sample, states: States, action: torch.Tensor | None
) -> tuple[list[Finding], torch.Tensor]:
    """Finds rows of padding: those a mask leaves out, and those with only zeros.

    Args:
        data (TensorDictBase): all transitions.
        sample (Sample): the rows.
        states (States): their states.
        action (torch.Tensor, optional): their actions, ``[n, A]``.

    Returns:
        tuple: the findings, and which rows are padding, bool ``[n]``.
    """
    padded = torch.zeros(len(sample), dtype=torch.bool)
    for key in _MASKS:
        mask = data.get(key, None)
        if isinstance(mask, torch.Tensor) and mask.numel() == len(mask):
            padded |= ~sample.raw(key).reshape(-1).bool()
    if states.after is not None and action is not None and action.shape[1]:
        zero = (states.now == 0).all(1) & (states.after == 0).all(1)
        zero &= (action == 0).all(1)
        # All rows zero: not padding, but data that were never written.
        if not bool(zero.all()):
            padded |= zero
    if not bool(padded.any()) or bool(padded.all()):
        return [], torch.zeros_like(padded)
    rows = sample.rows[padded]
    message = f"{len(rows)} checked rows are padding (masked, or only zeros)"
    return [finding("padded_rows", message, rows=rows)], padded


def check_action(
    sample: Sample,
    key: NestedKey,
    action: torch.Tensor,
    bounds: tuple[torch.Tensor, torch.Tensor] | None,
) -> list[Finding]:
    """Finds actions that never vary or are out of bounds.

    Args:
        sample (Sample): the rows.
        key (NestedKey): the key of the action.
        action (torch.Tensor): ``[n, A]``.
        bounds (pair of torch.Tensor, optional): the lowest and the highest action,
            each ``[A]`` or ``[]``.

    Returns:
        list of Finding: what was found.
    """
    findings = []
    if bounds is not None:
        low, high = (b.to(torch.float64).expand(action.shape[1]) for b in bounds)
        slack = _SLACK * (high - low).clamp_max(1e6) + 1e-6
        outside = (action < low - slack) | (action > high + slack)
        if bool(outside.any()):
            columns = [f"column {c}" for c in outside.any(0).nonzero()[:, 0].tolist()]
            rows = outside.any(1)
            message = (
                f"{key!r} ranges from {action.min().item():.4g} to "
                f"{action.max().item():.4g}, beyond its bounds from "
                f"{low.min().item():.4g} to {high.max().item():.4g}, in "
                f"{named(columns)}"
            )
            findings.append(
                finding(
                    "action_out_of_bounds",
                    message,
                    key=key,
                    columns=columns,
                    rows=sample.rows[rows],
                )
            )
    if len(action) < 2:
        return findings
    constant = (action == action[:1]).all(0)
    columns = [f"column {c}" for c in constant.nonzero()[:, 0].tolist()]
    if bool(constant.all()):
        message = f"{key!r} is the same in all checked rows"
        findings.append(finding("action_constant", message, key=key))
    elif columns:
        message = f"{key!r} never varies in {named(columns)}"
        findings.append(
            finding("action_columns_constant", message, key=key, columns=columns)
        )
    return findings
