"""Tests of TD3 for goals: a slow oracle, the goal of the next state, learning."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from tests.pretend_cuda import nothing_waits
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
    linear,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss

D, G, A, GAMMA = 5, 2, 3, 0.9
MASK = ("caiac", "counterfactual")


def make_layout(**kwargs) -> EntityLayout:
    return EntityLayout(
        {"arm": [0, 1], "cup": [2, 3, 4]},
        goal={"cup": range(G)},
        achieved={"cup": [2, 3]},
        fixed=["arm"],
        **kwargs,
    )


def make_batch(*batch: int, seed: int = 1, dtype=torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(width: int) -> torch.Tensor:
        return torch.randn(*batch, width, generator=generator, dtype=dtype)

    def flip(share: float) -> torch.Tensor:
        return torch.rand(*batch, 1, generator=generator) < share

    terminated, truncated = flip(0.3), flip(0.3)
    return TensorDict(
        {
            "observation": draw(D),
            "desired_goal": draw(G),
            "action": draw(A).tanh(),
            "caiac": {"counterfactual": flip(0.5)},
            "next": {
                "observation": draw(D),
                "reward": -flip(0.7).to(dtype),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        batch,
    )


class PlainActor(GoalConditionedActor):
    """A policy with a forward of its own, as a user's may have."""

    def forward(self, tensordict):
        return super().forward(tensordict)


class PlainCritic(GoalConditionedCritic):
    """The same of a critic."""

    def forward(self, tensordict):
        return super().forward(tensordict)


def make_loss(
    *,
    layout=None,
    dtype=None,
    gamma=GAMMA,
    keys=None,
    plain=False,
    device="cpu",
    **kwargs,
):
    torch.manual_seed(0)
    keys = keys or {}
    features = GoalFeatures(layout or make_layout(), reference="arm")
    actor = (PlainActor if plain else GoalConditionedActor)(
        features,
        A,
        (16, 8),
        hidden_dtype=dtype,
        action_key=keys.get("action", "action"),
    )
    critics = [
        (PlainCritic if plain else GoalConditionedCritic)(
            features,
            A,
            (16, 8),
            hidden_dtype=dtype,
            action_key=keys.get("action", "action"),
            out_key=keys.get("state_action_value", "state_action_value"),
        )
        for _ in range(2)
    ]
    networks = [network.to(device) for network in (actor, *critics)]
    loss = GoalConditionedTD3Loss(networks[0], networks[1:], **kwargs)
    if keys:
        loss.set_keys(**keys)
    loss.make_value_estimator(gamma=gamma)
    SoftUpdate(loss, tau=0.5)
    # Targets that differ from what they follow, as they do in training.
    for name, value in loss.named_buffers():
        if name.startswith("target_") and ".network." in name:
            value.add_(0.3 * torch.randn(value.shape).to(value))
    return loss


# --- the oracle: rows one by one, weights by name ------------------------------------


def slow_features(state, goal):
    achieved, position = state[2:4], state[0:2]
    return torch.cat([state, goal, achieved - position, goal - achieved])


def slow_network(value, weights):
    for layer in (0, 2, 4):
        value = weights[f"{layer}.weight"] @ value + weights[f"{layer}.bias"]
        if layer != 4:
            value = value.clamp_min(0.0)
    return value


def slow_weights(loss, name, critic=None):
    flat = getattr(loss, name).data.flatten_keys(".")
    prefix = "network."
    return {
        key[len(prefix) :]: value if critic is None else value[critic]
        for key, value in flat.items()
        if key.startswith(prefix)
    }


def slow_value(loss, critic, state, goal, action, target=False):
    weights = slow_weights(loss, "target_" * target + "qvalue_network_params", critic)
    return slow_network(torch.cat([slow_features(state, goal), action]), weights)[0]


def slow_action(loss, state, goal, target=False):
    weights = slow_weights(loss, "target_" * target + "actor_network_params")
    return slow_network(slow_features(state, goal), weights).tanh()


def slow_losses(loss, data, noise, *, low, high, alpha, masked, penalty):
    """Both losses of every row, and the targets."""
    flat, noise = data.reshape(-1), noise.reshape(-1, A)
    actor, critic, targets, values, errors, penalties = [], [], [], [], [], []
    for row, eps in zip(flat, noise, strict=True):
        goal = row["desired_goal"]
        after = row["next", "observation"]
        action = slow_action(loss, after, goal, target=True)
        action = (action + (0.2 * eps).clamp(-0.5, 0.5)).clamp(-1.0, 1.0)
        target = min(
            slow_value(loss, c, after, goal, action, target=True) for c in (0, 1)
        )
        if row["next", "terminated"]:
            target = torch.zeros_like(target)
        target = row["next", "reward"][0] + GAMMA * target
        if low is not None:
            target = max(min(target, torch.tensor(high)), torch.tensor(low))
        targets.append(target)
        critic.append(
            sum(
                (slow_value(loss, c, row["observation"], goal, row["action"]) - target)
                ** 2
                for c in (0, 1)
            )
        )
        action = slow_action(loss, row["observation"], goal)
        values.append(slow_value(loss, 0, row["observation"], goal, action))
        errors.append(sum((action - row["action"]) ** 2) / A)
        penalties.append(sum(action**2) / A)
    kept = [not (masked and bool(row[MASK])) for row in flat]
    lmbd = 1.0 if alpha is None else alpha * len(values) / sum(map(abs, values))
    for value, error, keep, square in zip(values, errors, kept, penalties, strict=True):
        cloned = error * keep * len(kept) / max(1, sum(kept)) if alpha else 0.0
        actor.append(-lmbd * value + cloned + penalty * square)
    return tuple(map(torch.stack, (actor, critic, targets)))


@settings(max_examples=25)
@given(
    batch=st.sampled_from([(), (1,), (6,), (2, 3)]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    alpha=st.sampled_from([None, 2.5]),
    masked=st.booleans(),
    penalty=st.sampled_from([0.0, 0.3]),
    bounds=st.sampled_from(["reward", "target", None]),
    networks=st.sampled_from(["own", "vmap", "loop"]),
    seed=st.integers(0, 1000),
)
def test_losses_against_a_slow_oracle(
    batch, dtype, alpha, masked, penalty, bounds, networks, seed
):
    masked = masked and alpha is not None
    kwargs = {
        "reward": {"reward_bounds": (-1.0, 0.0)},
        "target": {"target_bounds": (-0.4, -0.1)},
        None: {"reward_bounds": None},
    }[bounds]
    low, high = {"reward": (-10.0, 0.0), "target": (-0.4, -0.1), None: (None, None)}[
        bounds
    ]
    loss = make_loss(
        bc_alpha=alpha,
        bc_mask_key=MASK if masked else None,
        action_penalty=penalty,
        reduction="none",
        plain=networks != "own",
        deactivate_vmap=networks == "loop",
        **kwargs,
    ).to(dtype)
    data = make_batch(*batch, seed=seed, dtype=dtype)
    torch.manual_seed(seed)
    got = loss(data.clone())
    torch.manual_seed(seed)
    actor, critic, target = slow_losses(
        loss,
        data,
        torch.randn_like(data["action"]),
        low=low,
        high=high,
        alpha=alpha,
        masked=masked,
        penalty=penalty,
    )
    tolerance = {"rtol": 1e-4, "atol": 1e-5}
    for key, want in (
        ("target_value", target),
        ("loss_qvalue", critic),
        ("loss_actor", actor),
    ):
        assert got[key].dtype == dtype
        torch.testing.assert_close(
            got[key], want.to(dtype).reshape(batch), check_dtype=False, **tolerance
        )


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_reductions(reduction):
    data = make_batch(6)
    kwargs = {"bc_alpha": 2.5, "bc_mask_key": MASK, "action_penalty": 0.1}
    results = []
    for name in ("none", reduction):
        torch.manual_seed(0)
        results.append(make_loss(reduction=name, **kwargs)(data.clone()))
    rows, got = results
    for key in ("loss_actor", "loss_qvalue"):
        assert rows[key].shape == (6,)
        torch.testing.assert_close(got[key], getattr(rows[key], reduction)())


# --- goals and ends ------------------------------------------------------------------


def test_the_next_state_has_the_goal_of_its_row():
    loss, data = make_loss(reduction="none"), make_batch(8)
    torch.manual_seed(3)
    want = loss(data.clone())
    for stale in (torch.randn(8, G), torch.full((8, G), float("nan"))):
        torch.manual_seed(3)
        relabelled = data.clone()
        relabelled["next", "desired_goal"] = stale
        got = loss(relabelled)
        torch.testing.assert_close(got["loss_qvalue"], want["loss_qvalue"])
        torch.testing.assert_close(
            relabelled["next", "desired_goal"], stale, equal_nan=True
        )
    torch.manual_seed(3)
    data["desired_goal"][2] += 1.0
    other = loss(data)
    changed = other["next_state_value"] != want["next_state_value"]
    assert changed.tolist() == [row == 2 for row in range(8)]


def test_agrees_with_torchrl_where_that_is_right():
    """TD3Loss on fresh goals, nothing clamped: the same critic loss and gradients."""
    loss, data = make_loss(reward_bounds=None), make_batch(8)
    plain = make_loss(reward_bounds=None)
    data["next", "desired_goal"] = data["desired_goal"].clone()
    torch.manual_seed(3)
    got, _ = loss.value_loss(data)
    torch.manual_seed(3)
    want, _ = TD3Loss.value_loss(plain, data)
    torch.testing.assert_close(got, want)
    (got + loss.actor_loss(data)[0]).backward()
    (want + TD3Loss.actor_loss(plain, data)[0]).backward()
    for p, q in zip(loss.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(p.grad, q.grad)


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize(
    ("dtype", "batch"),
    [(None, ()), (None, (7,)), (None, (2, 3)), (torch.bfloat16, (200,))],
)
def test_networks_of_others_give_the_same(loop, dtype, batch):
    """Parameters handed to the networks, or swapped in: losses and gradients agree."""
    data = make_batch(*batch)
    losses = [
        make_loss(dtype=dtype, bc_alpha=2.5, action_penalty=0.1),
        make_loss(
            dtype=dtype,
            bc_alpha=2.5,
            action_penalty=0.1,
            plain=True,
            deactivate_vmap=loop,
        ),
    ]
    results = []
    for loss in losses:
        torch.manual_seed(3)
        out = loss(data.clone())
        (out["loss_actor"] + out["loss_qvalue"]).backward()
        results.append(out.detach())
    tolerance = {} if dtype is None else {"rtol": 0.02, "atol": 2e-3}
    for key in losses[0].out_keys:
        torch.testing.assert_close(results[0][key], results[1][key], **tolerance)
    for p, q in zip(*(loss.parameters() for loss in losses), strict=True):
        # Sums in bfloat16 differ by their order, and a ReLU may open in one only.
        if dtype is None:
            torch.testing.assert_close(p.grad, q.grad)
        assert (p.grad - q.grad).norm() < 0.05 * q.grad.norm()


def test_time_limits_do_not_cut_bootstrapping():
    loss, data = make_loss(reduction="none", reward_bounds=None), make_batch(8)
    results = {}
    for terminated in (False, True):
        for truncated in (False, True):
            data["next", "terminated"].fill_(terminated)
            data["next", "truncated"].fill_(truncated)
            data["next", "done"].fill_(terminated or truncated)
            torch.manual_seed(3)
            results[terminated, truncated] = loss(data.clone())["target_value"]
    reward = data["next", "reward"].squeeze(-1)
    torch.testing.assert_close(results[False, True], results[False, False])
    torch.testing.assert_close(results[True, False], reward)
    assert (results[False, True] != reward).all()
    with pytest.raises(KeyError, match=r"data lack .*terminated"):
        loss(data.exclude(("next", "terminated")))
    del data["next", "done"]
    torch.manual_seed(3)
    torch.testing.assert_close(loss(data)["target_value"], reward)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("gamma", [0.5, 0.97])
def test_targets_stay_within_what_a_return_can_be(sign, gamma):
    loss, data = make_loss(gamma=gamma, reduction="none"), make_batch(50)
    free = make_loss(gamma=gamma, reduction="none", reward_bounds=None)
    fixed = make_loss(gamma=gamma, reduction="none", target_bounds=(-3.0, 2.0))
    results = []
    for one in (loss, free, fixed):
        bias = one.target_qvalue_network_params["network", "4", "bias"]
        bias.data.fill_(sign * 1e4)
        results.append(one(data.clone())["target_value"])
    bounded, unbounded, given_bounds = results
    live = ~data["next", "terminated"].squeeze(-1)
    low = -1.0 / (1.0 - gamma)
    torch.testing.assert_close(
        bounded[live], torch.full_like(bounded[live], 0.0 if sign > 0 else low)
    )
    torch.testing.assert_close(
        given_bounds[live], torch.full_like(bounded[live], 2.0 if sign > 0 else -3.0)
    )
    assert (unbounded[live].abs() > 1e3).all()


def test_bounds_follow_the_discount():
    loss = make_loss(gamma=0.9)
    assert [round(float(x), 4) for x in loss.target_bounds] == [-10.0, 0.0]
    loss.make_value_estimator(gamma=0.5)
    assert [round(float(x), 4) for x in loss.target_bounds] == [-2.0, 0.0]
    assert make_loss(reward_bounds=None).target_bounds is None
    assert make_loss(target_bounds=(-1.0, 1.0)).target_bounds == (-1.0, 1.0)
    with pytest.raises(ValueError, match=r"gamma is 1.0.*give target_bounds"):
        loss.make_value_estimator(gamma=1.0)
    make_loss(reward_bounds=None).make_value_estimator(gamma=1.0)
    untold = GoalConditionedTD3Loss(loss.actor_network, loss.qvalue_network)
    assert round(float(untold.target_bounds[0]), 2) == -100.0  # TorchRL's own 0.99


# --- gradients -----------------------------------------------------------------------


def gradients(parameters) -> list[bool]:
    return [
        p.grad is not None and bool(p.grad.abs().sum() > 0)
        for p in parameters.values(True, True)
        if isinstance(p, torch.nn.Parameter)
    ]


@pytest.mark.parametrize("alpha", [None, 2.5])
def test_each_loss_trains_its_own_network(alpha):
    data = make_batch(32)
    loss = make_loss(bc_alpha=alpha, action_penalty=0.1)
    loss.actor_loss(data)[0].backward()
    assert all(gradients(loss.actor_network_params))
    assert not any(gradients(loss.qvalue_network_params))
    loss = make_loss(bc_alpha=alpha)
    loss.value_loss(data)[0].backward()
    assert not any(gradients(loss.actor_network_params))
    grads = gradients(loss.qvalue_network_params)
    assert grads and all(grads)
    logged = loss(data).exclude("loss_actor", "loss_qvalue")
    assert not any(value.requires_grad for value in logged.values())


def test_the_policy_follows_the_first_critic():
    data, loss = make_batch(16), make_loss()
    before, _ = loss.actor_loss(data)
    weight = loss.qvalue_network_params["network", "0", "weight"]
    with torch.no_grad():
        weight[1] += 1.0
    torch.testing.assert_close(loss.actor_loss(data)[0], before)
    with torch.no_grad():
        weight[0] += 1.0
    assert not torch.allclose(loss.actor_loss(data)[0], before)


# --- behaviour cloning ---------------------------------------------------------------


def test_masked_rows_are_not_cloned():
    loss = make_loss(bc_alpha=2.5, bc_mask_key=MASK)
    data = make_batch(40)
    masked = data[MASK].squeeze(-1)
    assert 0 < masked.sum() < 40
    want, before = loss.actor_loss(data)
    other = data.clone()
    other["action"][masked] = -other["action"][masked]
    torch.testing.assert_close(loss.actor_loss(other)[0], want)
    kept = make_loss(bc_alpha=2.5).actor_loss(data[~masked])[1]
    torch.testing.assert_close(before["bc_loss"], kept["bc_loss"])
    other[MASK] = other[MASK].squeeze(-1)
    torch.testing.assert_close(loss.actor_loss(other)[0], want)
    other = data.clone()
    other["action"][~masked] = -other["action"][~masked]
    assert not torch.allclose(loss.actor_loss(other)[0], want)
    data[MASK] = torch.ones(40, 1, dtype=torch.bool)
    nothing, info = loss.actor_loss(data)
    assert info["bc_loss"] == 0.0
    assert nothing.isfinite()


def test_cloning_pulls_towards_the_data():
    """With a weight of 0 on the value, steps on the loss imitate the actions."""
    loss, data = make_loss(bc_alpha=0.0), make_batch(16)
    optimizer = torch.optim.Adam(
        loss.actor_network_params.flatten_keys().values(), lr=1e-2
    )
    errors = []
    for _ in range(200):
        value, info = loss.actor_loss(data)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        errors.append(float(info["bc_loss"]))
    assert errors[-1] < 0.1 * errors[0]


def test_padding_does_not_count():
    loss = make_loss(bc_alpha=2.5, action_penalty=0.1)
    data = make_batch(8)
    torch.manual_seed(3)
    data["collector", "mask"] = torch.arange(8) < 5
    want = loss(data.clone())
    torch.manual_seed(3)
    data["observation"][5:] = 1e6
    data["action"][5:] = -1.0
    got = loss(data)
    for key in ("loss_actor", "loss_qvalue", "lmbd", "bc_loss"):
        torch.testing.assert_close(got[key], want[key])


# --- TorchRL's interface -------------------------------------------------------------


def test_keys_and_dispatch():
    keys = {
        "action": ("agent", "act"),
        "state_action_value": ("agent", "q"),
        "desired_goal": ("task", "wanted"),
        "reward": ("task", "pay"),
        "done": ("task", "end"),
        "terminated": ("task", "over"),
        "priority": ("agent", "priority"),
    }
    layout = make_layout(
        observation_key=("agent", "state"), desired_goal_key=("task", "wanted")
    )
    data = make_batch(6)
    nested = TensorDict(
        {
            "agent": {"state": data["observation"], "act": data["action"]},
            "task": {"wanted": data["desired_goal"]},
            "next": {
                "agent": {"state": data["next", "observation"]},
                "task": {
                    "pay": data["next", "reward"],
                    "end": data["next", "done"],
                    "over": data["next", "terminated"],
                    "wanted": torch.full((6, G), float("nan")),
                },
            },
        },
        [6],
    )
    loss = make_loss(layout=layout, keys=keys, gamma=GAMMA)
    torch.manual_seed(3)
    got = loss(nested)
    plain = make_loss()
    torch.manual_seed(3)
    want = plain(data)
    for key in plain.out_keys:
        torch.testing.assert_close(got[key], want[key])
    torch.testing.assert_close(nested["agent", "priority"], data["td_error"])
    assert loss.in_keys == [
        ("agent", "act"),
        ("agent", "state"),
        ("task", "wanted"),
        ("next", "agent", "state"),
        ("next", "task", "pay"),
        ("next", "task", "end"),
        ("next", "task", "over"),
    ]
    torch.manual_seed(3)
    out = plain(
        observation=data["observation"],
        desired_goal=data["desired_goal"],
        action=data["action"],
        next_observation=data["next", "observation"],
        next_reward=data["next", "reward"],
        next_done=data["next", "done"],
        next_terminated=data["next", "terminated"],
    )
    assert len(out) == len(plain.out_keys) == 6
    torch.testing.assert_close(out[1], want["loss_qvalue"])
    plain.select_out_keys("loss_actor", "loss_qvalue")
    assert set(plain(data).keys()) == {"loss_actor", "loss_qvalue"}


def test_out_keys_name_what_comes_out():
    for kwargs in ({}, {"bc_alpha": 2.5, "bc_mask_key": MASK}):
        loss = make_loss(**kwargs)
        assert set(loss(make_batch(4)).keys()) == set(loss.out_keys)
        assert (MASK in loss.in_keys) == bool(kwargs)
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(nonsense="x")


@pytest.mark.parametrize("make", ["instance", "class", "kind"])
def test_estimators_read_the_renamed_leaves(make):
    loss, data = make_loss(reduction="none"), make_batch(6)
    data["next", "pay"] = data["next", "reward"] - 0.25
    data["next", "over"] = ~data["next", "terminated"]
    loss.set_keys(reward="pay", terminated="over")
    if make == "instance":
        loss.make_value_estimator(TD0Estimator(gamma=0.5, value_network=None))
    elif make == "class":
        loss.make_value_estimator(TD0Estimator, gamma=0.5, value_network=None)
    else:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.5)
    out = loss(data)
    live = 1.0 - data["next", "over"].squeeze(-1).float()
    want = data["next", "pay"].squeeze(-1) + 0.5 * live * out["next_state_value"]
    torch.testing.assert_close(out["target_value"], want.clamp(-2.0, 0.0))


def test_weights_of_prioritised_replay():
    data = make_batch(6)
    torch.manual_seed(3)
    rows = make_loss(reduction="none")(data.clone())
    data["priority_weight"] = torch.rand(6)
    torch.manual_seed(3)
    got = make_loss()(data)
    weight = data["priority_weight"]
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(got[key], (rows[key] * weight).sum() / weight.sum())
    want = (rows["pred_value"] - rows["target_value"]).square().amax(0)
    torch.testing.assert_close(data["td_error"], want)


def test_soft_update():
    loss = make_loss()
    updater = SoftUpdate(loss, tau=0.25)
    before = loss.target_qvalue_network_params.clone()
    actor_before = loss.target_actor_network_params.clone()
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(1.0)
    updater.step()
    for old, new in (
        (before, loss.target_qvalue_network_params),
        (actor_before, loss.target_actor_network_params),
    ):
        for key, value in new.items(True, True):
            moved = 0.25 if "network" in key else 0.0
            torch.testing.assert_close(value, old[key] + moved)


def test_state_dict_and_copies():
    loss, data = make_loss(bc_alpha=2.5), make_batch(6)
    other = make_loss(bc_alpha=2.5)
    for parameter in other.parameters():
        parameter.data.normal_()
    other.load_state_dict(loss.state_dict())
    for one in (other, copy.deepcopy(loss)):
        torch.manual_seed(3)
        want = loss(data)
        torch.manual_seed(3)
        got = one(data)
        for key in loss.out_keys:
            torch.testing.assert_close(got[key], want[key])


def test_a_change_of_dtype_after_use():
    loss, data = make_loss(), make_batch(6)
    loss(data)
    want = loss.double().actor_loss(data.to(torch.float64))[0]
    fresh = make_loss().double().actor_loss(data.to(torch.float64))[0]
    torch.testing.assert_close(want, fresh)
    assert want.dtype == torch.float64


def test_reduced_precision():
    data = make_batch(200)
    torch.manual_seed(3)
    want = make_loss()(data)
    torch.manual_seed(3)
    got = make_loss(dtype=torch.bfloat16)(data)
    for key in ("loss_actor", "loss_qvalue"):
        assert got[key].dtype == torch.float32
        assert got[key] != want[key]
        torch.testing.assert_close(got[key], want[key], rtol=0.02, atol=0.002)


def test_action_spec_bounds_the_smoothed_action():
    spec = Bounded(-0.1, 0.1, shape=(A,))
    seen = []
    loss = make_loss(action_spec=spec)
    loss.qvalue_network.register_forward_pre_hook(
        lambda module, args: seen.append(args[0]["action"].detach().clone())
    )
    batch = make_batch(50)
    batch["action"] *= 0.1
    loss.value_loss(batch)
    of_targets, of_critics = seen
    assert of_targets.shape == of_critics.shape == (1, 50, A)
    assert of_targets.abs().max() <= 0.1 + 1e-6
    assert (of_targets.abs() > 0.09).any()
    assert torch.equal(of_critics, batch["action"].unsqueeze(0))


def test_layers_of_critics_call_their_hooks():
    loss, batch, calls = make_loss(), make_batch(5), []
    layer = loss.qvalue_network.network[0]
    layer.register_forward_hook(lambda *args: calls.append(args))
    loss.value_loss(batch)
    assert len(calls) == 4  # two critics, of values and of targets
    loss.actor_loss(batch)
    assert len(calls) == 5


@pytest.mark.parametrize("which", ["value_loss", "actor_loss"])
def test_actions_outside_of_their_bounds_are_refused(which):
    batch = make_batch(50)
    bounds = batch["action"].clone().abs().max().item()
    batch["action"][7, 1] = -1.01
    for loss in (make_loss(), make_loss(bounds=(-1.0, 1.0))):
        message = (
            r"'action' is -1\.01 in column 1 of row 7, expected \[-1, 1\] \(1 such"
        )
        for _ in range(2):
            with pytest.raises(ValueError, match=message):
                getattr(loss, which)(batch)
    getattr(make_loss(bounds=(-1.011, 1.0)), which)(batch)
    getattr(make_loss(bounds=(-1.009, 1.0)), which)(batch)  # rounding
    batch["action"][7, 1] = float("nan")
    with pytest.raises(ValueError, match="'action' is nan in column 1 of row 7"):
        getattr(make_loss(), which)(batch)
    degrees = make_batch(50)
    degrees["action"] *= 90 / bounds
    spec = Bounded(-90.0, 90.0, shape=(A,))
    getattr(make_loss(action_spec=spec), which)(degrees)
    with pytest.raises(ValueError, match=r"\d+ such rows of 50.: give bounds or"):
        getattr(make_loss(), which)(degrees)


def test_input_is_not_changed():
    data = make_batch(5)
    before = data.clone().lock_()
    loss = make_loss(bc_alpha=2.5, bc_mask_key=MASK)
    loss.value_loss(data)
    loss.actor_loss(data)
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()
    loss.value_loss(before)
    loss.actor_loss(before)


# --- errors --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"reward_bounds": (0.0, -1.0)}, "reward_bounds"),
        ({"target_bounds": (1.0, 1.0)}, "target_bounds"),
        ({"target_bounds": (-1.0, 0.0), "reward_bounds": (0.0, 1.0)}, "give one"),
        ({"action_penalty": -1.0}, "action_penalty"),
        ({"action_penalty": float("nan")}, "action_penalty"),
        ({"bc_alpha": -1.0}, "bc_alpha"),
        ({"bc_mask_key": MASK}, "give bc_alpha"),
        ({"bounds": (-1.0, 1.0), "action_spec": Bounded(-1, 1, (A,))}, "bounds"),
    ],
)
def test_bad_arguments(kwargs, match):
    with pytest.raises(ValueError, match=match):
        make_loss(**kwargs)


@pytest.mark.parametrize(
    "key",
    [
        "observation",
        "desired_goal",
        "action",
        ("next", "observation"),
        ("next", "reward"),
        ("next", "terminated"),
        MASK,
    ],
)
def test_missing_leaves(key):
    loss = make_loss(bc_alpha=2.5, bc_mask_key=MASK)
    with pytest.raises(KeyError, match="the data lack") as error:
        loss(make_batch(4).exclude(key))
    assert f"lack {key!r}; they have" in error.value.args[0]


def test_bad_leaves():
    loss = make_loss(bc_alpha=2.5, bc_mask_key=MASK)
    data = make_batch(4)
    data["desired_goal"] = torch.zeros(4, 7)
    for part in (loss.actor_loss, loss.value_loss):
        with pytest.raises(ValueError, match="has 7 columns, expected 2"):
            part(data)
    for name in ("reward", "terminated"):
        data = make_batch(4)
        data["next", name] = data["next", name].squeeze(-1)
        with pytest.raises(ValueError, match=rf"'{name}'\) has the shape \[4\], exp"):
            loss(data)
    data = make_batch(4)
    data[MASK] = torch.ones(4, 1)
    with pytest.raises(ValueError, match=r"counterfactual.*float32 of.*expected bool"):
        loss(data)


def test_networks_must_read_the_goal():
    loss = make_loss()
    loss.set_keys(desired_goal="desired_goal")
    with pytest.raises(ValueError, match=r"not the goal 'wanted'.*set_keys\(desired"):
        loss.set_keys(desired_goal="wanted")


# --- learning ------------------------------------------------------------------------


def reach_data(rows: int) -> TensorDict:
    """Random steps of a point on a line, goals drawn like hindsight does."""
    generator = torch.Generator().manual_seed(0)

    def draw() -> torch.Tensor:
        return torch.rand(rows, 1, generator=generator) * 2 - 1

    state, action, goal = draw(), draw(), draw()
    after = (state + 0.2 * action).clamp(-1, 1)
    near = torch.rand(rows, 1, generator=generator) < 0.3
    goal = torch.where(near, after + 0.1 * draw(), goal)
    reached = (after - goal).abs() < 0.1
    never = torch.zeros(rows, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": state,
            "desired_goal": goal,
            "action": action,
            "next": {
                "observation": after,
                "desired_goal": -goal,  # from before the relabelling
                "reward": reached.float() - 1.0,
                "terminated": never,
                "done": never,
            },
        },
        [rows],
    )


@torch.no_grad()
def reached_share(actor, steps: int = 15) -> torch.Tensor:
    """Of 21 x 21 starts and goals on the line, those that end within 0.1."""
    line = torch.linspace(-0.95, 0.95, 21)
    state, goal = (x.reshape(-1, 1) for x in torch.meshgrid(line, line, indexing="ij"))
    for _ in range(steps):
        td = TensorDict({"observation": state, "desired_goal": goal}, [len(state)])
        state = (state + 0.2 * actor(td)["action"]).clamp(-1, 1)
    return ((state - goal).abs() < 0.1).float().mean()


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_learns_to_reach_goals_from_random_data(dtype):
    torch.manual_seed(0)
    layout = EntityLayout({"point": [0]}, goal={"point": [0]}, achieved={"point": [0]})
    data = reach_data(20_000)
    features = GoalFeatures(layout).fit_statistics(data)
    actor = GoalConditionedActor(features, 1, (64, 64), hidden_dtype=dtype)
    critics = [
        GoalConditionedCritic(features, 1, (64, 64), hidden_dtype=dtype)
        for _ in range(2)
    ]
    loss = GoalConditionedTD3Loss(actor, critics).make_value_estimator(gamma=0.9)
    updater = SoftUpdate(loss, tau=0.02)
    critic_optimizer, actor_optimizer = (
        torch.optim.Adam(params.flatten_keys().values(), lr=2e-3)
        for params in (loss.qvalue_network_params, loss.actor_network_params)
    )
    untrained = reached_share(actor)
    for step in range(300):
        batch = data[torch.randint(len(data), (256,))]
        loss.value_loss(batch)[0].backward()
        critic_optimizer.step()
        critic_optimizer.zero_grad()
        if step % 2:
            loss.actor_loss(batch)[0].backward()
            actor_optimizer.step()
            actor_optimizer.zero_grad()
            updater.step()
    assert untrained < 0.3
    assert reached_share(actor) > 0.95


# --- on a GPU ------------------------------------------------------------------------


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_losses_of_a_gpu_are_those_of_the_cpu_and_wait_for_nothing(dtype):
    batch = make_batch(64)
    found = []
    for device in ("cpu", "cuda"):
        loss = make_loss(dtype=dtype, policy_noise=0.0, bc_alpha=2.5, device=device)
        updater, rows = SoftUpdate(loss, tau=0.5), batch.to(device)
        loss.value_loss(rows)
        with nothing_waits():
            values = [loss.value_loss(rows)[0], loss.actor_loss(rows)[0]]
            updater.step()
        assert all(value.device.type == device for value in values)
        found.append(torch.stack(values).detach().cpu())
    tolerance = (
        {"atol": 1e-5, "rtol": 1e-4} if dtype is None else {"atol": 0.02, "rtol": 0.02}
    )
    torch.testing.assert_close(found[1], found[0], **tolerance)


@pytest.mark.slow
def test_compiles_without_graph_breaks(monkeypatch):
    monkeypatch.setattr(linear, "_SMALL", 0)  # the choice of the library is traced too
    loss, data = make_loss(), make_batch(8)
    torch.manual_seed(0)
    want = loss(data)
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    torch.manual_seed(0)
    got = compiled(data)
    for key in loss.out_keys:
        torch.testing.assert_close(got[key], want[key])
    (got["loss_actor"] + got["loss_qvalue"]).backward()
    assert all(parameter.grad is not None for parameter in loss.parameters())
