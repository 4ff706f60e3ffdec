"""A scripted expert for Fetch-Push that remembers nothing.

Its action is a function of the observation and the goal, so that a policy that sees the
same can learn it: from demonstrations with hidden phases ("now going around the cube")
nothing can be learnt that acts on observations.

``python -m torchrl_caiac.envs.fetch_push.expert --episodes 200 --action-noise 0.2``
measures it.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["FetchPushExpert"]

logger = logging.getLogger("torchrl_caiac.envs.fetch_push.expert")

# Heights of the gripper, metres: the fingers' tips next to a cube, and above all cubes.
_PUSH_HEIGHT, _SAFE_HEIGHT = 0.425, 0.50
_LOW = 0.445
# What an action of 1 moves the gripper by in one step, metres; one step, seconds.
_REACH = 0.033
_STEP_SECONDS = 0.04
# The gripper descends this far behind the cube's centre. (Half a cube and half of the
# closed fingers are 4 cm.)
_BEHIND = 0.065
# It pushes while it is low, this far behind the centre and this near to the line from
# the cube to its goal.
_PUSH_BEHIND = (0.025, 0.075)
_PUSH_ASIDE = 0.02
# A cube that is being pushed is brought this near to its goal; one that is not is left
# alone until it is this far: a threshold with hysteresis, whose memory is the place of
# the gripper.
_DONE_PUSHED, _DONE_LEFT = 0.015, 0.04
# A way or goal with a cube nearer than this is blocked; the gripper flies over cubes
# that are nearer than this to its way.
_BLOCKED, _CLEARANCE = 0.06, 0.055
# A cube let go at speed v (metres per second) slides on for v^2 / (2 * 9.81), its
# friction being 1. The pusher slows down with it: this share of the speed from which
# the cube would slide to its goal.
_DECELERATION = 9.81
_SPEED_SHARE = 0.6
_SIDEWAYS_GAIN = 20.0


class FetchPushExpert:
    """Pushes one cube after the other to its goal (the expert data of A.6.2).

    It chooses a cube that is not at its goal: the one it is pushing, else one whose way
    is free and which does not end up in the way of another, else the nearest to its
    goal. It flies behind that cube (opposite to the goal), descends, pushes along the
    line to the goal with lateral correction, and flies there again when it has lost the
    line. Since cubes slide on, it brakes before the goal. When all cubes are done it
    goes up and waits. Cubes that stand in each other's way may be pushed back and forth
    for long: with two cubes this is rare, with three it costs some episodes.

    Why episodes have 100 steps: the median episode with two cubes is done after 30
    steps, after 37 with the noise of the data (0.2). But of 200 episodes with noise 36
    are not done after 50 steps, and 1 after 100: pushes that went astray are begun
    anew. In episodes of 50 steps the expert would show mostly the starts that are easy.

    Args:
        num_cubes: ``n``.

    Keyword Args:
        action_noise: standard deviation of the noise on every action.
        rng: source of the noise; a ``numpy.random.Generator`` or a seed.

    Raises:
        ValueError: ``num_cubes`` or ``action_noise`` is out of range.

    Example:
        >>> from torchrl_caiac.envs.fetch_push.env import FetchPushCubes
        >>> env, expert = FetchPushCubes(2), FetchPushExpert(2)
        >>> observation, info = env.reset(seed=0)
        >>> for _ in range(100):
        ...     observation, *_, info = env.step(expert(observation))
        >>> bool(info["success"])
        True
    """

    def __init__(
        self,
        num_cubes: int = 2,
        *,
        action_noise: float = 0.0,
        rng: np.random.Generator | int | None = None,
    ) -> None:
        if num_cubes < 1:
            raise ValueError(f"num_cubes is {num_cubes}, wanted at least 1")
        if not (np.isfinite(action_noise) and action_noise >= 0):
            raise ValueError(
                f"action_noise is {action_noise}, wanted a standard deviation of at "
                "least 0"
            )
        self.num_cubes = num_cubes
        self.action_noise = action_noise
        self.rng = np.random.default_rng(rng)

    def __call__(self, observation: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return the action with noise, clipped.

        Args:
            observation: see :meth:`act`.

        Returns:
            ``[*B, 4]`` in [-1, 1], float32.
        """
        action = self.act(observation)
        noise = self.action_noise * self.rng.normal(size=action.shape)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)

    def act(self, observation: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the action without noise.

        Args:
            observation: of :class:`~torchrl_caiac.envs.FetchPushCubes`, or
                a batch: ``"observation"`` ``[*B, 10 + 12 n]`` and ``"desired_goal"``
                ``[*B, 3 n]``.

        Returns:
            ``[*B, 4]`` in [-1, 1]; the fourth number, which does nothing, is 0.
        """
        n = self.num_cubes
        state = np.asarray(observation["observation"], dtype=np.float64)
        goal = np.asarray(observation["desired_goal"], dtype=np.float64)
        for name, value, width in (
            ("observation", state, 10 + 12 * n),
            ("desired_goal", goal, 3 * n),
        ):
            if not value.shape or value.shape[-1] != width:
                raise ValueError(
                    f"{name!r} has shape {value.shape}, wanted [*B, {width}] for "
                    f"{n} cubes"
                )
        batch = state.shape[:-1]
        action = self._act(state.reshape(-1, 10 + 12 * n), goal.reshape(-1, n, 3))
        return action.reshape(*batch, 4)

    def _act(
        self, state: NDArray[np.float64], goals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        rows = np.arange(len(state))
        gripper, height = state[:, :2], state[:, 2]
        columns = state[:, 10:].reshape(len(state), self.num_cubes, 12)
        cubes, velocity = columns[..., :2], columns[..., 6:8] / _STEP_SECONDS
        way = goals[..., :2] - cubes
        distance = _norm(way)
        ahead = way / np.maximum(distance, 1e-6)[..., None]
        # Where the gripper is, seen from each cube [R, n].
        offset = gripper[:, None] - cubes
        behind = -(offset * ahead).sum(-1)
        aside = offset + behind[..., None] * ahead
        pushing = (
            (height < _LOW)[:, None]
            & (behind > _PUSH_BEHIND[0])
            & (behind < _PUSH_BEHIND[1])
            & (_norm(aside) < _PUSH_ASIDE)
        )
        slide = velocity * _norm(velocity)[..., None] / (2 * _DECELERATION)
        limit = np.where(pushing, _DONE_PUSHED, _DONE_LEFT)
        todo: NDArray[np.bool_] = np.asarray(_norm(way - slide) > limit)

        # Metres, and one for each obstacle.
        cost = distance - 2.0 * pushing
        target = goals[..., :2]
        # [R, i, j]: does cube j stand in the way of cube i; does i's goal, of cube j?
        stands = _blocks(cubes[:, None, :], cubes[:, :, None], target[:, :, None])
        would = _blocks(target[:, :, None], cubes[:, None, :], target[:, None, :])
        others = ~np.eye(self.num_cubes, dtype=np.bool_)
        cost = (
            cost
            + (others & stands).sum(-1)
            + (others & would & todo[:, None, :]).sum(-1)
        )
        chosen = np.where(todo, cost, np.inf).argmin(-1)
        ahead, aside = ahead[rows, chosen], aside[rows, chosen]

        # Pushing.
        brake = _SPEED_SHARE * np.sqrt(2 * _DECELERATION * distance[rows, chosen])
        speed = np.minimum(1.0, brake * _STEP_SECONDS / _REACH)
        push = _action(
            speed[:, None] * ahead - _SIDEWAYS_GAIN * aside, _PUSH_HEIGHT - height
        )
        # Going behind the cube: over other cubes, where one is near the way.
        to = cubes[rows, chosen] - _BEHIND * ahead - gripper
        left = _norm(to)
        near = _segment(cubes, gripper[:, None], (gripper + to)[:, None]).min(-1)
        over = (near < _CLEARANCE) & (left > 0.015)
        level = np.where(left > 0.03, np.maximum(height, _PUSH_HEIGHT), _PUSH_HEIGHT)
        level = np.where(over, _SAFE_HEIGHT, np.minimum(level, _SAFE_HEIGHT))
        # Up first, then sideways.
        risen = np.where(over, np.clip((height + 0.035 - level) / 0.03, 0, 1), 1.0)
        share = np.minimum(1.0, left / _REACH) * risen / np.maximum(left, 1e-6)
        go = _action(share[:, None] * to, level - height)
        # Nothing left to do: up.
        wait = _action(np.zeros_like(gripper), _SAFE_HEIGHT - height)

        busy = todo.any(-1, keepdims=True)
        return np.where(busy, np.where(pushing[rows, chosen][:, None], push, go), wait)


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.square(vectors).sum(-1))


def _action(
    sideways: NDArray[np.float64], rise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Join shares of the speed ``[R, 2]`` and a change of height ``[R]``."""
    sideways = sideways / np.maximum(_norm(sideways), 1.0)[:, None]
    rise = np.clip(rise / _REACH, -1.0, 1.0)
    return np.stack((*sideways.T, rise, np.zeros_like(rise)), axis=-1)


def _segment(
    point: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance of points from the segments between starts and ends."""
    line = end - start
    share = ((point - start) * line).sum(-1) / np.maximum(np.square(line).sum(-1), 1e-9)
    return _norm(point - start - np.clip(share, 0.0, 1.0)[..., None] * line)


def _blocks(
    point: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.bool_]:
    return _segment(point, start, end) < _BLOCKED


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the expert's success and say it on standard output."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--cubes", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--action-noise", type=float, default=0.2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)

    from torchrl_caiac.envs.fetch_push.env import FetchPushCubes

    steps = 100
    env = FetchPushCubes(options.cubes, max_episode_steps=steps)
    success = np.zeros((options.episodes, steps), dtype=np.bool_)
    for episode, row in enumerate(success):
        observation, _ = env.reset(seed=options.seed + episode)
        expert = FetchPushExpert(
            options.cubes,
            action_noise=options.action_noise,
            rng=np.random.default_rng([options.seed, episode]),
        )
        for step in range(steps):
            observation, *_, info = env.step(expert(observation))
            row[step] = info["success"]
    for length in (50, steps):
        logger.info(
            "%d cubes, action noise %g, %d steps: all at their goals at some step in "
            "%.3f and at the last step in %.3f of %d episodes",
            options.cubes,
            options.action_noise,
            length,
            success[:, :length].any(-1).mean(),
            success[:, length - 1].mean(),
            options.episodes,
        )
    reached = success.any(-1)
    if reached.any():
        logger.info(
            "first success after %d steps (median)",
            np.median(success[reached].argmax(-1)) + 1,
        )
    env.close()
    return 0 if reached.any() else 1


if __name__ == "__main__":
    import sys

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sys.exit(main())
