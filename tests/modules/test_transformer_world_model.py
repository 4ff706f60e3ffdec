"""Tests of the transformer world model and the attention that it records."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import TransformerWorldModel

LAYOUT = EntityLayout({"arm": [0, 1, 4], "cup": [6, 5], "lid": [2]})
NESTED = EntityLayout.from_keys(
    {name: ("observation", name) for name in ("arm", "cup", "lid")}
)
WIDTHS = {"arm": 3, "cup": 2, "lid": 1}


def make(layout: EntityLayout = LAYOUT, **kwargs: Any) -> TransformerWorldModel:
    torch.manual_seed(0)
    settings: dict[str, Any] = {"layers": 2, "heads": 2, "width": 8, **kwargs}
    return TransformerWorldModel(layout, 2, **settings)


def transitions(*batch: int, dtype: Any = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    observation = torch.randn(*batch, 7, generator=generator, dtype=dtype)
    action = torch.rand(*batch, 2, generator=generator, dtype=dtype) * 2 - 1
    after = {"observation": observation + 0.1 * action[..., :1]}
    return TensorDict(
        {"observation": observation, "action": action, "next": after}, batch
    )


def by_hand(
    model: TransformerWorldModel,
    td: TensorDict,
    inputs: dict[str, list[int]] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Prediction and attention, token by token and head by head."""
    state, action = model.layout.read(td), td["action"]
    widths = WIDTHS
    if inputs is not None:
        state = td["observation"][:, [c for own in inputs.values() for c in own]]
        widths = {name: len(own) for name, own in inputs.items()}
    norms = [model.state_norm, model.action_norm]
    x = torch.cat(
        [
            (part - norm.mean) / norm.scale
            for part, norm in zip((state, action), norms, strict=True)
        ],
        -1,
    ).float()
    tokens, start = [], 0
    for size, layer in zip([*widths.values(), 2], model.inputs, strict=True):
        tokens.append(layer(x[:, start : start + size]))
        start += size
    x = torch.stack(tokens, 1)
    matrices = []
    for layer in model.layers:
        attention = layer.self_attn
        qkv = x @ attention.in_proj_weight.T + attention.in_proj_bias
        heads = [part.unflatten(-1, (model.heads, -1)) for part in qkv.chunk(3, -1)]
        mixed, weights = [], []
        for h in range(model.heads):
            q, k, v = (part[:, :, h] for part in heads)
            a = torch.softmax(q @ k.mT / math.sqrt(q.shape[-1]), -1)
            weights.append(a)
            mixed.append(a @ v)
        x = layer.norm1(x + attention.out_proj(torch.cat(mixed, -1)))
        x = layer.norm2(x + layer.linear2(torch.relu(layer.linear1(x))))
        matrices.append(torch.stack(weights).mean(0))
    parts = [
        output(x[:, model.layout.index(name)])
        for name, output in zip(model.predicted, model.outputs, strict=True)
    ]
    return torch.cat(parts, -1), torch.stack(matrices, 1)


@pytest.mark.parametrize("predict", [None, {"cup": [5], "arm": ()}])
@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("heads", [1, 2, 4])
def test_prediction_and_attention_are_those_made_by_hand(
    heads: int, training: bool, predict: Any
) -> None:
    model, td = make(heads=heads, predict=predict, feedforward=12), transitions(20)
    model(td)  # makes the statistics
    model.eval()
    state, action = LAYOUT.read(td), td["action"]
    with torch.set_grad_enabled(training):
        model.train(training)
        if training:
            model.state_norm.eval()
            model.action_norm.eval()
        loc, attention = by_hand(model, td)
        torch.testing.assert_close(model.attention(state, action), attention)
        torch.testing.assert_close(model(td)["prediction", "loc"], loc)
    assert loc.shape == (20, 6 if predict is None else 2)
    torch.testing.assert_close(attention.sum(-1), torch.ones(20, 2, 4))


def test_tokens_are_made_of_the_inputs() -> None:
    inputs = {"arm": [4, 0], "cup": [5], "lid": [2]}
    model, td = make(inputs={"arm": [4, 0], "cup": [5]}), transitions(20)
    model(td)  # makes the statistics
    model.eval()
    loc, attention = by_hand(model, td, inputs)
    torch.testing.assert_close(model(td)["prediction", "loc"], loc)
    torch.testing.assert_close(
        model.attention(LAYOUT.read(td), td["action"]), attention
    )
    assert loc.shape == (20, 6)
    twin = TransformerWorldModel.from_config(model.config)
    twin.load_state_dict(model.state_dict())
    assert twin.config["inputs"] == inputs


def test_keys_and_predicted_slices() -> None:
    model = make(predict={"cup": [5], "lid": ()}, out_keys=[("out", "mean")])
    assert model.in_keys == ["observation", "action"]
    assert model.out_keys == [("out", "mean")]
    assert model.predicted == {"arm": slice(0, 3), "cup": slice(3, 4)}
    td = transitions(6)
    assert model(td) is td and td["out", "mean"].shape == (6, 4)


@pytest.mark.parametrize("batch", [(), (3,), (2, 4), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_shapes_and_dtypes(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    model = make().eval()
    td = transitions(*batch, dtype=dtype)
    with torch.no_grad():
        out = model(td)["prediction", "loc"]
        attention = model.attention(LAYOUT.read(td), td["action"])
    assert out.shape == (*batch, 6) and out.dtype == torch.float32
    assert attention.shape == (*batch, 2, 4, 4)
    count = math.prod(batch)
    flat = td.float().reshape(count)
    expected, matrices = by_hand(model, flat)
    torch.testing.assert_close(out.reshape(count, 6), expected)
    torch.testing.assert_close(attention.reshape(count, 2, 4, 4), matrices)


def test_broadcast_actions_give_what_expanded_ones_give() -> None:
    model = make().eval()
    state, action = torch.randn(5, 1, 6), torch.randn(1, 7, 2)
    wide = state.expand(5, 7, 6), action.expand(5, 7, 2)
    torch.testing.assert_close(
        model.forward_tensors(state, action), model.forward_tensors(*wide)
    )
    torch.testing.assert_close(model.attention(state, action), model.attention(*wide))


def test_nested_layouts_give_what_flat_ones_give() -> None:
    flat, nested = make().eval(), make(NESTED, widths=WIDTHS).eval()
    td = transitions(9)
    x = td["observation"]
    parts = {
        "arm": x[:, [0, 1, 4]],
        "cup": TensorDict({"a": x[:, 6:7], "b": x[:, 5:6]}, [9]),
        "lid": x[:, 2:3],
    }
    tree = TensorDict({"observation": parts, "action": td["action"]}, [9])
    torch.testing.assert_close(
        nested(tree)["prediction", "loc"], flat(td)["prediction", "loc"]
    )


def test_recording_leaves_no_trace() -> None:
    model, td = make().eval(), transitions(5)
    state, action = LAYOUT.read(td), td["action"]
    before = model.forward_tensors(state, action)[0]
    model.attention(state, action)
    assert torch.equal(model.forward_tensors(state, action)[0], before)
    with pytest.raises(ValueError, match="action has the shape"):
        model.attention(state, action[:, :1])
    for layer in model.layers:
        assert not layer.self_attn._forward_hooks
        assert not layer.self_attn._forward_pre_hooks


def test_a_layer_without_attention_is_named() -> None:
    class Blind(torch.nn.MultiheadAttention):
        def forward(self, *args: Any, **kwargs: Any) -> Any:
            return super().forward(*args, **{**kwargs, "need_weights": False})

    model, td = make().eval(), transitions(5)
    model.layers[1].self_attn = Blind(8, 2, batch_first=True)
    with pytest.raises(RuntimeError, match="1 of 2 encoder layers returned their"):
        model.attention(LAYOUT.read(td), td["action"])
    model.layers = torch.nn.ModuleList()
    with pytest.raises(RuntimeError, match="0 of 0 encoder layers"):
        model.attention(LAYOUT.read(td), td["action"])


def test_layers_begin_with_weights_of_their_own() -> None:
    first, second = make().layers
    assert not torch.equal(first.self_attn.in_proj_weight, second.linear1.weight)
    assert not torch.equal(
        first.self_attn.in_proj_weight, second.self_attn.in_proj_weight
    )


def test_all_parameters_learn() -> None:
    model, td = make(predict={"cup": [5]}), transitions(30)
    model.fit_statistics(td)
    prediction = model.forward_tensors(LAYOUT.read(td), td["action"])
    loss = model.nll(prediction, model.targets(td))
    assert loss.shape == (30,)
    torch.testing.assert_close(
        loss, 0.5 * (prediction[0] - model.targets(td)).square().mean(-1)
    )
    loss.mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_dropout_is_for_training_only() -> None:
    model, td = make(dropout=0.5), transitions(30)
    model(td)
    tensors = LAYOUT.read(td), td["action"]
    noisy = [model.forward_tensors(*tensors)[0] for _ in range(2)]
    assert not torch.equal(*noisy)
    model.eval()
    assert torch.equal(*(model.forward_tensors(*tensors)[0] for _ in range(2)))


@pytest.mark.parametrize("layout", [LAYOUT, NESTED])
def test_config_copies_and_pickles(layout: EntityLayout) -> None:
    model = make(
        layout,
        widths=None if layout.is_flat else WIDTHS,
        feedforward=6,
        dropout=0.1,
        predict={"cup": [5 if layout.is_flat else 1]},
        variance_floor={"arm": 0.1, "cup": 0.2, "lid": 0.3},
        target="absolute",
    )
    model.set_action_bounds(-1.0, 2.0)
    twin = TransformerWorldModel.from_config(model.config)
    twin.load_state_dict(model.state_dict())
    for other in (twin, copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert other.config == model.config
        for name, value in model.state_dict().items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(other.state_dict()[name], value), name
    with pytest.raises(ValueError, match="another width, saved"):
        make(width=16, feedforward=6).load_state_dict(make(feedforward=6).state_dict())


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"layers": 0}, "layers must be an int of at least 1, got 0"),
        ({"heads": 1.5}, "heads must be an int"),
        ({"width": True}, "width must be an int"),
        ({"feedforward": -1}, "feedforward must be an int"),
        ({"heads": 3}, "width is 8, expected a multiple of the 3 heads"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1.0"),
        ({"out_keys": ["a", "b"]}, "out_keys must be one key"),
        ({"target": "next"}, "'change' or 'absolute'"),
        ({"predict": {"pot": [1]}}, "not entities of this layout"),
        ({"inputs": {"lid": ()}}, r"inputs give \['lid'\] no columns"),
    ],
)
def test_wrong_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_wrong_input() -> None:
    with pytest.raises(ValueError, match=r"state has the shape \[3, 5\]"):
        make().forward_tensors(torch.zeros(3, 5), torch.zeros(3, 2))
    with pytest.raises(ValueError, match="action_dim"):
        TransformerWorldModel(LAYOUT, 0)
