"""Layouts as YAML and JSON files, saved and written by hand."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import UnreadableFileError
from torchrl_caiac.layouts import layout_names, ready_layout

names = st.text(min_size=1, max_size=8)
keys = st.one_of(names, st.lists(names, min_size=2, max_size=3).map(tuple))
floors = st.floats(1e-300, 1e300)
SUFFIXES = ["yaml", "yml", "YAML", "json"]


@st.composite
def flat_layouts(draw: Any) -> EntityLayout:
    found = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    columns = draw(st.permutations(range(12)))
    count = len(found) - 1
    cuts = draw(st.sets(st.integers(1, 11), min_size=count, max_size=count))
    parts = [columns[a:b] for a, b in pairwise([0, *sorted(cuts), 12])]
    parts = [sorted(p) if draw(st.booleans()) else p for p in parts]
    entities = dict(zip(found, parts, strict=True))
    fixed = [n for n in found if draw(st.booleans())]
    arguments: dict[str, Any] = {"fixed": fixed}
    if draw(st.booleans()):
        starts = [sum(map(len, parts[:i])) for i in range(len(parts))]
        arguments["goal"] = {
            n: range(s, s + len(entities[n]))
            for n, s in zip(found, starts, strict=True)
        }
        arguments["achieved"] = entities
    if draw(st.booleans()):
        arguments["positions"] = {found[-1]: entities[found[-1]][:1]}
    if draw(st.booleans()):
        arguments["variance_floor"] = {
            n: draw(st.one_of(floors, st.just([draw(floors)] * len(entities[n]))))
            for n in found
        }
    if draw(st.booleans()):
        arguments["width"] = draw(st.integers(12, 2**31 - 1))
    for name in (
        "observation_key",
        "next_key",
        "desired_goal_key",
        "achieved_goal_key",
    ):
        if draw(st.booleans()):
            arguments[name] = draw(keys)
    return EntityLayout(entities, **arguments)


@st.composite
def nested_layouts(draw: Any) -> EntityLayout:
    found = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    # Keys below different parents do not overlap.
    entities = {n: (f"state{i}", draw(names)) for i, n in enumerate(found)}
    arguments: dict[str, Any] = {"fixed": found[:1]}
    if draw(st.booleans()):
        goal: dict[str, Any] = {n: ("goal", str(i)) for i, n in enumerate(found)}
        goal[found[-1]] = draw(st.sampled_from([None, "null"]))
        arguments |= {"goal": goal, "achieved": entities}
    if draw(st.booleans()):
        arguments["positions"] = {found[0]: [2, 3, 4]}
    if draw(st.booleans()):
        arguments["variance_floor"] = draw(floors)
    if draw(st.booleans()):
        arguments["next_key"] = draw(keys)
    return EntityLayout.from_keys(entities, **arguments)


@settings(max_examples=80, deadline=None)
@given(st.one_of(flat_layouts(), nested_layouts()), st.sampled_from(SUFFIXES))
def test_round_trip(tmp_path_factory: Any, layout: EntityLayout, suffix: str) -> None:
    file = tmp_path_factory.mktemp("layout") / f"layout.{suffix}"
    layout.save(file)
    loaded = EntityLayout.load(file)
    assert loaded.to_dict() == layout.to_dict()
    assert list(loaded.names) == list(layout.names)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize("name", layout_names())
@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_ready_layouts_round_trip(name: str, suffix: str, tmp_path: Path) -> None:
    ready_layout(name).save(tmp_path / f"a.{suffix}")
    assert EntityLayout.load(tmp_path / f"a.{suffix}") == ready_layout(name)


def write(folder: Path, text: str, name: str = "mine.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


WHOLE = """
entities:          # a comment
  gripper: 0:10
  cube: [10, 11, 12]
  lid: 30, 32:34
fixed: [gripper]
goal: {cube: 0:3, lid: []}
achieved: {cube: 10:13, lid: []}
positions:
  cube: "10:13"
variance_floor:
  gripper: 1e-3
  cube: [.001, 0.001, 1.0e-3]
  lid: 2
observation_key: [observation, state]
width: 34
"""
WANTED = EntityLayout(
    {"gripper": range(10), "cube": [10, 11, 12], "lid": [30, 32, 33]},
    observation_key=("observation", "state"),
    fixed=("gripper",),
    goal={"cube": range(3), "lid": []},
    achieved={"cube": range(10, 13), "lid": []},
    positions={"cube": range(10, 13)},
    variance_floor={"gripper": 1e-3, "cube": [1e-3] * 3, "lid": 2.0},
    width=34,
)


def test_a_person_writes_yaml(tmp_path: Path) -> None:
    assert EntityLayout.load(write(tmp_path, WHOLE)) == WANTED


def test_a_person_writes_json(tmp_path: Path) -> None:
    content = {
        "entities": {"gripper": "0:10", "cube": [10, 11, 12], "lid": ["30", "32:34"]},
        "fixed": ["gripper"],
        "goal": {"cube": "0:3", "lid": []},
        "achieved": {"cube": "10:13", "lid": []},
        "positions": {"cube": "10:13"},
        "variance_floor": {"gripper": 1e-3, "cube": [1e-3] * 3, "lid": 2},
        "observation_key": ["observation", "state"],
        "width": 34,
    }
    file = write(tmp_path, json.dumps(content), "mine.json")
    assert EntityLayout.load(file) == WANTED


def test_a_person_writes_a_nested_layout(tmp_path: Path) -> None:
    text = """
keys: {arm: [observation, arm], cup: [observation, cup]}
goal: {arm: ~, cup: goal}
fixed: [arm]
variance_floor: 0.001
"""
    assert EntityLayout.load(write(tmp_path, text)) == EntityLayout.from_keys(
        {"arm": ("observation", "arm"), "cup": ("observation", "cup")},
        goal={"arm": None, "cup": "goal"},
        fixed=("arm",),
        variance_floor=0.001,
    )


def test_names_that_yaml_would_change(tmp_path: Path) -> None:
    layout = EntityLayout.load(write(tmp_path, "entities: {no: 1, 7: 2}\nfixed: [7]"))
    assert layout == EntityLayout({"no": [1], "7": [2]}, fixed=["7"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("entities: [", "line 1"),
        ("- 1", "line 1, the layout: expected a mapping"),
        ("fixed: [a]", "expected 'entities', or 'keys'"),
        ("entities:\n  a: 0:3\nfixd: [a]", "line 3, fixd: expected only the fields"),
        ("entities:\n  a: 0-3", r"line 2, entities\.a: expected columns .* got '0-3'"),
        ("entities:\n  a: 3:3", r"line 2, entities\.a: .* from small to large"),
        ("entities:\n  a: 0:999999999", r"entities\.a: .* from small to large"),
        ("entities:\n  a:\n  - 1\n  - x", r"line 4, entities\.a\.1: .* got 'x'"),
        ("entities:\n  a: [1.5]", r"entities\.a\.0: .* got '1.5'"),
        ("entities:\n  a: [-1]", r"entities\.a\.0: .* got '-1'"),
        ("entities:\n  a:", r"line 2, entities\.a: expected columns"),
        ("entities: 0:10", "line 1, entities: expected a mapping from names"),
        ("entities:\n  a: 0\n  a: 1", "line 3 gives 'a' a second time"),
        ("entities: {a: &x [0]}\npositions: {a: *x}", "used twice"),
        ("entities: {a: !!python/tuple [0]}", "tag .*python/tuple"),
        ("entities: {[a]: 0}", "a name that is not a text"),
        ("entities: {a: 0, b: 0}", "belongs to both 'a' and 'b'"),
        ("entities: {a: 0}\nfixed: a", "line 2, fixed: expected a list of names"),
        ("entities: {a: 0}\nfixed: [b]", "not entities of this layout"),
        ("entities: {a: 0}\nvariance_floor: high", "line 2, variance_floor: expected"),
        ("entities: {a: 0}\nvariance_floor: -1", "positive and finite"),
        ("entities: {a: 0}\nvariance_floor: {a: '1'}", r"variance_floor\.a: expected"),
        ("entities: {a: 0}\nwidth: 0", "width is 0"),
        ("entities: {a: 0}\nwidth: a", "line 2, width: expected a number of columns"),
        ("entities: {a: 0}\nobservation_key: []", "observation_key: expected a key"),
        ("keys: {a: [b, {c: d}]}", r"keys\.a\.1: expected a text"),
        ("keys: {a: b}\nwidth: 3", "width: expected only the fields"),
        ("entities: {a: 0}\n---\nentities: {a: 1}", "single document"),
        ("[" * 2000, "not a readable layout"),
        ("#" * (1 << 20) + "#", "bytes, expected at most"),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str, tmp_path: Path) -> None:
    file = write(tmp_path, text)
    with pytest.raises(UnreadableFileError, match=message) as caught:
        EntityLayout.load(file)
    assert str(file) in str(caught.value)
    assert "correct the file" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"entities": {"a": [0], "a": [1]}}', "gives 'a' twice"),
        ('{"entities": {"a": "0-3"}}', r"entities\.a: expected columns"),
        ('{"entities": {"a": [true]}}', r"entities\.a\.0: expected columns"),
        ('{"entities": {"a": [0]}, "variance_floor": NaN}', "positive and finite"),
        (
            '{"entities": {"a": [0]}, "variance_floor": true}',
            "variance_floor: expected",
        ),
        ("3", "does not describe an EntityLayout"),
    ],
)
def test_what_is_wrong_in_json_is_named(
    text: str, message: str, tmp_path: Path
) -> None:
    file = write(tmp_path, text, "mine.json")
    with pytest.raises(UnreadableFileError, match=message) as caught:
        EntityLayout.load(file)
    assert str(file) in str(caught.value)


def test_binary_files_and_folders_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnreadableFileError, match=r"a\.yaml is not a readable layout"):
        EntityLayout.load(file)
    (tmp_path / "b.yaml").mkdir()
    with pytest.raises(UnreadableFileError, match="it is not a file"):
        EntityLayout.load(tmp_path / "b.yaml")
    with pytest.raises(FileNotFoundError, match=r"c\.yaml"):
        EntityLayout.load(tmp_path / "c.yaml")
