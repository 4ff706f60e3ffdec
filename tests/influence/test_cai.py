"""The estimator of causal action influence, exact and fast."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded

from tests.influence.plain_influence import plain_influence
from tests.influence.scoring import ready
from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import (
    CAI,
    cai,
    mixture_divergence,
)
from torchrl_caiac.influence.cai import draw_actions
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel

APPROXIMATIONS: tuple[Any, ...] = ("bounds", "product")


LAYOUT = EntityLayout({"arm": [0, 1], "cup": [3, 2, 4]})


def trained(**kwargs: Any) -> GaussianWorldModel:
    torch.manual_seed(0)
    model = GaussianWorldModel(LAYOUT, 2, (16, 16), **kwargs)
    model.forward_tensors(torch.randn(100, 5), torch.rand(100, 2) * 2 - 1)
    return ready(model)


def states(*batch: int, dtype: Any = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    observation = torch.randn(*batch, 5, generator=generator, dtype=dtype)
    return TensorDict({"observation": observation}, batch)


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_scores_are_eq_3_of_the_predicted_gaussians(approximation: Any) -> None:
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
            expected = plain_influence(
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
    ready(other)
    torch.testing.assert_close(CAI(other)(td), CAI(model)(flat))
    assert CAI(other)(td.reshape(2, 3)).shape == (2, 3, 2)


def test_restores_training_modes_and_statistics() -> None:
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


def test_rejects_bad_arguments() -> None:
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
    model = GaussianWorldModel(layout, 2, (hidden,))
    model.fit_statistics(torch.ones(1, model.predict_dim))
    model.set_action_bounds(-1.0, 1.0)
    estimator = CAI(model, num_actions=actions)
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
    # MiB, with the 30 of model, data and scores.
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
def test_compiled_and_uncompiled_scores_agree(approximation: Any) -> None:
    model = trained(predict={"arm": [0]})  # entities of one and of three columns
    kwargs: dict[str, Any] = {"num_actions": 20, "approximation": approximation}
    slow = CAI(model, compile=False, **kwargs)(states(70))
    for max_memory in (1, 2**17, 2**28):
        fused = CAI(model, compile=True, max_memory=max_memory, **kwargs)(states(70))
        torch.testing.assert_close(fused, slow, atol=1e-6, rtol=1e-5)


def test_compiles_the_kernel_for_many_states(monkeypatch: pytest.MonkeyPatch) -> None:
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
    estimator.prepare(states(4), 10)  # more are announced
    estimator(states(2))
    assert fused == [False, True, False, True, True]


# --- the fast mode -------------------------------------------------------------------


def gated() -> GaussianWorldModel:
    """A model in which the first column sets the influence on the cup.

    It is none below 0.98, rises from there, and is full at 1.
    """
    model = GaussianWorldModel(LAYOUT, 2, (1,))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        model.hidden[0].weight[0, 0] = 100.0
        model.hidden[0].weight[0, 5] = 1.0
        model.hidden[0].bias.fill_(-99.0)
        model.loc_head.weight[2, 0] = 3.0
    return ready(model)


def gates(rows: int, near: float) -> TensorDict:
    """States; a share ``near`` has a first column between 0.98 and 1."""
    generator = torch.Generator().manual_seed(2)
    observation = torch.zeros(rows, 5)
    draw = torch.rand(rows, generator=generator)
    observation[draw > 0.8, 0] = 1.0
    between = draw < near
    amount = torch.rand(rows, generator=generator)
    observation[between, 0] = 0.98 + 0.02 * amount[between]
    return TensorDict({"observation": observation}, [rows])


def test_fast_mode_is_exact_near_the_threshold(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model, td = gated(), gates(6_000, 0.2)
    exact = CAI(model)(td)
    fast = CAI(model, mode="fast", threshold=0.1)
    with caplog.at_level("INFO", "torchrl_caiac.cai"):
        scores = fast(td)
    assert "fast mode: scores from" in caplog.text
    assert fast._near is not None
    low, high = fast._near
    below = scores <= 0.1
    assert 0.2 < below[:, 1].float().mean() < 0.95
    assert (below == (exact <= 0.1)).double().mean() >= 0.999
    near = (scores[:, 1] > low) & (scores[:, 1] < high)
    assert near.any() and not near.all()
    torch.testing.assert_close(scores[near], exact[near])
    # The others are estimates from fewer actions.
    assert not torch.equal(scores, exact)
    error = (scores - exact).abs()
    assert (error <= 0.02 + 0.3 * exact).all()
    # A second call does not search again and finds the same.
    assert torch.equal(fast(td[:100]), scores[:100])


def test_smoothing_widens_the_range_of_the_fast_mode() -> None:
    fast = CAI(gated(), mode="fast", threshold=0.1)
    td = gates(3_000, 0.2)
    fast.prepare(td, 3_000)
    assert fast._near is not None
    low, high = fast._near
    fast.prepare(td, 3_000, smoothing=10)
    assert fast._near == pytest.approx((low, 10 * high))


def test_fast_mode_falls_back_if_its_masks_are_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, td = gated(), gates(500, 0.8)
    # Estimates from one action are always 0.
    monkeypatch.setattr(cai, "_spread", lambda actions, count: [0] * count)
    fast = CAI(model, mode="fast", threshold=0.1)
    with pytest.warns(RuntimeWarning, match=r"cannot be used: .* expected 99\.95%"):
        scores = fast(td)
    assert torch.equal(scores, CAI(model)(td))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(fast(td), scores)


def test_fixed_entities_do_not_count_as_near() -> None:
    layout = EntityLayout(LAYOUT.columns, fixed=("cup",))
    model = ready(GaussianWorldModel(layout, 2, (1,)))
    fast = CAI(model, mode="fast", threshold=0.1)
    scores = torch.tensor([[0.0, 0.1], [0.1, 0.0], [0.3, 0.3]])
    assert fast._any_within(scores, (0.05, 0.2)).tolist() == [False, True, False]


def test_estimates_are_from_actions_far_from_each_other() -> None:
    actions = draw_actions(64, -torch.ones(2), torch.tensor([1.0, 99.0]))
    chosen = cai._spread(actions, 16)
    assert len(set(chosen)) == 16
    unit = actions / actions.std(0)
    apart = torch.cdist(unit[chosen], unit[chosen]).fill_diagonal_(9).min()
    first = torch.cdist(unit[:16], unit[:16]).fill_diagonal_(9).min()
    assert apart > 2 * first


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_prepare_ignores_states_that_are_not_finite(
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


def test_repr_separates_modes() -> None:
    model = gated()
    assert repr(CAI(model)) != repr(CAI(model, mode="fast", threshold=0.1))
    assert "mode='fast', threshold=0.1" in repr(
        CAI(model, mode="fast", threshold=0.1, compile=True)
    )
    assert repr(CAI(model)) == repr(CAI(model, compile=True))


# --- the bounds of the actions -------------------------------------------------------


def test_a_model_that_was_never_fitted_is_refused() -> None:
    with pytest.raises(ValueError, match="the model was never fitted"):
        CAI(GaussianWorldModel(LAYOUT, 2, (16, 16)))


def test_actions_are_drawn_from_the_bounds_that_the_model_recorded() -> None:
    model = trained()
    model.set_action_bounds([-90.0, 0.0], [90.0, 0.01])
    twin = GaussianWorldModel.from_config(model.config)
    twin.load_state_dict(model.state_dict())
    for one in (model, twin):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            actions = CAI(one, num_actions=500).actions
        assert -90 <= actions[:, 0].min() < -85 and 85 < actions[:, 0].max() <= 90
        assert 0 <= actions[:, 1].min() < 0.001 and 0.009 < actions[:, 1].max() <= 0.01


def test_unknown_bounds_and_other_bounds_are_warned_of() -> None:
    model = trained()
    unknown = GaussianWorldModel(LAYOUT, 2, (16, 16))
    unknown.fit_statistics(torch.ones(1, 5))
    with pytest.warns(UserWarning, match=r"not known, .* drawn from \[-1, 1\]"):
        actions = CAI(unknown).actions
    assert torch.equal(actions, CAI(model).actions)
    for low, high, warns in (
        (-1.0, 1.0, False),
        (-0.8, 1.0, False),
        (-0.6, 0.6, True),
        (-1.1, 1.0, True),
        (-90.0, 90.0, True),
    ):
        spec = Bounded(torch.tensor([-1.0, low]), torch.tensor([1.0, high]), (2,))
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            actions = CAI(model, num_actions=500, action_spec=spec).actions
        assert (actions[:, 1] >= low).all() and (actions[:, 1] <= high).all()
        assert len(found) == warns
        if warns:
            assert f"[-1, 1] x [{low:g}, {high:g}]" in str(found[0].message)
            assert "[-1, 1] x [-1, 1]" in str(found[0].message)
            assert "columns [1]" in str(found[0].message)
