"""Tests of the LMP actor: windows, resets, batched environments, bad input."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    EnvBase,
    InitTracker,
    SerialEnv,
    TransformedEnv,
    check_env_specs,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_caiac.modules.lmp import LMPModel
from torchrl_caiac.modules.lmp_actor import LMPActor

D, G, A, K, P = 3, 2, 2, 4, 3


class CountEnv(EnvBase):
    """Observation = (episode's length, step, 0); ends after ``length`` steps."""

    def __init__(self, length: int) -> None:
        super().__init__(batch_size=[])
        self.length = length
        self.count = 0
        self.observation_spec = Composite(
            observation=Unbounded(D), desired_goal=Unbounded(G)
        )
        self.action_spec = Bounded(-1.0, 1.0, (A,))
        self.reward_spec = Unbounded(1)

    def _observe(self) -> TensorDict:
        row = torch.tensor([float(self.length), float(self.count), 0.0])
        return TensorDict(
            {"observation": row, "desired_goal": torch.full((G,), 0.5)}, []
        )

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDict:
        self.count = 0
        out = self._observe()
        return out.set("done", torch.zeros(1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.count += 1
        out = self._observe()
        out["reward"] = torch.zeros(1)
        return out.set("done", torch.tensor([self.count >= self.length]))

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_model(decoder: str = "open_loop") -> LMPModel:
    torch.manual_seed(0)
    return LMPModel(D, G, A, K, plan_dim=P, hidden_size=16, decoder=decoder)


def make_rows(*batch: int, start: bool = True, dtype=torch.float32) -> TensorDict:
    torch.manual_seed(3)
    return TensorDict(
        {
            "observation": torch.randn(*batch, D, dtype=dtype),
            "desired_goal": torch.randn(*batch, G, dtype=dtype),
            "is_init": torch.full((*batch, 1), start),
        },
        batch_size=batch,
    )


def carry(td: TensorDict, **new: torch.Tensor) -> TensorDict:
    """The next step's input: carried leaves to the root, new observations."""
    out = TensorDict({"lmp": td["next", "lmp"].clone()}, td.batch_size)
    for key in ("observation", "desired_goal", "is_init"):
        out[key] = new.get(key, td[key])
    return out


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_plays_the_decoded_window(batch, dtype):
    model = make_model()
    actor = LMPActor(model, sample=False)
    td = make_rows(*batch, dtype=dtype)
    plan, _ = model.prior.module(td["observation"], td["desired_goal"])
    want = model.decoder.module(plan)
    for t in range(K):
        actor(td)
        torch.testing.assert_close(td["action"], want[..., t, :])
        torch.testing.assert_close(td["next", "lmp", "plan"], plan)
        assert (td["next", "lmp", "step"] == (t + 1) % K).all()
        no = torch.zeros(*batch, 1, dtype=torch.bool)
        # The open loop does not look at the states in between.
        new = torch.randn(*batch, D, dtype=dtype)
        td = carry(td, observation=new, is_init=no)
    actor(td)  # the next window starts from the new state
    plan, _ = model.prior.module(td["observation"], td["desired_goal"])
    torch.testing.assert_close(td["action"], model.decoder.module(plan)[..., 0, :])


def test_closed_loop_sees_every_state():
    model = make_model("closed_loop")
    actor = LMPActor(model, sample=False)
    assert ("lmp", "actions") not in actor.in_keys
    td = make_rows(5)
    plan, _ = model.prior.module(td["observation"], td["desired_goal"])
    for _ in range(K):
        actor(td)
        want = model.decoder.module(plan, td["observation"])
        torch.testing.assert_close(td["action"], want)
        no = torch.zeros(5, 1, dtype=torch.bool)
        td = carry(td, observation=torch.randn(5, D), is_init=no)


def test_is_init_starts_a_window_in_its_row_only():
    model = make_model()
    actor = LMPActor(model, sample=False)
    td = actor(make_rows(3))
    first = td["next", "lmp"].clone()
    new = torch.randn(3, D)
    td = carry(td, observation=new, is_init=torch.tensor([[False], [True], [False]]))
    actor(td)
    assert td["next", "lmp", "step"].flatten().tolist() == [2, 1, 2]
    plan, _ = model.prior.module(new, td["desired_goal"])
    want = model.decoder.module(plan)
    torch.testing.assert_close(td["action"][1], want[1, 0])
    for row in (0, 2):
        torch.testing.assert_close(td["action"][row], first["actions"][row, 1])
        torch.testing.assert_close(td["next", "lmp", "plan"][row], first["plan"][row])


def test_the_prior_is_called_at_the_start_of_a_window_only():
    model = make_model()
    actor = LMPActor(model)
    td = carry(actor(make_rows(3)), is_init=torch.zeros(3, 1, dtype=torch.bool))
    calls = []
    model.prior.module.register_forward_hook(lambda *_: calls.append(1))
    actor(td)
    assert not calls


def test_sampling_and_exploration_type():
    model = make_model()
    rows = make_rows(4)
    mean = LMPActor(model, sample=False)(rows.clone())["next", "lmp", "plan"]

    def plan(actor: LMPActor) -> torch.Tensor:
        return actor(rows.clone())["next", "lmp", "plan"]

    assert not torch.allclose(plan(LMPActor(model)), mean)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(plan(LMPActor(model)), mean)
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.allclose(plan(LMPActor(model, sample=False)), mean)

    def seeded(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return plan(LMPActor(model, generator=generator))

    torch.testing.assert_close(seeded(1), seeded(1))
    assert not torch.allclose(seeded(1), seeded(2))


def test_samples_follow_the_prior():
    model = make_model()
    row = make_rows(1)
    loc, log_std = model.prior.module(row["observation"], row["desired_goal"])
    generator = torch.Generator().manual_seed(0)
    actor = LMPActor(model, generator=generator)
    plans = actor(row.expand(20_000).clone())["next", "lmp", "plan"]
    std = log_std.exp()[0]
    assert ((plans.mean(0) - loc[0]).abs() < 4 * std / 20_000**0.5).all()
    torch.testing.assert_close(plans.std(0), std, rtol=0.03, atol=0.0)


def make_env(actor: LMPActor, lengths=(6, 100), init: bool = True) -> TransformedEnv:
    base = SerialEnv(2, [lambda n=n: CountEnv(n) for n in lengths])
    env = TransformedEnv(base)
    if init:
        env.append_transform(InitTracker())
    env.append_transform(actor.make_tensordict_primer())
    return env


def expected_starts(length: int, steps: int) -> list[bool]:
    """Plain-Python oracle: does a window start at each step of the rollout?"""
    starts, count = [], 0
    for _ in range(steps):
        starts.append(count % K == 0)
        count = 0 if count + 1 == length else count + 1
    return starts


@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("init", [True, False])
def test_one_environment_resets_within_its_window(decoder, init):
    """Episodes of 6 and 100 steps, windows of 4: the first resets mid-window."""
    model = make_model(decoder)
    actor = LMPActor(model)
    env = make_env(actor, init=init)
    check_env_specs(env)
    steps = 20
    with torch.no_grad():
        rollout = env.rollout(steps, actor, break_when_any_done=False)
    assert rollout.shape == (2, steps)
    plans = rollout["next", "lmp", "plan"]
    for row, length in enumerate((6, 100)):
        starts = expected_starts(length, steps)
        for t in range(steps):
            if t:
                changed = not torch.equal(plans[row, t], plans[row, t - 1])
                assert changed == starts[t], (row, t)
            begun = max(i for i in range(t + 1) if starts[i])
            if decoder == "open_loop":
                want = model.decoder.module(plans[row, t])[t - begun]
            else:
                state = rollout["observation"][row, t]
                want = model.decoder.module(plans[row, t], state)
            torch.testing.assert_close(rollout["action"][row, t], want)


def test_works_in_a_collector():
    actor = LMPActor(make_model())
    collector = Collector(make_env(actor), actor, frames_per_batch=24, total_frames=48)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    data = torch.cat(batches, dim=1)
    starts = data["lmp", "step"][..., 0] == 0
    assert starts[0].tolist() == expected_starts(6, 24)
    assert starts[1].tolist() == expected_starts(100, 24)


def test_state_keys_can_be_renamed():
    model = make_model()
    actor = LMPActor(
        model,
        plan_key="z",
        actions_key=("a", "chunk"),
        step_key="t",
        action_key=("out", "action"),
    )
    td = actor(make_rows(3))
    assert td["next", "a", "chunk"].shape == (3, K, A)
    assert td["out", "action"].shape == (3, A)
    primer = actor.make_tensordict_primer()
    assert set(primer.primers.keys(True, True)) == {"z", ("a", "chunk"), "t"}
    assert set(actor.out_keys) == {
        ("out", "action"),
        ("next", "z"),
        ("next", "a", "chunk"),
        ("next", "t"),
    }


def test_parameters_and_state_dict_are_the_models():
    model = make_model()
    actor = LMPActor(model)
    assert isinstance(actor, nn.Module)
    assert {id(p) for p in actor.parameters()} == {id(p) for p in model.parameters()}


def test_carried_leaves_must_be_there():
    actor = LMPActor(make_model())
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        actor(make_rows(3, start=False))
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        actor(make_rows(3).exclude("is_init"))
    env = TransformedEnv(CountEnv(10), InitTracker())  # no primer
    td = actor(env.reset())
    td = step_mdp(env.step(td)).exclude("lmp")
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        actor(td)


def test_bad_leaves():
    actor = LMPActor(make_model())
    with pytest.raises(KeyError, match="observation"):
        actor(make_rows(3).exclude("observation"))
    with pytest.raises(KeyError, match="desired_goal"):
        actor(make_rows(3).exclude("desired_goal"))
    rows = make_rows(3)
    rows["desired_goal"] = torch.zeros(3, G + 1)
    with pytest.raises(ValueError, match=r"'desired_goal' has the shape \[3, 3\]"):
        actor(rows)
    rows = TensorDict({**make_rows(3), "desired_goal": torch.zeros(G)})
    with pytest.raises(ValueError, match="must agree"):
        actor(rows)
    rows = TensorDict({**make_rows(3), "is_init": torch.ones(2, dtype=torch.bool)})
    with pytest.raises(ValueError, match="'is_init' has the shape"):
        actor(rows)
    td = carry(actor(make_rows(3)))
    td["lmp", "actions"] = torch.zeros(3, K + 1, A)
    with pytest.raises(ValueError, match="take the primer from this actor"):
        actor(td)


@pytest.mark.parametrize("key", ["observation", "desired_goal"])
def test_a_window_never_starts_from_non_finite_values(key):
    actor = LMPActor(make_model())
    rows = make_rows(3)
    rows[key][1, 0] = float("nan")
    with pytest.raises(ValueError, match=f"'{key}' is not finite"):
        actor(rows)
