"""What an inspection finds, against data whose layout is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.check.pushing import clean
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac import EntityLayout, check_dataset
from torchrl_caiac.inspection import inspect_dataset


def transitions(states: torch.Tensor, action: torch.Tensor) -> TensorDict:
    """One episode with the states ``[T + 1, D]``."""
    length = len(states) - 1
    done = torch.zeros(length, 1, dtype=torch.bool)
    done[-1] = True
    return TensorDict(
        {
            "observation": states[:-1],
            "action": action[:length],
            "episode": torch.zeros(length, dtype=torch.int64),
            "next": {"observation": states[1:], "done": done},
        },
        [length],
    )


def world(
    entities: int, widths: list[int], seed: int, length: int = 800
) -> tuple[torch.Tensor, torch.Tensor]:
    """States of a robot (2 columns) and entities, moved one after another by turns."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (length, 1))
    robot = np.cumsum(np.concatenate([action, 0.5 * action], -1), 0)
    parts = [robot]
    turn = rng.integers(0, entities + 2, length // 20 + 1).repeat(20)[:length]
    for number in range(entities):
        step = rng.normal(size=(length, widths[number]))
        parts.append(np.cumsum(step * (turn == number)[:, None], 0))
    states = np.concatenate(parts, -1)
    states = np.concatenate([np.zeros_like(states[:1]), states])
    return torch.from_numpy(states).float(), torch.from_numpy(action).float()


@settings(max_examples=20)
@given(
    widths=st.lists(st.integers(1, 4), min_size=1, max_size=4),
    seed=st.integers(0, 2**16),
)
def test_the_layout_of_a_world_comes_back(widths: list[int], seed: int) -> None:
    data = transitions(*world(len(widths), widths, seed))
    change = data["next", "observation"] - data["observation"]
    # An entity whose turn comes more often than not would count as the robot.
    assume(bool(((change[:, 2:] != 0).float().mean(0) < 0.5).all()))
    found = inspect_dataset(data).proposal
    moved = data["observation"].amax(0) > data["observation"].amin(0)
    expected, place = {(0, 1)}, 2
    for width in widths:
        columns = tuple(range(place, place + width))
        if moved[list(columns)].all():  # else its turn never came
            expected.add(columns)
        place += width
    if len(expected) == 1:
        assert found is None
    else:
        assert set(found.columns.values()) == expected
        assert found.fixed == ("robot",) and found.columns["robot"] == (0, 1)


def test_the_layout_of_the_pushes_comes_back() -> None:
    found = inspect_dataset(push_transitions())
    assert list(found.proposal.columns.values()) == list(LAYOUT.columns.values())


def test_numbers_are_those_of_numpy() -> None:
    data = push_transitions()
    found = inspect_dataset(data)
    assert found.lengths == (40, 30, 50, 40, 35, 45)
    leaves = {leaf.key: leaf for leaf in found.leaves}
    assert set(leaves) == set(data.keys(True, True))
    for key, leaf in leaves.items():
        values = data[key].numpy()
        assert leaf.shape == values.shape[1:] and leaf.dtype == str(values.dtype)
        assert (leaf.low, leaf.high) == (values.min(), values.max())
    state, after = (
        data[key].double().numpy() for key in ("observation", ("next", "observation"))
    )
    size = np.abs(after - state)
    moves = size > 1e-3 * (state.max(0) - state.min(0))
    design = np.concatenate([data["action"].numpy(), np.ones((len(data), 1))], -1)
    for column, fact in enumerate(found.columns):
        assert fact.column == column
        assert fact.moves == pytest.approx(moves[:, column].mean())
        change = (after - state)[:, column]
        rest = change - design @ np.linalg.lstsq(design, change, rcond=None)[0]
        assert fact.explained == pytest.approx(1 - rest.var() / change.var(), abs=1e-6)
    cup = next(group for group in found.groups if group.columns == (2, 3))
    moving = moves[:, 2] | moves[:, 3]
    assert cup.moves == pytest.approx(moving.mean())
    step = np.concatenate([np.arange(n) * 10 // n for n in found.lengths])
    for tenth, share in enumerate(cup.when):
        assert share == pytest.approx(moving[step == tenth].mean())


def test_values_that_are_not_finite_are_counted() -> None:
    data = push_transitions()
    data["action"][3] = float("nan")
    data["next", "observation"][5, 2] = float("inf")
    data["observation"][:, 5] = float("nan")
    data["observation"][7, 4] = float("nan")
    found = inspect_dataset(data)
    bad = {leaf.key: leaf.not_finite for leaf in found.leaves if leaf.not_finite}
    assert bad == {"action": 1, "observation": 241, ("next", "observation"): 1}
    assert (found.columns[5].low, found.columns[5].high) == (None, None)
    assert found.columns[4].high == push_transitions()["observation"][:, 4].max()
    assert "1 values are not finite" in str(found)
    json.dumps(found.to_dict(), allow_nan=False)


def test_nested_observations_are_grouped_by_leaf() -> None:
    data = push_transitions()
    for source in (data, data["next"]):
        state = source["observation"]
        del source["observation"]
        source["observation"] = TensorDict(
            {
                "hand": state[:, :2],
                "cups": {"left": state[:, 2:4], "right": state[:, 4:]},
            },
            [len(data)],
        )
    found = inspect_dataset(data)
    assert found.proposal == EntityLayout.from_keys(
        {
            "hand": ("observation", "hand"),
            "cups_left": ("observation", "cups", "left"),
            "cups_right": ("observation", "cups", "right"),
        },
        fixed=["hand"],
        positions={"hand": [0]},  # the other column is its velocity
    )


def test_columns_that_never_move_are_left_out_or_with_their_group() -> None:
    states, action = world(2, [2, 2], 0)
    one = torch.ones(len(states), 1)
    states = torch.cat([states[:, :3], one, states[:, 3:4], one, states[:, 4:]], -1)
    found = inspect_dataset(transitions(states, action))
    assert list(found.proposal.columns.values()) == [(0, 1), (2, 3, 4), (6, 7)]
    (note,) = [note for note in found.notes if "never move" in note]
    assert "columns 5 " in note


def test_a_single_column_between_those_of_the_robot_is_its_own() -> None:
    states, action = world(2, [1, 2], 0)
    states = states[:, [0, 2, 1, 3, 4]]
    found = inspect_dataset(transitions(states, action))
    assert list(found.proposal.columns.values()) == [(0, 1, 2), (3, 4)]


def test_images_are_not_looked_at() -> None:
    data = push_transitions()
    for source in (data, data["next"]):
        image = torch.rand(len(data), 3, 32, 32)
        source["observation"] = TensorDict(
            {"camera": image, "state": source["observation"]}, [len(data)]
        )
    found = inspect_dataset(data)
    assert {fact.key for fact in found.columns} == {("observation", "state")}
    assert any("camera" in note and "images" in note for note in found.notes)


def test_an_image_alone_and_a_state_at_rest_give_no_proposal() -> None:
    data = push_transitions()
    for source in (data, data["next"]):
        source["observation"] = torch.rand(len(data), 3, 32, 32)
    assert inspect_dataset(data).proposal is None
    for source in (data, data["next"]):
        source["observation"] = torch.ones(len(data), 4)
    found = inspect_dataset(data)
    assert (
        found.proposal is None and "no layout is proposed: nothing moves" in found.notes
    )


def test_no_robot_is_said() -> None:
    states, action = world(2, [2, 2], 0)
    found = inspect_dataset(transitions(states[:, 2:], action))
    assert found.proposal.fixed == ()
    assert any("no robot was found" in note for note in found.notes)


def test_a_large_dataset_is_looked_at_in_part() -> None:
    data = transitions(*world(2, [2, 2], 0, length=2000))
    found = inspect_dataset(data, max_rows=300)
    assert found.num_transitions == 2000 and found.num_looked_at == 286
    assert list(found.proposal.columns.values()) == [(0, 1), (2, 3), (4, 5)]


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_an_entry_that_is_missing(key: str | tuple[str, ...]) -> None:
    data = push_transitions()
    del data[key]
    with pytest.raises(KeyError, match="the data lack"):
        inspect_dataset(data)


@pytest.mark.parametrize("rows", [0, -1, True, 2.5])
def test_a_wrong_number_of_rows(rows: object) -> None:
    with pytest.raises(ValueError, match="max_rows must be"):
        inspect_dataset(push_transitions(), max_rows=rows)


def sliding(length: int = 900, seed: int = 0) -> TensorDict:
    """A robot and two objects, with velocities: x, y, vx, vy of each."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (length + 1, 2))
    turn = rng.integers(0, 5, length // 20 + 1).repeat(20)[:length]
    speeds = [action[1:]]
    for number in range(2):
        push = rng.normal(size=(length, 2)) * (turn == number)[:, None]
        speeds.append(push)
    states = []
    for speed in speeds:
        speed = np.concatenate([np.zeros((1, 2)), speed])
        states += [0.05 * np.cumsum(speed, 0), speed]
    return transitions(
        torch.from_numpy(np.concatenate(states, -1)).float(),
        torch.from_numpy(action[1:]).float(),
    )


def test_positions_are_told_from_velocities() -> None:
    found = inspect_dataset(sliding())
    assert found.proposal.columns == {
        "robot": (0, 1, 2, 3),
        "entity0": (4, 5, 6, 7),
        "entity1": (8, 9, 10, 11),
    }
    expected = {"robot": (0, 1), "entity0": (4, 5), "entity1": (8, 9)}
    assert found.proposal.positions == expected
    assert not any("positions" in note for note in found.notes)


def test_positions_are_told_from_velocities_in_leaves() -> None:
    data = sliding()
    for state in (data, data["next"]):
        flat = state["observation"]
        leaves = {"arm": flat[:, :4], "cup": flat[:, 4:8]}
        state["observation"] = TensorDict(leaves, [len(flat)])
    found = inspect_dataset(data).proposal
    assert found.positions == {"arm": (0, 1), "cup": (0, 1)}


def test_without_velocities_positions_are_unknown() -> None:
    found = inspect_dataset(transitions(*world(2, [2, 2], 3)))
    assert not found.proposal.positions
    assert any("positions of robot, entity0" in note for note in found.notes)


def test_goals_that_equal_columns_are_mapped() -> None:
    data = clean()
    found = inspect_dataset(data)
    assert found.proposal is not None
    columns = found.proposal.columns
    goals = {name: list(own) for name, own in found.proposal.goal.items()}
    assert [columns[name] for name in goals] == [(4, 5), (7, 8)]
    assert list(goals.values()) == [[0, 1], [2, 3]]
    assert check_dataset(data, found.proposal).ok
    data["achieved_goal"] = data["achieved_goal"] + 0.01
    other = inspect_dataset(data)
    assert other.proposal is not None and not other.proposal.goal
    assert any("name goal and achieved" in note for note in other.notes)


def test_the_goal_of_one_object() -> None:
    data = clean()
    data["achieved_goal"] = data["achieved_goal"][:, :2].clone()
    data["desired_goal"] = data["desired_goal"][:, :2].clone()
    found = inspect_dataset(data)
    assert found.proposal is not None
    assert sorted(map(len, found.proposal.goal.values())) == [0, 2]


def test_discrete_actions() -> None:
    data = clean()
    found = inspect_dataset(data.set("action", (data["action"][:, 0] > 0).long()))
    assert found.proposal is not None
