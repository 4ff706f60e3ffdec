"""Tests of the goal-conditioned policy, action values and state values."""

from __future__ import annotations

import math
import warnings
from unittest import mock

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalConditionedValue,
    GoalFeatures,
)
from torchrl_caiac.modules import goal_networks as networks_module
from torchrl_caiac.modules.goal_networks import takes_params

LAYOUT = EntityLayout(
    {"arm": [0, 1], "cup": [2, 3]},
    goal={"cup": [0, 1]},
    achieved={"cup": [2, 3]},
    fixed=["arm"],
)


def rows(*batch: int, dtype=torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(0)

    def draw(width: int) -> torch.Tensor:
        return torch.randn(*batch, width, generator=generator, dtype=dtype)

    return TensorDict(
        {"observation": draw(4), "desired_goal": draw(2), "action": draw(3)}, batch
    )


def networks(dtype=None, **kwargs):
    torch.manual_seed(0)
    features = GoalFeatures(LAYOUT, reference="arm").fit_statistics(rows(200))
    actor = GoalConditionedActor(features, 3, (32, 16), hidden_dtype=dtype, **kwargs)
    return actor, GoalConditionedCritic(features, 3, (32, 16), hidden_dtype=dtype)


def slow_network(features: torch.Tensor, parameters: list[torch.Tensor]):
    """Linear layers with ReLU in between."""
    for i in range(0, len(parameters), 2):
        features = features @ parameters[i].T + parameters[i + 1]
        if i + 2 < len(parameters):
            features = features.clamp_min(0.0)
    return features


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_against_matrix_products(batch, dtype):
    actor, critic = (network.to(dtype) for network in networks(low=-2.0, high=1.0))
    td = rows(*batch, dtype=dtype)
    features = actor.features.forward_tensors(td["observation"], td["desired_goal"])
    got = critic(td)["state_action_value"]
    inputs = torch.cat([features, td["action"]], -1)
    torch.testing.assert_close(got, slow_network(inputs, list(critic.parameters())))
    assert got.shape == (*batch, 1) and got.dtype == dtype
    want = slow_network(features, list(actor.parameters())).tanh()
    got = actor(td)["action"]
    torch.testing.assert_close(got, -0.5 + 1.5 * want)
    assert got.shape == (*batch, 3) and got.dtype == dtype


def test_bounds_per_column():
    low, high = torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 0.5, 3.0])
    actor, _ = networks(low=low, high=high)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(30.0)
    action = actor(rows(500))["action"]
    assert (action >= low - 1e-6).all() and (action <= high + 1e-6).all()
    torch.testing.assert_close(action.amin(0), low)
    torch.testing.assert_close(action.amax(0), high)


def test_reduced_precision_keeps_the_weights():
    full, half = networks(), networks(torch.bfloat16)
    td = rows(300)
    for a, b in zip(full, half, strict=True):
        b.load_state_dict(a.state_dict())
        want, got = (network(td.clone())[network.out_keys[0]] for network in (a, b))
        assert got.dtype == torch.float32
        error = (want - got).abs().max()
        assert 0.0 < error < 0.02 * want.abs().max()
        got.square().mean().backward()
        want.square().mean().backward()
        for p, q in zip(a.parameters(), b.parameters(), strict=True):
            assert q.dtype == q.grad.dtype == torch.float32
            assert (p.grad - q.grad).norm() < 0.05 * p.grad.norm()


@pytest.mark.parametrize("units", [True, False])
def test_a_processor_without_bfloat16_units_is_told_of(monkeypatch, units):
    known = {"avx512_f": True, "avx512_bf16": units, "cpu_name": "Some CPU"}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known)
    networks_module._warn_without_bfloat16.cache_clear()
    (actor, _), (plain, _) = networks(torch.bfloat16), networks()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plain(rows(5))
        assert not caught
        first, again = (actor(rows(5))["action"] for _ in range(2))
    networks_module._warn_without_bfloat16.cache_clear()
    assert torch.equal(first, again)
    assert [str(w.message)[:30] for w in caught] == [
        "hidden layers in bfloat16 are "
    ] * (not units)
    if caught:
        assert "Some CPU" in str(caught[0].message)


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_parameters_of_another(dtype, batch):
    """Those of two networks, stacked, give the values of both."""
    pairs = zip(networks(dtype), networks(dtype), strict=True)
    for one, other in pairs:
        torch.manual_seed(1)
        with torch.no_grad():
            for tensor in (*other.parameters(), *other.buffers()):
                tensor.mul_(torch.rand_like(tensor) + 0.5)
        key = one.out_keys[0]
        want = [network(rows(*batch))[key] for network in (one, other)]
        params = [TensorDict.from_module(x).data for x in (one, other)]
        torch.testing.assert_close(one(rows(*batch), params[1])[key], want[1])
        assert not torch.equal(*want)
        if key == "action":
            continue  # a loss has one policy
        stacked = torch.stack(params)
        got = one(rows(*batch).expand(2, *batch), stacked)[key]
        torch.testing.assert_close(got, torch.stack(want))
        with mock.patch.object(networks_module, "_on_cpu", return_value=False):
            got = one(rows(*batch).expand(2, *batch), stacked)[key]
        tolerance = {} if dtype is None else {"rtol": 0.02, "atol": 0.02}
        torch.testing.assert_close(got, torch.stack(want), **tolerance)


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_normalised_layers(dtype, batch):
    """Hidden units have mean 0 and variance 1 in each row, before their ReLU."""
    torch.manual_seed(0)
    features = GoalFeatures(LAYOUT, reference="arm").fit_statistics(rows(200))
    pair = [
        GoalConditionedCritic(
            features, 3, (32, 16), hidden_dtype=dtype, layer_norm=True
        )
        for _ in range(2)
    ]
    td = rows(*batch)
    wants = []
    for critic in pair:
        value = torch.cat([features(td.clone())["features"], td["action"]], -1)
        parameters = list(critic.network.parameters())
        for i in range(0, len(parameters), 2):
            value = value @ parameters[i].T + parameters[i + 1]
            if i + 2 < len(parameters):
                deviation = value.var(-1, correction=0, keepdim=True).add(1e-5).sqrt()
                value = ((value - value.mean(-1, keepdim=True)) / deviation).clamp_min(
                    0
                )
        wants.append(value)
    tolerance = {} if dtype is None else {"rtol": 0.05, "atol": 0.05}
    got = pair[0](td.clone())["state_action_value"]
    torch.testing.assert_close(got, wants[0], **tolerance)
    stacked = torch.stack([TensorDict.from_module(x).data for x in pair])
    for on_cpu in (True, False):
        with mock.patch.object(networks_module, "_on_cpu", return_value=on_cpu):
            for inputs in (td.expand(2, *batch), td.unsqueeze(0)):
                got = pair[0](inputs, stacked)
                assert got.batch_size == (2, *batch)
                got = got["state_action_value"]
                torch.testing.assert_close(got, torch.stack(wants), **tolerance)
            # Rows that are no batch dimensions, and a single critic.
            for params, inputs in ((stacked, td.expand(2, *batch)), (stacked[:1], td)):
                inputs = inputs.reshape(len(params), *batch).clone()
                inputs.batch_size = []
                got = pair[0](inputs, params)
                assert got is inputs
                want = torch.stack(wants[: len(params)])
                got = got["state_action_value"]
                torch.testing.assert_close(got, want, **tolerance)


def test_who_takes_parameters():
    class Other(GoalConditionedCritic):
        def forward(self, tensordict):
            return super().forward(tensordict)

    actor, critic = networks()
    assert takes_params(actor) and takes_params(critic)
    assert not takes_params(Other(actor.features, 3, (4,)))
    assert not takes_params(torch.nn.Linear(1, 1))


def test_networks_keep_the_features_they_were_made_of():
    features = GoalFeatures(LAYOUT, reference="arm").fit_statistics(rows(200))
    actor = GoalConditionedActor(features, 3, (16,))
    critic = GoalConditionedCritic(features, 3, (16,))
    before = [network(rows(4))[network.out_keys[0]] for network in (actor, critic)]
    features.norm.shift.add_(1.0)
    for network, want in zip((actor, critic), before, strict=True):
        torch.testing.assert_close(network(rows(4))[network.out_keys[0]], want)


def test_nested_keys():
    actor, critic = networks()
    layout = EntityLayout(
        dict(LAYOUT.columns),
        goal=dict(LAYOUT.goal),
        achieved=dict(LAYOUT.achieved),
        fixed=["arm"],
        observation_key=("agent", "state"),
        desired_goal_key=("agent", "goal"),
    )
    features = GoalFeatures(layout, reference="arm")
    key = ("agent", "act")
    nested_actor = GoalConditionedActor(features, 3, (32, 16), action_key=key)
    nested_critic = GoalConditionedCritic(
        features, 3, (32, 16), action_key=key, out_key=("agent", "q")
    )
    nested_actor.load_state_dict(actor.state_dict())
    nested_critic.load_state_dict(critic.state_dict())
    td = rows(4)
    nested = TensorDict(
        {"agent": {"state": td["observation"], "goal": td["desired_goal"]}}, [4]
    )
    nested = nested_critic(nested_actor(nested))
    td = critic(actor(td))
    torch.testing.assert_close(nested[key], td["action"])
    torch.testing.assert_close(nested["agent", "q"], td["state_action_value"])


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_state_values_are_action_values_without_actions(batch, dtype, layer_norm):
    features = GoalFeatures(LAYOUT, reference="arm").fit_statistics(rows(200))
    options = {"hidden_dtype": dtype, "layer_norm": layer_norm}
    value = GoalConditionedValue(features, (32, 16), out_key=("agent", "v"), **options)
    critic = GoalConditionedCritic(features, 1, (32, 16), **options)
    weights = value.network.state_dict()
    first = critic.network.state_dict()["0.weight"]
    first[:, :-1], first[:, -1] = weights["0.weight"], 0.0
    critic.network.load_state_dict({**weights, "0.weight": first})
    td = rows(*batch).exclude("action")
    assert value.in_keys == ["observation", "desired_goal"]
    found = value(td.clone())
    assert found["agent", "v"].shape == (*batch, 1)
    td["action"] = torch.randn(*batch, 1)
    expected = critic(td)["state_action_value"]
    # bfloat16 sums are rounded in another order.
    atol = 1e-6 if dtype is None else 0.02
    torch.testing.assert_close(found["agent", "v"], expected, atol=atol, rtol=0)
    dispatched = value(observation=td["observation"], desired_goal=td["desired_goal"])
    assert torch.equal(dispatched, found["agent", "v"])


@pytest.mark.parametrize(
    "size", [(), (16, 0), 16, None, (True,), b"\x08", {16: 1}, {16}]
)
def test_bad_sizes_of_state_values(size):
    with pytest.raises(ValueError, match="hidden_sizes"):
        GoalConditionedValue(GoalFeatures(LAYOUT), size)


@pytest.mark.parametrize("cls", [GoalConditionedActor, GoalConditionedCritic])
@pytest.mark.parametrize(
    ("args", "kwargs", "match"),
    [
        ((0,), {}, "action_dim"),
        ((2.0,), {}, "action_dim"),
        ((2, ()), {}, "hidden_sizes"),
        ((2, (16, 0)), {}, "hidden_sizes"),
        ((2, (16,)), {"hidden_dtype": torch.int8}, "hidden_dtype"),
        ((2, (16,)), {"hidden_dtype": "bfloat16"}, "hidden_dtype"),
        ((2, (16,)), {"hidden_dtype": torch.float8_e4m3fn}, "hidden_dtype"),
    ],
)
def test_bad_arguments(cls, args, kwargs, match):
    with pytest.raises(ValueError, match=match):
        cls(GoalFeatures(LAYOUT), *args, **kwargs)


@pytest.mark.parametrize("features", [None, LAYOUT, torch.nn.Linear(1, 1)])
def test_other_features(features):
    for cls in (GoalConditionedActor, GoalConditionedCritic):
        with pytest.raises(TypeError, match="features must be GoalFeatures"):
            cls(features, 2)
    with pytest.raises(TypeError, match="features must be GoalFeatures"):
        GoalConditionedValue(features)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (1.0, 1.0),
        (-math.inf, math.inf),
        (-3e38, 3e38),  # the width of the range is infinite
        (math.nan, 1.0),
        (None, 1.0),
        ("a", 1.0),
        (torch.zeros(3), 1.0),
    ],
)
def test_bad_bounds(low, high):
    with pytest.raises(
        ValueError, match=r"low and high must be .* \[2\], low below high"
    ):
        GoalConditionedActor(GoalFeatures(LAYOUT), 2, low=low, high=high)


def test_a_policy_on_the_meta_device():
    with torch.device("meta"):
        empty = GoalConditionedActor(GoalFeatures(LAYOUT), 2, (16,), high=2.0)
    assert {x.device.type for x in empty.state_dict().values()} == {"meta"}
    actor = GoalConditionedActor(GoalFeatures(LAYOUT), 2, (16,), high=2.0)
    empty.load_state_dict(actor.state_dict(), assign=True)
    assert torch.equal(empty(rows(4))["action"], actor(rows(4))["action"])


def test_bad_goals():
    for network in networks():
        td = rows(4)
        td["desired_goal"] = torch.zeros(4, 5)
        with pytest.raises(ValueError, match="'desired_goal' has 5 columns"):
            network(td)
