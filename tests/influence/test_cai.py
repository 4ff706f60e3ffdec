"""Tests of causal action influence against oracles, bounds and Monte Carlo."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import cai, mixture_divergence
from torchrl_caiac.influence.cai import CAI, causal_action_influence, draw_actions
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.modules.transformer_world_model import TransformerWorldModel

APPROXIMATIONS: tuple[Any, ...] = ("bounds", "product")
LAYOUT = EntityLayout({"arm": [0, 1], "cup": [3, 2, 4]})


def oracle(loc: list[Any], var: list[Any], approximation: str) -> float:
    """Eq. 3 in plain Python: loc and var are [K][d] lists."""
    k, d = len(loc), len(loc[0])
    total = 0.0
    for i in range(k):
        variational = product = own = 0.0
        for c in range(d):
            if approximation == "product":
                own += -0.5 * math.log(2 * math.pi * 2 * var[i][c])
            else:
                own += -0.5 * math.log(2 * math.pi * math.e * var[i][c])
        for j in range(k):
            kl = log_product = 0.0
            for c in range(d):
                m, n, v, w = loc[i][c], loc[j][c], var[i][c], var[j][c]
                kl += 0.5 * (math.log(w / v) + (v + (m - n) ** 2) / w - 1)
                log_product -= 0.5 * math.log(2 * math.pi * (v + w))
                log_product -= 0.5 * (m - n) ** 2 / (v + w)
            variational += math.exp(-kl) / k
            product += math.exp(log_product - own) / k
        total += max(0.0, -math.log(variational)) / 2
        total += max(0.0, -math.log(product) if product else math.inf) / 2
    return total / k


def monte_carlo(
    loc: torch.Tensor, var: torch.Tensor, draws: int = 20_000
) -> tuple[float, float]:
    """The true value of eq. 3 for [K, d] in float64, and its standard error."""
    k, d = loc.shape
    generator = torch.Generator().manual_seed(0)
    values = []
    for i in range(k):
        noise = torch.randn(draws, d, generator=generator, dtype=loc.dtype)
        x = loc[i] + var[i].sqrt() * noise
        logs = -0.5 * ((x[:, None] - loc).square() / var + var.log()).sum(-1)
        values.append(logs[:, i] - torch.logsumexp(logs, -1) + math.log(k))
    stacked = torch.stack(values)
    error = (stacked.var(1) / draws).sum().sqrt() / k
    return stacked.mean().item(), error.item()


def gaussians(
    seed: int, k: int, d: int, spread: float, log_var: float, *batch: int
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, k, d)
    loc = spread * torch.randn(shape, generator=generator, dtype=torch.float64)
    var = (log_var * torch.randn(shape, generator=generator, dtype=torch.float64)).exp()
    return loc, var


mixtures = st.builds(
    gaussians,
    st.integers(0, 10_000),
    st.integers(1, 9),
    st.integers(1, 7),
    st.sampled_from([0.0, 0.01, 0.3, 1.0, 5.0, 40.0]),
    st.sampled_from([0.0, 0.1, 1.0, 3.0]),
)


@settings(max_examples=80, deadline=None)
@given(mixture=mixtures, approximation=st.sampled_from(APPROXIMATIONS))
def test_equals_the_plain_oracle_and_stays_in_range(
    mixture: Any, approximation: Any
) -> None:
    loc, var = mixture
    score = causal_action_influence(loc, var, approximation=approximation)
    expected = oracle(loc.tolist(), var.tolist(), approximation)
    k = loc.shape[0]
    expected = min(expected, math.log(k))
    assert abs(score.item() - expected) < 1e-9
    assert 0 <= score <= math.log(k) + 1e-12
    single = causal_action_influence(
        loc.float(), var.float(), approximation=approximation
    )
    assert single.dtype == torch.float32
    assert abs(single.item() - expected) <= max(1e-5, 1e-4 * expected)


@settings(max_examples=40, deadline=None)
@given(
    mixture=mixtures,
    approximation=st.sampled_from(APPROXIMATIONS),
    scale=st.sampled_from([1e-4, 0.5, 1.0, 300.0]),
    shift=st.sampled_from([-50.0, 0.0, 2.0]),
    seed=st.integers(0, 100),
)
def test_invariant_under_affine_maps_and_orders(
    mixture: Any, approximation: Any, scale: float, shift: float, seed: int
) -> None:
    loc, var = mixture
    score = causal_action_influence(loc, var, approximation=approximation)
    generator = torch.Generator().manual_seed(seed)
    k, d = loc.shape
    # A map of its own for each column, signs included.
    a = scale * (torch.rand(d, generator=generator).double() + 0.5)
    a[::2] *= -1
    b = shift * torch.rand(d, generator=generator).double()
    actions = torch.randperm(k, generator=generator)
    columns = torch.randperm(d, generator=generator)
    mapped = causal_action_influence(
        (a * loc + b)[actions][:, columns],
        (a.square() * var)[actions][:, columns],
        approximation=approximation,
    )
    torch.testing.assert_close(mapped, score, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
@pytest.mark.parametrize("d", [1, 4, 9])
def test_no_influence_is_exactly_zero(approximation: Any, d: int) -> None:
    loc, var = gaussians(0, 1, d, 30.0, 2.0, 5)
    loc, var = loc.expand(5, 64, d), var.expand(5, 64, d)
    for dtype in (torch.float32, torch.float64):
        score = causal_action_influence(
            loc.to(dtype), var.to(dtype), approximation=approximation
        )
        assert score.abs().max() < 1e-6


@pytest.mark.parametrize("d", [1, 3, 7])
def test_far_apart_actions_reach_log_k(d: int) -> None:
    loc = torch.arange(16.0)[:, None].expand(16, d) * 1000
    var = torch.ones(16, d)
    product = causal_action_influence(loc, var, approximation="product")
    torch.testing.assert_close(product, torch.tensor(math.log(16)))
    # A lower bound there: the mean of it and of log K.
    bounds = causal_action_influence(loc, var)
    gap = d * (1 - math.log(2)) / 4
    torch.testing.assert_close(bounds, torch.tensor(math.log(16) - gap))


@pytest.mark.parametrize("d", [1, 2, 7])
@pytest.mark.parametrize("spread", [0.05, 0.2, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("log_var", [0.0, 0.3])
def test_near_float64_monte_carlo(d: int, spread: float, log_var: float) -> None:
    loc, var = gaussians(1, 12, d, spread, log_var)
    truth, error = monte_carlo(loc, var)
    score = causal_action_influence(loc, var).item()
    # Its two parts enclose the truth.
    upper = variational(loc, var)
    lower = 2 * score - upper
    assert lower - 4 * error <= truth <= upper + 4 * error
    assert abs(score - truth) <= 0.25 * truth + 0.02
    product = causal_action_influence(loc, var, approximation="product").item()
    assert truth - 4 * error - 1e-3 <= product <= 1.7 * truth + 0.05


def variational(loc: torch.Tensor, var: torch.Tensor) -> float:
    """The upper bound that is one half of the score, in plain torch."""
    kl = (
        (var[None].log() - var[:, None].log())
        + (var[:, None] + (loc[:, None] - loc[None]).square()) / var[None]
        - 1
    ).sum(-1) / 2
    return (math.log(len(loc)) - torch.logsumexp(-kl, -1)).mean().item()


@pytest.mark.parametrize("groups", [1, 4, 16])
@pytest.mark.parametrize("d", [1, 7])
def test_groups_of_actions_against_monte_carlo(groups: int, d: int) -> None:
    loc = torch.zeros(64, d, dtype=torch.float64)
    loc[:groups] = 20.0  # these actions touch the entity, the others do not
    var = torch.ones_like(loc)
    truth, error = monte_carlo(loc, var, 500)
    product = causal_action_influence(loc, var, approximation="product").item()
    assert abs(product - truth) <= 4 * error + 1e-6
    assert 0 < causal_action_influence(loc, var).item() <= truth + 1e-9


@pytest.mark.parametrize("batch", [(), (1,), (7,), (3, 2), (0,), (2, 0, 3)])
@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_batch_shapes_and_chunks(batch: Any, approximation: Any) -> None:
    loc, var = gaussians(3, 10, 3, 1.0, 0.5, *batch)
    score = causal_action_influence(loc, var, approximation=approximation)
    assert score.shape == batch and score.dtype == torch.float64
    # 1 byte forces one row and one action at a time.
    for max_memory in (1, 2_000, 20_000):
        small = causal_action_influence(
            loc, var, approximation=approximation, max_memory=max_memory
        )
        torch.testing.assert_close(small, score)
    view = causal_action_influence(
        loc.flip(-1), var.flip(-1), approximation=approximation
    )
    torch.testing.assert_close(view, score)


def test_extreme_numbers_stay_finite() -> None:
    loc = torch.tensor([[0.0], [1e4], [-1e4], [0.0]])
    for var in ([1e-8, 200.0, 1e-8, 1.0], [1e-30, 1.0, 1e-20, 1e10]):
        for approximation in APPROXIMATIONS:
            score = causal_action_influence(
                loc.expand(4, 6),
                torch.tensor(var)[:, None].expand(4, 6).contiguous(),
                approximation=approximation,
            )
            assert torch.isfinite(score) and 0 <= score <= math.log(4)


def test_no_gradient_and_inputs_untouched() -> None:
    loc, var = gaussians(4, 5, 2, 1.0, 0.5, 3)
    loc.requires_grad_()
    before = (loc.detach().clone(), var.clone())
    score = causal_action_influence(loc, var)
    assert not score.requires_grad
    assert torch.equal(loc.detach(), before[0]) and torch.equal(var, before[1])


@pytest.mark.parametrize(
    ("loc", "var", "message"),
    [
        (torch.zeros(3, 2), torch.ones(3, 1), r"\[3, 2\] and \[3, 1\]"),
        (torch.zeros(3), torch.ones(3), "K and d at least 1"),
        (torch.zeros(0, 2), torch.ones(0, 2), "K and d at least 1"),
        (torch.zeros(3, 0), torch.ones(3, 0), "K and d at least 1"),
        (torch.full((3, 1), math.nan), torch.ones(3, 1), "loc has NaN"),
        (torch.zeros(3, 1), torch.zeros(3, 1), "not positive"),
        (torch.zeros(3, 1), torch.full((3, 1), math.inf), "not positive and finite"),
        (torch.zeros(3, 1).long(), torch.ones(3, 1).long(), "one floating dtype"),
        (torch.zeros(3, 1), torch.ones(3, 1).double(), "one floating dtype"),
    ],
)
def test_wrong_gaussians_are_named(loc: Any, var: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        causal_action_influence(loc, var)


def test_wrong_options_are_named() -> None:
    loc, var = torch.zeros(3, 1), torch.ones(3, 1)
    with pytest.raises(ValueError, match="'mean'"):
        causal_action_influence(loc, var, approximation="mean")  # type: ignore
    with pytest.raises(ValueError, match="max_memory"):
        causal_action_influence(loc, var, max_memory=0)


# --- the estimator -------------------------------------------------------------------


def trained(**kwargs: Any) -> GaussianWorldModel:
    torch.manual_seed(0)
    model = GaussianWorldModel(LAYOUT, 2, (16, 16), **kwargs)
    model.forward_tensors(torch.randn(100, 5), torch.rand(100, 2) * 2 - 1)
    return model


def states(*batch: int, dtype: Any = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    observation = torch.randn(*batch, 5, generator=generator, dtype=dtype)
    return TensorDict({"observation": observation}, batch)


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_estimator_is_eq_3_of_the_models_gaussians(approximation: Any) -> None:
    model = trained(predict={"cup": [4, 2]})
    estimator = CAI(model, num_actions=6, approximation=approximation)
    td = states(4)
    scores = estimator(td)
    assert scores.shape == (4, 2) and scores.dtype == torch.float32
    model.eval()
    for row in range(4):
        loc, var = [], []
        for action in estimator.actions:
            out = model(
                TensorDict({"observation": td["observation"][row], "action": action})
            )
            loc.append(out["prediction", "loc"].tolist())
            var.append(out["prediction", "var"].tolist())
        for name, where in (("arm", slice(0, 2)), ("cup", slice(2, 4))):
            expected = oracle(
                [x[where] for x in loc], [x[where] for x in var], approximation
            )
            got = scores[row, LAYOUT.index(name)].item()
            assert abs(got - expected) <= max(1e-5, 1e-4 * expected)


@pytest.mark.parametrize("batch", [(), (1,), (9,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_estimator_batch_shapes_and_dtypes(batch: Any, dtype: Any) -> None:
    estimator = CAI(trained(), num_actions=5)
    scores = estimator(states(*batch, dtype=dtype))
    assert scores.shape == (*batch, 2) and scores.dtype == torch.float32
    if scores.numel() and dtype == torch.float32:
        flat = estimator(states(*batch).reshape(-1))
        torch.testing.assert_close(scores.reshape(-1, 2), flat)


def test_chunks_and_storages_make_no_difference(tmp_path: Path) -> None:
    model, td = trained(), states(50)
    scores = CAI(model, num_actions=8)(td)
    for max_memory in (1, 5_000, 100_000):
        small = CAI(model, num_actions=8, max_memory=max_memory)
        torch.testing.assert_close(small(td), scores, atol=1e-6, rtol=1e-5)
    mapped = td.memmap(tmp_path)
    assert torch.equal(CAI(model, num_actions=8)(mapped), scores)
    assert sorted(mapped.keys()) == ["observation"]


def test_nested_layout() -> None:
    layout = EntityLayout.from_keys({"arm": ("o", "arm"), "cup": ("o", "cup")})
    flat = states(6)
    x = flat["observation"]
    td = TensorDict(
        {"o": {"arm": x[:, :2], "cup": {"a": x[:, 3:4], "b": x[:, [2, 4]]}}}, [6]
    )
    model = trained()
    other = GaussianWorldModel(layout, 2, (16, 16), widths=layout.widths(td))
    values = {k: v for k, v in model.state_dict().items() if "extra" not in k}
    other.load_state_dict({**values, "_extra_state": other.get_extra_state()})
    torch.testing.assert_close(CAI(other)(td), CAI(model)(flat))
    assert CAI(other)(td.reshape(2, 3)).shape == (2, 3, 2)


def test_modes_are_restored_and_nothing_is_learnt() -> None:
    model = trained()
    model.train()
    model.state_norm.eval()
    count = model.action_norm.count.clone()
    scores = CAI(model)(states(5))
    assert not scores.requires_grad
    assert model.training and model.action_norm.training
    assert not model.state_norm.training
    assert torch.equal(model.action_norm.count, count)
    bad = states(5)
    bad["observation"][3, 2] = math.inf
    with pytest.raises(
        ValueError, match="'observation' is inf for entity 'cup' in row 3"
    ):
        CAI(model)(bad)
    assert model.training and not model.state_norm.training


def test_actions_are_drawn_once_within_the_spec() -> None:
    spec = Bounded(torch.tensor([-2.0, 5.0]), torch.tensor([0.0, 5.5]), (2,))
    model = trained()
    estimator = CAI(model, num_actions=500, action_spec=spec)
    actions = estimator.actions
    assert actions.shape == (500, 2)
    low, high = actions.amin(0), actions.amax(0)
    torch.testing.assert_close(low, torch.tensor([-2.0, 5.0]), atol=0.05, rtol=0)
    torch.testing.assert_close(high, torch.tensor([0.0, 5.5]), atol=0.05, rtol=0)
    assert (low >= spec.space.low).all() and (high <= spec.space.high).all()
    assert torch.equal(CAI(model, seed=3).actions, CAI(model, seed=3).actions)
    assert not torch.equal(CAI(model, seed=3).actions, CAI(model, seed=4).actions)
    generator = torch.Generator().manual_seed(3)
    assert torch.equal(
        CAI(model, generator=generator).actions, CAI(model, seed=3).actions
    )
    before = estimator.actions.clone()
    estimator(states(4))
    assert torch.equal(estimator.actions, before)
    assert "actions" in estimator.state_dict()
    default = CAI(model, num_actions=500).actions
    assert -1 <= default.min() < -0.98 and 0.98 < default.max() <= 1
    assert draw_actions(3, torch.zeros(1), torch.zeros(1)).tolist() == [[0.0]] * 3


def test_an_entity_that_follows_the_action_scores_above_one_that_does_not() -> None:
    model = trained()
    with torch.no_grad():
        model.loc_head.weight[2:] = 0  # the cup's Gaussian ignores everything
        model.var_head.weight[2:] = 0
    scores = CAI(model)(states(20))
    assert (scores[:, 1] < 1e-6).all() and (scores[:, 0] > 1e-3).all()


def test_wrong_arguments_are_named() -> None:
    model = trained(predict={"cup": ()})
    with pytest.raises(ValueError, match=r"predicts no column of \['cup'\]"):
        CAI(model)
    model = trained()
    for kwargs, message in (
        ({"num_actions": 1}, "num_actions .* got 1"),
        ({"approximation": "mean"}, "'mean'"),
        ({"max_memory": 0}, "max_memory"),
        ({"mode": "quick"}, "'quick'"),
        ({"mode": "fast"}, "needs the threshold .* got None"),
        ({"mode": "fast", "threshold": 0.0}, "above 0, got 0.0"),
        ({"mode": "fast", "threshold": 1.0, "num_actions": 16}, "num_actions=16"),
        ({"action_spec": Bounded(-1, 1, (3,))}, r"shape \[3\].*\[2\]"),
        ({"action_spec": Bounded(-1, 1, (4, 2))}, r"shape \[4, 2\]"),
        ({"action_spec": Bounded(-math.inf, 1, (2,))}, "infinite bounds"),
    ):
        with pytest.raises(ValueError, match=message):
            CAI(model, **kwargs)  # type: ignore[arg-type]
    transformer = TransformerWorldModel(LAYOUT, 2, layers=1, heads=1, width=4)
    with pytest.raises(TypeError, match="a TransformerWorldModel has no distribution"):
        CAI(transformer)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="Bounded spec, got Unbounded"):
        CAI(model, action_spec=Unbounded((2,)))  # type: ignore[arg-type]
    with pytest.raises(KeyError, match="observation"):
        CAI(model)(TensorDict({}, [3]))
    with pytest.raises(ValueError, match="has 4 columns"):
        CAI(model)(TensorDict({"observation": torch.zeros(3, 4)}, [3]))


_PEAK = """
import torch
from tensordict import TensorDict
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.cai import CAI
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

torch.set_num_threads(1)

def score(rows, entities, actions, hidden):
    layout = EntityLayout({f"e{i}": [2 * i, 2 * i + 1] for i in range(entities)})
    estimator = CAI(GaussianWorldModel(layout, 2, (hidden,)), num_actions=actions)
    td = TensorDict({"observation": torch.zeros(rows, 2 * entities)}, [rows])
    estimator(td)

def peak():
    # ru_maxrss would be inherited from the process that started this one.
    with open("/proc/self/status") as file:
        return next(int(x.split()[1]) for x in file if x.startswith("VmHWM")) / 1024

score(2, 2, 2, 4)
before = peak()
for case in [
    (1_000_000, 2, 2, 4),  # many rows
    (1, 1, 6_000, 8),  # many actions: one tensor [K, K] is 137 MiB
    (2, 1, 2, 65_536),  # wide layers
    (64, 300, 64, 8),  # many entities
]:
    score(*case)
    print(case, peak() - before, "MiB")
"""


def test_peak_memory_stays_far_below_a_gibibyte() -> None:
    result = subprocess.run(
        [sys.executable, "-c", _PEAK], capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    # MiB, the 30 of model, data and scores included.
    assert float(result.stdout.split()[-2]) < 400, result.stdout


def test_memory_limit_bounds_the_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    # As on a GPU, where only max_memory limits the chunks.
    monkeypatch.setattr(mixture_divergence, "_CPU_PAIR_BYTES", 2**40)
    monkeypatch.setattr(cai, "_CPU_GAUSSIAN_BYTES", 2**40)
    monkeypatch.setattr(cai, "_CPU_NETWORK_BYTES", 2**40)
    model = trained()
    estimator = CAI(model, num_actions=16, max_memory=2**20)
    assert 1 < estimator._states_at_once(16) * 16 * 4 * 5 <= 2**18
    torch.testing.assert_close(
        estimator(states(300)), CAI(model, num_actions=16)(states(300))
    )


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_compiled_estimator_agrees_with_the_other(approximation: Any) -> None:
    model = trained(predict={"arm": [0]})  # entities of one and of three columns
    kwargs: dict[str, Any] = {"num_actions": 20, "approximation": approximation}
    slow = CAI(model, compile=False, **kwargs)(states(70))
    for max_memory in (1, 2**17, 2**28):
        fused = CAI(model, compile=True, max_memory=max_memory, **kwargs)(states(70))
        torch.testing.assert_close(fused, slow, atol=1e-6, rtol=1e-5)


def test_enough_states_are_worth_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    fused = []

    def influence(loc: Any, var: Any, slices: Any, **kwargs: Any) -> torch.Tensor:
        fused.append(kwargs["fused"])
        return torch.zeros(len(loc), len(slices))

    monkeypatch.setattr(cai, "mixture_influence", influence)
    monkeypatch.setattr(mixture_divergence, "_LEAST_PAIRS", 10 * 2 * 6 * 6)
    CAI(trained(), num_actions=6)(states(9))
    CAI(trained(), num_actions=6)(states(10))
    CAI(trained(), num_actions=6, compile=False)(states(10))
    CAI(trained(), num_actions=6, compile=True)(states(2))
    estimator = CAI(trained(), num_actions=6)
    estimator.prepare(states(4), 10)  # told of more
    estimator(states(2))
    assert fused == [False, True, False, True, True]


# --- the fast mode -------------------------------------------------------------------


def gated() -> GaussianWorldModel:
    """A model in which the first column says how much of the cup an action moves.

    None at 0, all at 1, and from 0.98 on more and more.
    """
    model = GaussianWorldModel(LAYOUT, 2, (1,))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        model.hidden[0].weight[0, 0] = 100.0
        model.hidden[0].weight[0, 5] = 1.0
        model.hidden[0].bias.fill_(-99.0)
        model.loc_head.weight[2, 0] = 3.0
    return model


def gates(rows: int, near: float) -> TensorDict:
    """States of which few, most or all have some influence."""
    generator = torch.Generator().manual_seed(2)
    observation = torch.zeros(rows, 5)
    draw = torch.rand(rows, generator=generator)
    observation[draw > 0.8, 0] = 1.0
    between = draw < near
    amount = torch.rand(rows, generator=generator)
    observation[between, 0] = 0.98 + 0.02 * amount[between]
    return TensorDict({"observation": observation}, [rows])


def test_fast_mode_is_exact_where_it_matters(caplog: pytest.LogCaptureFixture) -> None:
    model, td = gated(), gates(6_000, 0.2)
    exact = CAI(model)(td)
    fast = CAI(model, mode="fast", threshold=0.1)
    with caplog.at_level("INFO", "torchrl_caiac.cai"):
        scores = fast(td)
    assert "fast mode: states with scores from" in caplog.text
    assert fast._near is not None
    low, high = fast._near
    below = scores <= 0.1
    assert 0.2 < below[:, 1].float().mean() < 0.95
    assert (below == (exact <= 0.1)).double().mean() >= 0.999
    near = (scores[:, 1] > low) & (scores[:, 1] < high)
    assert near.any() and not near.all()
    torch.testing.assert_close(scores[near], exact[near])
    # Elsewhere they are estimates, by other actions.
    assert not torch.equal(scores, exact)
    error = (scores - exact).abs()
    assert (error <= 0.02 + 0.3 * exact).all()
    # A second call does not look around again, and finds the same.
    assert torch.equal(fast(td[:100]), scores[:100])


def test_fast_mode_makes_more_exact_for_means_over_states() -> None:
    fast = CAI(gated(), mode="fast", threshold=0.1)
    td = gates(3_000, 0.2)
    fast.prepare(td, 3_000)
    assert fast._near is not None
    low, high = fast._near
    fast.prepare(td, 3_000, smoothing=10)
    assert fast._near == pytest.approx((low, 10 * high))


def test_fast_mode_falls_back_where_its_masks_are_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, td = gated(), gates(500, 0.8)
    # A first look that sees nothing.
    monkeypatch.setattr(cai, "_spread", lambda actions, count: [0] * count)
    fast = CAI(model, mode="fast", threshold=0.1)
    with pytest.warns(RuntimeWarning, match=r"cannot be used: .* wanted 99\.95%"):
        scores = fast(td)
    assert torch.equal(scores, CAI(model)(td))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(fast(td), scores)


def test_fixed_entities_may_be_near() -> None:
    layout = EntityLayout(LAYOUT.columns, fixed=("cup",))
    model = GaussianWorldModel(layout, 2, (1,))
    fast = CAI(model, mode="fast", threshold=0.1)
    scores = torch.tensor([[0.0, 0.1], [0.1, 0.0], [0.3, 0.3]])
    assert fast._any_within(scores, (0.05, 0.2)).tolist() == [False, True, False]


def test_first_look_is_by_actions_far_from_each_other() -> None:
    actions = draw_actions(64, -torch.ones(2), torch.tensor([1.0, 99.0]))
    chosen = cai._spread(actions, 16)
    assert len(set(chosen)) == 16
    unit = actions / actions.std(0)
    apart = torch.cdist(unit[chosen], unit[chosen]).fill_diagonal_(9).min()
    first = torch.cdist(unit[:16], unit[:16]).fill_diagonal_(9).min()
    assert apart > 2 * first


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_fast_mode_passes_over_what_is_not_finite_until_it_is_scored(
    bad: float,
) -> None:
    td = gates(50, 0.2)
    td["observation"][7, 1] = bad
    fast = CAI(gated(), mode="fast", threshold=0.1)
    fast.prepare(td, 50)
    with pytest.raises(ValueError, match="in row 7"):
        fast(td)
    fast.prepare(td[7:8], 1)
    assert fast(td[:5]).shape == (5, 2)


def test_modes_are_told_apart() -> None:
    model = gated()
    assert repr(CAI(model)) != repr(CAI(model, mode="fast", threshold=0.1))
    assert "mode='fast', threshold=0.1" in repr(
        CAI(model, mode="fast", threshold=0.1, compile=True)
    )
    assert repr(CAI(model)) == repr(CAI(model, compile=True))
