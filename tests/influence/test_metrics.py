from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.influence import best_threshold, influence_report, roc_auc

scores = st.lists(
    st.tuples(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 3.0]), st.booleans()),
    min_size=1,
    max_size=30,
)


def slow_auc(score, truth):
    wins = [
        1.0 if a > b else 0.5 if a == b else 0.0
        for a, up in zip(score, truth, strict=True)
        if up
        for b, down in zip(score, truth, strict=True)
        if not down
    ]
    return sum(wins) / len(wins) if wins else math.nan


def balanced_accuracy(score, truth, threshold):
    positive = [a > threshold for a, t in zip(score, truth, strict=True) if t]
    negative = [a <= threshold for a, t in zip(score, truth, strict=True) if not t]
    return (sum(positive) / len(positive) + sum(negative) / len(negative)) / 2


class TestMetrics:
    @settings(max_examples=100, deadline=None)
    @given(scores)
    def test_auc_is_the_share_of_ordered_pairs(self, rows):
        score, truth = (np.array(x) for x in zip(*rows, strict=True))
        assert roc_auc(score, truth) == pytest.approx(
            slow_auc(score, truth), nan_ok=True
        )

    @settings(max_examples=100, deadline=None)
    @given(scores)
    def test_no_threshold_has_a_higher_balanced_accuracy(self, rows):
        score, truth = (np.array(x) for x in zip(*rows, strict=True))
        threshold, accuracy = best_threshold(score, truth)
        if truth.all() or not truth.any():
            assert math.isnan(threshold) and math.isnan(accuracy)
            return
        assert math.isfinite(threshold)
        assert accuracy == pytest.approx(balanced_accuracy(score, truth, threshold))
        for other in (-2.0, *score, *(score + 0.1)):
            assert balanced_accuracy(score, truth, other) <= accuracy + 1e-12

    def test_best_threshold_is_in_the_middle_of_the_widest_gap(self):
        score, truth = [0.0, 0.1, 0.9, 1.0], np.array([False, False, True, True])
        assert best_threshold(score, truth) == (0.5, 1.0)
        assert best_threshold([0.5, 0.5], np.array([True, False])) == (0.5, 0.5)

    def test_accepts_tensors(self):
        score, truth = torch.tensor([0.1, 0.9]), torch.tensor([False, True])
        assert roc_auc(score, truth) == 1.0

    def test_report_of_each_entity(self):
        truth = torch.tensor(
            [[True, True, False], [True, False, False], [True, True, False]]
        )
        values = torch.tensor([[9.0, 0.9, 0.1], [9.0, 0.5, 0.4], [9.0, 0.2, 0.1]])
        report = influence_report(values, truth, ["robot", "cup", "ball"], 0.3)
        assert list(report) == ["robot", "cup", "ball"]
        cup = report["cup"]
        assert cup["auc"] == 0.5
        assert cup["true_positive_rate"] == 0.5 and cup["false_positive_rate"] == 1.0
        assert cup["influenced"] == pytest.approx(2 / 3)
        assert cup["below_threshold"] == pytest.approx(1 / 3)
        assert cup["best_balanced_accuracy"] == 0.75
        assert math.isnan(report["ball"]["auc"])
        assert math.isnan(report["ball"]["true_positive_rate"])
        assert report["ball"]["false_positive_rate"] == pytest.approx(1 / 3)
        assert math.isnan(report["robot"]["false_positive_rate"])

    def test_rejects_bad_input(self):
        truth = np.array([True, False])
        with pytest.raises(
            ValueError, match=r"NaN \(not scored\) or infinite in 1 rows"
        ):
            roc_auc([np.nan, 1.0], truth)
        with pytest.raises(ValueError, match="infinite in 1 rows"):
            influence_report([[np.inf], [0.0]], truth[:, None], ["kettle"], 0.3)
        with pytest.raises(ValueError, match="expected the same"):
            roc_auc([1.0], truth)
        with pytest.raises(ValueError, match="expected bool"):
            best_threshold([1.0, 2.0], [1, 0])
        with pytest.raises(ValueError, match="empty"):
            best_threshold([], np.zeros(0, dtype=bool))
        with pytest.raises(ValueError, match=r"\[S, 2\]"):
            influence_report(np.zeros((2, 3)), np.zeros((2, 3), bool), ["a", "b"], 0.3)


@pytest.mark.gpu
def test_scores_on_a_gpu() -> None:
    scores, truth = torch.tensor([[0.9], [0.1]]), torch.tensor([[True], [False]])
    on_cpu = influence_report(scores, truth, ["cup"], 0.5)
    assert influence_report(scores.cuda(), truth.cuda(), ["cup"], 0.5) == on_cpu
