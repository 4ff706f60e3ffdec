"""The reward of cubes against their distances one by one."""

from __future__ import annotations

import pytest
import torch

from torchrl_caiac.envs.ogbench import ogbench_cube_reward


@pytest.mark.parametrize("cubes", [1, 2, 4])
@pytest.mark.parametrize("batch", [(), (50,), (5, 10)])
def test_rewards_are_those_of_distances(cubes, batch) -> None:
    generator = torch.Generator().manual_seed(0)
    achieved = torch.randn(*batch, 3 * cubes, generator=generator)
    desired = achieved + 0.3 * torch.randn(*batch, 3 * cubes, generator=generator)
    found = ogbench_cube_reward(achieved, desired)
    assert found.shape == batch
    for row, (own, goal) in enumerate(
        zip(achieved.reshape(-1, cubes, 3), desired.reshape(-1, cubes, 3), strict=True)
    ):
        metres = ((own - goal) / 10).square().sum(-1).sqrt()
        assert found.reshape(-1)[row] == (0 if bool((metres <= 0.04).all()) else -1)


@pytest.mark.parametrize(
    "shapes", [((), ()), ((2, 0),) * 2, ((2, 4),) * 2, ((3,), (6,))]
)
def test_other_shapes_are_refused(shapes) -> None:
    with pytest.raises(ValueError, match=r"expected \[\*B, 3 n\]"):
        ogbench_cube_reward(*map(torch.zeros, shapes))
