"""Tests of the Gaussian world model."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import CAI
from torchrl_caiac.influence.estimator_digest import estimator_digest
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel, _softplus

LAYOUT = EntityLayout({"arm": [0, 1, 4], "cup": [6, 5], "lid": [2]})


def transitions(rows: int, *, seed: int = 0, dtype: Any = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(rows, 7, generator=generator, dtype=dtype)
    action = torch.rand(rows, 2, generator=generator, dtype=dtype) * 2 - 1
    change = torch.zeros(rows, 7, dtype=dtype)
    change[:, 0] = 0.3 * action[:, 0]
    change[:, 5] = 0.01 * action[:, 1]
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "next": {"observation": observation + change},
        },
        [rows],
    )


def nested(td: TensorDict) -> TensorDict:
    def part(x: torch.Tensor) -> dict[str, Any]:
        return {
            "arm": x[:, [0, 1, 4]],
            "cup": {"a": x[:, 6:7], "b": x[:, 5:6]},
            "lid": x[:, 2:3],
        }

    return TensorDict(
        {
            "observation": part(td["observation"]),
            "action": td["action"],
            "next": {"observation": part(td["next", "observation"])},
        },
        td.batch_size,
    )


NESTED = EntityLayout.from_keys(
    {name: ("observation", name) for name in ("arm", "cup", "lid")}
)


def test_keys_shapes_and_predicted_slices() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8, 8), predict={"cup": [5], "lid": ()})
    td = transitions(6)
    out = model(td)
    assert out is td
    assert model.in_keys == ["observation", "action"]
    assert model.predicted == {"arm": slice(0, 3), "cup": slice(3, 4)}
    assert model.index.tolist() == [0, 1, 2, 4]
    for key in ("loc", "var"):
        assert td["prediction", key].shape == (6, 4)
    model = GaussianWorldModel(LAYOUT, 2, (8,), out_keys=("mean", ("out", "v")))
    out = model(transitions(6))
    assert out["mean"].shape == out["out", "v"].shape == (6, 6)


@pytest.mark.parametrize("batch", [(), (3,), (2, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_shapes_and_dtypes(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8,)).eval()
    count = int(torch.Size(batch).numel())
    flat = transitions(count, dtype=dtype)
    td = flat.reshape(batch) if batch else flat[0]
    out = model(td)["prediction", "loc"]
    assert out.shape == (*batch, 6) and out.dtype == torch.float32
    torch.testing.assert_close(
        out.reshape(count, 6), model(flat.float())["prediction", "loc"]
    )


def test_broadcast_actions_give_what_expanded_ones_give() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (16, 16), spectral_norm=True)
    model(transitions(100))
    model.eval()
    state, action = torch.randn(5, 1, 6), torch.randn(1, 7, 2)
    loc, var = model.forward_tensors(state, action)
    slow = model.forward_tensors(state.expand(5, 7, 6), action.expand(5, 7, 2))
    torch.testing.assert_close((loc, var), slow, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("onednn", [True, False])
@pytest.mark.parametrize("rows", [1, 5, 1024])
def test_predictions_for_the_same_actions(
    dtype: torch.dtype, onednn: bool, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = GaussianWorldModel(LAYOUT, 2, (16, 8), spectral_norm=True, max_variance=1.0)
    td = transitions(100)
    model(td)
    model.fit_statistics(td)
    model = model.to(dtype).eval()
    state, action = torch.randn(9, 6), torch.randn(7, 2)
    slow = model.forward_tensors(state[:, None], action[None])
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: onednn)
    predict = model.for_actions(action, rows=rows)
    out = predict(state)
    assert out[0].dtype == dtype and out[0].shape == (9, 7, 6)
    torch.testing.assert_close(out, slow, atol=1e-6, rtol=1e-5)
    assert not any(x.requires_grad for x in out)
    assert [x.shape for x in predict(state[:0])] == [(0, 7, 6)] * 2
    with pytest.raises(ValueError, match=r"\[B, 6\], got \[9, 5\]"):
        predict(state[:, :5])


def test_predictions_for_the_same_actions_learn_nothing() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (16, 8))
    model(transitions(100))
    counts = [norm.count.clone() for norm in (model.state_norm, model.action_norm)]
    action = torch.randn(3, 2)
    model.for_actions(action)(torch.randn(4, 6))
    assert model.training and model.state_norm.training
    assert [model.state_norm.count, model.action_norm.count] == counts
    with pytest.raises(ValueError, match="expected"):
        model.for_actions(action[:, :1])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_softplus_is_that_of_torch(scale: float) -> None:
    x = scale * torch.randn(1000, generator=torch.Generator().manual_seed(0))
    expected = torch.nn.functional.softplus(x.double()).float()
    torch.testing.assert_close(_softplus(x), expected, atol=0, rtol=1e-6)


def test_first_layer_is_a_plain_linear_layer_of_the_normalised_input() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8, 5))
    td = transitions(50)
    model(td)
    model.eval()
    x = torch.cat([LAYOUT.read(td), td["action"]], -1)
    norms = (model.state_norm, model.action_norm)
    mean = torch.cat([n.mean for n in norms])
    scale = torch.cat([n.scale for n in norms])
    hidden = ((x - mean) / scale).float()
    for layer in model.hidden:
        hidden = torch.relu(layer(hidden))
    var = torch.nn.functional.softplus(model.var_head(hidden)) + 1e-8 + 1e-6
    td = model(td)
    torch.testing.assert_close(td["prediction", "loc"], model.loc_head(hidden))
    torch.testing.assert_close(td["prediction", "var"], var)


def test_initialisation() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (32, 32))
    for layer in [*model.hidden, model.loc_head, model.var_head]:
        weight = layer.weight.detach()
        gram = (
            weight @ weight.T
            if weight.shape[0] < weight.shape[1]
            else weight.T @ weight
        )
        torch.testing.assert_close(gram, torch.eye(len(gram)), atol=1e-5, rtol=0)
        assert not layer.bias.any()


@pytest.mark.parametrize("target", ["change", "absolute"])
def test_targets_and_their_inverse(target: Any) -> None:
    td = transitions(200, dtype=torch.float64)
    model = GaussianWorldModel(
        LAYOUT, 2, (8,), target=target, predict={"cup": [5], "arm": [4, 0]}
    )
    with pytest.raises(RuntimeError, match="fit_statistics"):
        model.targets(td)
    model.fit_statistics(td)
    columns = [4, 0, 5, 2]
    now, after = td["observation"][:, columns], td["next", "observation"][:, columns]
    raw = after - now if target == "change" else after
    scale = raw.std(0, correction=0).clamp_min(1e-3)
    if target == "absolute":
        raw = raw - raw.mean(0)
    torch.testing.assert_close(model.targets(td), (raw / scale).float())
    state = LAYOUT.read(td)
    torch.testing.assert_close(model.physical(state, (raw / scale)), after)
    model.eval()
    loc = model(td)["prediction", "loc"]
    torch.testing.assert_close(
        model.predict_next(td), model.physical(state, loc), rtol=1e-6, atol=1e-6
    )


def test_statistics_by_chunks_and_from_several_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    td = transitions(101, dtype=torch.float64)
    whole, chunked, several, raw = (
        GaussianWorldModel(LAYOUT, 2, (8,)) for _ in range(4)
    )
    whole.fit_statistics(td)
    monkeypatch.setattr(
        "torchrl_caiac.modules.entity_dynamics_model._STATISTICS_ROWS", 10
    )
    chunked.fit_statistics(td.memmap(tmp_path))
    several.fit_statistics([td[:30], td[30:].reshape(71, 1)])
    raw.fit_statistics(raw.raw_targets(LAYOUT.read(td), LAYOUT.read(td, next=True)))
    for other in (chunked, several, raw):
        torch.testing.assert_close(other.target_scale, whole.target_scale)
    with pytest.raises(ValueError, match="data are empty"):
        whole.fit_statistics(td[:0])
    td["next", "observation"][3, 5] = float("nan")
    with pytest.raises(ValueError, match="entity 'cup' are not finite"):
        whole.fit_statistics(td)


def test_resting_columns_get_the_floor_as_scale_and_variance() -> None:
    td = transitions(300)
    model = GaussianWorldModel(
        LAYOUT, 2, (8,), variance_floor={"arm": 0.01, "cup": [0.5, 1e-3], "lid": 0.002}
    )
    model.fit_statistics(td)
    scale = model.target_scale.tolist()
    #           arm: moves, rests, rests; cup: rests, moves a little; lid: rests
    assert scale[1:4] == [0.01, 0.01, 0.5] and scale[5] == 0.002
    torch.testing.assert_close(
        scale[0], td["action"][:, 0].double().std(correction=0).item() * 0.3
    )
    assert 1e-3 < scale[4] < 0.01
    with torch.no_grad():
        model.var_head.bias.fill_(-100.0)  # as sure as it can be
    var = model(td)["prediction", "var"].double()
    physical = var.sqrt() * model.target_scale
    torch.testing.assert_close(
        physical, model.floor.expand_as(physical), rtol=1e-5, atol=1e-6
    )


def test_variance_is_capped() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8,), max_variance=7.0)
    with torch.no_grad():
        model.var_head.bias.fill_(1e4)
    assert (model(transitions(5))["prediction", "var"] == 7.0).all()


def test_nested_layout_equals_the_flat_one() -> None:
    td = transitions(64)
    flat = GaussianWorldModel(LAYOUT, 2, (8, 8), predict={"cup": [5]})
    torch.manual_seed(0)
    other = nested(td)
    with pytest.raises(ValueError, match=r"widths=layout\.widths"):
        GaussianWorldModel(NESTED, 2)
    model = GaussianWorldModel(
        NESTED, 2, (8, 8), predict={"cup": [1]}, widths=NESTED.widths(other)
    )
    assert model.predicted == flat.predicted
    flat.fit_statistics(td)
    model.fit_statistics(other)
    values = {k: v for k, v in flat.state_dict().items() if "extra" not in k}
    model.load_state_dict({**values, "_extra_state": model.get_extra_state()})
    torch.testing.assert_close(model.targets(other), flat.targets(td))
    torch.testing.assert_close(
        model(other)["prediction", "loc"], flat(td)["prediction", "loc"]
    )
    rows = other[:4].reshape(2, 2)
    assert model.predict_next(rows).shape == (2, 2, 5)


def test_nested_keys_of_flat_layout_and_action() -> None:
    layout = EntityLayout({"a": [0], "b": [1]}, observation_key=("state", "vector"))
    model = GaussianWorldModel(layout, 1, (8,), action_key=("agent", "action"))
    td = TensorDict(
        {
            "state": {"vector": torch.randn(9, 2)},
            "agent": {"action": torch.randn(9, 1)},
            "next": {"state": {"vector": torch.randn(9, 2)}},
        },
        [9],
    )
    model.fit_statistics(td)
    assert model(td)["prediction", "loc"].shape == (9, 2)
    loc, var = GaussianWorldModel(LAYOUT, 2, (8,))(
        observation=torch.randn(4, 7), action=torch.randn(4, 2)
    )
    assert loc.shape == var.shape == (4, 6)


def test_spectral_norm_bounds_the_hidden_layers() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (16, 16), spectral_norm=True)
    with torch.no_grad():
        for layer in model.hidden:
            layer.parametrizations.weight.original.mul_(30)
    td = transitions(10)
    for _ in range(50):
        model(td)
    model.eval()
    for layer in model.hidden:
        norm = torch.linalg.matrix_norm(layer.weight, 2)
        torch.testing.assert_close(norm, torch.ones(()), atol=1e-2, rtol=0)
    assert type(model.loc_head) is torch.nn.Linear


def test_state_dict_carries_statistics_and_compares_arguments(tmp_path: Path) -> None:
    td = transitions(64)
    model = GaussianWorldModel(LAYOUT, 2, (8,), variance_floor=0.01)
    model(td)
    model.fit_statistics(td)
    torch.save(model.state_dict(), tmp_path / "model.pt")
    state = torch.load(tmp_path / "model.pt", weights_only=True)
    twin = GaussianWorldModel.from_config(model.config)
    assert twin.config == model.config
    twin.load_state_dict(state)
    td = transitions(5, seed=1)
    assert torch.equal(twin.eval().predict_next(td), model.eval().predict_next(td))

    layout = EntityLayout({"arm": [0, 1, 4], "cup": [6, 5], "lamp": [2]})
    other = GaussianWorldModel(layout, 2, (8,), variance_floor=0.01)
    other.set_action_bounds(0.0, 1.0)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(ValueError, match=r"(?s)another layout.*lid.*lamp"):
        other.load_state_dict(state)
    for key, value in other.state_dict().items():
        assert torch.equal(
            torch.as_tensor(value == before[key]).all(), torch.tensor(True)
        )
    for change, name in (
        ({"variance_floor": 0.02}, "variance_floor"),
        ({"hidden_sizes": (9,)}, "hidden_sizes"),
        ({"predict": {"arm": [0]}}, "predict"),
        ({"target": "absolute"}, "target"),
        ({"inputs": {"arm": [0]}}, "inputs"),
    ):
        arguments: dict[str, Any] = {"hidden_sizes": (8,), "variance_floor": 0.01}
        other = GaussianWorldModel(LAYOUT, 2, **{**arguments, **change})
        with pytest.raises(ValueError, match=f"another {name}"):
            other.load_state_dict(state)


# --- columns that the model reads ---------------------------------------------------


@pytest.mark.parametrize("layout", [LAYOUT, NESTED])
def test_inputs_are_all_that_a_model_reads(layout: EntityLayout) -> None:
    flat = layout is LAYOUT
    td, actions = transitions(50), torch.rand(9, 2)
    model = GaussianWorldModel(
        layout,
        2,
        (16, 16),
        widths=None if flat else {"arm": 3, "cup": 2, "lid": 1},
        inputs={"arm": (), "cup": [5] if flat else [1]},
    )
    model.fit_statistics(td if flat else nested(td))
    assert model.input_dim == 2 and model.predict_dim == 6
    assert model.hidden[0].in_features == 4
    state = LAYOUT.read(td)
    model(td if flat else nested(td))  # merges the statistics
    torch.testing.assert_close(model.state_norm.mean, state[:, 4:].mean(0).double())
    model.eval()
    # The same network, whose input is made by hand.
    x = model.state_norm(state[:, [4, 5]])
    x = torch.cat([x, model.action_norm(td["action"])], -1)
    for layer in model.hidden:
        x = layer(x).relu()
    loc, _ = model.forward_tensors(state, td["action"])
    torch.testing.assert_close(loc, model.loc_head(x))
    changed = state.clone()
    changed[:, :4] = torch.randn(50, 4)
    for one, other in zip(
        model.forward_tensors(state, td["action"]),
        model.forward_tensors(changed, td["action"]),
        strict=True,
    ):
        assert torch.equal(one, other)
    for one, other in zip(
        model.for_actions(actions)(changed),
        model.forward_tensors(state[:, None], actions[None]),
        strict=True,
    ):
        torch.testing.assert_close(one, other)
    # Targets are those of all entities.
    whole = GaussianWorldModel(LAYOUT, 2, (8,))
    whole.fit_statistics(td)
    assert torch.equal(model.target_scale, whole.target_scale)


def test_inputs_are_saved_and_old_configs_are_those_of_all_columns() -> None:
    every = {"arm": [0, 1, 4], "cup": [6, 5], "lid": [2]}
    plain = GaussianWorldModel(LAYOUT, 2, (8,))
    named = GaussianWorldModel(LAYOUT, 2, (8,), inputs=every)
    assert "inputs" not in plain.config and named.config == plain.config
    some = GaussianWorldModel(LAYOUT, 2, (8,), inputs={"arm": [4, 0], "lid": ()})
    assert some.config["inputs"] == {"arm": [4, 0], "cup": [6, 5], "lid": []}
    twin = GaussianWorldModel.from_config(some.config)
    twin.load_state_dict(some.state_dict())
    assert twin.config == some.config and twin.input_index.tolist() == [2, 0, 3, 4]
    with pytest.raises(ValueError, match=r"(?s)another inputs.*\[4, 0\].*None"):
        plain.load_state_dict(some.state_dict())
    with pytest.raises(ValueError, match=r"(?s)another inputs.*None.*\[4, 0\]"):
        some.load_state_dict(plain.state_dict())


def test_scores_depend_on_the_inputs_alone() -> None:
    td = transitions(40)
    model = GaussianWorldModel(LAYOUT, 2, (16,), inputs={"arm": [4], "lid": ()})
    model.fit_statistics(td)
    model.set_action_bounds(-1.0, 1.0)
    cai = CAI(model.eval(), num_actions=8)
    changed = td.clone()
    changed["observation"][:, :4] = 0.0  # columns 0, 1 and 2 of the entities, and 3
    assert torch.equal(cai(changed), cai(td))
    changed["observation"][:, 4] = 0.0
    assert not torch.equal(cai(changed), cai(td))
    other = GaussianWorldModel(LAYOUT, 2, (16,), inputs={"arm": [1], "lid": ()})
    other.fit_statistics(td)
    other.load_state_dict({**model.state_dict(), **_extra(other)})
    assert estimator_digest(CAI(other.eval(), 8)) != estimator_digest(cai)


def _extra(model: GaussianWorldModel) -> dict[str, Any]:
    return {"_extra_state": model.get_extra_state()}


def test_copies_and_pickles() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8,), spectral_norm=False)
    td = transitions(5)
    model.fit_statistics(td)
    model.eval()
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert torch.equal(twin.predict_next(td), model.predict_next(td))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"action_dim": 0}, "action_dim .* got 0"),
        ({"hidden_sizes": ()}, "hidden_sizes"),
        ({"hidden_sizes": (8, 0)}, "hidden_sizes"),
        ({"predict": {"hand": [0]}}, r"predict names \['hand'\].*'arm', 'cup', 'lid'"),
        ({"predict": {"cup": [0]}}, r"'cup' the columns \[0\], which it does not own"),
        ({"predict": {"cup": [5, 5]}}, "'cup' .* at most once"),
        ({"predict": {"arm": (), "cup": (), "lid": ()}}, "nothing to predict"),
        ({"variance_floor": -1.0}, "variance_floor of entity 'arm' is -1.0"),
        ({"variance_floor": float("nan")}, "variance_floor"),
        ({"variance_floor": {"arm": 1.0}}, r"predicted entities \['arm', 'cup'"),
        ({"variance_floor": {"arm": 1, "cup": [1, 2, 3], "lid": 1}}, "of its 2"),
        ({"inputs": {"hand": [0]}}, r"inputs names \['hand'\].*'arm', 'cup', 'lid'"),
        ({"inputs": {"cup": [0]}}, r"inputs gives entity 'cup' .*does not own"),
        ({"inputs": {"cup": [5, 5]}}, "'cup' .* at most once"),
        ({"inputs": {"arm": (), "cup": (), "lid": ()}}, "same in every state"),
        ({"target": "delta"}, "'change' or 'absolute', got 'delta'"),
        ({"max_variance": 0.0}, "max_variance"),
        ({"out_keys": ("loc",)}, "two keys"),
        ({"widths": {"arm": 1, "cup": 2, "lid": 1}}, "leave widths out"),
    ],
)
def test_wrong_arguments_are_named(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GaussianWorldModel(LAYOUT, **{"action_dim": 2, **kwargs})


def test_wrong_widths_of_nested_layouts() -> None:
    with pytest.raises(ValueError, match="widths are of"):
        GaussianWorldModel(NESTED, 2, widths={"arm": 1})
    with pytest.raises(ValueError, match="width of entity 'lid'"):
        GaussianWorldModel(NESTED, 2, widths={"arm": 1, "cup": 2, "lid": 0})


def test_wrong_inputs_are_named() -> None:
    model = GaussianWorldModel(LAYOUT, 2, (8,))
    td = transitions(4)
    with pytest.raises(ValueError, match=r"action has the shape \[4, 3\].*\[\*B, 2\]"):
        model(td.clone().set("action", torch.zeros(4, 3)))
    with pytest.raises(KeyError, match="observation"):
        model(td.exclude("observation"))
    state = LAYOUT.read(td).clone()
    model.check_finite(state)
    state[2, 3] = float("inf")
    with pytest.raises(
        ValueError, match=r"'observation' is inf for entity 'cup' in row 12"
    ):
        model.check_finite(state, first_row=10)
    with pytest.raises(ValueError, match=r"\('next', 'observation'\) is inf"):
        model.check_finite(state, next=True)
    action = td["action"].clone()
    action[1, 0] = float("nan")
    with pytest.raises(ValueError, match="'action' is nan in column 0 of row 1 "):
        model.check_finite_action(action)
