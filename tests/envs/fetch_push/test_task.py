"""Distances and rewards of goals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchrl_caiac.envs.fetch_push import (
    fetch_push_distances,
    fetch_push_layout,
    fetch_push_reward,
)


class TestReward:
    goals = hnp.arrays(
        np.float64,
        st.tuples(st.integers(0, 3), st.integers(1, 4), st.sampled_from([3, 6, 9])),
        elements=st.floats(-0.06, 0.06),
    )

    @settings(max_examples=40)
    @given(achieved=goals, threshold=st.floats(0.01, 0.1))
    def test_numpy_torch_and_loop_agree(self, achieved, threshold):
        desired = np.roll(achieved, 1, axis=-1)
        distances = fetch_push_distances(achieved, desired)
        assert distances.shape == (*achieved.shape[:2], achieved.shape[-1] // 3)
        rewards = fetch_push_reward(achieved, desired, threshold=threshold)
        assert rewards.shape == achieved.shape[:-1]
        assert rewards.dtype == np.float32
        ours = torch.from_numpy(achieved), torch.from_numpy(desired)
        as_torch = fetch_push_reward(*ours, threshold=threshold)
        assert as_torch.dtype == torch.float32
        assert np.array_equal(as_torch.numpy(), rewards)
        assert np.allclose(fetch_push_distances(*ours).numpy(), distances)
        for place in np.ndindex(*rewards.shape):
            reached = [
                np.linalg.norm(
                    achieved[place][3 * i : 3 * i + 3]
                    - desired[place][3 * i : 3 * i + 3]
                )
                for i in range(achieved.shape[-1] // 3)
            ]
            assert distances[place] == pytest.approx(reached, abs=1e-12)
            if np.abs(np.array(reached) - threshold).min() > 1e-9:
                expected = 0.0 if max(reached) < threshold else -1.0
                assert rewards[place] == expected

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_shapes_and_dtypes(self, dtype):
        for batch in ((), (4,), (2, 3)):
            achieved = torch.zeros(*batch, 6, dtype=dtype)
            reward = fetch_push_reward(achieved, torch.full((6,), 0.01, dtype=dtype))
            assert reward.shape == batch and reward.dtype == torch.float32
            assert not reward.any()
            assert fetch_push_reward(achieved.numpy(), np.ones(6)).shape == batch

    def test_bad_widths(self):
        for achieved, desired, message in (
            (np.zeros(7), np.zeros(6), r"achieved.*\(7,\)"),
            (np.zeros(6), torch.zeros(2, 5), r"desired.*\(2, 5\)"),
            (np.float64(0), np.zeros(6), r"achieved.*\(\)"),
            (np.zeros(6), np.zeros(9), "same last dimension"),
            (np.zeros(6), np.zeros(0), r"desired.*\(0,\)"),
        ):
            with pytest.raises(ValueError, match=message):
                fetch_push_reward(achieved, desired)
        with pytest.raises(ValueError, match="num_cubes"):
            fetch_push_layout(0)
