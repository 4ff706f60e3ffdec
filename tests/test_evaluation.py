from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.evaluation import (
    Candidate,
    compare_influence,
    swap_shares,
)

NAMES = ("arm", "cup", "box")
LAYOUT = EntityLayout({"arm": [0], "cup": [1], "box": [2]}, fixed=["arm"])


def rows(count: int = 60) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(count, 3, generator=generator)
    done = (torch.arange(count) % 20 == 19)[:, None]
    return TensorDict(
        {
            "observation": state,
            "action": torch.rand(count, 1, generator=generator),
            "episode": torch.arange(count) // 20,
            "next": {"observation": state, "done": done},
        },
        [count],
    )


class Observed:
    """Scores that are the observation; in graphs, the row of the action."""

    def __init__(self, graph: bool = False) -> None:
        self.layout, self.graph = LAYOUT, graph

    def __call__(self, td):
        scores = td["observation"]
        if not self.graph:
            return scores
        graph = torch.zeros(*scores.shape[:-1], 4, 3)
        graph[..., -1, :] = scores
        return graph


def every_draw(scores, truth, transform, batches=60):
    """The shares of infeasible swaps, draw by draw in Python."""
    generator = torch.Generator().manual_seed(0)
    swapped_rows, counts, bad = [], [0] * 3, [0] * 3
    for _ in range(batches):
        choice = torch.randint(len(scores), (32,), generator=generator)
        draw = transform.generate_parameters(scores[choice], generator)
        offset = 32 - len(draw.swapped)
        chosen = torch.ones(len(draw.swapped)) if draw.chosen is None else draw.chosen
        for i, row in enumerate(draw.swapped.tolist()):
            if not chosen[i]:
                assert not any(row)
                continue
            swapped_rows.append(any(row))
            for j, swapped in enumerate(row):
                if swapped:
                    own = truth[choice[offset + i], j]
                    donor = truth[choice[draw.donors[i, j]], j]
                    counts[j] += 1
                    bad[j] += bool(own or donor)
    share = [b / c if c else math.nan for b, c in zip(bad, counts, strict=True)]
    return sum(swapped_rows) / len(swapped_rows), share, sum(bad) / max(1, sum(counts))


@given(
    threshold=st.sampled_from([0.0, 0.3, 0.7]),
    ratio=st.sampled_from([0.25, 1.0]),
    seed=st.integers(0, 9),
)
def test_shares_match_single_draws(threshold, ratio, seed):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(50, 3, generator=generator)
    truth = torch.rand(50, 3, generator=generator) < 0.3
    transform = CAIACTransform(LAYOUT, threshold, counterfactual_ratio=ratio)
    found = swap_shares(transform, scores, truth, batch_size=32, batches=60)
    expected = every_draw(scores, truth, transform)
    assert found.rows == expected[0]
    torch.testing.assert_close(
        found.infeasible, torch.tensor(expected[1], dtype=torch.float64), equal_nan=True
    )
    if found.rows:
        assert found.infeasible_total == pytest.approx(expected[2])
    else:
        assert math.isnan(found.infeasible_total)


def test_all_swaps_are_feasible_by_ground_truth_and_none_by_its_opposite():
    truth = torch.rand(200, 3) < 0.5
    truth[:, 0] = True
    transform = CAIACTransform(LAYOUT, 0.5, counterfactual_ratio=1.0)
    assert swap_shares(transform, truth.float(), truth).infeasible_total == 0
    assert swap_shares(transform, 1 - truth.float(), truth).infeasible_total == 1


def test_components_are_compared_entity_by_entity():
    graph = torch.zeros(100, 4, 3)
    graph[:, 1, 2] = 1.0  # cup and box are one component
    truth = torch.zeros(100, 3, dtype=torch.bool)
    truth[:, 2] = True
    found = swap_shares(CoDATransform(LAYOUT), graph, truth)
    assert found.rows == 1
    assert found.infeasible[1:].tolist() == [0, 1]
    assert found.infeasible_total == 0.5
    assert math.isnan(found.infeasible[0])


@pytest.mark.parametrize(
    ("transform", "shape", "message"),
    [
        (CAIACTransform(LAYOUT, window=2), (8, 3), "windows of 2 rows"),
        (CAIACTransform(LAYOUT, donors=LazyTensorStorage(3)), (8, 3), "donor"),
        (CAIACTransform(LAYOUT), (8, 4, 3), r"\[8, 4, 3\].*expected \[8, 3\]"),
        (CoDATransform(LAYOUT), (8, 3), r"expected \[8, 4, 3\]"),
    ],
)
def test_rejects_transforms_and_shapes_that_do_not_fit(transform, shape, message):
    with pytest.raises(ValueError, match=message):
        swap_shares(transform, torch.zeros(shape), torch.zeros(8, 3).bool())


def test_table_of_several_estimators():
    data = rows()
    before = data.clone()
    truth = data["observation"] > 0.5
    truth[:, 2] = False  # the box has no AUC
    table = compare_influence(
        data,
        truth,
        {
            "row": Candidate(Observed(), CAIACTransform(LAYOUT, 0.5), 1, 12.0),
            "smooth": Candidate(Observed(), CAIACTransform(LAYOUT, 0.5), 5),
            "graph": Candidate(Observed(graph=True), CoDATransform(LAYOUT, 0.5)),
        },
        progress=False,
    )
    assert (data == before).all() and data.keys() == before.keys()
    assert [(r["estimator"], r["entity"]) for r in table] == list(
        product(("row", "smooth", "graph"), ("all", "cup", "box"))
    )
    by_name = {(r["estimator"], r["entity"]): r for r in table}
    row, cup, box = (by_name["row", entity] for entity in ("all", "cup", "box"))
    assert row["auc"] == cup["auc"] == cup["true_positive_rate"] == 1
    assert math.isnan(box["auc"])
    high = data["observation"][:, 1:] > 0.5
    assert row["density"] == pytest.approx(high.float().mean())
    assert box["false_positive_rate"] == pytest.approx(high[:, 1].float().mean())
    assert row["infeasible"] == 0
    assert row["fit_seconds"] == 12 and row["score_seconds"] >= 0
    assert by_name["smooth", "all"]["auc"] < 1
    assert math.isnan(by_name["smooth", "all"]["fit_seconds"])
    graph = by_name["graph", "all"]
    assert graph["auc"] == 1
    # Of the nine links between different nodes, only those of the action exist.
    everything = (data["observation"] > 0.5).float().mean().item()
    assert graph["density"] == pytest.approx(everything / 3)
