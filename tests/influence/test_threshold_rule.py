"""The split of the scores of one entity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_caiac.influence.threshold_rule import MOVES, RESTS, split_scores

CLEAR, UNCLEAR = "two clear modes", "unclear"
NEVER, ALWAYS = "one mode: never influenced", "one mode: always influenced"


def mixture(
    low: int = 900, high: int = 100, *, apart: float = 2.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Log-normal scores and which are of the upper mode, ``apart`` decades higher."""
    rng = np.random.default_rng(seed)
    logs = np.concatenate(
        [rng.normal(-3, 0.25, low), rng.normal(-3 + apart, 0.25, high)]
    )
    is_high = np.arange(low + high) >= low
    order = rng.permutation(low + high)
    return 10 ** logs[order], is_high[order]


def accuracy(scores: np.ndarray, truth: np.ndarray, threshold: float) -> float:
    above = scores > threshold
    return float((above[truth].mean() + (~above)[~truth].mean()) / 2)


def slow_otsu(values: np.ndarray) -> float:
    """The variance between both sides of every gap, one by one."""
    values = np.sort(values)
    best, split = -1.0, 0.0
    for i in range(1, len(values)):
        if values[i] == values[i - 1]:
            continue
        low, high = values[:i], values[i:]
        between = len(low) * len(high) * (low.mean() - high.mean()) ** 2
        if between > best * (1 + 1e-12):
            best, split = between, (values[i - 1] + values[i]) / 2
    return split


@given(
    st.lists(st.integers(1, 300), min_size=2, max_size=40).filter(
        lambda x: len(set(x)) > 1
    )
)
def test_the_start_is_otsus_split(numbers: list[int]) -> None:
    scores = np.array(numbers, dtype=np.float64)
    found = np.log10(split_scores(scores).threshold)
    logs = np.log10(scores)

    def between(at: float) -> float:
        low, high = logs[logs <= at], logs[logs > at]
        return len(low) * len(high) * (low.mean() - high.mean()) ** 2

    assert between(found) == pytest.approx(between(slow_otsu(logs)), rel=1e-9)


@given(scale=st.floats(1e-3, 1e3), share=st.floats(0.02, 0.9), seed=st.integers(0, 99))
def test_two_modes_far_apart_need_no_motion(scale, share, seed) -> None:
    high = int(2000 * share)
    scores, truth = mixture(2000 - high, high, apart=2.5, seed=seed)
    split = split_scores(scale * scores)
    assert split.confidence == CLEAR
    assert accuracy(scale * scores, truth, split.threshold) > 0.97


@pytest.mark.parametrize("apart", [0.0, 0.3, 0.6])
def test_modes_that_overlap_are_not_clear(apart: float) -> None:
    scores, _ = mixture(apart=apart)
    split = split_scores(scores, why_unknown="no positions")
    assert split.confidence == UNCLEAR and "no positions" in split.reason


def test_a_few_outliers_are_no_mode() -> None:
    scores, _ = mixture(2000, 15, apart=3.0)
    assert split_scores(scores).confidence == UNCLEAR


def test_motion_makes_overlapping_modes_clear() -> None:
    scores, truth = mixture(5000, 500, apart=1.2)
    assert split_scores(scores).confidence == UNCLEAR
    split = split_scores(scores, np.where(truth, MOVES, RESTS).astype(np.int8))
    assert split.confidence == CLEAR and split.area > 0.99
    assert accuracy(scores, truth, split.threshold) > 0.95


def test_motion_moves_a_split_to_the_right_pair_of_modes() -> None:
    # Three modes, the widest gap between the two that are both at rest.
    rng = np.random.default_rng(0)
    logs = [rng.normal(m, 0.05, n) for m, n in ((-4, 400), (-1, 400), (-0.5, 200))]
    scores = 10 ** np.concatenate(logs)
    truth = np.arange(1000) >= 800
    alone = split_scores(scores).threshold
    assert accuracy(scores, truth, alone) < 0.8
    split = split_scores(scores, np.where(truth, MOVES, RESTS).astype(np.int8))
    assert split.confidence == CLEAR
    assert accuracy(scores, truth, split.threshold) > 0.97
    assert "moved from the scores' own split" in split.reason


def test_rows_near_contact_do_not_pull_the_split_up() -> None:
    # Rows at rest that could have been moved score as high as those that move.
    scores, truth = mixture(5000, 500)
    motion = np.where(truth, MOVES, RESTS).astype(np.int8)
    motion[np.flatnonzero(truth)[:150]] = RESTS
    split = split_scores(scores, motion)
    assert split.confidence == CLEAR
    assert split.threshold == split_scores(scores).threshold


def test_scores_that_miss_motion_are_not_clear() -> None:
    scores, _ = mixture(1000, 1000, apart=3.0)
    assert split_scores(scores).confidence == CLEAR
    motion = np.random.default_rng(1).integers(0, 2, 2000).astype(np.int8)
    split = split_scores(scores, motion)
    assert split.confidence == UNCLEAR and "moves by itself" in split.reason
    assert split.area == pytest.approx(0.5, abs=0.05)


def test_the_area_is_that_of_all_pairs() -> None:
    rng = np.random.default_rng(0)
    scores = rng.integers(1, 9, 200).astype(np.float64)
    motion = rng.integers(0, 2, 200).astype(np.int8)
    moves, rests = scores[motion == MOVES], scores[motion == RESTS]
    wins = (moves[:, None] > rests).mean() + (moves[:, None] == rests).mean() / 2
    assert split_scores(scores, motion).area == pytest.approx(wins)


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_what_never_moves_is_never_influenced(apart: float) -> None:
    scores, _ = mixture(apart=apart)
    split = split_scores(scores, np.full(1000, RESTS, np.int8))
    assert split.confidence == NEVER and "never moves in 1000 rows" in split.reason


def test_what_never_moves_may_be_in_reach_in_an_upper_mode() -> None:
    scores, _ = mixture(4000, 1000)
    split = split_scores(scores, np.full(5000, RESTS, np.int8))
    assert split.confidence == UNCLEAR
    assert "it never moves in 5000 rows" in split.reason
    assert split.threshold == split_scores(scores).threshold


def test_zeros_do_not_rule_out_influence_where_there_is_doubt() -> None:
    split = split_scores(np.zeros(500), doubt="its state changes")
    assert split.confidence == UNCLEAR and "its state changes" in split.reason


def test_one_unclear_row_is_not_never() -> None:
    scores, _ = mixture()
    motion = np.full(1000, RESTS, np.int8)
    motion[5] = -1
    assert split_scores(scores, motion).confidence == UNCLEAR


@pytest.mark.parametrize("moving", [1, 29])
def test_few_moving_rows_tell_nothing(moving: int) -> None:
    scores, _ = mixture()
    motion = np.full(1000, RESTS, np.int8)
    motion[:moving] = MOVES
    split = split_scores(scores, motion)
    assert split.confidence == UNCLEAR and f"moves in {moving} of" in split.reason


def test_what_always_moves() -> None:
    motion = np.full(1000, MOVES, np.int8)
    alike = 0.5 + np.linspace(0, 0.3, 1000)
    assert split_scores(alike, motion).confidence == ALWAYS
    scores, _ = mixture()  # some rows do without the agent
    assert split_scores(scores, motion).confidence == UNCLEAR


@pytest.mark.parametrize("count", [0, 1, 20, 99])
def test_few_rows_are_not_clear(count: int) -> None:
    scores, truth = mixture()
    motion = np.where(truth, MOVES, RESTS).astype(np.int8)[:count]
    for given_motion in (None, motion, np.zeros_like(motion)):
        split = split_scores(scores[:count], given_motion)
        assert split.confidence == UNCLEAR
        assert split.reason.startswith(f"only {count} rows")


def test_equal_scores() -> None:
    zero, one = np.zeros(500), np.ones(500)
    moving = np.where(np.arange(500) < 100, MOVES, RESTS).astype(np.int8)
    assert split_scores(zero).confidence == split_scores(-one).confidence == NEVER
    assert split_scores(zero, moving).confidence == UNCLEAR
    assert split_scores(one).confidence == UNCLEAR
    assert np.isnan(split_scores(one).threshold)
    assert split_scores(one, moving).confidence == UNCLEAR
    assert split_scores(one, np.zeros_like(moving)).confidence == NEVER


def test_zeros_are_a_mode_of_their_own() -> None:
    # As influence by motion: 0, or the distance in tolerances.
    rng = np.random.default_rng(0)
    scores = np.where(np.arange(1000) < 300, 1 + rng.exponential(20, 1000), 0.0)
    split = split_scores(scores)
    assert split.confidence == CLEAR
    assert split.threshold == pytest.approx(scores[scores > 0].min() / 2)
    binary = (scores > 0).astype(np.float64)
    assert split_scores(binary).threshold == 0.5
    assert split_scores(binary).confidence == CLEAR


@pytest.mark.parametrize(
    ("found", "near", "confidence"),
    [
        (100, 300, CLEAR),  # also scores 1 where it could be moved
        (100, 0, CLEAR),
        (94, 300, UNCLEAR),  # misses motion
        (100, 850, UNCLEAR),  # tells little
    ],
)
def test_scores_of_0_and_1_have_their_own_threshold(found, near, confidence) -> None:
    row = np.arange(1000)
    motion = np.where(row < 100, MOVES, RESTS).astype(np.int8)
    scores = ((row < found) | ((row >= 100) & (row < 100 + near))).astype(np.float64)
    split = split_scores(scores, motion)
    assert split.threshold == 0.5 and split.confidence == confidence
    never = split_scores(scores, np.full(1000, RESTS, np.int8))
    assert never.threshold == 0.5 and never.confidence == CLEAR
    assert "own threshold is 0.5; it never moves" in never.reason


@pytest.mark.parametrize(("moving", "confidence"), [(4, UNCLEAR), (5, CLEAR)])
def test_zeros_need_fewer_moving_rows(moving: int, confidence: str) -> None:
    scores = np.where(np.arange(400) < moving, 7.0, 0.0)
    motion = np.where(scores > 0, MOVES, RESTS).astype(np.int8)
    assert split_scores(scores, motion).confidence == confidence


def test_zeros_below_a_spread_are_small_scores() -> None:
    scores, truth = mixture()
    scores[np.flatnonzero(~truth)[:50]] = 0.0
    scores[np.flatnonzero(~truth)[50]] = 1e-12
    assert accuracy(scores, truth, split_scores(scores).threshold) > 0.98


def test_negative_scores_need_motion() -> None:
    scores, truth = mixture()
    shifted = np.where(truth, scores, -scores)
    assert split_scores(shifted).confidence == UNCLEAR
    split = split_scores(shifted, np.where(truth, MOVES, RESTS).astype(np.int8))
    assert split.confidence == CLEAR
    assert accuracy(shifted, truth, split.threshold) > 0.97
