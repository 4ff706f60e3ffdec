"""A memoryless scripted expert for Fetch-Push.

Its action is a function of the observation and the goal, so a policy with the same
inputs can learn it. Demonstrations with hidden phases ("now going around the cube")
could not be learned from observations.

``python -m torchrl_caiac.envs.fetch_push.expert --episodes 200 --action-noise 0.2``
measures its success.
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

_logger = logging.getLogger("torchrl_caiac.envs.fetch_push.expert")

# Heights of the gripper in metres: with the tips of the fingers next to a cube, and
# above all cubes.
_PUSH_HEIGHT, _SAFE_HEIGHT = 0.425, 0.50
_LOW = 0.445
# How far an action of 1 moves the gripper in one step, in metres; the duration of a
# step, in seconds.
_REACH = 0.033
_STEP_SECONDS = 0.04
# The gripper descends this far behind the centre of the cube. (Half a cube and half of
# the closed fingers are 4 cm.)
_BEHIND = 0.065
# It pushes while it is low, this far behind the centre, and this close to the line from
# the cube to its goal.
_PUSH_BEHIND = (0.025, 0.075)
_PUSH_ASIDE = 0.02
# The expert stops pushing a cube that is this close to its goal, and starts with a cube
# that is this far from it: a threshold with hysteresis, whose memory is the position of
# the gripper.
_DONE_PUSHED, _DONE_LEFT = 0.015, 0.04
# A cube blocks a path or a goal that is closer than this; the gripper moves over cubes
# that are closer than this to its path.
_BLOCKED, _CLEARANCE = 0.06, 0.055
# A cube that is released at speed v (metres per second) slides v^2 / (2 * 9.81), since
# its friction is 1. The gripper pushes at this share of the speed from which the cube
# would slide to its goal.
_DECELERATION = 9.81
_SPEED_SHARE = 0.6
_SIDEWAYS_GAIN = 20.0


class FetchPushExpert:
    """Pushes one cube after the other to its goal (the expert data of A.6.2).

    It chooses a cube that is not at its goal: the one that it is pushing, else one with
    a free path that does not block another cube, else the one that is closest to its
    goal. It moves behind that cube (opposite to the goal), descends, and pushes along
    the line to the goal with lateral correction. If it leaves the line, it moves behind
    the cube again. Since cubes slide, it brakes before the goal. When all cubes are at
    their goals, it moves up and waits. Cubes that block each other may be pushed back
    and forth for a long time: this is rare with two cubes and costs some episodes with
    three.

    Why episodes have 100 steps: the median episode with two cubes takes 30 steps, and
    37 with the noise of the data (0.2). But of 200 episodes with noise, 36 take more
    than 50 steps and 1 takes more than 100, because failed pushes are repeated.
    Episodes of 50 steps would mostly show easy starts.

    Args:
        num_cubes (int): the number of cubes ``n``. Defaults to 2.

    Keyword Args:
        action_noise (float): the standard deviation of the noise on every action.
            Defaults to 0.
        rng (np.random.Generator or int, optional): the source of the noise, or its
            seed.

    Raises:
        ValueError: ``num_cubes`` or ``action_noise`` is out of range.

    Examples:
        >>> from torchrl_caiac.envs import FetchPushCubes, FetchPushExpert
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
            raise ValueError(f"num_cubes is {num_cubes}, expected at least 1")
        if not (np.isfinite(action_noise) and action_noise >= 0):
            raise ValueError(
                f"action_noise is {action_noise}, expected a standard deviation of at "
                "least 0"
            )
        self.num_cubes = num_cubes
        self.action_noise = action_noise
        self.rng = np.random.default_rng(rng)

    def __call__(self, observation: Mapping[str, Any]) -> NDArray[np.float32]:
        """Returns the action with noise.

        Args:
            observation (mapping): see :meth:`act`.

        Returns:
            NDArray: ``[*B, 4]``, float32, clipped to [-1, 1].
        """
        action = self.act(observation)
        noise = self.action_noise * self.rng.normal(size=action.shape)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)

    def act(self, observation: Mapping[str, Any]) -> NDArray[np.float64]:
        """Returns the action without noise.

        Args:
            observation (mapping): of :class:`~torchrl_caiac.envs.FetchPushCubes`, or a
                batch: ``"observation"`` ``[*B, 10 + 12 n]`` and ``"desired_goal"``
                ``[*B, 3 n]``.

        Returns:
            NDArray: ``[*B, 4]`` in [-1, 1]; the fourth number, which has no effect, is
            0.

        Raises:
            ValueError: the shapes are not those of ``n`` cubes.
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
                    f"{name!r} has shape {value.shape}, expected [*B, {width}] for "
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
        # The position of the gripper relative to each cube [R, n].
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

        # In metres, plus one for each obstacle.
        cost = distance - 2.0 * pushing
        target = goals[..., :2]
        # [R, i, j]: does cube j block the path of cube i; does the goal of i block j?
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
        # Moving behind the cube, and over other cubes that are close to the path.
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
        # All cubes are at their goals: up.
        wait = _action(np.zeros_like(gripper), _SAFE_HEIGHT - height)

        busy = todo.any(-1, keepdims=True)
        return np.where(busy, np.where(pushing[rows, chosen][:, None], push, go), wait)


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.square(vectors).sum(-1))


def _action(
    sideways: NDArray[np.float64], rise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Joins shares of the speed ``[R, 2]`` and a change of height ``[R]``."""
    sideways = sideways / np.maximum(_norm(sideways), 1.0)[:, None]
    rise = np.clip(rise / _REACH, -1.0, 1.0)
    return np.stack((*sideways.T, rise, np.zeros_like(rise)), axis=-1)


def _segment(
    point: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the distance of points from the segments between starts and ends."""
    line = end - start
    share = ((point - start) * line).sum(-1) / np.maximum(np.square(line).sum(-1), 1e-9)
    return _norm(point - start - np.clip(share, 0.0, 1.0)[..., None] * line)


def _blocks(
    point: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.bool_]:
    return _segment(point, start, end) < _BLOCKED


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures the success of the expert and logs it.

    Args:
        arguments (sequence of str, optional): the command line.

    Returns:
        int: 0 if an episode succeeded, else 1.
    """
    parser = argparse.ArgumentParser(description="Measures the success of the expert.")
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
        _logger.info(
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
        _logger.info(
            "first success after %d steps (median)",
            np.median(success[reached].argmax(-1)) + 1,
        )
    env.close()
    return 0 if reached.any() else 1


if __name__ == "__main__":
    import sys

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sys.exit(main())
