from __future__ import annotations

import pytest
import torch

from torchrl_caiac.transforms.rewards import call_reward


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_call_reward(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    like = torch.zeros(shape, dtype=dtype)
    goals = torch.arange(8.0).view(4, 2)
    for out in (goals[:, 1], goals[:, 1:], goals[:, 1] > 3):
        found = call_reward(lambda a, d, out=out: out, goals, goals, like)
        assert found.shape == like.shape and found.dtype == dtype
        assert found.flatten().tolist() == out.flatten().tolist()
    for wrong in (goals, goals[:2], 1.0):
        with pytest.raises(ValueError, match=r"reward_fn returned .*expected \[4\]"):
            call_reward(lambda a, d, wrong=wrong: wrong, goals, goals, like)
