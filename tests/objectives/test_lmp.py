"""Tests of the LMP loss: KL values and gradient shares, masks, learning."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_caiac.modules.lmp import LMPModel, gaussian_plan
from torchrl_caiac.objectives.lmp import LMPLoss, balanced_kl, gaussian_kl

D, G, A, K, P = 5, 2, 3, 6, 4


def make_model(**kwargs) -> LMPModel:
    torch.manual_seed(0)
    return LMPModel(D, G, A, K, plan_dim=P, hidden_size=16, **kwargs)


def make_batch(*batch: int, window: int = K) -> TensorDict:
    torch.manual_seed(1)
    return TensorDict(
        {
            "observation": torch.randn(*batch, window, D),
            "action": torch.rand(*batch, window, A) * 2 - 1,
            "desired_goal": torch.randn(*batch, window, G),
        },
        batch_size=[*batch, window],
    )


def make_loss(model=None, **kwargs) -> LMPLoss:
    generator = torch.Generator().manual_seed(2)
    return LMPLoss(model or make_model(), generator=generator, **kwargs)


def gaussians(seed: int, *shape: int, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    make = [torch.randn(*shape, generator=g, dtype=dtype) for _ in range(4)]
    return make[0], 0.7 * make[1], make[2], 0.7 * make[3]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 12))
def test_kl_against_torch_distributions(seed, batch, width):
    loc_q, log_std_q, loc_p, log_std_p = gaussians(seed, batch, width)
    got = gaussian_kl(loc_q, log_std_q, loc_p, log_std_p)
    want = kl_divergence(
        Independent(Normal(loc_q, log_std_q.exp()), 1),
        Independent(Normal(loc_p, log_std_p.exp()), 1),
    )
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)
    assert (got >= 0).all()
    zero = gaussian_kl(loc_q, log_std_q, loc_q, log_std_q)
    torch.testing.assert_close(zero, torch.zeros_like(zero))


def test_kl_against_monte_carlo():
    """A million float64 draws, 4 standard errors; deviations would be far off."""
    loc_q, log_std_q, loc_p, log_std_p = gaussians(3, P)
    generator = torch.Generator().manual_seed(4)
    draws = 1_000_000
    q = Independent(Normal(loc_q, log_std_q.exp()), 1)
    p = Independent(Normal(loc_p, log_std_p.exp()), 1)
    noise = torch.randn(draws, P, generator=generator, dtype=torch.float64)
    z = gaussian_plan(loc_q, log_std_q, noise)
    ratio = q.log_prob(z) - p.log_prob(z)
    mean, deviation = ratio.mean().item(), ratio.std().item()
    got = gaussian_kl(loc_q, log_std_q, loc_p, log_std_p).item()
    error = 4 * deviation / math.sqrt(draws)
    assert abs(got - mean) < error
    wrong = gaussian_kl(loc_q, 0.5 * log_std_q, loc_p, 0.5 * log_std_p).item()
    assert abs(wrong - mean) > 5 * error


@pytest.mark.parametrize("balance", [0.0, 0.3, 0.8, 1.0])
def test_balanced_kl_shares_the_gradient_exactly(balance):
    inputs = [x.requires_grad_() for x in gaussians(5, 7, P)]
    plain = gaussian_kl(*inputs)
    whole = torch.autograd.grad(plain.sum(), inputs)
    shared = balanced_kl(*inputs, balance)
    torch.testing.assert_close(shared, plain)
    parts = torch.autograd.grad(shared.sum(), inputs)
    for part, full, share in zip(
        parts, whole, [1 - balance, 1 - balance, balance, balance], strict=True
    ):
        torch.testing.assert_close(part, share * full)


def test_loss_shares_the_gradient_between_the_networks():
    """Through the networks: 0.8 of the KL's gradient for the prior, 0.2 for q."""
    model = make_model().double()
    batch = make_batch(8).double()
    loss = LMPLoss(model, kl_weight=0.5)
    prior = list(model.prior.parameters())
    posterior = list(model.posterior.parameters())
    got = torch.autograd.grad(
        loss(batch)["loss_kl"], prior + posterior, allow_unused=True
    )
    q = model.posterior.module(batch["observation"], batch["action"])
    p = model.prior.module(batch["observation"][:, 0], batch["desired_goal"][:, 0])
    want = torch.autograd.grad(0.5 * gaussian_kl(*q, *p).mean(), prior + posterior)
    for i, (a, b) in enumerate(zip(got, want, strict=True)):
        share = 0.8 if i < len(prior) else 0.2
        torch.testing.assert_close(a, share * b, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_values_against_a_slow_oracle(decoder, batch):
    model = make_model(decoder=decoder)
    data = make_batch(*batch)
    losses = make_loss(model, kl_weight=0.3, reduction="none")(data)
    assert losses.batch_size == torch.Size(batch)
    noise = torch.randn(*batch, P, generator=torch.Generator().manual_seed(2))
    flat = data.reshape(-1, K)
    noise = noise.reshape(-1, P)
    reconstruction, divergence = [], []
    for row in range(flat.shape[0]):
        obs, act = flat["observation"][row], flat["action"][row]
        q_loc, q_log_std = model.posterior.module(obs, act)
        p_loc, p_log_std = model.prior.module(obs[0], flat["desired_goal"][row, 0])
        plan = q_loc + q_log_std.exp() * noise[row]
        if decoder == "open_loop":
            out = model.decoder.module(plan)
        else:
            out = torch.stack([model.decoder.module(plan, obs[t]) for t in range(K)])
        steps = [((out[t] - act[t]) ** 2).sum() for t in range(K)]
        reconstruction.append(2.0 * sum(steps) / K)
        q, p = Normal(q_loc, q_log_std.exp()), Normal(p_loc, p_log_std.exp())
        divergence.append(0.3 * kl_divergence(q, p).sum())
    got = losses["loss_reconstruction"].reshape(-1)
    torch.testing.assert_close(got, torch.stack(reconstruction), rtol=1e-4, atol=1e-5)
    got = losses["loss_kl"].reshape(-1)
    torch.testing.assert_close(got, torch.stack(divergence), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["mse"] * 2 * A, losses["loss_reconstruction"])
    torch.testing.assert_close(losses["kl"] * 0.3, losses["loss_kl"])
    assert not losses["kl"].requires_grad
    assert not losses["mse"].requires_grad


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_reductions(reduction):
    model, batch = make_model(), make_batch(4)
    rows = make_loss(model, reduction="none")(batch)
    got = make_loss(model, reduction=reduction)(batch)
    for key in make_loss().out_keys:
        torch.testing.assert_close(got[key], getattr(rows[key], reduction)())


@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("last_dim", [False, True])
@pytest.mark.parametrize("key", ["mask", ("collector", "mask")])
def test_padded_steps_do_not_matter(decoder, last_dim, key):
    model, batch = make_model(decoder=decoder), make_batch(4)
    mask = torch.arange(K) < torch.tensor([[1], [3], [K], [K - 1]])
    batch.set(key, mask.unsqueeze(-1) if last_dim else mask)
    first = make_loss(model)(batch)
    for leaf in ("observation", "action"):
        batch[leaf] = batch[leaf].masked_fill(~mask.unsqueeze(-1), float("nan"))
    second = make_loss(model)(batch)
    for name in make_loss().out_keys:
        torch.testing.assert_close(first[name], second[name])
    sum(v for k, v in second.items() if k.startswith("loss")).backward()
    for parameter in model.parameters():
        assert parameter.grad.isfinite().all()


def test_mask_of_all_true_changes_nothing():
    model, batch = make_model(), make_batch(4)
    plain = make_loss(model)(batch)
    batch["mask"] = torch.ones(4, K, dtype=torch.bool)
    masked = make_loss(model)(batch)
    for name in make_loss().out_keys:
        torch.testing.assert_close(plain[name], masked[name])


def test_shorter_windows_need_a_mask():
    batch = make_batch(4, window=K - 2)
    with pytest.raises(ValueError, match=f"windows of {K - 2} steps, expected {K}"):
        make_loss()(batch)
    batch["mask"] = torch.ones(4, K - 2, dtype=torch.bool)
    assert make_loss()(batch)["loss_reconstruction"].isfinite()
    long = make_batch(4, window=K + 1)
    long["mask"] = torch.ones(4, K + 1, dtype=torch.bool)
    with pytest.raises(ValueError, match="windows of 7 steps"):
        make_loss()(long)


def test_only_the_first_goal_is_read():
    model, batch = make_model(), make_batch(4)
    first = make_loss(model)(batch)
    batch["desired_goal"][:, 1:] = float("nan")
    second = make_loss(model)(batch)
    torch.testing.assert_close(first["loss_kl"], second["loss_kl"])
    batch["desired_goal"][:, 0] += 1.0
    assert not torch.allclose(make_loss(model)(batch)["loss_kl"], first["loss_kl"])


def test_plans_are_sampled_while_learning():
    """Loss modules run in deterministic mode: the sample must be drawn all the same."""
    model, batch = make_model(), make_batch(4)
    loss = LMPLoss(model)
    values = {float(loss(batch)["loss_reconstruction"].detach()) for _ in range(4)}
    assert len(values) == 4
    torch.manual_seed(7)
    first = loss(batch)["loss_reconstruction"]
    torch.manual_seed(7)
    torch.testing.assert_close(loss(batch)["loss_reconstruction"], first)


def test_input_is_not_changed():
    batch = make_batch(4)
    batch["mask"] = torch.arange(K).expand(4, K) < 3
    before = batch.clone()
    make_loss()(batch)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


def test_keys_and_dispatch():
    model = make_model(goal_key=("data", "goal"))
    loss = make_loss(model)
    assert loss.in_keys == ["observation", "action", ("data", "goal")]
    assert loss.out_keys == ["loss_reconstruction", "loss_kl", "kl", "mse"]
    loss.set_keys(observation=("data", "state"), mask="valid", desired_goal="target")
    assert loss.in_keys == [("data", "state"), "action", "target"]
    batch = make_batch(4)
    batch.rename_key_("observation", ("data", "state"))
    batch.rename_key_("desired_goal", "target")
    want = make_loss(make_model())(make_batch(4))
    torch.testing.assert_close(loss(batch)["loss_kl"], want["loss_kl"])
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(nonsense="x")

    data = make_batch(4)
    out = make_loss()(
        observation=data["observation"],
        action=data["action"],
        desired_goal=data["desired_goal"],
    )
    torch.testing.assert_close(out[1], want["loss_kl"])


def test_weights_are_schedulable_and_saved():
    loss = make_loss()
    loss.kl_weight = 0.25
    assert isinstance(loss.kl_weight, torch.Tensor)
    other = make_loss()
    other.load_state_dict(loss.state_dict())
    assert float(other.kl_weight) == 0.25
    parameters = {id(p) for p in loss.parameters()}
    assert parameters == {id(p) for p in loss.model.parameters()}


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"kl_weight": -1.0}, "kl_weight"),
        ({"kl_weight": float("nan")}, "kl_weight"),
        ({"kl_balance": 1.5}, "kl_balance"),
        ({"reconstruction_weight": -1.0}, "reconstruction_weight"),
        ({"reduction": "max"}, "reduction"),
    ],
)
def test_bad_arguments(kwargs, match):
    with pytest.raises(ValueError, match=match):
        make_loss(**kwargs)


@pytest.mark.parametrize("key", ["observation", "action", "desired_goal"])
def test_bad_leaves(key):
    loss = make_loss()
    with pytest.raises(KeyError, match=key):
        loss(make_batch(4).exclude(key))
    batch = make_batch(4)
    batch[key] = torch.zeros(4, K, 11)
    with pytest.raises(ValueError, match=rf"'{key}' has the shape \[4, 6, 11\]"):
        loss(batch)
    batch = make_batch(4)
    batch[key][1, 0, 1] = float("nan")
    with pytest.raises(ValueError, match=f"'{key}' has 1 non-finite"):
        loss(batch)


def test_bad_shapes():
    loss = make_loss()
    with pytest.raises(ValueError, match=r"batch.reshape\(-1, 6\)"):
        loss(make_batch(4).reshape(-1))
    batch = make_batch(4)
    batch = TensorDict({**batch, "desired_goal": torch.zeros(4, G)}, [4])
    with pytest.raises(ValueError, match=r"'desired_goal'.*must agree"):
        loss(batch)
    with pytest.raises(ValueError, match="no window"):
        loss(make_batch(4)[:0])


@pytest.mark.parametrize(
    ("mask", "match"),
    [
        (torch.ones(4, K), "float32"),
        (torch.ones(4, K - 1, dtype=torch.bool), r"shape \[4, 5\]"),
        (torch.arange(K).expand(4, K) != 2, "first steps"),
        (torch.arange(K).expand(4, K) > 2, "first steps"),
        (torch.zeros(4, K, dtype=torch.bool), "first steps"),
    ],
)
def test_bad_masks(mask, match):
    batch = TensorDict(dict(make_batch(4).items()), [4])
    batch["mask"] = mask
    with pytest.raises(ValueError, match=match):
        make_loss()(batch)


@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
def test_learns_which_actions_lead_to_which_goal(decoder):
    """Four goals, four action sequences: the loss falls and the prior finds them."""
    torch.manual_seed(0)
    table = torch.rand(4, K, A) * 1.6 - 0.8
    goals = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])

    clock = torch.linspace(-1.5, 1.5, K)  # the closed loop has to see the time

    def states(n: int) -> torch.Tensor:
        value = torch.randn(n, K, D)
        value[..., 0] = clock
        return value

    def draw(n: int) -> TensorDict:
        which = torch.randint(0, 4, (n,))
        action = table[which] + 0.02 * torch.randn(n, K, A)
        return TensorDict(
            {
                "observation": states(n),
                "action": action,
                "desired_goal": goals[which].unsqueeze(1).expand(n, K, G),
            },
            batch_size=[n, K],
        )

    model = LMPModel(D, G, A, K, plan_dim=P, hidden_size=32, depth=2, decoder=decoder)
    model.fit_statistics(draw(500))
    loss = LMPLoss(model, kl_weight=0.01)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    history = []
    for _ in range(400):
        losses = loss(draw(64))
        value = losses["loss_reconstruction"] + losses["loss_kl"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        history.append(float(value.detach()))
    start, end = sum(history[:5]) / 5, sum(history[-20:]) / 20
    assert end < 0.15 * start

    which = torch.arange(4).repeat(50)
    observation = states(200)
    with torch.no_grad():
        loc, log_std = model.prior.module(observation[:, 0], goals[which])
        plan = gaussian_plan(loc, log_std, torch.randn_like(loc))
        args = (plan,) if decoder == "open_loop" else (plan, observation)
        actions = model.decoder.module(*args)
    error = (actions - table[which]).square().mean().sqrt()
    wrong = (actions.unsqueeze(1) - table).square().mean((-2, -1)).argmin(1) != which
    assert error < 0.15
    assert not wrong.any()


@pytest.mark.gpu
def test_losses_of_a_gpu_are_those_of_the_cpu():
    batch, found = make_batch(8), []
    for device in ("cpu", "cuda"):
        losses = make_loss(make_model().to(device))(batch.to(device))
        assert all(value.device.type == device for value in losses.values())
        found.append(losses.detach().cpu())
    torch.testing.assert_close(found[1].to_dict(), found[0].to_dict())


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int64, torch.bool])
@pytest.mark.parametrize("decoder", ["open_loop", "closed_loop"])
def test_integers_and_flags_are_the_numbers_that_they_are(dtype, decoder):
    whole = make_batch(8)
    for key in ("observation", "desired_goal"):
        whole[key] = (whole[key] > 0).to(dtype)
    whole["mask"] = torch.ones(8, K, dtype=torch.bool)
    whole["mask"][3, 2:] = False
    exact = whole.clone()
    for key in ("observation", "desired_goal"):
        exact[key] = exact[key].double()
    losses = []
    for td in (whole, exact):
        model = make_model(decoder=decoder).fit_statistics(td)
        losses.append(make_loss(model)(td))
        for name in ("observation_norm", "goal_norm"):
            losses[-1][name] = getattr(model, name).mean
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            losses[-1]["plan"] = model(td[:, 0].clone())["plan"]
    for key, value in losses[0].items():
        torch.testing.assert_close(value, losses[1][key])
