"""Measures how often the scripted expert succeeds in the Franka-Kitchen.

``python -m torchrl_caiac.envs.kitchen.measure_expert --task all --episodes 50``
measures single tasks, ``--chain 4 --episodes 30 [--random-start]`` chains of four tasks
in random order.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np

from torchrl_caiac.envs.kitchen.chain import KitchenChain, random_chain_start
from torchrl_caiac.envs.kitchen.env import KitchenEnv
from torchrl_caiac.envs.kitchen.expert import KitchenExpert
from torchrl_caiac.envs.kitchen.starts import set_kitchen_start
from torchrl_caiac.envs.kitchen.waypoints import TASKS

__all__ = ["main"]

_logger = logging.getLogger("torchrl_caiac.envs.kitchen.measure_expert")

# More than a chain of all tasks takes, retries included.
_CHAIN_STEPS = 1500


def _make_env() -> Any:
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=list(TASKS),
        terminate_on_tasks_completed=False,
        max_episode_steps=_CHAIN_STEPS,
        disable_env_checker=True,
    )


def _measure_task(env: Any, name: str, options: argparse.Namespace) -> int:
    """Plays episodes of one task, logs the results, returns the number of successes."""
    expert = None
    lengths, moved, ends, seconds = [], [], [], time.perf_counter()
    for episode in range(options.episodes):
        env.reset(seed=options.seed + episode)
        set_kitchen_start(env, {"slide_cabinet": options.cabinet})
        if expert is None:
            expert = KitchenExpert(
                env,
                name,
                speed=options.speed,
                speed_range=options.speed_range,
                waypoint_noise=options.waypoint_noise,
                action_noise=options.action_noise,
            )
        expert.rng = np.random.default_rng([options.seed, episode])
        expert.reset()
        start = expert.data.qpos.copy()
        kept = 0
        for step in range(120):
            env.step(expert())
            if options.verbose:
                _logger.info(
                    "%d stage %d tool %s object %s distance %.3f",
                    step,
                    expert.stage,
                    expert.ik.pose(expert.data.qpos)[0].round(3),
                    expert.data.qpos[list(expert.task.columns)].round(3),
                    expert.goal_distance,
                )
            kept += expert.success
            if kept > options.keep:
                break
        others = np.ones(30, dtype=bool)
        others[:9] = False
        others[list(expert.task.columns)] = False
        moved.append(np.abs(expert.data.qpos - start) * others)
        lengths.append(step + 1 if kept > options.keep else 0)
        ends.append(expert.data.qpos[list(expert.task.columns)].copy())
    done = [length for length in lengths if length]
    largest = np.max(moved, axis=0)
    _logger.info(
        "%s: %d of %d episodes, steps %d to %d (median %d), %.2f s per episode; object "
        "at the end %s (median), others moved by at most %.4f (position %d)",
        name,
        len(done),
        len(lengths),
        min(done, default=0),
        max(done, default=0),
        np.median(done) if done else 0,
        (time.perf_counter() - seconds) / len(lengths),
        np.median(ends, axis=0).round(3),
        largest.max(),
        largest.argmax(),
    )
    return len(done)


def _measure_chains(env: Any, options: argparse.Namespace) -> int:
    """Plays random chains, logs the results, returns the number of successes."""
    kitchen = KitchenEnv()
    names = list(TASKS)
    chain = None
    lengths, clean, seconds = [], 0, time.perf_counter()
    # For each pair of a task and the one before it: first-attempt successes, chains.
    pairs: dict[tuple[str, str], list[int]] = {}
    for episode in range(options.episodes):
        rng = np.random.default_rng([options.seed, episode])
        tasks = [str(name) for name in rng.permutation(names)[: options.chain]]
        env.reset(seed=options.seed + episode)
        start = kitchen.default_state()
        if options.random_start:
            start = random_chain_start(kitchen, tasks, rng=rng)
        set_kitchen_start(env, qpos=start)
        if chain is None:
            chain = KitchenChain(
                env,
                tasks,
                retries=options.retries,
                speed=options.speed,
                speed_range=options.speed_range,
                waypoint_noise=options.waypoint_noise,
                action_noise=options.action_noise,
            )
        chain.rng = rng
        chain.reset(tasks)
        own = [column for name in tasks for column in TASKS[name].columns]
        others = np.setdiff1d(np.arange(9, 30), own)
        moved, steps = 0.0, 0
        while steps < _CHAIN_STEPS:
            action = chain()
            if chain.finished:
                break
            env.step(action)
            steps += 1
            change = np.abs(chain.expert.data.qpos - start)[others]
            moved = max(moved, float(change.max(initial=0.0)))
        lengths.append(steps if chain.success else 0)
        clean += chain.success and moved < 0.02
        for before, name in zip(["", *tasks], tasks, strict=False):
            count = pairs.setdefault((before, name), [0, 0])
            count[0] += chain.attempts[name] == 1 and name in chain.solved
            count[1] += 1
        if options.verbose or not chain.success:
            _logger.info(
                "chain %d %s: %s after %d steps, attempts %s, undone %s, wrong %s, "
                "speed %.2f",
                episode,
                tasks,
                "success" if chain.success else "failure",
                steps,
                list(chain.attempts.values()),
                [name for name in tasks if name not in chain.solved],
                list(chain.wrong_tasks),
                chain.expert.speed,
            )
    done = [length for length in lengths if length]
    _logger.info(
        "chains of %d: %d of %d, in %d no other object moved by 2 cm (or 0.02 rad); "
        "steps %d to %d (median %d), %.2f s per chain",
        options.chain,
        len(done),
        len(lengths),
        clean,
        min(done, default=0),
        max(done, default=0),
        np.median(done) if done else 0,
        (time.perf_counter() - seconds) / len(lengths),
    )
    failing = {pair: count for pair, count in pairs.items() if count[0] < count[1]}
    _logger.info(
        "in %d of %d pairs of tasks the second was always done at the first attempt%s",
        len(pairs) - len(failing),
        len(pairs),
        "; exceptions:" if failing else "",
    )
    for (before, name), (first, total) in sorted(failing.items()):
        _logger.info(
            "  %s after %s: %d of %d", name, before or "the start", first, total
        )
    return len(done)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures the success rate of the expert and logs it.

    Args:
        arguments (sequence of str, optional): command line arguments. Defaults to those
            of the process.

    Returns:
        int: exit status, 0 if every measured task had a success.
    """
    parser = argparse.ArgumentParser(
        description="Measure the success rate of the expert."
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--task", choices=[*sorted(TASKS), "all"])
    what.add_argument(
        "--chain",
        type=int,
        choices=range(1, len(TASKS) + 1),
        help="number of tasks, in random order",
    )
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--cabinet", type=float, default=0.0, help="slide, metres")
    parser.add_argument("--random-start", action="store_true", help="of chains")
    parser.add_argument("--retries", type=int, default=1, help="of chains")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--speed-range", type=float, default=0.05)
    parser.add_argument("--waypoint-noise", type=float, default=0.005)
    parser.add_argument("--action-noise", type=float, default=0.03)
    parser.add_argument("--keep", type=int, default=5, help="steps after success")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error(f"--episodes is {options.episodes}, expected at least 1")

    env = _make_env()
    if options.chain:
        done = [_measure_chains(env, options)]
    else:
        names = list(TASKS) if options.task == "all" else [options.task]
        done = [_measure_task(env, name, options) for name in names]
    env.close()
    return 0 if all(done) else 1


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sys.exit(main())
