"""Checks that all entries which later steps read are there, with fitting shapes."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey

from torchrl_caiac._keys import join, leaf_names
from torchrl_caiac._layout_reading import check_width
from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.report import Finding, Severity
from torchrl_caiac.entities import EntityLayout

__all__ = ["check_entries", "goal_entries", "state_leaves"]


def state_leaves(layout: EntityLayout, data: TensorDictBase) -> list[NestedKey]:
    """Returns the keys of the tensors of the state, in layout order.

    Args:
        layout (EntityLayout): the entities.
        data (TensorDictBase): the transitions.

    Returns:
        list of NestedKey: for entities that are sub-tensordicts, all leaves in the
        order in which :meth:`~torchrl_caiac.EntityLayout.read` concatenates them.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.check.entries import state_leaves
        >>> data = TensorDict({"cup": {"y": torch.ones(2), "x": torch.ones(2)}}, [2])
        >>> state_leaves(EntityLayout.from_keys({"cup": "cup"}), data)
        [('cup', 'x'), ('cup', 'y')]
    """
    return [leaf for key in layout.in_keys for leaf in _leaves(data, key)]


def goal_entries(layout: EntityLayout) -> list[NestedKey]:
    """Returns the keys of the goals that the layout maps, without ``next``.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.check.entries import goal_entries
        >>> goal_entries(EntityLayout({"cup": [0]}, goal={"cup": [0]}))
        ['desired_goal', 'achieved_goal']
    """
    if not layout.goal:
        return []
    if layout.is_flat:
        assert layout.desired_goal_key is not None  # the layout is flat
        assert layout.achieved_goal_key is not None
        return [layout.desired_goal_key, layout.achieved_goal_key]
    keys = [*layout.goal.values(), *layout.achieved.values()]
    return [key for key in keys if key is not None]


def check_entries(
    data: TensorDictBase,
    layout: EntityLayout,
    *,
    action_key: NestedKey | None,
    reward_key: NestedKey | None,
    read_next: bool,
) -> list[Finding]:
    """Finds entries that are missing or do not have one row for each transition.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        layout (EntityLayout): the entities.

    Keyword Args:
        action_key (NestedKey, optional): the action; ``None`` if nothing reads it.
        reward_key (NestedKey, optional): the reward; ``None`` if nothing reads it.
        read_next (bool): whether the next state is read.

    Returns:
        list of Finding: what was found.
    """
    findings = []
    for key in layout.in_keys:
        both = [key, layout.next(key)] if read_next else [key]
        bad = (_check_state(data, layout, k) for k in both)
        found = [f for f in bad if f is not None][:1]
        findings += found
        if read_next and not found:
            findings += _check_pair(data, layout, key)
    if action_key is not None:
        findings += _check_tensor(data, action_key, "the action")
    if layout.goal:
        findings += _check_goals(data, layout, reward_key)
    else:
        findings += _check_unmapped(data, layout)
    return findings


def _check_unmapped(data: TensorDictBase, layout: EntityLayout) -> list[Finding]:
    """Finds goals of the transitions that the layout does not name."""
    achieved = layout.achieved_goal_key or "achieved_goal"
    desired = layout.desired_goal_key or "desired_goal"
    keys = [achieved, layout.next(achieved), desired]
    keys = [key for key in keys if data.get(key, None) is not None]
    if not keys:
        return []
    found = " and ".join(map(repr, keys))
    message = f"the transitions have {found}, but the layout names no goals"
    # Transforms refuse batches with achieved goals that they cannot swap.
    severity: Severity = "warning" if keys == [desired] else "error"
    return [finding("goals_not_mapped", message, key=keys[0], severity=severity)]


def _missing(data: TensorDictBase, key: NestedKey, what: str) -> Finding:
    return finding(
        "missing_entry",
        f"the transitions lack {what} {key!r}; they have "
        f"{', '.join(leaf_names(data)) or 'no entries'}",
        key=key,
    )


def _check_tensor(data: TensorDictBase, key: NestedKey, what: str) -> list[Finding]:
    value = data.get(key, None)
    if value is None:
        return [_missing(data, key, what)]
    if not isinstance(value, torch.Tensor):
        message = f"{key!r} is a {type(value).__name__}, expected a tensor"
        return [finding("wrong_shape", message, key=key)]
    if value.ndim > 1 and not value.shape[1:].numel():
        message = f"{key!r} has shape {list(value.shape)}, which has no columns"
        return [finding("wrong_shape", message, key=key)]
    return []


def _check_state(
    data: TensorDictBase, layout: EntityLayout, key: NestedKey
) -> Finding | None:
    value = data.get(key, None)
    if value is None:
        return _missing(data, key, "the state")
    if not layout.is_flat:
        for leaf in _leaves(data, key):
            found = _check_tensor(data, leaf, "the state")
            if found:
                return found[0]
        if not _leaves(data, key):
            message = f"{key!r} has no entries"
            return finding("wrong_shape", message, key=key)
        return None
    if not isinstance(value, torch.Tensor):
        message = (
            f"{key!r} is a {type(value).__name__}, but the layout names columns of a "
            "tensor"
        )
        return finding("wrong_shape", message, key=key)
    if value.ndim != 2:
        message = f"{key!r} has shape {list(value.shape)}, expected [T, D]"
        return finding("wrong_shape", message, key=key)
    try:
        check_width(layout, value.shape[1], key)
    except ValueError as error:
        return finding("wrong_shape", str(error), key=key)
    return None


def _check_pair(
    data: TensorDictBase, layout: EntityLayout, key: NestedKey
) -> list[Finding]:
    """Finds differences in the leaves of a state and its next state."""
    own, after = _leaves(data, key), _leaves(data, layout.next(key))
    wanted = [layout.next(leaf) for leaf in own]
    for leaf in sorted(set(wanted) ^ set(after), key=str):
        return [_missing(data, leaf, "the counterpart of")]
    for leaf in own:
        shape, other = data.get(leaf).shape, data.get(layout.next(leaf)).shape
        if shape != other:
            message = (
                f"{layout.next(leaf)!r} has shape {list(other)}, but {leaf!r} has "
                f"{list(shape)}"
            )
            return [finding("wrong_shape", message, key=layout.next(leaf))]
    return []


def _check_goals(
    data: TensorDictBase, layout: EntityLayout, reward_key: NestedKey | None
) -> list[Finding]:
    findings = []
    keys = goal_entries(layout)
    present = [key for key in keys if data.get(key, None) is not None]
    if not present:
        return []  # goals are drawn from later states
    if not layout.is_flat:
        # Data without desired goals are complete: goals come from later states.
        wanted = [key for key in layout.goal.values() if key is not None]
        if any(k in present for k in wanted):
            findings += [
                _missing(data, k, "the goal") for k in wanted if k not in present
            ]
        return findings
    for key in [*keys, layout.next(layout.achieved_goal_key)]:
        value = data.get(key, None)
        if value is None:
            continue
        if not isinstance(value, torch.Tensor) or value.ndim != 2:
            shape = list(getattr(value, "shape", []))
            message = f"{key!r} has shape {shape}, expected [T, {layout.goal_width}]"
            findings.append(finding("wrong_shape", message, key=key))
        elif value.shape[1] != layout.goal_width:
            message = (
                f"{key!r} has {value.shape[1]} columns, but the goals of the layout "
                f"have {layout.goal_width}"
            )
            findings.append(finding("wrong_shape", message, key=key))
    if layout.desired_goal_key in present:
        after = layout.next(layout.achieved_goal_key)
        if data.get(after, None) is None and not layout.achieved:
            findings.append(_missing(data, after, "the next achieved goal"))
        if reward_key is not None and data.get(reward_key, None) is None:
            message = f"the transitions have goals, but no reward {reward_key!r}"
            findings.append(finding("missing_reward", message, key=reward_key))
    return findings


def _leaves(data: TensorDictBase, key: NestedKey) -> list[NestedKey]:
    """Returns the keys of the leaves of an entry, in the order of ``flatten``."""
    value = data.get(key, None)
    if not is_tensor_collection(value):
        return [] if value is None else [key]
    return [
        leaf
        for name in sorted(value.keys(), key=str)
        for leaf in _leaves(data, join(key, name))
    ]
