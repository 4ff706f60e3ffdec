"""Influence from the attention of a transformer."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from tests.influence.scoring import ready
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import AttentionInfluence, score_buffer
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel
from torchrl_caiac.transforms import CAIACTransform, CoDATransform

LAYOUT = EntityLayout({"arm": [0, 1], "cup": [2], "lid": [3]})
N = 3


def make(**kwargs: Any) -> TransformerWorldModel:
    torch.manual_seed(0)
    settings: dict[str, Any] = {"layers": 3, "heads": 2, "width": 8, **kwargs}
    return ready(TransformerWorldModel(LAYOUT, 2, **settings))


def transitions(*batch: int, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def random(width: int) -> torch.Tensor:
        return torch.randn(*batch, width, generator=generator)

    return TensorDict(
        {
            "observation": random(4),
            "action": random(2),
            "next": {"observation": random(4)},
        },
        batch,
    )


class Known(TransformerWorldModel):
    """A model with a given attention."""

    def attention(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.known.expand(*state.shape[:-1], *self.known.shape)


def known(*layers: torch.Tensor) -> AttentionInfluence:
    model = ready(Known(LAYOUT, 2, 1, 1, 4))
    model.known = torch.stack(layers)
    return AttentionInfluence(model)


def test_one_layer_is_transposed() -> None:
    # The output of the lid (query 2) attends to the action (key 3).
    attention = torch.zeros(N + 1, N + 1)
    attention[2, 3] = 1.0
    graph = known(attention)(transitions(2))
    expected = torch.zeros(2, N + 1, N)
    expected[:, 3, 2] = 1.0  # from the action to the lid
    torch.testing.assert_close(graph, expected)


def test_layers_are_chained_from_the_input_to_the_output() -> None:
    # First the cup reads the action, then the lid reads the cup. In the opposite order
    # the lid reads the cup before the cup has read the action.
    first, second = torch.eye(N + 1), torch.eye(N + 1)
    first[1] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    second[2] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    graph = known(first, second)(transitions())
    assert graph[3].tolist() == [0.0, 1.0, 1.0]
    graph = known(second, first)(transitions())
    assert graph[3].tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize("batch", [(), (7,), (2, 3), (0,)])
def test_product_of_the_layers(batch: tuple[int, ...]) -> None:
    model, td = make().eval(), transitions(*batch)
    before = td.clone()
    graph = AttentionInfluence(model)(td)
    assert graph.shape == (*batch, N + 1, N) and graph.dtype == torch.float32
    assert not graph.requires_grad and (td == before).all()
    with torch.no_grad():
        layers = model.attention(LAYOUT.read(td), td["action"])
    slow = torch.zeros(*batch, N + 1, N)
    # The sum over all paths of the products along them.
    for cause in range(N + 1):
        for effect in range(N):
            for a in range(N + 1):
                for b in range(N + 1):
                    slow[..., cause, effect] += (
                        layers[..., 2, effect, b]
                        * layers[..., 1, b, a]
                        * layers[..., 0, a, cause]
                    )
    torch.testing.assert_close(graph, slow)
    torch.testing.assert_close(graph.sum(-2), torch.ones(*batch, N))
    only = AttentionInfluence(model, action_only=True)(td)
    assert torch.equal(only, graph[..., -1, :])


def test_chunks_and_modes_make_no_difference() -> None:
    model, td = make(dropout=0.3), transitions(50)
    model.state_norm.update(LAYOUT.read(td))
    whole = AttentionInfluence(model)
    small = AttentionInfluence(model, max_memory=1)
    assert small.chunk_rows == 1 < whole.chunk_rows
    model.layers[0].eval()
    graph = whole(td)
    assert model.training and not model.layers[0].training
    assert model.state_norm.count == 50
    torch.testing.assert_close(small(td), graph)
    torch.testing.assert_close(pickle.loads(pickle.dumps(whole))(td), graph)


def buffer(kind: str, path: Path, data: TensorDict) -> ReplayBuffer:
    storage = (
        LazyMemmapStorage(len(data), scratch_dir=str(path))
        if kind == "memmap"
        else LazyTensorStorage(len(data))
    )
    rb = ReplayBuffer(storage=storage, batch_size=40)
    rb.extend(data)
    return rb


@pytest.mark.parametrize("kind", ["memory", "memmap"])
def test_scores_in_a_storage_for_coda_and_coda_action(
    kind: str, tmp_path: Path
) -> None:
    data = transitions(60)
    data["episode"] = torch.arange(60) // 10
    rb, model = buffer(kind, tmp_path, data), make().eval()
    graphs = AttentionInfluence(model)
    action = AttentionInfluence(model, action_only=True)
    options: Any = {"lookahead": 0, "done_key": None, "progress": False}
    score_buffer(rb, graphs, 7, key=("coda", "graph"), **options)
    score_buffer(rb, action, key=("coda", "action"), **options)
    stored = rb.storage[:]["coda", "graph"]
    torch.testing.assert_close(stored, graphs(data))
    torch.testing.assert_close(rb.storage[:]["coda", "action"], stored[:, -1])
    # The state after the last row has no action, so the maximum is without it.
    ahead = {**options, "lookahead": 1, "key": ("coda", "ahead")}
    score_buffer(rb, graphs, **ahead)
    last = torch.arange(9, 60, 10)
    torch.testing.assert_close(rb.storage[:]["coda", "ahead"][last], stored[last])
    with pytest.raises(ValueError, match="have other settings: estimator"):
        score_buffer(rb, action, key=("coda", "graph"), **options)
    threshold = stored[:, -1].median().item()
    rb.append_transform(
        CAIACTransform(LAYOUT, threshold=threshold, score_key=("coda", "action"))
    )
    batch = rb.sample()
    free = batch["coda", "action"] <= threshold
    assert batch["caiac", "swapped"].any()
    assert not (batch["caiac", "swapped"] & ~free).any()
    rb = buffer("memory", tmp_path, data)
    score_buffer(rb, graphs, key=("coda", "graph"), **options)
    rb.append_transform(CoDATransform(LAYOUT, threshold=stored.quantile(0.9).item()))
    batch = rb.sample()
    links = batch["coda", "graph"][:, -1] > rb.transform[-1].threshold
    assert batch["caiac", "swapped"].any()
    assert not (batch["caiac", "swapped"] & links).any()


def test_rejects_models_without_attention() -> None:
    with pytest.raises(TypeError, match="a GaussianWorldModel has no attention"):
        AttentionInfluence(GaussianWorldModel(LAYOUT, 2, (8,)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"predicts no column of \['cup'\]"):
        AttentionInfluence(make(predict={"cup": ()}))
    with pytest.raises(ValueError, match="max_memory"):
        AttentionInfluence(make(), max_memory=0)
    with pytest.raises(ValueError, match="the model was never fitted"):
        AttentionInfluence(TransformerWorldModel(LAYOUT, 2, 1, 1, 4))


def test_rejects_input_that_is_not_finite() -> None:
    td = transitions(6)
    model = make()
    estimator = AttentionInfluence(model)
    td["observation"][4, 2] = torch.nan
    with pytest.raises(ValueError, match="'observation' is nan for entity 'cup' in"):
        estimator(td)
    td = transitions(6)
    td["action"][5, 1] = torch.inf
    with pytest.raises(ValueError, match="'action' is inf in column 1 of row 5"):
        estimator(td)
    with pytest.raises(KeyError, match=r"lack the action .*action"):
        estimator(td.exclude("action"))


def test_rejects_attention_that_is_nan() -> None:
    attention = torch.eye(N + 1)
    attention[1, 0] = torch.nan
    with pytest.raises(ValueError, match=r"attention of \['cup'\] is NaN.*row 0"):
        known(attention)(transitions(2))
    model = make()
    with torch.no_grad():
        model.layers[0].linear1.weight.fill_(torch.nan)
    with pytest.raises(ValueError, match=r"\['arm', 'cup', 'lid'\] is NaN"):
        AttentionInfluence(model)(transitions(2))
