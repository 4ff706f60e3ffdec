"""Tests of the loss of world models."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import linear
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.modules.transformer_world_model import TransformerWorldModel
from torchrl_caiac.objectives.entity_dynamics import EntityDynamicsLoss, gaussian_nll

LAYOUT = EntityLayout({"arm": [0, 1], "cup": [2]})


def transitions(*batch: int, dtype: Any = torch.float32) -> TensorDict:
    observation = torch.randn(*batch, 3, dtype=dtype)
    return TensorDict(
        {
            "observation": observation,
            "action": torch.randn(*batch, 2, dtype=dtype),
            "next": {"observation": observation + torch.randn(*batch, 3, dtype=dtype)},
        },
        batch,
    )


def fitted(td: TensorDict, **kwargs: Any) -> GaussianWorldModel:
    torch.manual_seed(0)
    model = GaussianWorldModel(LAYOUT, 2, (16, 16), **kwargs)
    model.fit_statistics(td)
    return model


@pytest.mark.parametrize("batch", [(7,), (3, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_is_the_negative_log_likelihood(batch: Any, dtype: Any) -> None:
    td = transitions(*batch, dtype=dtype)
    model = fitted(td).eval()
    out = EntityDynamicsLoss(model, functional=False).eval()(td)
    assert sorted(out.keys()) == ["loss_nll", "mse"] and out.batch_size == ()
    assert "prediction" not in td
    loc, var = model.forward_tensors(LAYOUT.read(td).float(), td["action"].float())
    target = model.targets(td)
    normal = torch.distributions.Normal(loc, var.sqrt())
    torch.testing.assert_close(out["loss_nll"], -normal.log_prob(target).mean())
    torch.testing.assert_close(out["mse"], (loc - target).square().mean())
    assert out["loss_nll"].requires_grad and not out["mse"].requires_grad
    torch.testing.assert_close(
        gaussian_nll(loc, var, target), -normal.log_prob(target).mean(-1)
    )


@pytest.mark.parametrize("spectral_norm", [False, True])
def test_functional_and_not_do_the_same_to_the_same_model(spectral_norm: bool) -> None:
    td = transitions(20)
    results = []
    for functional in (True, False):
        model = fitted(td, spectral_norm=spectral_norm)
        loss = EntityDynamicsLoss(model, functional=functional)
        assert loss.functional is functional
        assert len(list(loss.parameters())) == len(list(model.parameters()))
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(3):
            optimizer.zero_grad()
            loss(td)["loss_nll"].backward()
            optimizer.step()
        assert model.state_norm.count == 60
        results.append(model.state_dict())
    for key, value in results[0].items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, results[1][key], equal_nan=True)


def test_modes_reach_the_model() -> None:
    td = transitions(9)
    model = fitted(td)
    loss = EntityDynamicsLoss(model)
    loss.eval()
    loss(td)
    assert not model.training and model.state_norm.count == 0
    loss.train()
    loss(td)
    assert model.training and model.state_norm.count == 9


def test_reductions_and_masks() -> None:
    td = transitions(6, 5)
    model = fitted(td).eval()
    rows = EntityDynamicsLoss(model, reduction="none").eval()(td)
    assert rows.batch_size == (6, 5) and rows["loss_nll"].shape == (6, 5)
    total = EntityDynamicsLoss(model, reduction="sum").eval()(td)
    torch.testing.assert_close(total["loss_nll"], rows["loss_nll"].sum())
    mask = torch.rand(6, 5) < 0.5
    mask[0, 0] = True
    td["collector", "mask"] = mask.unsqueeze(-1)
    mean = EntityDynamicsLoss(model).eval()(td)
    torch.testing.assert_close(mean["loss_nll"], rows["loss_nll"][mask].mean())
    torch.testing.assert_close(mean["mse"], rows["mse"][mask].mean())


def test_keys_and_dispatch() -> None:
    td = transitions(8)
    model = fitted(td).eval()
    loss = EntityDynamicsLoss(model).eval()
    assert loss.in_keys == ["observation", "action", ("next", "observation")]
    expected = loss(td)
    nll, mse = loss(
        observation=td["observation"],
        action=td["action"],
        next_observation=td["next", "observation"],
    )
    assert nll == expected["loss_nll"] and mse == expected["mse"]
    loss.set_keys(action=("agent", "action"))
    assert ("agent", "action") in loss.in_keys
    td.rename_key_("action", ("agent", "action"))
    assert loss(td)["loss_nll"] == nll
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(reward="reward")


def test_nested_layout() -> None:
    layout = EntityLayout.from_keys({"arm": ("o", "arm"), "cup": ("o", "cup")})
    td = TensorDict(
        {
            "o": {"arm": torch.randn(9, 2), "cup": {"x": torch.randn(9, 3, 2)}},
            "a": torch.randn(9, 1),
            "next": {
                "o": {"arm": torch.randn(9, 2), "cup": {"x": torch.randn(9, 3, 2)}}
            },
        },
        [9],
    )
    model = GaussianWorldModel(
        layout, 1, (8,), widths=layout.widths(td), action_key="a"
    )
    model.fit_statistics(td)
    loss = EntityDynamicsLoss(model)
    assert loss.in_keys == [
        ("o", "arm"),
        ("o", "cup"),
        "a",
        ("next", "o", "arm"),
        ("next", "o", "cup"),
    ]
    assert torch.isfinite(loss(td)["loss_nll"])
    assert sorted(loss.entity_mse(td).keys()) == ["arm", "cup"]


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("target", ["change", "absolute"])
def test_entity_mse_is_in_physical_units(functional: bool, target: Any) -> None:
    td = transitions(30)
    model = fitted(td, target=target)
    model(td.clone())
    count = model.state_norm.count.clone()
    loss = EntityDynamicsLoss(model, functional=functional)
    mse = loss.entity_mse(td)
    assert model.training and loss.training and model.state_norm.count == count
    error = model.eval().predict_next(td) - td["next", "observation"]
    torch.testing.assert_close(mse["arm"], error[:, :2].square().mean())
    torch.testing.assert_close(mse["cup"], error[:, 2:].square().mean())


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("batch", [(9,), (3, 4)])
def test_transformers_minimise_the_squared_error(functional: bool, batch: Any) -> None:
    td = transitions(*batch)
    torch.manual_seed(0)
    model = TransformerWorldModel(LAYOUT, 2, layers=2, heads=2, width=8)
    model.fit_statistics(td)
    loss = EntityDynamicsLoss(model, functional=functional, reduction="none")
    model(td.clone())  # makes the statistics of the inputs
    loss.eval()
    out = loss(td)
    target = model.targets(td)
    with torch.no_grad():
        error = (model(td.clone())["prediction", "loc"] - target).square().mean(-1)
    torch.testing.assert_close(out["mse"], error)
    torch.testing.assert_close(out["loss_nll"].detach(), 0.5 * error)
    # Gaussian likelihood with unit variance, up to the constant.
    loc = loss.model.forward_tensors(LAYOUT.read(td), td["action"])[0]
    unit = gaussian_nll(loc, torch.ones_like(loc), target)
    constant = unit.detach() - out["loss_nll"].detach()
    torch.testing.assert_close(constant, torch.full(batch, 0.9189385))
    out["loss_nll"].mean().backward()
    assert all(parameter.grad is not None for parameter in loss.parameters())
    physical = loss.entity_mse(td)
    error = (model.predict_next(td) - td["next", "observation"]).square().detach()
    torch.testing.assert_close(physical["arm"], error[..., :2].mean())
    torch.testing.assert_close(physical["cup"], error[..., 2:].mean())


def test_wrong_arguments() -> None:
    td = transitions(4)
    with pytest.raises(TypeError, match="GaussianWorldModel, got Linear"):
        EntityDynamicsLoss(torch.nn.Linear(1, 1))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="'median'"):
        EntityDynamicsLoss(fitted(td), reduction="median")  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="fit_statistics"):
        EntityDynamicsLoss(GaussianWorldModel(LAYOUT, 2, (8,)))(td)
    with pytest.raises(KeyError, match="next"):
        EntityDynamicsLoss(fitted(td))(td.exclude("next"))


@pytest.mark.parametrize("functional", [True, False])
def test_compiles_without_graph_breaks(
    functional: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linear, "_SMALL", 0)  # the choice of the library is traced too
    td = transitions(8)
    losses = [EntityDynamicsLoss(fitted(td), functional=functional) for _ in range(2)]
    want = losses[0](td)
    got = torch.compile(losses[1], fullgraph=True, backend="eager")(td)
    for key in losses[0].out_keys:
        torch.testing.assert_close(got[key], want[key])
    counts = [loss.model.state_norm.count for loss in losses]
    assert counts == [8, 8]
    got["loss_nll"].backward()
    assert all(parameter.grad is not None for parameter in losses[1].parameters())


def test_out_keys_can_be_selected() -> None:
    td = transitions(4)
    loss = EntityDynamicsLoss(fitted(td)).select_out_keys("loss_nll")
    assert loss.out_keys == ["loss_nll"] and list(loss(td).keys()) == ["loss_nll"]
    assert EntityDynamicsLoss(fitted(td)).out_keys == ["loss_nll", "mse"]
