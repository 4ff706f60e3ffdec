"""Tests of the features of goal-conditioned networks."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import GoalFeatures


def push(**kwargs) -> EntityLayout:
    """Fetch-Push with two cubes."""
    return EntityLayout(
        {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)},
        goal={"cube0": range(3), "cube1": range(3, 6)},
        achieved={"cube0": range(10, 13), "cube1": range(22, 25)},
        fixed=("gripper",),
        **kwargs,
    )


def rows(*batch: int, width: int = 34, goal: int = 6, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "observation": torch.randn(*batch, width, generator=generator, dtype=dtype),
            "desired_goal": torch.randn(*batch, goal, generator=generator, dtype=dtype),
        },
        batch_size=batch,
    )


def slow_features(layout, state, goal, relative, reference) -> list[float]:
    """One row, number by number."""
    out = [float(state[c]) for name in layout.names for c in layout.columns[name]]
    out += [float(x) for x in goal]
    from_reference, to_goal = [], []
    for column in range(len(goal)):
        for name, columns in layout.goal.items():
            if column in columns:
                place = columns.index(column)
                achieved = state[layout.achieved[name][place]]
                if reference is not None:
                    position = state[layout.columns[reference][place]]
                    from_reference.append(float(achieved - position))
                to_goal.append(float(goal[column] - achieved))
    return out + from_reference + to_goal if relative else out


@st.composite
def layouts(draw) -> tuple[EntityLayout, int]:
    """Random flat layouts: columns in any order, some of them nobody's."""
    sizes = draw(st.lists(st.integers(2, 4), min_size=1, max_size=3))
    width = 3 + sum(sizes) + draw(st.integers(0, 2))
    columns = draw(st.permutations(range(width)))
    entities, start = {"arm": columns[:3]}, 3
    for i, size in enumerate(sizes):
        entities[f"object{i}"] = columns[start : start + size]
        start += size
    described = {
        name: draw(st.integers(0, min(3, len(owned)))) if name != "arm" else 0
        for name, owned in entities.items()
    }
    described["object0"] = max(1, described["object0"])
    order = iter(draw(st.permutations(range(sum(described.values())))))
    goal = {n: [next(order) for _ in range(k)] for n, k in described.items()}
    achieved = {n: draw(st.permutations(entities[n]))[:k] for n, k in described.items()}
    return EntityLayout(entities, goal=goal, achieved=achieved, fixed=["arm"]), width


@given(
    layouts(),
    st.sampled_from([(), (1,), (5,), (2, 3)]),
    st.sampled_from([(False, None), (True, None), (True, "arm")]),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_features_against_a_loop(made, batch, options, dtype):
    layout, width = made
    relative, reference = options
    td = rows(*batch, width=width, goal=layout.goal_width, dtype=dtype)
    features = GoalFeatures(layout, relative=relative, reference=reference).to(dtype)
    got = features(td)["features"]
    assert got.shape == (*batch, features.width)
    assert got.dtype == dtype
    want = [
        slow_features(layout, state, goal, relative, reference)
        for state, goal in zip(
            td["observation"].reshape(-1, width),
            td["desired_goal"].reshape(-1, layout.goal_width),
            strict=True,
        )
    ]
    want = torch.tensor(want, dtype=dtype).reshape(got.shape)
    torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)


def test_widths_of_fetch_push():
    assert GoalFeatures(push(), reference="gripper").width == 34 + 6 + 12
    assert GoalFeatures(push()).width == 34 + 6 + 6
    assert GoalFeatures(push(), relative=False).width == 34 + 6


def test_reference_columns_are_those_given_or_the_positions_of_the_layout():
    td = rows(4)
    state = td["observation"]
    given = {"reference": "gripper", "reference_columns": [5, 4, 9]}
    cases = [
        (push(), {"reference": "gripper"}, [0, 1, 2]),
        (push(), given, [5, 4, 9]),
        (push(positions={"gripper": [7, 8, 6]}), {"reference": "gripper"}, [7, 8, 6]),
        (push(positions={"gripper": [7, 8, 6]}), given, [5, 4, 9]),
        (push(positions={"cube0": [11]}), {"reference": "gripper"}, [0, 1, 2]),
    ]
    for layout, kwargs, columns in cases:
        got = GoalFeatures(layout, **kwargs)(td)["features"][:, 40:46]
        achieved = torch.cat([state[:, 10:13], state[:, 22:25]], -1)
        want = achieved - state[:, columns * 2]
        torch.testing.assert_close(got, want)


def test_a_swap_moves_the_relative_features():
    """They are computed from the swapped state."""
    features = GoalFeatures(push(), reference="gripper")
    td = rows(4)
    before = features(td.clone())["features"]
    td["observation"][:, 10:22] = td["observation"][:, 10:22].flip(0)
    after = features(td)["features"]
    moved = (before != after).any(0)
    assert moved[10:22].all()
    assert moved[40:43].all() and moved[46:49].all()  # cube0: to gripper, to goal
    assert not moved[43:46].any() and not moved[49:52].any()


def test_statistics():
    features = GoalFeatures(push(), reference="gripper", floor=0.1)
    td = rows(4000)
    td["observation"] *= 3.0
    td["observation"] += 5.0
    td["observation"][:, 7] = 2.0
    raw = features(td.clone())["features"]
    assert features.fit_statistics(td) is features
    fitted = features(td.clone())["features"]
    moves = torch.arange(52) != 7
    torch.testing.assert_close(fitted.mean(0), torch.zeros(52), rtol=0, atol=1e-4)
    torch.testing.assert_close(
        fitted.std(0, correction=0)[moves], torch.ones(51), rtol=1e-3, atol=1e-3
    )
    td["observation"][:, 7] += 0.05  # the floor, not the deviation, divides
    torch.testing.assert_close(
        features(td)["features"][:, 7], torch.full((4000,), 0.5), rtol=1e-4, atol=1e-4
    )
    back = fitted * features.norm.scale.float() + features.norm.mean.float()
    torch.testing.assert_close(back, raw, rtol=1e-4, atol=1e-4)

    other = GoalFeatures(push(), reference="gripper", floor=0.1)
    other.load_state_dict(features.state_dict())
    torch.testing.assert_close(other(td)["features"], features(td)["features"])
    assert not list(features.parameters())


def test_nested_keys_and_dispatch():
    layout = push(
        observation_key=("agent", "state"), desired_goal_key=("task", "desired")
    )
    features = GoalFeatures(layout, reference="gripper", out_key=("net", "in"))
    assert features.in_keys == [("agent", "state"), ("task", "desired")]
    td = rows(3)
    want = GoalFeatures(push(), reference="gripper")(td)["features"]
    nested = TensorDict(
        {"agent": {"state": td["observation"]}, "task": {"desired": td["desired_goal"]}}
    )
    torch.testing.assert_close(features(nested)["net", "in"], want)
    got = GoalFeatures(push(), reference="gripper")(
        observation=td["observation"], desired_goal=td["desired_goal"]
    )
    torch.testing.assert_close(got, want)


@pytest.mark.parametrize(
    ("layout", "kwargs", "match"),
    [
        (EntityLayout({"arm": [0]}), {}, "flat layout"),
        (EntityLayout.from_keys({"arm": "arm"}), {}, "flat layout"),
        (push(), {"reference": "hand"}, "'hand'.*not an entity"),
        (push(), {"reference": "gripper", "relative": False}, "relative features only"),
        (push(), {"reference_columns": [0, 1, 2]}, "name it, reference="),
        (
            push(),
            {"reference": "gripper", "reference_columns": [0, 1, 10]},
            r"reference_columns are \[0, 1, 10\].*'gripper'",
        ),
        (
            push(),
            {"reference": "gripper", "reference_columns": [0, 0, 1]},
            "each at most once",
        ),
        (
            push(),
            {"reference": "gripper", "reference_columns": [0, 1, 2, 3]},
            r"'cube0' has 3 goal columns.*'gripper' has 4 columns \[0, 1, 2, 3\]",
        ),
        (
            push(positions={"gripper": [0, 1]}),
            {"reference": "gripper"},
            "'cube0' has 3 goal columns.*give reference_columns",
        ),
        (push(), {"floor": 0.0}, "floor"),
        (push(), {"floor": float("nan")}, "floor"),
        (
            EntityLayout(
                {"arm": [0], "cup": [1, 2]},
                goal={"cup": [0, 1]},
                achieved={"cup": [1, 2]},
                fixed=["arm"],
            ),
            {"reference": "arm"},
            "'cup' has 2 goal columns.*'arm' has only 1",
        ),
    ],
)
def test_bad_arguments(layout, kwargs, match):
    with pytest.raises(ValueError, match=match):
        GoalFeatures(layout, **kwargs)


@pytest.mark.parametrize("method", ["forward", "fit_statistics"])
def test_bad_data(method):
    call = getattr(GoalFeatures(push()), method)
    with pytest.raises(KeyError, match=r"data lack 'desired_goal'; they have"):
        call(rows(4).exclude("desired_goal"))
    with pytest.raises(ValueError, match="'observation' has 20 columns"):
        call(rows(4, width=20))
    with pytest.raises(ValueError, match=r"'desired_goal' has 7 columns, expected 6"):
        call(rows(4, goal=7))


def test_statistics_refuse_what_is_not_finite():
    features, td = GoalFeatures(push()), rows(4)
    td["desired_goal"][1, 2] = float("inf")
    with pytest.raises(ValueError, match="'desired_goal' has 1 non-finite"):
        features.fit_statistics(td)
    with pytest.raises(ValueError, match=r"no .* rows"):
        features.fit_statistics(rows(0))
    assert (features.norm.mean == 0).all()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int64, torch.bool])
def test_integers_and_flags_are_the_numbers_that_they_are(dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    data = rows(20)
    for key, value in data.items():
        data[key] = torch.randint(2, value.shape, generator=generator).to(dtype)
    exact = data.to(torch.float64)
    for features in (GoalFeatures(push(), reference="gripper"), GoalFeatures(push())):
        found = [features(td)["features"] for td in (data, exact)]
        assert found[0].min() == -1.0
        torch.testing.assert_close(*found)
        fitted = [
            GoalFeatures(push(), reference=features.reference).fit_statistics(td)
            for td in (data, exact)
        ]
        torch.testing.assert_close(*(f(data)["features"] for f in fitted))
