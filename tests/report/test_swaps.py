from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.report.walks import LAYOUT, scored_dataset, transitions
from torchrl_caiac import EntityLayout
from torchrl_caiac.report.places import Place, entity_places
from torchrl_caiac.report.swaps import (
    CELLS,
    PLANE,
    SampledSwaps,
    choose_examples,
    moved_entities,
    pair_coverage,
    sample_swaps,
)
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import trajectory_index


def swaps_of(scored: ScoredDataset, rows: int = 2048, **options: float) -> SampledSwaps:
    return sample_swaps(
        scored.data, scored.layout, scored.thresholds, rows=rows, **options
    )


class TestSamples:
    def test_only_free_entities_of_chosen_samples_change(self, walks) -> None:
        swaps = swaps_of(walks)
        stored = walks.layout.read(walks.data)
        assert torch.equal(swaps.recorded, stored[swaps.rows])
        assert int(swaps.counterfactual.sum()) == 1024
        assert not swaps.swapped[~swaps.counterfactual].any()
        assert not (swaps.swapped & ~walks.is_free[swaps.rows]).any()
        # Whatever is free is swapped, as every batch has donors.
        assert swaps.no_donor == 0
        free = walks.is_free[swaps.rows][swaps.counterfactual]
        assert torch.equal(swaps.swapped[swaps.counterfactual], free)
        # What is swapped is the state of that entity in a row in which it is free too.
        slices = walks.layout.slices()
        for n, name in enumerate(walks.layout.names):
            own = swaps.swapped[:, n]
            kept = swaps.made[~own][:, slices[name]]
            assert torch.equal(kept, swaps.recorded[~own][:, slices[name]])
            donors = stored[walks.is_free[:, n]][:, slices[name]]
            made = swaps.made[own][:, slices[name]]
            assert (made[:, None] == donors).all(-1).any(-1).all()

    def test_seed_and_ratio(self, walks) -> None:
        first, again, other = (swaps_of(walks, seed=seed) for seed in (3, 3, 4))
        assert torch.equal(first.made, again.made)
        assert not torch.equal(first.rows, other.rows)
        assert int(swaps_of(walks, ratio=0.25).counterfactual.sum()) == 512

    def test_dataset_stays(self, walks) -> None:
        before = walks.data.clone()
        swaps_of(walks)
        assert (before == walks.data).all()

    def test_nested_and_other_keys(self) -> None:
        data = transitions(5, 10, 3)
        nested = TensorDict(
            {
                "state": {
                    "arm": data["observation"][:, :1],
                    "cup": data["observation"],
                },
                "image": torch.zeros(50, 8, 8),
                "next": {
                    "state": {
                        "arm": data["next", "observation"][:, :1],
                        "cup": data["next", "observation"],
                    }
                },
                "scores": torch.zeros(50, 2),
            },
            [50],
        )
        layout = EntityLayout.from_keys(
            {"arm": ("state", "arm"), "cup": ("state", "cup")}, fixed=["arm"]
        )
        swaps = sample_swaps(nested, layout, {"cup": 0.1}, score_key="scores", rows=512)
        assert swaps.swapped[swaps.counterfactual].tolist() == [[False, True]] * 256


class TestCoverage:
    def test_planes_against_sets(self, walks) -> None:
        swaps = swaps_of(walks)
        places = entity_places(walks.layout, walks.data)
        pairs = pair_coverage(swaps, places, walks.layout.fixed)
        assert {pair.names for pair in pairs} == {
            ("arm", "cup"),
            ("arm", "box"),
            ("cup", "box"),
        }
        gains = [pair.share_after - pair.share_before for pair in pairs]
        assert gains == sorted(gains, reverse=True) and gains[-1] > 0

        def cell(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[tuple]:
            # Which of the intervals between the edges, counted by comparison.
            found = []
            for value in values:
                steps = (value - low) / (high - low) * PLANE
                found.append(tuple(np.clip(np.ceil(steps) - 1, 0, PLANE - 1)))
            return found

        for pair in pairs:
            cells = {}
            for name in pair.names:
                features = list(places[name].features)[:2]
                recorded = swaps.recorded[:, features].double().numpy()
                made = swaps.made[:, features].double().numpy()
                low, high = (
                    np.quantile(recorded, q, axis=0, method="nearest")
                    for q in (0.005, 0.995)
                )
                cells[name] = cell(recorded, low, high), cell(made, low, high)
            one, two = (cells[name] for name in pair.names)
            before = set(zip(one[0], two[0], strict=True))
            after = set(zip(one[1], two[1], strict=True))
            possible = len(set(one[0])) * len(set(two[0]))
            assert pair.possible == possible
            # A value on an edge may fall on either side, in two ways of rounding.
            assert pair.share_before == pytest.approx(
                len(before) / possible, abs=4 / possible
            )
            assert pair.share_after == pytest.approx(
                len(after) / possible, abs=4 / possible
            )

    def test_intervals(self) -> None:
        values = torch.arange(200.0)
        recorded = torch.stack([values, values], -1)
        made = torch.stack([values, values.flip(0)], -1)
        flags = torch.tensor([False, True]).expand(200, 2)
        swaps = SampledSwaps(torch.arange(200), recorded, made, flags[:, 1], flags, 0)
        places = {"a": Place((0,), ("x",), (0.0,)), "b": Place((1,), ("y",), (0.0,))}
        (pair,) = pair_coverage(swaps, places, ["a"])
        assert pair.before.sum() == CELLS and torch.equal(
            pair.before, torch.eye(CELLS, dtype=torch.bool)
        )
        assert pair.share_before == CELLS / CELLS**2
        # On the other diagonal a few values lie in neighbouring cells.
        assert pair.after.flip(1).diagonal().all()
        assert pair_coverage(swaps, places, ["a", "b"]) == []

    @pytest.mark.parametrize(
        "floor, pairs",
        [(0.0, 1), (0.2, 1), (0.3, 0)],
        ids=["unknown", "below", "noise"],
    )
    def test_what_never_moves_is_left_out(self, floor: float, pairs: int) -> None:
        recorded = torch.stack([torch.arange(100.0), torch.linspace(0, 1, 100)], -1)
        flags = torch.zeros(100, 2, dtype=torch.bool)
        swaps = SampledSwaps(
            torch.arange(100), recorded, recorded, flags[:, 0], flags, 0
        )
        places = {"a": Place((0,), ("x",), (0.0,)), "b": Place((1,), ("y",), (floor,))}
        assert len(pair_coverage(swaps, places, ())) == pairs

    def test_constant_entity(self) -> None:
        recorded = torch.tensor([[0.0, 5.0], [1.0, 5.0]])
        flags = torch.zeros(2, 2, dtype=torch.bool)
        swaps = SampledSwaps(torch.arange(2), recorded, recorded, flags[:, 0], flags, 0)
        places = {"a": Place((0,), ("x",), (0.0,)), "b": Place((1,), ("y",), (0.0,))}
        assert pair_coverage(swaps, places, ()) == []


class TestExamples:
    def test_varied_and_moved(self, walks) -> None:
        swaps = swaps_of(walks)
        places = entity_places(walks.layout, walks.data)
        index = trajectory_index(walks.data)
        chosen = choose_examples(
            swaps, ~walks.is_free, places, walks.layout.fixed, index, 6
        )
        moved, _ = moved_entities(swaps, places)
        assert len(chosen) == 6
        assert swaps.counterfactual[chosen].all() and moved[chosen].any(-1).all()
        trajectories = index.numbers()[swaps.rows[chosen]].tolist()
        assert len(set(trajectories)) == 6
        # The agent is busy with another object in the first ones.
        busy = ~walks.is_free[swaps.rows[chosen]][:, 1:]
        assert busy.any(-1).sum() >= 2

    def test_as_many_as_there_are(self) -> None:
        data = transitions(1, 6, 11)
        scored = scored_dataset(data, LAYOUT, thresholds={"cup": 2.0, "box": -1.0})
        swaps = swaps_of(scored, rows=512)
        places = entity_places(LAYOUT, data)
        chosen = choose_examples(
            swaps,
            ~scored.is_free,
            places,
            LAYOUT.fixed,
            trajectory_index(data),
            100,
        )
        assert len(chosen) == len(set(swaps.rows[chosen].tolist())) <= 6
        assert len(chosen) > 3

    def test_nothing_swapped(self) -> None:
        data = transitions(2, 6, 11)
        scored = scored_dataset(data, LAYOUT, thresholds={"cup": -1.0, "box": -1.0})
        swaps = swaps_of(scored, rows=512)
        places = entity_places(LAYOUT, data)
        index = trajectory_index(data)
        assert not swaps.swapped.any()
        assert (
            choose_examples(swaps, ~scored.is_free, places, LAYOUT.fixed, index, 3)
            == []
        )
