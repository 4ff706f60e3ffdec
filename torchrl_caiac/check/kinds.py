"""The kinds of findings: their effect on counterfactuals, and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict.utils import NestedKey

from torchrl_caiac.check.report import Finding, Severity

__all__ = ["KINDS", "Kind", "finding"]

_FIRST = 5  # rows and columns that a finding names


class Kind(NamedTuple):
    """A kind of finding: its severity, its effect and the remedy."""

    severity: Severity
    effect: str
    remedy: str


KINDS: dict[str, Kind] = {
    # --- entries ---------------------------------------------------------------------
    "missing_entry": Kind(
        "error",
        "a later step fails when it reads this entry",
        "add or rename the entry, or give its key to the layout or to the check",
    ),
    "missing_reward": Kind(
        "warning",
        "a learner that reads rewards fails, and none can be recomputed after a swap",
        "add the rewards, unless the learner reads none",
    ),
    "goals_not_mapped": Kind(
        "warning",
        "goals do not follow a swap, so that the actions of counterfactuals do not "
        "lead to them",
        "say which columns of the goals belong to which entity, by goal and achieved "
        "of the layout; remove goals that the learner does not read",
    ),
    "wrong_shape": Kind(
        "error",
        "a later step fails, or reads the wrong numbers",
        "compare the entry with the layout",
    ),
    "ids_missing": Kind(
        "error",
        "windows, smoothing and goals cannot be kept inside a trajectory",
        "add integer ids, name their key in trajectory_key, or pass "
        "trajectory_key=None to rely on end flags alone",
    ),
    "ends_missing": Kind(
        "error",
        "where trajectories end is unknown, so windows and goals cross their ends",
        "add end flags or trajectory ids",
    ),
    "not_finite": Kind(
        "error",
        "a swap copies the value into other transitions, and the loss becomes NaN",
        "remove or repair these rows",
    ),
    "padded_rows": Kind(
        "warning",
        "rows of padding are drawn as donors, and entities are swapped for zeros",
        "remove these rows",
    ),
    # --- next states -----------------------------------------------------------------
    "next_equals_state": Kind(
        "error",
        "nothing seems to move, so that every entity counts as uninfluenced",
        "store the state after the action as the next state",
    ),
    "next_zero_at_ends": Kind(
        "error",
        "swaps at ends combine real states with zeros, and the world model learns "
        "jumps to zero",
        "store the last state of each trajectory, or remove its last row",
    ),
    "next_repeats_at_ends": Kind(
        "warning",
        "in the last transitions nothing moves, whatever the action",
        "store the state after the last action, or remove the last rows",
    ),
    "next_over_end": Kind(
        "error",
        "the last transitions jump to another trajectory: the world model learns "
        "jumps, and donors bring them into counterfactuals",
        "store the state before the reset as the next state, or remove the last rows",
    ),
    "next_not_following": Kind(
        "error",
        "windows combine states that do not belong together, and donors bring "
        "impossible motion into counterfactuals",
        "mark the end of the trajectory there, or correct the next states",
    ),
    "next_of_other_rows": Kind(
        "error",
        "state and next state of a transition do not belong together: the world model "
        "and every donor are wrong",
        "correct how next states were assigned to rows",
    ),
    "next_skips_rows": Kind(
        "error",
        "the motion of several steps is ascribed to a single action",
        "store the state after one action; for n-step transitions, store "
        "'steps_to_next_obs'",
    ),
    "next_unrelated": Kind(
        "warning",
        "windows, smoothing and lookahead combine states that do not follow each other",
        "give each transition its own trajectory id if they are independent, or "
        "correct the next states",
    ),
    "rows_out_of_order": Kind(
        "error",
        "windows, smoothing and goals go through time in the wrong order",
        "sort the rows of each trajectory by time",
    ),
    # --- ends ------------------------------------------------------------------------
    "end_missing": Kind(
        "error",
        "two trajectories count as one: windows, smoothing and goals cross the end",
        "set the end flag of the last row, or give each trajectory its own id",
    ),
    "ends_never_set": Kind(
        "warning",
        "what relies on end flags, such as targets and samplers, sees one endless "
        "trajectory",
        "set the end flag in the last row of each trajectory",
    ),
    "ends_misplaced": Kind(
        "error",
        "trajectories are cut one row off their ends: windows lose rows, and the last "
        "row seems to be a trajectory of its own",
        "move the end flags to the last row of each trajectory",
    ),
    "ends_contradict_ids": Kind(
        "warning",
        "a trajectory is cut in two: windows, smoothing and goals end there",
        "correct the end flags or the ids, so that they agree",
    ),
    "ends_unmarked": Kind(
        "warning",
        "ids mark these ends, but what relies on end flags looks past them",
        "set the end flag in the last row of each trajectory",
    ),
    "done_contradicts": Kind(
        "warning",
        "targets and the index of trajectories disagree about where trajectories end",
        "set done where terminated or truncated is set, and nowhere else",
    ),
    # --- columns ---------------------------------------------------------------------
    "duplicate_columns": Kind(
        "warning",
        "after a swap one copy is the donor's and the other is not",
        "remove one of the copies, or give both to the same entity",
    ),
    "constant_columns": Kind(
        "warning",
        "these columns are the same in all transitions: a swap does not change them",
        "check that they were recorded; otherwise leave them out of the layout",
    ),
    "stale_columns": Kind(
        "warning",
        "no swap changes these columns, so afterwards they describe the entity that "
        "was there before",
        "remove them and compute them in the network (GoalFeatures), or give them to "
        "the entity",
    ),
    "mixed_columns": Kind(
        "warning",
        "after a swap these columns describe the place of the donor's other entities",
        "store quantities of one entity alone, and compute relative ones in the "
        "network (GoalFeatures)",
    ),
    "moves_with_other": Kind(
        "warning",
        "if the columns are the other entity's, a swap takes them apart: states become "
        "impossible",
        "compare the layout with the documentation of the data and with what 'caiac "
        "inspect' proposes: columns may be off by one, or in another order",
    ),
    "unowned_columns_move": Kind(
        "warning",
        "no swap changes these columns and no world model reads them, so that an "
        "object among them is left behind",
        "give them to an entity, a robot's to a fixed one; leave them out of the "
        "observation if nothing needs them",
    ),
    "goal_not_mirrored": Kind(
        "error",
        "after a swap goals and rewards do not agree with the state",
        "correct goal or achieved of the layout, or the achieved goals of the data",
    ),
    # --- motion ----------------------------------------------------------------------
    "never_moves": Kind(
        "warning",
        "what influences the entity cannot be learnt, and it always counts as "
        "uninfluenced",
        "add trajectories in which it moves, or leave it out of the layout",
    ),
    "none_fixed": Kind(
        "warning",
        "the robot is swapped like an object, so that counterfactuals have it in "
        "places where it does not touch what it holds",
        "name the robot in fixed, unless the layout leaves it out",
    ),
    "robot_not_fixed": Kind(
        "warning",
        "a robot is swapped like an object, so that the actions of counterfactuals do "
        "not fit their states",
        "name it in fixed",
    ),
    "always_moves": Kind(
        "warning",
        "if the noise of a sensor moves the entity, the world model has to tell it "
        "from influence",
        "check the units and the noise, and set variance_floor above the noise",
    ),
    "jump": Kind(
        "warning",
        "the world model learns the jump, and donors bring it into counterfactuals",
        "mark the end of the trajectory there if it was a reset, or remove the row",
    ),
    "floor_too_high": Kind(
        "warning",
        "all motion counts as noise, so that nothing is influenced",
        "lower variance_floor: it is a standard deviation in the units of the data",
    ),
    "floor_too_low": Kind(
        "warning",
        "entities at rest get tiny variances, and their scores are noise",
        "raise variance_floor: it is a standard deviation in the units of the data",
    ),
    # --- actions ---------------------------------------------------------------------
    "action_out_of_bounds": Kind(
        "error",
        "influence is computed for other actions than those of the data",
        "scale or clip the actions, or give their bounds (CAI(model, action_spec=...))",
    ),
    "action_constant": Kind(
        "error",
        "the influence of an action that never varies cannot be learnt",
        "check that the actions were recorded, and add transitions with others",
    ),
    "action_columns_constant": Kind(
        "warning",
        "the influence of these parts of the action cannot be learnt",
        "check that they were recorded, and add transitions with other values",
    ),
}


def finding(
    code: str,
    message: str,
    *,
    key: NestedKey | None = None,
    columns: Sequence[str] = (),
    rows: torch.Tensor | None = None,
    severity: Severity | None = None,
) -> Finding:
    """Returns a finding of a known kind.

    Args:
        code (str): the kind, a key of :data:`KINDS`.
        message (str): what was found, without a full stop.

    Keyword Args:
        key (NestedKey, optional): the entry concerned.
        columns (sequence of str): the columns concerned.
        rows (torch.Tensor, optional): the rows concerned, ``[n]``.
        severity (str, optional): instead of that of the kind.

    Returns:
        Finding: the finding, which names the first rows.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.check.kinds import finding
        >>> finding("jump", "cup jumps", rows=torch.arange(9)).rows
        (0, 1, 2, 3, 4)
    """
    kind = KINDS[code]
    first = () if rows is None else tuple(rows[:_FIRST].tolist())
    return Finding(
        code=code,
        severity=severity or kind.severity,
        message=message,
        effect=kind.effect,
        remedy=kind.remedy,
        key=key,
        columns=tuple(columns),
        rows=first,
        count=0 if rows is None else len(rows),
    )
