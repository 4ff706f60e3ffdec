"""Checks of trajectory ids and end flags."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.report import Finding
from torchrl_caiac.trajectories import COLLECTOR_KEY, STEPS_KEY, end_flags

__all__ = ["check_end_entries", "check_ends", "find_ids"]

_MAX_ROWS = 2_000_000  # rows whose ids and flags are compared


def find_ids(
    data: TensorDictBase, trajectory_key: NestedKey | None
) -> NestedKey | None:
    """Returns the key of the trajectory ids, ``None`` without ids.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.check.ends import find_ids
        >>> td = TensorDict({"collector": {"traj_ids": torch.zeros(3)}}, [3])
        >>> find_ids(td, "episode")
        ('collector', 'traj_ids')
    """
    if trajectory_key is None:
        return None
    known = [
        k for k in (trajectory_key, COLLECTOR_KEY) if data.get(k, None) is not None
    ]
    return known[0] if known else None


def check_end_entries(
    data: TensorDictBase,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
) -> list[Finding]:
    """Finds ids and end flags that are missing or have another shape.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        trajectory_key (NestedKey, optional): the trajectory ids.
        done_key (NestedKey, optional): the end flags.

    Returns:
        list of Finding: what was found.
    """
    findings = []
    ids_key = find_ids(data, trajectory_key)
    if trajectory_key is not None and ids_key is None:
        message = f"the transitions lack the trajectory ids {trajectory_key!r}"
        findings.append(finding("ids_missing", message, key=trajectory_key))
    has_done = done_key is not None and data.get(done_key, None) is not None
    has_flags = has_done or (
        done_key is not None and end_flags(data, done_key) is not None
    )
    if ids_key is None and not has_flags:
        message = f"the transitions have no end flags {done_key!r} either"
        if trajectory_key is None:
            message = f"the transitions have neither ids nor end flags {done_key!r}"
        findings.append(finding("ends_missing", message, key=done_key))
    for key in (ids_key, done_key if has_done else None):
        if key is None:
            continue
        value = data.get(key)
        if not isinstance(value, torch.Tensor):
            message = f"{key!r} is a {type(value).__name__}, expected a tensor"
            findings.append(finding("wrong_shape", message, key=key))
        elif value.numel() != len(value):
            message = (
                f"{key!r} has shape {list(value.shape)}, expected one value for each "
                "transition"
            )
            findings.append(finding("wrong_shape", message, key=key))
        elif key == ids_key and (value.is_floating_point() or value.is_complex()):
            message = f"{key!r} is {value.dtype}, expected integers"
            findings.append(finding("wrong_shape", message, key=key))
    return findings


def check_ends(
    data: TensorDictBase,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
    num_trajectories: int,
    newest: torch.Tensor,
    continues: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None,
) -> list[Finding]:
    """Finds end flags that are never set, or that contradict ids or other flags.

    Args:
        data (TensorDictBase): transitions ``[T]``, whose ids and flags fit.
        trajectory_key (NestedKey, optional): the trajectory ids.
        done_key (NestedKey, optional): the end flags.
        num_trajectories (int): the number of trajectories.
        newest (torch.Tensor): int64 ``[B]``, the rows that were written last, whose
            trajectories may go on.
        continues (callable, optional): maps rows and later rows, int64 ``[p]``, to
            whether the later state is the next state of the earlier one; ``None`` if
            next states are not known.

    Returns:
        list of Finding: what was found.
    """
    done = None if done_key is None else end_flags(data, done_key)
    if done_key is None or done is None:
        return []
    flags = done[:_MAX_ROWS].cpu()
    if len(flags) < 2:
        return []
    ids_key = find_ids(data, trajectory_key)
    if not bool(flags.any()):
        if ids_key is None or num_trajectories > 1:
            message = f"{done_key!r} is false in all rows"
            return [finding("ends_never_set", message, key=done_key)]
        return []
    findings = []
    if data.get(STEPS_KEY, None) is None:  # whose flags are those of later states
        findings = _check_done(data, done_key, flags)
    if ids_key is None:
        return findings
    ids = data.get(ids_key).as_subclass(torch.Tensor)[:_MAX_ROWS].cpu().reshape(-1)
    order = ids.argsort(stable=True)
    same = ids[order][1:] == ids[order][:-1]
    later = torch.full_like(order, -1)  # the following row with the same id
    later[order[:-1][same]] = order[1:][same]
    earlier = torch.full_like(order, -1)
    earlier[order[1:][same]] = order[:-1][same]
    unmarked = (later < 0) & ~flags
    unmarked[-1] = False
    unmarked[newest[newest < len(unmarked)]] = False
    inside = flags & (later >= 0)
    if not bool(unmarked.any()) and not bool(inside.any()):
        return findings
    # One row too early: the following row of that id is its last one.
    early = inside & (later[later.clamp_min(0)] < 0)
    late = inside & (earlier < 0)
    for rows, where in ((early, "second last"), (late, "first")):
        if int(rows.sum()) >= 3 and 10 * int(rows.sum()) >= 9 * int(flags.sum()):
            message = f"{done_key!r} is set in the {where} row of {int(rows.sum())} ids"
            found = finding(
                "ends_misplaced", message, key=done_key, rows=rows.nonzero()[:, 0]
            )
            return [*findings, found]
    rows = inside.nonzero()[:, 0]
    if continues is not None and len(rows):
        rows = rows[:10_000]
        rows = rows[continues(rows, later[rows])]
        if len(rows):
            message = (
                f"{done_key!r} is set in rows after which the trajectory goes on, with "
                "the same id and the next state as state"
            )
            findings.append(
                finding("ends_contradict_ids", message, key=done_key, rows=rows)
            )
    rows = unmarked.nonzero()[:, 0]
    if len(rows):
        message = (
            f"{done_key!r} is false in {len(rows)} last rows of the ids in {ids_key!r}"
        )
        findings.append(finding("ends_unmarked", message, key=done_key, rows=rows))
    return findings


def _check_done(
    data: TensorDictBase, done_key: NestedKey, flags: torch.Tensor
) -> list[Finding]:
    """Finds rows where done is not "terminated or truncated"."""
    parent = () if isinstance(done_key, str) else done_key[:-1]
    parts = [data.get((*parent, name), None) for name in ("terminated", "truncated")]
    if any(
        not isinstance(part, torch.Tensor) or part.numel() != len(part)
        for part in parts
    ):
        return []
    either = torch.zeros_like(flags)
    for part in parts:
        either |= part.as_subclass(torch.Tensor)[: len(flags)].cpu().reshape(-1).bool()
    rows = (either != flags).nonzero()[:, 0]
    if not len(rows):
        return []
    message = f"{done_key!r} is not 'terminated or truncated' in {len(rows)} rows"
    return [finding("done_contradicts", message, key=done_key, rows=rows)]
