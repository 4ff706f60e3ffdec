"""Tests of the variance floor that a world model takes from data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import CAI
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel
from torchrl_caiac.modules._variance_floor import checked_floor
from torchrl_caiac.noise import resting_noise

LAYOUT = EntityLayout({"arm": [3, 0, 1], "cup": [2, 4]})
NESTED = EntityLayout.from_keys({"arm": "arm", "cup": ("things", "cup")})


def transitions(rows: int = 600) -> TensorDict:
    """The arm moves; the cup rests in two thirds of the rows, with noise of 1e-3."""
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(rows, 5, generator=generator)
    change = 0.1 * torch.randn(rows, 5, generator=generator)
    change[: rows * 2 // 3, [2, 4]] *= 0.01
    return TensorDict(
        {
            "observation": observation,
            "action": torch.rand(rows, 2, generator=generator),
            "next": {"observation": observation + change},
        },
        [rows],
    )


def nested(td: TensorDict) -> TensorDict:
    def parts(x: torch.Tensor) -> dict[str, Any]:
        return {"arm": x[:, [3, 0, 1]], "things": {"cup": x[:, [2, 4]]}}

    source = {**parts(td["observation"]), "action": td["action"]}
    return TensorDict(
        {**source, "next": parts(td["next", "observation"])}, td.batch_size
    )


@pytest.mark.parametrize("kind", [GaussianWorldModel, TransformerWorldModel])
@pytest.mark.parametrize("layout", [LAYOUT, NESTED])
def test_the_floor_is_that_of_the_predicted_columns(
    kind: Any, layout: EntityLayout, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "torchrl_caiac.fit")
    td = transitions()
    noise = resting_noise(td, LAYOUT)
    flat = layout.is_flat
    data = td if flat else nested(td)
    model = kind(
        layout,
        2,
        predict={"cup": [4] if flat else [1], "arm": [0, 3] if flat else [1, 0]},
        widths=None if flat else {"arm": 3, "cup": 2},
        variance_floor="auto",
    )
    assert model.floor.isnan().all() and not model.has_floor
    # In parts of any size.
    model.fit_statistics([data[:100], data[100:100], data[100:]])
    arm, cup = noise["arm"], noise["cup"]
    want = [arm.floor[1], arm.floor[0], cup.floor[1]]
    torch.testing.assert_close(model.floor, torch.tensor(want, dtype=torch.float64))
    assert model.floor_reasons == {"arm": arm.reason, "cup": cup.reason}
    assert model.entity_floors() == {"arm": want[:2], "cup": want[2:]}
    assert 1e-3 < want[2] < 0.02  # the noise, or a tenth of the motion
    assert cup.reason in caplog.text and "variance floor of 'cup'" in caplog.text
    scale = model.target_scale.clone()
    model.fit_statistics(model.raw_targets(*_states(layout, data)))  # known by now
    torch.testing.assert_close(model.target_scale, scale)


@pytest.mark.parametrize("is_flat", [True, False])
def test_the_positions_of_an_entity_share_the_largest_floor(is_flat: bool) -> None:
    td = transitions()
    td["next", "observation"][:, 4] = td["observation"][:, 4]  # hardly moves
    td["next", "observation"][:3, 4] += 1e-4
    noise = resting_noise(td, LAYOUT)
    if is_flat:
        layout = EntityLayout(LAYOUT.columns, positions={"cup": [4, 2], "arm": [0, 1]})
        model = GaussianWorldModel(layout, 2, (8,), variance_floor="auto")
        model.fit_variance_floor(td)
    else:
        layout = EntityLayout.from_keys(
            NESTED.keys, positions={"cup": [1, 0], "arm": [1, 2]}
        )
        widths = {"arm": 3, "cup": 2}
        model = GaussianWorldModel(
            layout, 2, (8,), widths=widths, variance_floor="auto"
        )
        model.fit_variance_floor(nested(td))
    arm, cup = model.entity_floors().values()
    assert cup[0] == cup[1] > 100 * min(noise["cup"].floor)
    assert arm[1] == arm[2]


def _states(layout: EntityLayout, td: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    return layout.read(td), layout.read(td, next=True)


def test_an_unknown_floor_is_refused() -> None:
    td = transitions()
    model = GaussianWorldModel(LAYOUT, 2, (8,), variance_floor="auto")
    with pytest.raises(RuntimeError, match="floor is not known: call"):
        model(td)
    with pytest.raises(ValueError, match="never fitted"):
        CAI(model)
    raw = model.raw_targets(*_states(LAYOUT, td))
    for data in (raw, [raw], iter([td])):
        with pytest.raises(ValueError, match="'auto' needs transitions"):
            model.fit_statistics(data)
    with pytest.raises(ValueError, match="the data are empty"):
        model.fit_variance_floor(td[:0])
    broken = td.clone()
    broken["observation"][3, 2] = float("nan")
    with pytest.raises(ValueError, match=r"\['cup'\] have NaN"):
        model.fit_statistics(broken)
    assert not model.has_floor and not model.fitted
    with pytest.raises(ValueError, match="a variance floor of its own"):
        GaussianWorldModel(LAYOUT, 2, (8,)).fit_variance_floor(td)


@pytest.mark.parametrize("floor", ["automatic", {"arm": "auto", "cup": 0.1}])
def test_other_texts_are_refused(floor: Any) -> None:
    with pytest.raises(ValueError, match=r"of entity 'arm' is .*or 'auto' for all"):
        GaussianWorldModel(LAYOUT, 2, variance_floor=floor)


def test_floors_of_numpy_and_torch() -> None:
    predict = {"arm": (0, 1), "cup": (0,)}
    given = {"arm": np.array([0.5, 0.25]), "cup": torch.tensor([2.0])}
    assert checked_floor(given, predict) == [0.5, 0.25, 2.0]
    assert checked_floor(np.float32(0.5), predict) == [0.5] * 3
