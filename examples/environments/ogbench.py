"""OGBench's scenes: data of its scripted policies, its tasks, its success."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from omegaconf import DictConfig, ListConfig
from tensordict import TensorDict, TensorDictBase

from environments.base import Environment
from environments.one_goal import OneGoal
from environments.playing import Split, play_together
from shared.settings import keep_settings
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_ogbench, load_transitions, write_transitions
from torchrl_caiac.data.digests import data_digest
from torchrl_caiac.envs.ogbench import (
    OGBenchSimulator,
    OGBenchTruth,
    create_ogbench_play,
    make_ogbench_task,
    ogbench_cube_reward,
)
from torchrl_caiac.influence import DistanceInfluence, SimulatorInfluence
from torchrl_caiac.layouts import ready_layout
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["HandleDistance", "OGBench"]

TASKS = 5  # OGBench has as many in each environment
# Which goals the policy is told at a time, and the measure of its success.
GOALS = {"all": "success", "one": "success, one goal at a time"}
# Positions in observations are 10 x (m - CENTRE).
SCALE, CENTRE = 10.0, (0.425, 0.0, 0.0)
REACHED = 0.04  # m, from the goal of a cube, see OGBench
# Where the hand takes hold of what has no position in space in the observation.
HANDLES = {"drawer": "drawer_handle_center", "window": "window_handle_center"}


class OGBench(Environment):
    """Data of OGBench's own scripted policies, and its five tasks with its success.

    The goals are those of OGBench's variant ``oraclerep``: what the task is about, such
    as the positions of the cubes. In OGBench's other datasets the goal is a whole
    observation, with a posture of the robot that no task asks for. A swap exchanges the
    goal of an entity with its state, which such a posture does not allow.

    ``env.evaluate.goals`` lists what policies are told: ``all`` goals, which is
    OGBench's evaluation, or ``one`` goal at a time, see
    :class:`~environments.one_goal.OneGoal`. With both, the policy of a run is the one
    with the highest mean of both on validation starts.

    ``env.demonstrations`` is the number of episodes to learn from, the first ones.
    ``held_out`` are rows of episodes with another seed, some steps apart, which only
    check the scores.
    """

    action_dim = 5
    episodes_have_goals = False
    demonstrations_have_goals = False
    data_name: ClassVar[str] = "play data"
    goal_reference = "robot"

    def __init__(self, settings: DictConfig, out: Path, *, workers: int = 1) -> None:
        super().__init__(settings, out, workers=workers)
        self.layout = ready_layout(f"ogbench/{settings.scene}")
        self.predicted = self.layout.positions
        if settings.robot_inputs not in ("position", "all"):
            raise ValueError(
                f"robot_inputs is {settings.robot_inputs!r}, expected 'position' or "
                "'all'"
            )
        if settings.robot_inputs == "position":
            positions = self.layout.positions
            self.inputs = {name: positions[name] for name in self.layout.fixed}
        goals = settings.evaluate.goals
        if not (
            isinstance(goals, ListConfig)
            and len(goals) == len(set(goals)) > 0
            and set(goals) <= set(GOALS)
        ):
            raise ValueError(
                f"env.evaluate.goals is {goals!r}, expected a list of some of "
                f"{list(GOALS)}, each once"
            )
        if settings.scene.startswith("cube-"):
            self.reward_fn = ogbench_cube_reward
        elif "one" in goals:
            raise ValueError(
                f"env.evaluate.goals is {list(goals)}, but only goals of cubes can be "
                f"told one at a time, and the scene is {settings.scene}: use [all]"
            )
        number, collected = settings.demonstrations, settings.collect.episodes
        if number is not None and not 1 <= number <= collected:
            raise ValueError(
                f"env.demonstrations is {number}, expected 1 to {collected} "
                "(env.collect.episodes), or null for all"
            )
        self._envs: list[Any] = []

    def check(self) -> None:
        """Raises if a task is not known, or the splits have starts in common."""
        super().check()
        self._seeds("test")

    @property
    def folder(self) -> Path:
        """The folder of the number of episodes that are learned from."""
        number = self.settings.demonstrations
        return self.out if number is None else self.out / f"episodes-{number}"

    def collect(self, *, progress: bool = False) -> None:
        """Collects what is missing of the files, and loads them."""
        settings, out = self.settings.collect, self.out
        one = [1.0] * self.action_dim
        bounds = [-x for x in one], one
        for name, episodes, seed in (
            ("rows", settings.episodes, settings.seed),
            ("held_out", settings.held_out, settings.held_out_seed),
        ):
            if (out / "loaded" / name).exists():
                continue
            file = out / f"{name}.npz"
            if not file.exists():
                create_ogbench_play(
                    file,
                    self.settings.scene,
                    episodes=episodes,
                    steps=settings.steps,
                    seed=seed,
                    noisy=settings.noisy,
                    work=out / "work" / name,
                    num_workers=self.workers,
                    progress=progress,
                )
            load_ogbench(
                file, out / "loaded" / name, action_bounds=bounds, progress=progress
            )
        for path, name, number, every in (
            (self.folder / "rows", "rows", self.settings.demonstrations, 1),
            (out / "held_out", "held_out", None, settings.every),
        ):
            loaded = out / "loaded" / name
            source = {"loaded": data_digest(loaded), "episodes": number}
            keep_settings(path.parent, f"{path.name}_source", source | {"every": every})
            if path.exists():
                continue
            data = load_transitions(loaded)
            if number is not None:
                data = data[data["episode"] < number]
            write_transitions(data[::every], path, action_bounds=bounds)

    def rows(self) -> TensorDictBase:
        """Returns the first ``env.demonstrations`` episodes."""
        return load_transitions(self.folder / "rows")

    def goal_rows(self) -> TensorDictBase:
        """Returns the rows with goals: what later states of the episodes achieve.

        No episode has a goal of its own. All later states are equally likely, as the
        goals of policies are in OGBench's learners, which draw new ones in each batch.
        """
        rows = self.rows().exclude("info")
        achieved = self.layout.achieved_goal(rows, next=True)
        index = trajectory_index(rows)
        last = index.ends.repeat_interleave(index.lengths)
        first = torch.arange(len(rows))
        generator = torch.Generator().manual_seed(self.settings.collect.seed)
        share = torch.rand(len(rows), generator=generator, dtype=torch.float64)
        goals = achieved[first + (share * (last - first + 1)).long()]
        rows = TensorDict(rows.to_dict(), rows.batch_size)
        rows["desired_goal"] = goals
        if self.reward_fn is not None:
            rows["next", "reward"] = self.reward_fn(achieved, goals)[:, None]
        return rows

    def simulator(self, num_actions: int) -> SimulatorInfluence:
        """Returns the simulator as an estimator."""
        keys = ["qpos", "qvel"]
        if any(name.startswith("button") for name in self.layout.names):
            keys.append("button_states")
        return SimulatorInfluence(
            partial(OGBenchTruth, self.settings.scene),
            state_key=[("info", key) for key in keys],
            num_actions=num_actions,
            threshold=self.settings.truth.threshold,
            # One worker is this process.
            num_workers=self.workers if self.workers > 1 else 0,
        )

    def distance_rule(self, *, action_only: bool) -> DistanceInfluence | HandleDistance:
        """Returns the rule of distance between the hand and the entities, 5 cm."""
        if not self.settings.scene.startswith("cube-"):
            return HandleDistance(self.settings.scene, action_only=action_only)
        return DistanceInfluence(self.layout, distance=0.5, action_only=action_only)

    def play(
        self,
        actor: Any,
        seed: int,
        folder: Path,
        *,
        split: Split = "test",
    ) -> list[dict[str, Any]]:
        """Plays the tasks from the same starts for all runs; the splits have others."""
        results = []
        seeds = self._seeds(split)
        self._make_envs(max(map(len, seeds.values())))
        for goals in self.settings.evaluate.goals:
            torch.manual_seed(seed)  # for each kind, whichever are listed
            told = actor
            if goals == "one":
                told = OneGoal(actor, self.layout, SCALE * REACHED)
            for task, own in seeds.items():
                episodes = play_task(told, self._envs[: len(own)], task, own)
                results += [{**episode, "goals": goals} for episode in episodes]
        return results

    def _seeds(self, split: str) -> dict[int, range]:
        """Returns the seeds of the starts, by task."""
        settings = self.settings.evaluate
        starts = {
            "test": (settings.seed, settings.episodes),
            "validation": (settings.validation_seed, settings.validation_episodes),
        }
        if split not in starts:
            raise ValueError(f"split is {split!r}, expected one of {list(starts)}")
        spans = [range(first, first + TASKS * n) for first, n in starts.values()]
        if set(spans[0]) & set(spans[1]):
            raise ValueError(
                f"env.evaluate: the seeds of the validation starts, {spans[1]}, are "
                f"also some of the test starts, {spans[0]}: change validation_seed"
            )
        unknown = set(settings.tasks) - set(range(1, TASKS + 1))
        if unknown or not settings.tasks:
            raise ValueError(
                f"env.evaluate.tasks is {list(settings.tasks)}, expected some of 1 to "
                f"{TASKS}"
            )
        first, n = starts[split]
        return {
            task: range(first + (task - 1) * n, first + task * n)
            for task in settings.tasks
        }

    def _make_envs(self, number: int) -> None:
        """Makes simulators, which are kept: each takes half a second."""
        while len(self._envs) < number:
            self._envs.append(make_ogbench_task(self.settings.scene))

    def measures(self, episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Returns the success of each task."""
        kinds: dict[tuple[str, str], list[bool]] = {}
        for e in episodes:
            kinds.setdefault((e["task"], GOALS[e["goals"]]), []).append(e["success"])
        return [
            {
                "task": task,
                "measure": measure,
                "episodes": len(found),
                "value": float(np.mean(found)),
            }
            for (task, measure), found in kinds.items()
        ]


class HandleDistance:
    """The rule of distance, between the hand and where entities are taken hold of.

    Args:
        scene (str): the name of the environment.

    Keyword Args:
        action_only (bool): whether to score the action's links alone.
    """

    in_keys = ("observation", ("info", "qpos"))

    def __init__(self, scene: str, *, action_only: bool) -> None:
        self.layout = layout = ready_layout(f"ogbench/{scene}")
        points = EntityLayout(
            {name: range(3 * i, 3 * i + 3) for i, name in enumerate(layout.names)},
            observation_key="points",
            fixed=layout.fixed,
        )
        self._rule = DistanceInfluence(
            points, dict(points.columns), distance=0.05, action_only=action_only
        )
        simulator = OGBenchSimulator(scene)
        try:
            simulator.reset(seed=0)
            self._lines = {
                name: _line(simulator, name)
                for name in layout.names
                if name not in layout.fixed
            }
        finally:
            simulator.close()

    def __call__(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Scores rows by the rule."""
        qpos = tensordict["info", "qpos"]
        (robot,) = self.layout.fixed
        hand = tensordict["observation"][..., list(self.layout.positions[robot])]
        points = [hand / SCALE + hand.new_tensor(CENTRE)]
        for columns, origin, axis in self._lines.values():
            way = qpos[..., columns].to(hand.dtype)
            points.append(way if axis is None else origin + way * axis)
        rows = {"points": torch.cat(points, -1)}
        return self._rule(TensorDict(rows, tensordict.batch_size))

    def __repr__(self) -> str:
        """Returns the rule that the scores depend on."""
        return f"{type(self).__name__}({self._rule!r})"


def _line(
    simulator: OGBenchSimulator, entity: str
) -> tuple[slice, torch.Tensor | None, torch.Tensor | None]:
    """Returns where an entity is in ``qpos``, and for a slide its origin and axis."""
    place, data = simulator.places[entity], simulator.data
    if place.stop - place.start > 1:  # a cube
        return slice(place.start, place.start + 3), None, None
    model = simulator.model
    number = int(np.flatnonzero(model.jnt_qposadr == place.start)[0])
    site = HANDLES.get(entity) or f"btntop_{entity.removeprefix('button')}"
    mujoco.mj_forward(model, data)
    axis = data.xaxis[number]
    origin = data.site_xpos[model.site(site).id] - axis * data.qpos[place]
    return place, torch.from_numpy(origin).float(), torch.from_numpy(axis).float()


def play_task(
    actor: Any, envs: Sequence[Any], task: int, seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Plays an episode of a task in each environment, with one call of the policy.

    Args:
        actor (TensorDictModule): the policy.
        envs (sequence of gymnasium.Env): one for each seed.
        task (int): from 1.
        seeds (sequence of int): of the starts.

    Returns:
        list of dict: for each episode ``"task"``, ``"episode"``, ``"success"``
        (OGBench's), and the number of ``"steps"``.
    """
    options = {"task_id": task, "render_goal": False}
    starts = [
        env.reset(seed=seed, options=options)
        for env, seed in zip(envs, seeds, strict=True)
    ]
    goals = [np.float32(info["goal"]) for _, info in starts]
    results = [
        {"task": f"task{task}", "episode": i, "success": False, "steps": 0}
        for i in range(len(envs))
    ]

    def state(i: int, observation: np.ndarray) -> dict[str, np.ndarray]:
        return {"observation": np.float32(observation), "desired_goal": goals[i]}

    def step(i: int, action: np.ndarray) -> tuple[dict[str, np.ndarray], bool]:
        # As in OGBench's evaluation.
        observation, _, terminated, truncated, info = envs[i].step(action.clip(-1, 1))
        over = bool(terminated or truncated)
        results[i]["steps"] += 1
        results[i]["success"] = over and bool(info["success"])
        return state(i, observation), over

    play_together(actor, [state(i, found) for i, (found, _) in enumerate(starts)], step)
    return results
