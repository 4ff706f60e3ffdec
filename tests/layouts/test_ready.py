from __future__ import annotations

import pickle
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout, check_dataset
from torchrl_caiac.layouts import layout_names, layout_notes, ready_layout
from torchrl_caiac.layouts.ready import describe_layout

DOCS = Path(__file__).parents[2] / "docs" / "layouts.md"


@pytest.mark.parametrize("name", layout_names())
def test_each_layout_is_complete(name: str) -> None:
    layout, description = ready_layout(name), describe_layout(name)
    assert layout.width == description.width
    assert layout.names, "an entity at least"
    for entity in layout.names:
        floors = layout.variance_floor[entity]
        assert isinstance(floors, tuple)
        assert len(floors) == len(layout.columns[entity])
        moves = entity not in layout.fixed
        assert layout.positions.get(entity) or not moves
        if layout.goal and moves:
            assert layout.goal[entity]
    owned = {c for columns in layout.columns.values() for c in columns}
    assert owned.isdisjoint(description.unowned)
    assert len(owned) + len(description.unowned) == layout.width
    assert pickle.loads(pickle.dumps(layout)) == layout == ready_layout(name)
    assert layout_notes(name).endswith(".")


@pytest.mark.parametrize("name", layout_names())
def test_notes_explain_columns_without_an_entity(name: str) -> None:
    if name.startswith("metaworld"):
        return  # those columns are zeros
    stale = bool(describe_layout(name).unowned)
    words = ("wrong after a swap", "Nothing can be swapped")
    assert any(word in layout_notes(name) for word in words) == stale


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ogbench/cube-doubel", "similar ones are ogbench/cube-double"),
        ("scene", "similar ones are .*ogbench/scene"),
        ("FETCH/PUSH", "similar ones are fetch/push"),
        ("", "there are ogbench/cube-single, ogbench/cube-double"),
        ("xyzzy", "there are .*metaworld/one-object"),
        (3, "no ready layout 3"),
    ],
)
@pytest.mark.parametrize("function", [ready_layout, layout_notes])
def test_unknown_names(function, name, message) -> None:
    with pytest.raises(ValueError, match=message):
        function(name)


def rows(width: int) -> TensorDict:
    observation = torch.randn(30, width)
    return TensorDict(
        {
            "observation": observation,
            "action": torch.randn(30, 5),
            "episode": torch.zeros(30, dtype=torch.int64),
            "next": {"observation": observation, "done": torch.zeros(30, 1) > 0},
        },
        [30],
    )


def test_data_of_another_width_name_the_layouts_that_fit(tmp_path: Path) -> None:
    layout, data = ready_layout("ogbench/cube-single"), rows(37)
    message = (
        "'observation' has 37 columns, but the layout is for 28: .*ready layouts of "
        "this width: ogbench/cube-double"
    )
    layout.save(tmp_path / "layout.yaml")
    for same in (layout, EntityLayout.load(tmp_path / "layout.yaml")):
        with pytest.raises(ValueError, match=message):
            same.check(data)
        with pytest.raises(ValueError, match=message):
            same.read(data)
        with pytest.raises(ValueError, match=message):
            same.column_entity(37)
        report = check_dataset(data, same)
        assert "cube-double" in str(report).replace("\n         ", " ")
        assert [finding.code for finding in report.errors] == ["wrong_shape"]
    layout.check(rows(28))


def test_a_width_without_a_ready_layout_names_none() -> None:
    with pytest.raises(ValueError, match=r"is for 28: .*correct the data$"):
        ready_layout("ogbench/cube-single").check(rows(29))


def test_goals_that_are_no_vector_are_refused() -> None:
    data = rows(59)
    data["desired_goal"] = TensorDict({"microwave": torch.zeros(30, 1)}, [30])
    with pytest.raises(TypeError, match="'desired_goal' is a TensorDict"):
        ready_layout("kitchen/franka").check(data)
    ready_layout("kitchen/franka").check(data.exclude("desired_goal"))


@pytest.mark.parametrize("width", [2, 0, -1])
def test_the_width_holds_all_columns(width: int) -> None:
    with pytest.raises(ValueError, match=r"entity 'a' has the columns \[.*2\]"):
        EntityLayout({"a": [0, 2]}, width=width)


@pytest.mark.parametrize("width", [True, 3.0, "3"])
def test_the_width_is_an_integer(width: object) -> None:
    with pytest.raises(TypeError, match="width must be an int or None"):
        EntityLayout({"a": [0]}, width=width)


def test_the_page_has_every_layout() -> None:
    text = DOCS.read_text()
    for name in layout_names():
        assert f"`{name}`" in text, name


def test_the_files_of_the_page_can_be_loaded(tmp_path: Path) -> None:
    files = re.findall(r"```yaml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert len(files) == 2
    for i, text in enumerate(files):
        (tmp_path / f"{i}.yaml").write_text(text)
        EntityLayout.load(tmp_path / f"{i}.yaml")
