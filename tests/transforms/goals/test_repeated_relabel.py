"""Relabelling batches like an earlier one: the same numbers as step by step."""

from __future__ import annotations

import copy
import pickle
from typing import Any
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase

from tests.pretend_cuda import nothing_waits
from tests.transforms.test_repeated_swap import DEVICES, assert_same
from torchrl_caiac import EntityLayout
from torchrl_caiac._sampling import only_torch
from torchrl_caiac.transforms import HindsightGoal, TransformKeys
from torchrl_caiac.transforms.goals.repeated_relabel import RepeatedRelabel

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [3]},
    goal={"cup": [0, 1], "box": [2]},
    achieved={"cup": [2, 1], "box": [3]},
    fixed=["arm"],
)
NO_COLUMNS = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [3]},
    goal={"cup": [0, 1], "box": [2]},
    fixed=["arm"],
)


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved - desired).abs().sum(-1)


def batch(
    rows: int = 30,
    seed: int = 0,
    *,
    flags: bool = True,
    mirrored: bool = True,
    flat_reward: bool = False,
    dtype: torch.dtype = torch.float32,
) -> TensorDict:
    """Transitions, half of them counterfactual."""
    of = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(rows, *shape, generator=of, dtype=torch.float64).to(dtype)

    td = TensorDict(
        {
            "observation": random(4),
            "desired_goal": random(3),
            "next": {
                "observation": random(4),
                "achieved_goal": random(3),
                "reward": random() if flat_reward else random(1),
                "terminated": random(1) > 0.5,
            },
        },
        [rows],
    )
    if flags:
        td["caiac", "counterfactual"] = random(1) > 0.5
    if mirrored:
        td["next", "desired_goal"] = td["desired_goal"].clone()
    return td


def relabelled(goals: HindsightGoal, td: TensorDictBase) -> tuple[Any, bool]:
    """A batch with new goals, and whether it was relabelled by few calls."""
    results = []
    call = RepeatedRelabel.__call__

    def watched(*args: Any, **kwargs: Any) -> Any:
        results.append(call(*args, **kwargs))
        return results[-1]

    if goals.future > 0:
        later = torch.rand(
            len(td), 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64
        )
        goals.keep_goals({"desired_goal": later.to(td["desired_goal"])})
    with mock.patch.object(RepeatedRelabel, "__call__", watched):
        out = goals(td)
    return out, bool(results) and results[-1] is not None


def pair(td: TensorDict, **kwargs: Any) -> tuple[HindsightGoal, HindsightGoal]:
    """A transform that has seen a batch, and another one that draws the same."""
    layout = kwargs.pop("layout", LAYOUT)
    goals = HindsightGoal(layout, reward, generator=torch.Generator(), **kwargs)
    fresh = copy.deepcopy(goals)
    relabelled(goals, td)
    goals.generator.set_state(fresh.generator.get_state())
    return goals, fresh


@DEVICES
@settings(max_examples=60, deadline=None)
@given(
    layout=st.sampled_from([LAYOUT, NO_COLUMNS]),
    rows=st.integers(1, 20),
    future=st.sampled_from([0.0, 0.5, 1.0]),
    random=st.sampled_from([0.0, 0.3]),
    counterfactual=st.sampled_from([0.0, 0.5, 1.0]),
    form=st.fixed_dictionaries(
        {
            "flags": st.booleans(),
            "mirrored": st.booleans(),
            "flat_reward": st.booleans(),
            "dtype": st.sampled_from([torch.float32, torch.float64, torch.int32]),
        }
    ),
    ends=st.booleans(),
    unexplained=st.sampled_from([None, ("hindsight", "unexplained"), "other"]),
    seed=st.integers(0, 99),
)
@pytest.mark.filterwarnings("ignore:.*terminated.*is true in some")
def test_the_same_as_step_by_step(
    device: str,
    layout: EntityLayout,
    rows: int,
    future: float,
    random: float,
    counterfactual: float,
    form: dict[str, Any],
    ends: bool,
    unexplained: Any,
    seed: int,
) -> None:
    def reached(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
        return (achieved - desired).abs().sum(-1) < 1.0

    goals, fresh = pair(
        batch(rows, 0, **form).to(device),
        layout=layout,
        future=future,
        random=min(random, 1.0 - future),
        counterfactual=counterfactual,
        terminated_fn=reached if ends else None,
        keys=TransformKeys(unexplained=unexplained),
    )
    td = batch(rows, seed + 1, **form).to(device)
    before = td.clone()
    out, is_repeated = relabelled(goals, td)
    assert is_repeated
    with only_torch():
        wanted, is_repeated = relabelled(fresh, td)
    assert not is_repeated
    assert_same(out, wanted)
    assert_same(td, before)
    assert torch.equal(goals.generator.get_state(), fresh.generator.get_state())


def test_settings_that_change() -> None:
    td = batch()
    goals, _ = pair(td, future=0.0)
    goals.counterfactual = 0.0
    assert not relabelled(goals, td)[0]["hindsight", "relabeled"].any()
    goals.counterfactual = 1.0
    out, is_repeated = relabelled(goals, td)
    flags = td["caiac", "counterfactual"]
    assert is_repeated and torch.equal(out["hindsight", "relabeled"], flags)
    goals.keys = TransformKeys(relabeled="other")
    out, is_repeated = relabelled(goals, td)
    assert not is_repeated and out["other"].shape == (30, 1)
    assert relabelled(goals, td)[1]


def test_methods_of_a_subclass_are_called() -> None:
    class Marked(HindsightGoal):
        def apply_parameters(self, tensordict: Any, draw: Any) -> Any:
            return super().apply_parameters(tensordict, draw).set("source", draw.source)

    goals = Marked(LAYOUT, reward, future=0.0, counterfactual=1.0)
    for _ in range(2):
        out, is_repeated = relabelled(goals, batch())
        assert not is_repeated and out["source"].shape == (30,)


def test_goals_of_other_rows_are_marked() -> None:
    td, keys = batch(), TransformKeys(unexplained="other")
    goals, fresh = pair(td, future=0.5, random=0.3, counterfactual=0.5, keys=keys)
    assert "other" in goals.out_keys
    for some in (goals, fresh):
        out, _ = relabelled(some, td)
        reached = out["next", "observation"][:, [2, 1, 3]]
        is_other = (out["desired_goal"][:, None] == reached).all(-1).any(1)
        assert torch.equal(out["other"][:, 0], is_other) and is_other.any()
        assert not is_other.all()


# Buffers send their transforms to other processes pickled; nothing is read from a file.
@pytest.mark.parametrize(
    "send", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_copies_relabel_too(send: Any) -> None:
    td = batch()
    goals, fresh = pair(td)
    goals = send(goals)
    for is_later in (False, True):  # a copy reads the structure anew
        out, is_repeated = relabelled(goals, td)
        assert is_repeated == is_later
        assert_same(out, relabelled(fresh, td)[0])


@pytest.mark.parametrize(
    "change", ["size", "entry", "strided", "double", "shape", "narrow", "flags"]
)
def test_other_batches_are_relabelled_step_by_step(change: str) -> None:
    td = batch()
    goals, fresh = pair(td, future=0.0)
    other = td.clone()
    if change == "size":
        other = other[:-2]
    elif change == "entry":
        other["more"] = other["observation"]
    elif change == "strided":
        other["desired_goal"] = torch.stack([td["desired_goal"]] * 2, -1)[..., 0]
    elif change == "double":
        other["desired_goal"] = td["desired_goal"].double()
    elif change == "shape":
        other = other.view(2, -1)
    elif change == "narrow":
        other["next", "observation"] = td["next", "observation"][:, :3]
    else:
        other["caiac", "counterfactual"] = td["caiac", "counterfactual"][:, 0]
    if change in ("narrow", "flags"):
        for some in (goals, fresh):
            with pytest.raises(ValueError, match=r"columns in|has shape \[30\]"):
                some(other)
        return
    out, is_repeated = relabelled(goals, other)
    assert not is_repeated
    assert_same(out, relabelled(fresh, other)[0])


def test_errors_are_those_of_single_steps() -> None:
    td = batch()
    goals, _ = pair(td)
    with pytest.raises(RuntimeError, match="no future goals were drawn"):
        goals(td)
    goals.keep_goals({"desired_goal": torch.zeros(7, 3)})
    with pytest.raises(RuntimeError, match="drawn for 7 rows"):
        goals(td)
    goals.keep_goals({"other": torch.zeros(30, 3)})
    with pytest.raises(KeyError, match="desired_goal"):
        goals(td)
    out = relabelled(goals, td)[0]
    with pytest.raises(RuntimeError, match="already relabelled"):
        relabelled(goals, out)
    td["next", "observation"][:] = torch.nan
    with pytest.raises(ValueError, match="reward_fn returned nan for row"):
        relabelled(goals, td)


def test_flags_of_other_bytes_than_0_and_1() -> None:
    td = batch()
    goals, fresh = pair(td, future=0.0, counterfactual=1.0)
    odd = td.clone()
    flags = td["caiac", "counterfactual"]
    odd["caiac", "counterfactual"] = (flags.byte() * 200).view(torch.bool)
    out, is_repeated = relabelled(goals, odd)
    assert is_repeated and torch.equal(out["hindsight", "relabeled"], flags)
    wanted = relabelled(fresh, td)[0]
    assert torch.equal(out["desired_goal"], wanted["desired_goal"])


@pytest.mark.gpu
def test_a_gpu_is_not_waited_for() -> None:
    td = batch().to("cuda")
    goals, _ = pair(td, future=0.0)
    relabelled(goals, td)
    torch.cuda.synchronize()
    with nothing_waits():
        assert relabelled(goals, td)[1]
