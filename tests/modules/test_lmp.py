"""Tests of the LMP model: shapes, padding, standardization, bad input."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_caiac.modules import running_norm
from torchrl_caiac.modules.lmp import LMPModel
from torchrl_caiac.modules.lmp_parts import gaussian_plan

D, G, A, K, P = 5, 2, 3, 6, 4


def make_model(**kwargs) -> LMPModel:
    torch.manual_seed(0)
    return LMPModel(D, G, A, K, plan_dim=P, hidden_size=16, **kwargs)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
def test_parts_write_their_keys(batch, dtype, decoder):
    model = make_model(decoder=decoder)
    window = TensorDict(
        {
            "observation": torch.randn(*batch, K, D, dtype=dtype),
            "action": torch.rand(*batch, K, A, dtype=dtype),
        },
        batch_size=batch,
    )
    model.posterior(window)
    assert window["posterior", "loc"].shape == (*batch, P)
    assert window["posterior", "log_std"].shape == (*batch, P)
    window["plan"] = window["posterior", "loc"]
    model.decoder(window)
    assert window["lmp", "actions"].shape == (*batch, K, A)
    assert window["lmp", "actions"].abs().max() <= 1.0

    row = TensorDict(
        {
            "observation": torch.randn(*batch, D, dtype=dtype),
            "desired_goal": torch.randn(*batch, G, dtype=dtype),
        },
        batch_size=batch,
    )
    model(row)
    assert row["prior", "loc"].shape == row["plan"].shape == (*batch, P)
    steps = (K,) if decoder == "open_loop" else ()
    assert row["lmp", "actions"].shape == (*batch, *steps, A)
    assert set(model.out_keys) <= set(row.keys(True, True))


def test_nested_keys():
    model = make_model(
        decoder="closed_loop",
        observation_key=("data", "state"),
        goal_key=("data", "goal"),
        plan_key=("z", "plan"),
        actions_key=("z", "actions"),
    )
    td = TensorDict(
        {"data": {"state": torch.randn(4, D), "goal": torch.randn(4, G)}}, [4]
    )
    model(td)
    assert td["z", "plan"].shape == (4, P)
    assert td["z", "actions"].shape == (4, A)


def test_exploration_type_decides_between_mean_and_sample():
    model = make_model()
    td = TensorDict({"observation": torch.randn(4, D), "desired_goal": torch.ones(G)})
    td["desired_goal"] = torch.randn(4, G)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = model(td.copy())
    torch.testing.assert_close(out["plan"], out["prior", "loc"])
    with set_exploration_type(ExplorationType.RANDOM):
        out = model(td.copy())
    assert not torch.allclose(out["plan"], out["prior", "loc"])


def test_log_std_is_bounded():
    model = make_model()
    with torch.no_grad():
        head = model.prior.module.head.linear
        head.bias[P:] = torch.tensor([-100.0, 100.0, 0.0, 1.0])
        head.weight[P:] = 0.0
        _, log_std = model.prior.module(torch.randn(2, D), torch.randn(2, G))
    expected = torch.tensor([-10.0, 2.0, 0.0, 1.0]).expand(2, P)
    torch.testing.assert_close(log_std, expected)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.data())
def test_padding_does_not_matter(seed, batch, data):
    """A padded window's plan is the plan of the window cut off at its last step."""
    model = make_model()
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(batch, K, D, generator=generator)
    action = torch.rand(batch, K, A, generator=generator)
    lengths = [data.draw(st.integers(1, K)) for _ in range(batch)]
    mask = torch.arange(K) < torch.tensor(lengths).unsqueeze(-1)
    observation = observation.masked_fill(~mask.unsqueeze(-1), float("nan"))
    with torch.no_grad():
        loc, log_std = model.posterior.module(observation, action, mask)
        for row, n in enumerate(lengths):
            want = model.posterior.module(observation[row, :n], action[row, :n])
            torch.testing.assert_close(loc[row], want[0])
            torch.testing.assert_close(log_std[row], want[1])


def test_padding_leaves_gradients_finite():
    model = make_model()
    mask = torch.tensor([[True, True, False]])
    observation = torch.randn(1, 3, D)
    observation[:, 2] = float("nan")
    loc, _ = model.posterior.module(observation, torch.rand(1, 3, A), mask)
    loc.sum().backward()
    for parameter in model.posterior.parameters():
        assert parameter.grad.isfinite().all()


def test_gaussian_plan_carries_gradients():
    loc = torch.zeros(3, requires_grad=True)
    log_std = torch.full((3,), 0.5, requires_grad=True)
    noise = torch.tensor([0.0, 1.0, -2.0])
    plan = gaussian_plan(loc, log_std, noise)
    plan.sum().backward()
    torch.testing.assert_close(loc.grad, torch.ones(3))
    torch.testing.assert_close(log_std.grad, plan.detach())


def make_rows(n: int = 50) -> TensorDict:
    torch.manual_seed(1)
    return TensorDict(
        {
            "observation": torch.randn(n, D) * 3.0 + 7.0,
            "action": torch.rand(n, A) * 2 - 1,
            "desired_goal": torch.randn(n, G) - 1.0,
        },
        batch_size=[n],
    )


@pytest.mark.parametrize("memmap", [False, True])
@pytest.mark.parametrize("chunk", [7, 65_536])
def test_statistics_against_torch(memmap, chunk, monkeypatch, tmp_path):
    monkeypatch.setattr(running_norm, "_ROWS_PER_CHUNK", chunk)
    rows = make_rows()
    rows["observation"][:, 0] = 3.0  # constant: divided by the floor
    rows["action"][:, 0] = 0.25
    want = rows.double()
    if memmap:
        rows = rows.memmap(str(tmp_path))
    model = make_model().fit_statistics(rows)
    for norm, key, floor in (
        (model.observation_norm, "observation", 0.02),
        (model.goal_norm, "desired_goal", 0.02),
        (model.action_norm, "action", 0.05),
    ):
        std = want[key].std(0, unbiased=False).clamp_min(floor)
        torch.testing.assert_close(norm.mean, want[key].mean(0))
        torch.testing.assert_close(norm.scale, std)
        normalised = (want[key] - want[key].mean(0)) / std
        torch.testing.assert_close(norm(want[key]), normalised.float())
    assert model.observation_norm.scale[0] == pytest.approx(0.02)
    assert model.action_norm.scale[0] == pytest.approx(0.05)


def test_statistics_take_windows_masks_and_goals():
    rows = make_rows(48)
    goals = torch.randn(9, G) + 100.0
    windows = rows.reshape(-1, K)
    mask = torch.ones(8, K, dtype=torch.bool)
    mask[:, -2:] = False
    windows["mask"] = mask
    windows["observation"][:, -1] = float("nan")
    model = make_model().fit_statistics(windows, goals=goals)
    valid = windows["observation"][mask]
    torch.testing.assert_close(model.observation_norm.mean, valid.double().mean(0))
    torch.testing.assert_close(model.goal_norm.mean, goals.double().mean(0))


def test_statistics_are_shared_and_saved():
    model = make_model(decoder="closed_loop").fit_statistics(make_rows())
    for part in (model.posterior, model.prior, model.decoder):
        assert part.module.observation_norm is model.observation_norm
    other = LMPModel(**model.config)
    other.load_state_dict(model.state_dict())
    torch.testing.assert_close(other.goal_norm.gain, model.goal_norm.gain)
    torch.testing.assert_close(
        other.decoder.module.observation_norm.shift, model.observation_norm.shift
    )
    twin = copy.deepcopy(model)
    assert twin.prior.module.goal_norm is twin.goal_norm


@pytest.mark.parametrize(
    ("key", "bad", "match"),
    [
        ("observation", float("nan"), "'observation' has 1 non-finite"),
        ("action", float("inf"), "'action' has 1 non-finite"),
        ("desired_goal", float("nan"), "'desired_goal' has 1 non-finite"),
        ("action", 1.5, "'action' has values up to 1.5.*rescale"),
    ],
)
def test_bad_statistics_change_nothing(key, bad, match):
    rows = make_rows()
    rows[key][3, 1] = bad
    model = make_model()
    before = copy.deepcopy(model.state_dict())
    with pytest.raises(ValueError, match=match):
        model.fit_statistics(rows)
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, before[name])


def test_statistics_of_nothing():
    model = make_model()
    with pytest.raises(ValueError, match="no \\(valid\\) rows"):
        model.fit_statistics(make_rows()[:0])
    with pytest.raises(KeyError, match="desired_goal"):
        model.fit_statistics(make_rows().exclude("desired_goal"))
    with pytest.raises(ValueError, match=r"goals has the shape \[4, 3\], expected"):
        model.fit_statistics(make_rows(), goals=torch.zeros(4, G + 1))
    rows = make_rows()
    rows["mask"] = torch.ones(50, 2, dtype=torch.bool)
    with pytest.raises(ValueError, match="mask has 100 entries"):
        model.fit_statistics(rows)


def test_missing_and_misshapen_leaves():
    model = make_model()
    td = TensorDict({"observation": torch.randn(4, D)}, [4])
    with pytest.raises(KeyError, match="desired_goal"):
        model(td)
    td["desired_goal"] = torch.randn(4, G + 1)
    with pytest.raises(ValueError, match=r"'desired_goal' has the shape \[4, 3\]"):
        model(td)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"window": 0}, "window"),
        ({"plan_dim": 0}, "plan_dim"),
        ({"observation_floor": 0.0}, "observation_floor"),
        ({"action_floor": float("inf")}, "action_floor"),
        ({"decoder": "both"}, "decoder"),
    ],
)
def test_bad_arguments(kwargs, match):
    arguments = {"window": K, **kwargs}
    with pytest.raises(ValueError, match=match):
        LMPModel(D, G, A, **arguments)


def test_sizes_follow_the_design():
    model = LMPModel(30, 21, 9, 10)
    assert model.posterior.module.lstm.hidden_size == 128
    assert model.posterior.module.lstm.input_size == 39
    assert model.plan_dim == 10
    for network, layers in (
        (model.prior.module.network, 3),
        (model.decoder.module.network, 4),
    ):
        linear = [m for m in network if isinstance(m, torch.nn.Linear)]
        assert len(linear) == layers
        assert all(m.out_features == 128 for m in linear[:3])
    assert model.decoder.in_keys == ["plan"]
