"""Tests of what all world models share, through a model of a single linear layer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel
from torchrl_caiac.modules.entity_dynamics_model import (
    EntityDynamicsModel,
    evaluating,
)
from torchrl_caiac.objectives import EntityDynamicsLoss

LAYOUT = EntityLayout({"arm": [0, 1], "cup": [2]})


class LinearModel(EntityDynamicsModel):
    def __init__(self, layout: Any, action_dim: int, **kwargs: Any) -> None:
        kwargs.setdefault("out_keys", [("linear", "mean")])
        super().__init__(layout, action_dim, **kwargs)
        self.map = torch.nn.Linear(self.state_dim + action_dim, self.predict_dim)

    def forward_tensors(
        self, state: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        parts = [self.state_norm(state), self.action_norm(action)]
        return (self.map(torch.cat(parts, -1)),)

    def nll(
        self, prediction: tuple[torch.Tensor, ...], target: torch.Tensor
    ) -> torch.Tensor:
        return (prediction[0] - target).abs().mean(-1)


def transitions(rows: int = 400) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(rows, 3, generator=generator)
    action = torch.randn(rows, 2, generator=generator)
    change = 0.1 * torch.cat([action, observation[:, :1]], -1)
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "episode": torch.arange(rows) // 10,
            "next": {"observation": observation + change},
        },
        [rows],
    )


def test_a_model_needs_forward_tensors_and_nll_only(tmp_path: Path) -> None:
    data, model = transitions(), LinearModel(LAYOUT, 2)
    history = fit_world_model(
        model,
        data,
        steps=300,
        eval_every=10,
        batch_size=64,
        lr=0.03,
        checkpoint=tmp_path / "fit",
        progress=False,
    )
    assert history["validation_nll"][-1] < 0.02 < 0.2 < history["validation_nll"][0]
    torch.testing.assert_close(
        model.predict_next(data), data["next", "observation"], atol=0.1, rtol=0
    )
    out = EntityDynamicsLoss(model).eval()(data)
    with torch.no_grad():
        written = model(data)["linear", "mean"]
    error = written - model.targets(data)
    torch.testing.assert_close(out["loss_nll"].detach(), error.abs().mean())
    torch.testing.assert_close(out["mse"], error.square().mean())


def test_what_a_subclass_lacks_is_named() -> None:
    model = EntityDynamicsModel(LAYOUT, 2, out_keys=["x"])
    with pytest.raises(NotImplementedError, match="has no forward_tensors"):
        model(transitions())
    with pytest.raises(NotImplementedError, match="has no nll"):
        model.nll((torch.zeros(1, 3),), torch.zeros(1, 3))


def test_configs_name_their_class() -> None:
    gaussian = GaussianWorldModel(LAYOUT, 2, (8,))
    transformer = TransformerWorldModel(LAYOUT, 2, 1, 2, 8)
    assert gaussian.config["class"] == "GaussianWorldModel"
    assert transformer.config["class"] == "TransformerWorldModel"
    with pytest.raises(ValueError, match=r"call GaussianWorldModel\.from_config"):
        TransformerWorldModel.from_config(gaussian.config)
    with pytest.raises(ValueError, match=r"another class(.|\n)*TransformerWorldModel"):
        gaussian.load_state_dict(transformer.state_dict(), strict=False)


def test_evaluating_restores_every_part() -> None:
    model = LinearModel(LAYOUT, 2)
    model.state_norm.eval()
    with pytest.raises(RuntimeError, match="stop"), evaluating(model):
        assert not model.training and not model.action_norm.training
        raise RuntimeError("stop")
    assert model.training and model.action_norm.training
    assert not model.state_norm.training


def test_device_and_dtype_are_those_of_the_parameters() -> None:
    model = LinearModel(LAYOUT, 2)
    assert model.dtype == torch.float32 and model.device == torch.device("cpu")
    assert model.double().dtype == torch.float64


@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.int8, torch.uint16, torch.int64, torch.bool]
)
def test_integers_and_flags_are_fitted_as_the_numbers_that_they_are(
    dtype: torch.dtype,
) -> None:
    """A column that falls by one has a change of -1, not of 255."""
    generator = torch.Generator().manual_seed(0)
    high = 2 if dtype == torch.bool else 100
    before = torch.randint(high, (200, 3), generator=generator).to(dtype)
    step = torch.randint(2, (200, 3), generator=generator)
    after = (before.long() - step).clamp_min(0).to(dtype)
    data = transitions(200)
    whole = data.replace({"observation": before, "next": {"observation": after}})
    exact = data.replace(
        {"observation": before.double(), "next": {"observation": after.double()}}
    )
    for target in ("change", "absolute"):
        models = []
        for td in (whole, exact):
            torch.manual_seed(0)
            model = GaussianWorldModel(LAYOUT, 2, (8,), target=target)
            model.fit_statistics(td)
            models.append(model)
            fitted = GaussianWorldModel.from_config(model.config)
            fitted.load_state_dict(model.state_dict())
            for memory in (2**30, 0):  # in one block, and batch by batch
                fit_world_model(
                    fitted,
                    td,
                    steps=2,
                    batch_size=8,
                    max_memory=memory,
                    check=False,
                    progress=False,
                )
                models.append(fitted)
        own, reference = models[:3], models[3:]
        for one, other in zip(own, reference, strict=True):
            assert torch.equal(one.target_scale, other.target_scale)
            assert torch.equal(one.target_loc, other.target_loc)
            same = zip(one.parameters(), other.parameters(), strict=True)
            assert all(torch.equal(a, b) for a, b in same)
        torch.testing.assert_close(own[0].targets(whole), reference[0].targets(exact))
        torch.testing.assert_close(
            own[0].predict_next(whole),
            reference[0].predict_next(exact),
            check_dtype=False,
        )
