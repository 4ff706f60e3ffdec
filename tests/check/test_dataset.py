"""Each error, planted in clean data, is found, and nothing else is."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded, LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from tests.check.pushing import ENTITIES, LAYOUT, clean, nested, reorder
from torchrl_caiac import EntityLayout, check_dataset
from torchrl_caiac.check import DatasetError, check_before_use
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel

LENGTH = 30  # rows of a trajectory
NEXT = ("next", "observation")
DONE = ("next", "done")
PARTS = (("next", "terminated"), ("next", "truncated"))


def codes(data: Any, layout: EntityLayout = LAYOUT, **kwargs: Any) -> list[str]:
    """The codes of the findings, and a check of what every finding has."""
    report = check_dataset(data, layout, **kwargs)
    for finding in report.findings:
        assert finding.message and finding.effect and finding.remedy
    assert all(len(line) <= 80 for line in str(report).splitlines())
    assert json.loads(json.dumps(report.to_dict()))["ok"] == report.ok
    return [finding.code for finding in report.findings]


def both(data: TensorDict, key: str, value: torch.Tensor, after: torch.Tensor) -> None:
    data[key], data["next", key] = value, after


def widen(data: TensorDict, function: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Adds columns that are a function of the state to the observation."""
    for key in ("observation", NEXT):
        x = data[key]
        data[key] = torch.cat([x, function(x)], 1)


# --- clean data ----------------------------------------------------------------------


@settings(max_examples=25)
@given(
    kind=st.sampled_from(["flat", "nested"]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    storage=st.sampled_from(["data", "memmap", "buffer", "memmap buffer"]),
    interleaved=st.booleans(),
    seed=st.integers(0, 5),
    length=st.integers(10, 40),
    max_rows=st.sampled_from([500, 200_000]),
)
def test_clean_data_have_no_findings(
    tmp_path_factory: Any,
    kind: str,
    dtype: Any,
    storage: str,
    interleaved: bool,
    seed: int,
    length: int,
    max_rows: int,
) -> None:
    data, layout = clean(dtype, seed=seed, length=length), LAYOUT
    if kind == "nested":
        data, layout = nested(data)
    if interleaved:  # as parallel environments write them
        data = reorder(data, torch.arange(len(data)).view(-1, length).T.reshape(-1))
    source: Any = data
    if storage == "memmap":
        source = data.memmap(tmp_path_factory.mktemp("data"))
    elif storage != "data":
        make = LazyMemmapStorage if "memmap" in storage else LazyTensorStorage
        source = ReplayBuffer(storage=make(len(data) + 7), batch_size=1)
        source.extend(data)
    report = check_dataset(
        source, layout, action_spec=(-1, 1), variance_floor=1e-3, max_rows=max_rows
    )
    assert not report.findings
    assert report.num_transitions == len(data)
    assert report.num_checked == min(len(data), report.num_checked) <= max_rows


def drop(*keys: Any) -> Callable[[TensorDict], TensorDict]:
    return lambda data: data.exclude(*keys)


def noisy(data: TensorDict) -> None:
    generator = torch.Generator().manual_seed(0)
    for key in ("observation", NEXT):
        noise = torch.randn(data[key].shape, generator=generator)
        data[key] += 2e-3 * noise


def add_image(data: TensorDict) -> None:
    for prefix in ((), ("next",)):
        data[(*prefix, "pixels")] = torch.zeros(len(data), 3, 20, 20, dtype=torch.uint8)
        data[(*prefix, "depth")] = torch.zeros(len(data), 30, 30)


def n_step(data: TensorDict) -> None:
    """The state three rows later, or at the end."""
    rows = torch.arange(len(data))
    later = (rows + 2).minimum(rows // LENGTH * LENGTH + LENGTH - 1)
    data["next"] = data["next"][later].clone()
    data["steps_to_next_obs"] = later - rows + 1
    data["next", "done"][:] = (later % LENGTH == LENGTH - 1)[:, None]
    data["next", "truncated"] = data["next", "done"].clone()


def single_rows(data: TensorDict) -> TensorDict:
    """Independent transitions, each a trajectory of its own."""
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    data = reorder(data, order)
    data["episode"] = torch.arange(len(data))
    data["next", "done"][:] = True
    data["next", "truncated"][:] = True
    return data


def pieces(data: TensorDict) -> None:
    """Long trajectories that were stored as pieces of ten rows."""
    data["episode"] = torch.arange(len(data)) // 10
    ends = torch.arange(len(data)) % 10 == 9
    data["next", "done"][:] = ends[:, None]
    data["next", "truncated"][:] = ends[:, None]


def angles(data: TensorDict) -> None:
    """A column with angles, which jump by a turn."""
    for key in ("observation", NEXT):
        turns = data[key][:, 4] * 40
        data[key][:, 6] = torch.atan2(turns.sin(), turns.cos())


def add_goal_column(data: TensorDict) -> None:
    """A column that is constant in each trajectory."""
    goal = data["desired_goal"][:, :1]
    for key in ("observation", NEXT):
        data[key] = torch.cat([data[key], goal], 1)


def add_time(data: TensorDict) -> None:
    data["step_count"] = (torch.arange(len(data)) % LENGTH)[:, None]


def simulator_states(data: TensorDict) -> None:
    data["info"] = TensorDict({"simulator": data["observation"] * 2}, [len(data)])


@pytest.mark.parametrize(
    "change",
    [
        drop("desired_goal", "achieved_goal", ("next", "reward")),
        drop(DONE, ("next", "truncated"), ("next", "terminated")),
        drop("nothing"),
        noisy,
        add_image,
        n_step,
        single_rows,
        pieces,
        angles,
        add_goal_column,
        add_time,
        simulator_states,
    ],
)
def test_other_data_without_errors(change: Callable[[TensorDict], Any]) -> None:
    data = clean()
    data = result if (result := change(data)) is not None else data
    layout = LAYOUT
    if change is noisy:  # goals without the noise of the sensors
        data = data.exclude("achieved_goal", ("next", "achieved_goal"))
    assert codes(data, layout, variance_floor=5e-3) == []


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool])
def test_states_of_integers(dtype: Any) -> None:
    """A grid, where an agent pushes a box."""
    generator = torch.Generator().manual_seed(0)
    most = 2 if dtype == torch.bool else 8
    walk = torch.randint(-1, 2, (20, 41, 2), generator=generator).cumsum(1) % most
    walk[..., 1] = walk[:, :1, 1] + (walk[..., 0] == 0).cumsum(1)
    walk = (walk % most).to(dtype)
    data = TensorDict(
        {
            "observation": walk[:, :-1],
            "action": torch.randint(0, 4, (20, 40, 1), generator=generator),
            "episode": torch.arange(20)[:, None].expand(-1, 40),
            "next": {"observation": walk[:, 1:]},
        },
        [20, 40],
    ).reshape(-1)
    layout = EntityLayout({"agent": [0], "box": [1]}, fixed=["agent"])
    assert codes(data, layout) == []


def test_a_layout_without_a_fixed_entity() -> None:
    layout = EntityLayout(ENTITIES)
    findings = check_dataset(clean(), layout).findings
    (found,) = [f for f in findings if f.code == "none_fixed"]
    assert found.severity == "warning"
    assert "robot, left, right" in found.message
    assert "name the robot in fixed" in found.remedy
    alone = EntityLayout({"left": ENTITIES["left"]})
    assert "none_fixed" not in codes(clean(), alone)


# --- planted errors ------------------------------------------------------------------


def swap_rows(data: TensorDict) -> TensorDict:
    rows = torch.arange(len(data))
    rows[[70, 75]] = rows[[75, 70]]
    return reorder(data, rows)


def shuffle_rows(data: TensorDict) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    rows = torch.arange(len(data)).view(-1, LENGTH)
    order = torch.stack([torch.randperm(LENGTH, generator=generator) for _ in rows])
    data["next", "done"] = data["next", "truncated"] = torch.zeros(
        len(data), 1, dtype=torch.bool
    )
    return reorder(data.exclude(DONE), rows.gather(1, order).reshape(-1))


def reverse_rows(data: TensorDict) -> TensorDict:
    return reorder(data, torch.arange(len(data)).view(-1, LENGTH).flip(1).reshape(-1))


def shuffle_next(data: TensorDict) -> None:
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    for key in ("observation", "achieved_goal"):
        data["next", key] = data["next", key][order]


def skip_next(data: TensorDict) -> None:
    rows = torch.arange(len(data))
    later = (rows + 1).minimum(rows // LENGTH * LENGTH + LENGTH - 1)
    for key in ("observation", "achieved_goal"):
        data["next", key] = data["next", key][later]


def over_end(data: TensorDict) -> None:
    """Next states by shifting the rows, as in data with automatic resets."""
    for key in ("observation", "achieved_goal"):
        data["next", key] = data[key].roll(-1, 0)


def own_state(data: TensorDict) -> None:
    both(data, "observation", data["observation"], data["observation"].clone())
    both(data, "achieved_goal", data["achieved_goal"], data["achieved_goal"].clone())


def at_ends(data: TensorDict, value: Any) -> None:
    ends = data[DONE][:, 0]
    for key in ("observation", "achieved_goal"):
        data["next", key][ends] = value if value == 0 else data[key][ends]


def remove_rows(data: TensorDict) -> TensorDict:
    return reorder(data, [r for r in range(len(data)) if r not in (40, 41, 200)])


def merge_ids(data: TensorDict) -> None:
    data["episode"] //= 2
    data.exclude(DONE, *PARTS, inplace=True)


def merge_ids_with_time(data: TensorDict) -> None:
    add_time(data)
    merge_ids(data)


def set_flags(data: TensorDict, rows: Any, value: bool) -> None:
    data[DONE][rows] = value
    data["next", "truncated"] = data[DONE].clone()


def shift_flags(data: TensorDict, by: int) -> None:
    data[DONE] = data[DONE].roll(by, 0)
    data["next", "truncated"] = data[DONE].clone()


def jump(data: TensorDict) -> None:
    """An object is put elsewhere within one step."""
    for key, column in (("observation", 4), ("achieved_goal", 0)):
        data["next", key][100, column : column + 2] += 3.0
        data[key][101:120, column : column + 2] += 3.0
        data["next", key][101:120, column : column + 2] += 3.0


def freeze(data: TensorDict) -> None:
    for prefix in ((), ("next",)):
        data[(*prefix, "observation")][:, 7:9] = data["observation"][0, 7:9].clone()
        data[(*prefix, "achieved_goal")][:, 2:] = data["achieved_goal"][0, 2:].clone()


def shake(data: TensorDict) -> None:
    """The noise of a sensor on one object, larger than its motion."""
    noise = torch.randn(len(data) // LENGTH, LENGTH + 1, 2) * 0.05
    for key, part, where in (
        ("observation", noise[:, :-1], slice(7, 9)),
        (NEXT, noise[:, 1:], slice(7, 9)),
        ("achieved_goal", noise[:, :-1], slice(2, 4)),
        (("next", "achieved_goal"), noise[:, 1:], slice(2, 4)),
    ):
        data[key][:, where] += part.reshape(-1, 2)


def pad(data: TensorDict) -> TensorDict:
    """Every trajectory is filled up with zeros to the same length."""
    zeros = torch.zeros_like(data.view(-1, LENGTH)[:, :5])
    zeros["episode"] = data["episode"].view(-1, LENGTH)[:, :5]
    return torch.cat([data.view(-1, LENGTH), zeros], 1).reshape(-1)


def relative(x: torch.Tensor) -> torch.Tensor:
    return x[:, 4:6] - x[:, 0:2]


def own_relative(data: TensorDict) -> None:
    """The place of an object relative to the robot, owned by the object."""
    for key in ("observation", NEXT):
        data[key][:, 6] = data[key][:, 4] - data[key][:, 0]


def add_leaf(data: TensorDict) -> None:
    both(data, "vector", relative(data["observation"]), relative(data[NEXT]))


def put(key: Any, row: int, column: int, value: float) -> Callable[[TensorDict], None]:
    def change(data: TensorDict) -> None:
        data[key][row, column] = value

    return change


def copy_column(data: TensorDict) -> None:
    for key in ("observation", NEXT):
        data[key][:, 9] = data[key][:, 4]


PLANTED: dict[str, tuple[Callable[[TensorDict], Any], str, str]] = {
    "no observation": (drop("observation"), "missing_entry", "error"),
    "no next": (drop(NEXT), "missing_entry", "error"),
    "no action": (drop("action"), "missing_entry", "error"),
    "no reward": (drop(("next", "reward")), "missing_reward", "warning"),
    "no ids": (drop("episode"), "ids_missing", "error"),
    "narrow": (
        lambda d: both(d, "observation", d["observation"][:, :9], d[NEXT][:, :9]),
        "wrong_shape",
        "error",
    ),
    "narrow next": (
        lambda d: d.set(NEXT, torch.cat([d[NEXT], d[NEXT]], 1)),
        "wrong_shape",
        "error",
    ),
    "narrow goals": (
        lambda d: d.set("desired_goal", d["desired_goal"][:, :3]),
        "wrong_shape",
        "error",
    ),
    "float ids": (
        lambda d: d.set("episode", d["episode"].float()),
        "wrong_shape",
        "error",
    ),
    "wide flags": (
        lambda d: d.set(DONE, d[DONE].expand(-1, 2).clone()),
        "wrong_shape",
        "error",
    ),
    "two rows swapped": (swap_rows, "rows_out_of_order", "error"),
    "rows shuffled": (shuffle_rows, "rows_out_of_order", "error"),
    "rows reversed": (reverse_rows, "rows_out_of_order", "error"),
    "next shuffled": (shuffle_next, "next_of_other_rows", "error"),
    "next skips": (skip_next, "next_skips_rows", "error"),
    "next over ends": (over_end, "next_over_end", "error"),
    "next is state": (own_state, "next_equals_state", "error"),
    "next zero": (lambda d: at_ends(d, 0), "next_zero_at_ends", "error"),
    "next repeats": (lambda d: at_ends(d, 1), "next_repeats_at_ends", "warning"),
    "rows removed": (remove_rows, "next_not_following", "error"),
    "ids merged": (merge_ids, "next_not_following", "error"),
    "ids merged, time": (merge_ids_with_time, "end_missing", "error"),
    "never done": (
        lambda d: set_flags(d, slice(None), False),
        "ends_never_set",
        "warning",
    ),
    "done early": (lambda d: shift_flags(d, -1), "ends_misplaced", "error"),
    "done late": (lambda d: shift_flags(d, 1), "ends_misplaced", "error"),
    "done inside": (
        lambda d: set_flags(d, [12, 44], True),
        "ends_contradict_ids",
        "warning",
    ),
    "ends unmarked": (
        lambda d: set_flags(d, [LENGTH - 1], False),
        "ends_unmarked",
        "warning",
    ),
    "done alone": (
        lambda d: d.set(("next", "truncated"), torch.zeros_like(d[DONE])),
        "done_contradicts",
        "warning",
    ),
    "jump": (jump, "jump", "warning"),
    "at rest": (freeze, "never_moves", "warning"),
    "shaking": (shake, "always_moves", "warning"),
    "padding": (pad, "padded_rows", "warning"),
    "relative": (lambda d: widen(d, relative), "stale_columns", "warning"),
    "mixture": (
        lambda d: widen(d, lambda x: x[:, 4:5] + 0.3 * x[:, 8:9]),
        "stale_columns",
        "warning",
    ),
    "relative leaf": (add_leaf, "stale_columns", "warning"),
    "copy": (copy_column, "duplicate_columns", "warning"),
    "constant": (
        lambda d: widen(d, lambda x: x[:, :1] * 0 + 3),
        "constant_columns",
        "warning",
    ),
    "other goals": (
        lambda d: d.set("achieved_goal", d["achieved_goal"].roll(1, 1)),
        "goal_not_mirrored",
        "error",
    ),
    "large actions": (put("action", 5, 1, 1.2), "action_out_of_bounds", "error"),
    "same actions": (
        lambda d: d.set("action", torch.ones_like(d["action"])),
        "action_constant",
        "error",
    ),
    "same column": (
        lambda d: d["action"][:, 1].fill_(0.5),
        "action_columns_constant",
        "warning",
    ),
    "NaN": (put("observation", 77, 5, float("nan")), "not_finite", "error"),
    "infinite next": (put(NEXT, 77, 8, float("inf")), "not_finite", "error"),
    "NaN action": (put("action", 77, 0, float("nan")), "not_finite", "error"),
    "NaN goal": (put("desired_goal", 77, 0, float("nan")), "not_finite", "error"),
}


@pytest.mark.parametrize("name", PLANTED)
def test_planted_errors_are_found_alone(name: str) -> None:
    change, code, severity = PLANTED[name]
    data = clean()
    result = change(data)
    data = result if isinstance(result, TensorDict) else data
    layout = LAYOUT
    if name == "constant":
        columns = {**ENTITIES, "left": [*ENTITIES["left"], 10]}
        layout = EntityLayout(columns, fixed=["robot"])
        goals = ("desired_goal", "achieved_goal", ("next", "achieved_goal"))
        data = data.exclude(*goals)
    torch.manual_seed(0)
    report = check_dataset(data, layout, action_spec=(-1, 1))
    assert [(f.code, f.severity) for f in report.findings] == [(code, severity)]


def test_columns_that_mix_entities() -> None:
    """A column of an object that is relative to the robot also always moves."""
    data = clean()
    own_relative(data)
    assert codes(data) == ["always_moves", "mixed_columns"]


def test_goals_that_the_layout_does_not_name_are_found() -> None:
    data = clean()
    layout = EntityLayout(ENTITIES, fixed=["robot"])

    def severity(*left_out: Any) -> list[str]:
        report = check_dataset(data.exclude(*left_out), layout)
        assert {f.code for f in report.findings} <= {"goals_not_mapped"}
        return [f.severity for f in report.findings]

    # Transforms refuse achieved goals of the state or of the next state.
    now, later = "achieved_goal", ("next", "achieved_goal")
    assert severity() == severity(now) == severity(later) == ["error"]
    assert severity("desired_goal") == ["error"]
    assert severity(now, later) == ["warning"]
    assert severity(now, later, "desired_goal") == []


# --- other sources, layouts and options ----------------------------------------------


@pytest.mark.parametrize("name", ["rows reversed", "next skips", "ids merged"])
def test_errors_are_found_despite_noise(name: str) -> None:
    data = clean(length=60)
    noisy(data)
    change, code, _ = PLANTED[name]
    result = change(data)
    data = result if isinstance(result, TensorDict) else data
    data = data.exclude("achieved_goal", ("next", "achieved_goal"))
    assert code in codes(data)


@pytest.mark.parametrize("name", ["rows shuffled", "rows reversed"])
def test_time_tells_the_order_of_noisy_rows(name: str) -> None:
    data = clean()
    noisy(data)
    add_time(data)
    data = PLANTED[name][0](data.exclude("achieved_goal", ("next", "achieved_goal")))
    assert codes(data) == ["rows_out_of_order"]


def test_transitions_that_share_an_id_but_do_not_follow_each_other() -> None:
    data = single_rows(clean())
    keep = torch.arange(0, len(data), 3)  # their neighbours in time are not there
    data = reorder(clean(), keep)
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(2))
    data = reorder(data, order).exclude(DONE, *PARTS)
    data["episode"] = torch.arange(len(data)) // 20
    report = check_dataset(data, LAYOUT)
    assert [f.code for f in report.findings] == ["next_unrelated"]
    assert report.ok


def test_without_ids_breaks_are_ends_without_flags() -> None:
    data = clean()
    set_flags(data, slice(None), False)
    report = check_dataset(data, LAYOUT, trajectory_key=None)
    assert [f.code for f in report.errors] == ["ends_never_set"]
    assert report.findings[0].rows[:2] == (LENGTH - 1, 2 * LENGTH - 1)
    single = check_dataset(data[:LENGTH], LAYOUT, trajectory_key=None)
    assert single.ok and single.findings[0].code == "ends_never_set"
    del data["next", "done"]  # "terminated" and "truncated" are there
    assert codes(data, trajectory_key=None) == ["ends_never_set"]
    data = data.exclude(*PARTS)
    assert codes(data, trajectory_key=None) == ["ends_missing"]


def test_a_storage_of_several_environments_that_is_not_full() -> None:
    columns = [clean(), clean()]
    rb = ReplayBuffer(
        storage=LazyTensorStorage(8 * len(columns[0]), ndim=2), dim_extend=0
    )
    rb.extend(torch.stack(columns, 1))
    report = check_dataset(rb, LAYOUT)
    assert report.num_transitions == 2 * len(columns[0])
    assert not report.findings


def test_full_rings_and_later_writes() -> None:
    data = clean()
    rb = ReplayBuffer(storage=LazyTensorStorage(500), batch_size=1)
    for start in range(0, len(data), 50):
        rb.extend(data[start : start + 50])
    assert codes(rb, action_spec=(-1, 1)) == []


def test_names_of_columns_rows_and_keys() -> None:
    data, layout = nested(clean())
    data["state", "left"][31, 1] = float("nan")
    data["next", "state", "robot", "move"][40, 0] = float("inf")
    first, second = check_dataset(data, layout).errors
    assert first.columns == ("left (feature 1)",) and first.rows == (31,)
    assert second.columns == ("robot (feature 0)",) and second.rows == (40,)
    flat = clean()
    flat["observation"][31, 5] = float("nan")
    found = check_dataset(flat, LAYOUT).errors[0]
    assert found.columns == ("left (column 5)",) and found.key == "observation"
    assert "'observation' is nan in row 31, left (column 5)" in found.message


@pytest.mark.parametrize(
    ("floor", "expected"),
    [
        (1e-3, []),
        ({"robot": 1e-3, "left": 1e-3, "right": [1e-3, 1e-3, 1e-3]}, []),
        (1.0, ["floor_too_high"] * 3),
        (1e-6, ["floor_too_low"] * 3),
        ({"robot": 1e-3, "left": 1e-6, "right": 1e-3}, ["floor_too_low"]),
    ],
)
def test_variance_floors_in_other_units(floor: Any, expected: list[str]) -> None:
    assert codes(clean(), variance_floor=floor) == expected


def test_bounds_of_actions() -> None:
    data = clean()
    low, high = torch.full((2,), -1.0), torch.tensor([1.0, 0.5])
    for spec in ((low, high), Bounded(low, high, shape=(2,))):
        found = check_dataset(data, LAYOUT, action_spec=spec).errors[0]
        assert found.code == "action_out_of_bounds" and found.columns == ("column 1",)
    assert codes(data, action_spec=Bounded(-1, 1, shape=(2,))) == []
    assert codes(data.exclude("action"), action_key=None) == []


def test_next_states_that_nothing_reads() -> None:
    data = clean().exclude(NEXT, ("next", "achieved_goal"))
    assert codes(data, read_next=False) == []


def test_a_column_that_follows_the_robot_alone_is_not_stale() -> None:
    data = clean()
    widen(data, lambda x: 2 * x[:, 0:1])
    assert codes(data) == []


def test_wrong_arguments_are_named() -> None:
    data = clean()
    with pytest.raises(TypeError, match="layout must be an EntityLayout, got dict"):
        check_dataset(data, {})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="data must be a TensorDict or a ReplayBuffer"):
        check_dataset([data], LAYOUT)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="max_rows must be an int of at least 1"):
        check_dataset(data, LAYOUT, max_rows=0)
    with pytest.raises(ValueError, match="at least one transition"):
        check_dataset(data[:0], LAYOUT)
    with pytest.raises(TypeError, match="action_spec must be a torchrl Bounded"):
        check_dataset(data, LAYOUT, action_spec="box")
    with pytest.raises(ValueError, match="bounds of action_spec must be ordered"):
        check_dataset(data, LAYOUT, action_spec=(1, -1))
    with pytest.raises(ValueError, match="variance_floor names"):
        check_dataset(data, LAYOUT, variance_floor={"cup": 1.0})


def test_all_ends_with_automatic_resets_are_counted() -> None:
    data = clean()
    over_end(data)
    found = check_dataset(data, LAYOUT).errors[0]
    assert found.count == len(data) // LENGTH and found.rows[:2] == (29, 59)


def test_resets_are_found_among_fast_velocities() -> None:
    generator = torch.Generator().manual_seed(0)
    speed = torch.randn(20, 31, 6, generator=generator)
    place = 0.02 * speed[..., :2].cumsum(1) + torch.rand(20, 1, 2, generator=generator)
    states = torch.cat([place, speed], -1)
    data = TensorDict(
        {
            "observation": states[:, :-1],
            "action": speed[:, 1:, :2].clamp(-1, 1),
            "episode": torch.arange(20)[:, None].expand(-1, 30),
            "next": {"observation": states[:, 1:]},
        },
        [20, 30],
    ).reshape(-1)
    layout = EntityLayout({"robot": range(8)}, fixed=["robot"])
    assert "next_over_end" not in codes(data, layout)
    data["next", "observation"] = data["observation"].roll(-1, 0)
    assert "next_over_end" in codes(data, layout)
    # Pieces of one long trajectory have no jumps.
    long = torch.cat([0.02 * speed.view(-1, 6)[:, :2].cumsum(0), speed.view(-1, 6)], -1)
    data["observation"], data["next", "observation"] = long[:600], long[1:601]
    assert "next_over_end" not in codes(data, layout)


# --- before fitting ------------------------------------------------------------------

SILENT = ["next shuffled", "next over ends", "next zero", "next is state"]
SILENT += ["next skips", "rows shuffled", "same actions"]


@pytest.mark.parametrize("name", SILENT)
def test_fitting_stops_before_it_learns_from_errors(name: str) -> None:
    change, code, _ = PLANTED[name]
    data = clean()
    result = change(data)
    data = result if isinstance(result, TensorDict) else data
    model = GaussianWorldModel(LAYOUT, 2, (8,))
    options: Any = {"steps": 2, "batch_size": 8, "progress": False}
    with pytest.raises(DatasetError, match=code) as caught:
        fit_world_model(model, data, **options)
    assert not model.fitted
    assert caught.value.report.errors[0].code == code
    fit_world_model(model, data, **options, check=False)
    assert model.fitted


def test_warnings_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    columns = {"robot": range(4), "left": range(4, 7), "right": range(7, 9)}
    layout = EntityLayout(columns, fixed=["robot", "right"])
    goals = ("desired_goal", "achieved_goal", ("next", "achieved_goal"))
    data = clean().exclude(*goals)
    widen(data, relative)
    with caplog.at_level(logging.WARNING, "torchrl_caiac.check"):
        check_before_use(data, layout)
        assert [r.getMessage().split(":")[0] for r in caplog.records] == [
            "stale_columns"
        ]
        check_before_use(data, layout)
        assert len(caplog.records) == 1


# --- this package's own data ---------------------------------------------------------


def test_episodes_of_fetch_push_have_no_findings(tmp_path: Path) -> None:
    from torchrl_caiac.data import load_minari
    from torchrl_caiac.envs import create_fetch_push_expert, fetch_push_layout

    dataset = create_fetch_push_expert(
        episodes=4, steps=60, root=tmp_path, workers=1, seed=3, progress=False
    )
    data = load_minari(dataset, tmp_path / "rows", progress=False)
    layout = fetch_push_layout(2)
    report = check_dataset(data, layout, action_spec=(-1, 1), variance_floor=1e-3)
    assert not report.errors
    assert {f.code for f in report.warnings} <= {"never_moves"}
    at_ends(data := data.clone(), 0)
    assert [f.code for f in check_dataset(data, layout).errors] == ["next_zero_at_ends"]
