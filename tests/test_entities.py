from __future__ import annotations

import copy
import json
import traceback
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

import torchrl_caiac
from tests.mutations import mutate_file, mutate_json
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import UnreadableFileError

PACKAGE = str(Path(torchrl_caiac.__file__).parent)
GOAL = {"cube0": range(3), "cube1": range(3, 6)}
ACHIEVED = {"cube0": range(10, 13), "cube1": range(22, 25)}


def fetch(**kwargs) -> EntityLayout:
    arguments = {"goal": GOAL, "achieved": ACHIEVED, "fixed": ("gripper",)} | kwargs
    return EntityLayout(
        {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)},
        **arguments,
    )


def nested() -> EntityLayout:
    return EntityLayout.from_keys(
        {"arm": ("observation", "arm"), "kettle": ("observation", "kettle")},
        goal={"kettle": ("desired_goal", "kettle")},
        achieved={"kettle": ("achieved_goal", "kettle")},
        fixed=("arm",),
    )


def nested_data(batch=(4,)) -> TensorDict:
    def state() -> TensorDict:
        return TensorDict(
            {
                "arm": torch.randn(*batch, 2, 3),
                "kettle": TensorDict(
                    {
                        "velocity": torch.randn(*batch, 2, dtype=torch.float64),
                        "position": torch.randn(*batch, 3),
                        "grasped": torch.ones(*batch, 1, dtype=torch.bool),
                    },
                    batch,
                ),
            },
            batch,
        )

    next_state = TensorDict({"observation": state()}, batch)
    return TensorDict({"observation": state(), "next": next_state}, batch)


@st.composite
def partitions(draw) -> tuple[int, dict[str, list[int]]]:
    width = draw(st.integers(1, 12))
    owner = draw(st.lists(st.integers(-1, 3), min_size=width, max_size=width))
    order = draw(st.permutations(range(width)))
    entities: dict[str, list[int]] = {}
    for column in order:
        if owner[column] >= 0:
            entities.setdefault(f"e{owner[column]}", []).append(column)
    return width, entities


class TestFlat:
    def test_names_and_masks(self):
        layout = fetch()
        assert layout.names == ("gripper", "cube0", "cube1")
        assert len(layout) == layout.num_entities == 3
        assert layout.fixed_mask.tolist() == [True, False, False]
        assert layout.is_flat
        assert layout.in_keys == ["observation"]
        assert layout.goal_width == 6
        assert layout.index("cube1") == 2

    @given(partitions(), st.sampled_from([(), (3,), (2, 3)]))
    def test_read_and_owner_agree_with_a_loop(self, partition, batch):
        width, entities = partition
        if not entities:
            with pytest.raises(ValueError, match="at least one entity"):
                EntityLayout(entities)
            return
        layout = EntityLayout(entities)
        observation = torch.randn(*batch, width)
        td = TensorDict({"observation": observation}, batch)
        read = layout.read(td)
        owner = layout.column_entity(width)
        for number, (name, columns) in enumerate(entities.items()):
            place = layout.slices()[name]
            for offset, column in enumerate(columns):
                torch.testing.assert_close(
                    read[..., place.start + offset], observation[..., column]
                )
                assert owner[column] == number
            assert layout.widths()[name] == len(columns)
        assert (owner >= 0).sum() == read.shape[-1]

    def test_read_next(self):
        layout = EntityLayout({"arm": [2, 0]})
        td = TensorDict({"next": {"observation": torch.tensor([[1.0, 2.0, 3.0]])}}, [1])
        assert layout.read(td, next=True).tolist() == [[3.0, 1.0]]

    def test_whole_observation_is_not_copied(self):
        td = TensorDict({"observation": torch.randn(4, 34)}, [4])
        assert fetch().read(td).data_ptr() == td["observation"].data_ptr()

    def test_achieved_goal(self):
        td = TensorDict({"observation": torch.arange(34.0).expand(2, 34)}, [2])
        goal = fetch().achieved_goal(td)
        assert goal[0].tolist() == [10, 11, 12, 22, 23, 24]
        assert fetch().goal_columns() == (10, 11, 12, 22, 23, 24)
        assert fetch().goal_column_entity().tolist() == [1, 1, 1, 2, 2, 2]

    def test_index_tensors_are_created_once(self):
        layout, device = fetch(), torch.device("cpu")
        first = layout.index_tensor("goal", layout.goal_columns(), device)
        assert first.tolist() == list(layout.goal_columns())
        assert layout.index_tensor("goal", (), device) is first
        assert copy.deepcopy(layout) == layout

    @pytest.mark.parametrize(
        ("kwargs", "match"),
        [
            ({"entities": {}}, "at least one entity"),
            ({"entities": {"a": []}}, "'a' has no columns"),
            ({"entities": {"a": [0, 1], "b": [1]}}, "column 1 belongs to both"),
            ({"entities": {"a": [0, 0]}}, "column 0 belongs to both"),
            ({"entities": {"a": [-1]}}, "out of range"),
            ({"entities": {"a": [0]}, "fixed": ["b"]}, r"fixed names \['b'\]"),
            ({"entities": {"a": [0], "b": [1]}, "goal": {"a": [0]}}, r"lacks \['b'\]"),
            ({"entities": {"a": [0]}, "goal": {"c": [0]}}, r"goal names \['c'\]"),
            ({"entities": {"a": [0]}, "goal": {"a": [1]}}, "without a gap"),
            ({"entities": {"a": [0]}, "achieved": {"a": [0]}}, "achieved needs goal"),
            (
                {"entities": {"a": [0]}, "goal": {"a": [0]}, "achieved": {"a": [1]}},
                "not among its observation columns",
            ),
            (
                {
                    "entities": {"a": [0, 1]},
                    "goal": {"a": [0]},
                    "achieved": {"a": [0, 1]},
                },
                "1 goal columns but 2 achieved",
            ),
            (
                {"entities": {"a": [0]}, "goal": {"a": [0]}, "achieved": {}},
                "same entities",
            ),
        ],
    )
    def test_rejects(self, kwargs, match):
        with pytest.raises(ValueError, match=match):
            EntityLayout(**kwargs)

    @pytest.mark.parametrize("column", [0.5, "0", True])
    def test_rejects_columns_that_are_no_int(self, column):
        with pytest.raises(TypeError, match="must be ints"):
            EntityLayout({"a": [column]})

    def test_fixed_is_no_string(self):
        with pytest.raises(TypeError, match=r"\('a',\)"):
            EntityLayout({"a": [0]}, fixed="a")

    def test_an_entity_may_have_no_goal(self):
        layout = EntityLayout({"a": [0], "b": [1]}, goal={"a": [0], "b": ()})
        assert layout.goal_width == 1


class TestCheck:
    def test_missing_key_names_what_there_is(self):
        with pytest.raises(KeyError, match=r"reads from 'observation'.*state.*rename"):
            fetch().check(TensorDict({"state": torch.zeros(2, 34)}, [2]))

    def test_narrow_observation(self):
        td = TensorDict({"observation": torch.zeros(2, 33)}, [2])
        with pytest.raises(ValueError, match=r"33 columns.*at least 34"):
            fetch().check(td)

    def test_next(self):
        td = TensorDict({"observation": torch.zeros(2, 34)}, [2])
        fetch().check(td)
        with pytest.raises(KeyError, match="next"):
            fetch().check(td, next=True)

    @pytest.mark.parametrize("key", ["desired_goal", ("next", "achieved_goal")])
    def test_goal_width(self, key):
        td = TensorDict(
            {
                "observation": torch.zeros(2, 34),
                "next": {"observation": torch.zeros(2, 34)},
            },
            [2],
        ).set(key, torch.zeros(2, 5))
        with pytest.raises(ValueError, match=r"has 5 columns.*goal has 6"):
            fetch().check(td, next=True)

    def test_scalar_observation(self):
        with pytest.raises(ValueError, match=r"expected \[\*B, D\]"):
            EntityLayout({"a": [0]}).check(
                TensorDict({"observation": torch.zeros(2)}, [2])
            )

    def test_nested_data_for_a_flat_layout(self):
        with pytest.raises(TypeError, match="from_keys"):
            EntityLayout({"a": [0]}).check(nested_data())


class TestNested:
    @pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
    def test_leaves_and_sub_tensordicts(self, batch):
        layout, td = nested(), nested_data(batch)
        assert layout.widths(td) == {"arm": 6, "kettle": 6}
        read = layout.read(td)
        assert read.shape == (*batch, 12)
        kettle = read[..., layout.slices(td)["kettle"]]
        torch.testing.assert_close(
            kettle[..., 1:4].float(), td["observation", "kettle", "position"]
        )
        assert layout.read(td, next=True).shape == (*batch, 12)

    def test_widths_need_an_example(self):
        with pytest.raises(ValueError, match="example"):
            nested().widths()

    def test_missing_entity(self):
        td = nested_data().exclude(("observation", "kettle"))
        with pytest.raises(KeyError, match="kettle"):
            nested().check(td)

    @pytest.mark.parametrize("other", ["observation", ("observation", "arm", "q")])
    def test_overlap(self, other):
        with pytest.raises(ValueError, match="overlap"):
            EntityLayout.from_keys({"arm": ("observation", "arm"), "rest": other})

    def test_columns_are_of_flat_layouts(self):
        with pytest.raises(ValueError, match="no columns"):
            nested().column_entity(3)
        with pytest.raises(ValueError, match="goal"):
            nested().goal_columns()


class TestSaving:
    @pytest.mark.parametrize("layout", [fetch(), nested(), EntityLayout({"a": [3, 1]})])
    def test_round_trips(self, layout, tmp_path):
        layout.save(tmp_path / "layout.json")
        loaded = EntityLayout.load(tmp_path / "layout.json")
        assert loaded == layout
        assert hash(loaded) == hash(layout)
        assert repr(loaded) == repr(layout)
        assert copy.deepcopy(layout) == layout
        assert [path.name for path in tmp_path.iterdir()] == ["layout.json"]

    def test_order_matters(self):
        assert EntityLayout({"a": [0], "b": [1]}) != EntityLayout({"b": [1], "a": [0]})

    @pytest.mark.parametrize("cut", [0, 1, 40, 200])
    def test_truncated_file(self, cut, tmp_path):
        path = tmp_path / "layout.json"
        fetch().save(path)
        path.write_text(path.read_text()[:cut])
        with pytest.raises(ValueError, match="not a readable layout"):
            EntityLayout.load(path)

    @pytest.mark.parametrize(
        "change", [{"format": "else"}, {"version": 99}, {"entities": 3}, {"goal": None}]
    )
    def test_foreign_file(self, change, tmp_path):
        path = tmp_path / "layout.json"
        path.write_text(json.dumps(fetch().to_dict() | change))
        with pytest.raises(ValueError, match=r"layout\.json"):
            EntityLayout.load(path)

    @settings(max_examples=500)
    @given(st.sampled_from([fetch(), nested()]), st.randoms(use_true_random=False))
    def test_a_damaged_dict_is_a_layout_or_one_error(self, layout, rng):
        content = mutate_json(layout.to_dict(), rng)
        try:
            found = EntityLayout.from_dict(content)
        except (ValueError, TypeError) as error:
            frames = traceback.extract_tb(error.__traceback__)
            assert frames[-1].filename.startswith(PACKAGE)
            assert len(str(error)) > 20
        else:
            assert len(found.names) == len(content["entities"])
            assert found == EntityLayout.from_dict(found.to_dict())
            repr(found)

    def test_each_unknown_and_doubled_part_is_named(self):
        content = fetch().to_dict()
        for change, match in (
            ({"fixd": []}, "fixd"),
            ({"entities": [["a", [0]], ["a", [1]]]}, r"each name once.*'a', 'a'"),
            ({"entities": [["a", [2**31]]]}, "columns from 0 to 2147483647"),
            ({"flat": 1}, "flat of the layout: expected true or false, got 1"),
            ({"next_key": []}, "next_key"),
        ):
            with pytest.raises(ValueError, match=match):
                EntityLayout.from_dict(content | change)

    def test_text_of_far_columns_takes_no_memory(self):
        assert "[0, 1000000000]" in repr(EntityLayout({"a": [0, 10**9]}))

    @settings(max_examples=200)
    @given(st.randoms(use_true_random=False))
    def test_a_damaged_file_is_a_layout_or_one_error(self, tmp_path_factory, rng):
        path = tmp_path_factory.mktemp("damaged") / "layout.json"
        nested().save(path)
        mutate_file(path, rng)
        try:
            EntityLayout.load(path)
        except (UnreadableFileError, FileNotFoundError) as error:
            assert str(path) in str(error)

    def test_nothing_half_written(self, tmp_path, monkeypatch):
        path = tmp_path / "layout.json"
        nested().save(path)

        def full(self, text, **kwargs):
            with self.open("w") as file:
                file.write(text[:40])
            raise OSError("disk full")

        monkeypatch.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="disk full"):
            fetch().save(path)
        assert EntityLayout.load(path) == nested()
        assert [p.name for p in tmp_path.iterdir()] == ["layout.json"]


def test_repr_is_readable():
    assert repr(fetch()).splitlines()[1:3] == [
        "    gripper: observation[0:10], fixed",
        "    cube0: observation[10:22], goal[0:3] mirrors observation[10:13]",
    ]
    assert "('observation', 'arm'), fixed" in repr(nested())


@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.int8, torch.int16, torch.int64, torch.bool]
)
def test_read_returns_numbers_whose_differences_do_not_wrap_around(dtype):
    before, after = torch.tensor([[7, 1, 0], [6, 0, 1]]).to(dtype).split(1)
    tree = {"observation": before, "next": {"observation": after}}
    for layout, td in (
        (EntityLayout({"arm": [0, 1, 2]}), TensorDict(tree, [1])),
        (EntityLayout({"arm": [2, 0, 1]}), TensorDict(tree, [1])),
        (EntityLayout.from_keys({"arm": "observation"}), TensorDict(tree, [1])),
    ):
        change = layout.read(td, next=True) - layout.read(td)
        want = after.double() - before.double()
        assert sorted(change.flatten().tolist()) == sorted(want.flatten().tolist())


@pytest.mark.parametrize(
    "floor",
    [np.float64(0.5), np.float32(0.5), np.array(0.5), torch.tensor(0.5)],
)
def test_floors_may_be_numbers_of_numpy(floor):
    layout = EntityLayout({"a": [0, 1], "b": [2]}, variance_floor=floor)
    assert layout.variance_floor == {"a": 0.5, "b": 0.5}
    each = {"a": np.array([0.5, 1], np.float32), "b": floor}
    layout = EntityLayout({"a": [0, 1], "b": [2]}, variance_floor=each)
    assert layout.variance_floor == {"a": (0.5, 1.0), "b": 0.5}
