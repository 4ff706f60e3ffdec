"""Franka-Kitchen: demonstrations of single tasks, or of chains (A.2.1, A.6.1)."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from minari import MinariDataset
from tensordict import TensorDict, TensorDictBase

from environments.base import Environment
from environments.playing import Recording, Split, check_episode, play_together
from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import RenderingUnavailable
from torchrl_caiac.envs.kitchen import (
    DEMONSTRATIONS_ID,
    KITCHEN_TASKS,
    MICROWAVE_KETTLE,
    PLAY_ANY_START_ID,
    PLAY_ANY_START_ORDERS,
    PLAY_ID,
    PLAY_ORDERS,
    RANDOM_ID,
    KitchenEnv,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_reward,
    kitchen_transitions,
)
from torchrl_caiac.influence import DistanceInfluence, SimulatorInfluence
from torchrl_caiac.plotting import plot_frames, plot_influence
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["HandleDistance", "Kitchen"]

LAYOUT = KitchenEnv.layout
# Names, orders and longest attempts of the chains, by ``env.collect.chains``.
CHAINS = {
    "play": (PLAY_ID, PLAY_ORDERS, 400),
    "play_any_start": (PLAY_ANY_START_ID, PLAY_ANY_START_ORDERS, 440),
}


class Kitchen(Environment):
    """Demonstrations of a scripted expert, random actions, and all tasks as goals.

    ``demonstrations`` and ``random`` are for learning; ``held_out`` are demonstrations
    with other seeds, which only check the scores.
    """

    layout = LAYOUT
    action_dim = 9
    data_name = "demonstrations"
    demonstrations_have_goals = False

    @staticmethod
    def reward_fn(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
        """Returns 0 where all objects are at their goals, else -1."""
        return kitchen_reward(achieved, desired) - 1.0

    def check(self) -> None:
        """Raises if a task is not known, or the splits have starts in common."""
        super().check()
        tasks = list(self.settings.evaluate.tasks)
        if not tasks or not set(tasks) <= set(KITCHEN_TASKS):
            raise ValueError(
                f"env.evaluate.tasks is {tasks}, expected some of {list(KITCHEN_TASKS)}"
            )
        self.start_seeds(0, "test")  # or raises

    def collect(self, *, progress: bool = False) -> None:
        """Collects what is missing of the three datasets, as transitions too."""
        settings = self.settings.collect
        options: dict[str, Any] = {
            "root": self.out / "minari",
            "work": self.out / "work",
            "workers": self.workers,
            "overwrite": True,
            "progress": progress,
        }
        chains = settings.chains
        if chains not in (None, *CHAINS):
            raise ValueError(
                f"env.collect.chains is {chains!r}, expected null, for single tasks, "
                f"or one of {list(CHAINS)}"
            )
        demonstrations = DEMONSTRATIONS_ID if chains is None else CHAINS[chains][0]
        for name, dataset_id, episodes, seed in (
            ("demonstrations", demonstrations, settings.episodes, settings.seed),
            ("held_out", "kitchen/held-out-v0", settings.held_out, settings.seed + 1),
        ):
            if not (self.out / name).exists():
                dataset = self._demonstrate(dataset_id, episodes, seed, options)
                kitchen_transitions(dataset, self.out / name, progress=progress)
        if not (self.out / "random").exists():
            dataset = create_kitchen_random(
                demonstrations,
                RANDOM_ID,
                ratio=settings.random_ratio,
                seed=settings.seed,
                **options,
            )
            kitchen_transitions(dataset, self.out / "random", progress=progress)

    def _demonstrate(
        self, dataset_id: str, episodes: int, seed: int, options: dict[str, Any]
    ) -> MinariDataset:
        """Collects this number of demonstrations of each task, or chain of tasks."""
        chains = self.settings.collect.chains
        if chains is not None:
            _, orders, max_steps = CHAINS[chains]
            return create_kitchen_play(
                dataset_id,
                orders=orders,
                episodes=episodes,
                max_steps=max_steps,
                seed=seed,
                **options,
            )[0]
        groups = [dataclasses.replace(g, episodes=episodes) for g in MICROWAVE_KETTLE]
        return create_kitchen_demonstrations(
            dataset_id, demonstrations=groups, seed=seed, **options
        )[0]

    def rows(self) -> TensorDictBase:
        """Returns the demonstrations."""
        return load_transitions(self.out / "demonstrations")

    def goal_rows(self) -> TensorDictBase:
        """Returns the demonstrations, whose goal is the last state of each."""
        rows = self.rows()
        achieved = LAYOUT.achieved_goal(rows, next=True)
        index = trajectory_index(rows)
        last = index.ends.repeat_interleave(index.lengths)
        rows = TensorDict(rows.to_dict(), rows.batch_size)
        rows["desired_goal"] = achieved[last]
        rows["next", "reward"] = self.reward_fn(achieved, achieved[last])[:, None]
        return rows

    def model_rows(self) -> list[TensorDictBase]:
        """Returns the demonstrations and the random actions."""
        return [self.rows(), load_transitions(self.out / "random")]

    def simulator(self, num_actions: int) -> SimulatorInfluence:
        """Returns the simulator as an estimator."""
        return SimulatorInfluence(
            KitchenEnv,
            state_key=[("sim", "qpos"), ("sim", "qvel")],
            num_actions=num_actions,
            # One worker is this process.
            num_workers=self.workers if self.workers > 1 else 0,
        )

    def distance_rule(self, *, action_only: bool) -> HandleDistance:
        """Returns the rule of distance between the hand and the handles of objects."""
        return HandleDistance(action_only=action_only)

    def play(
        self, actor: Any, seed: int, folder: Path, *, split: Split = "test"
    ) -> list[dict[str, Any]]:
        """Plays all tasks. Success means that all objects are at their goals.

        Runs with another seed have other starts, and so have the two splits.
        """
        settings = self.settings.evaluate
        seeds = self.start_seeds(seed, split)
        kitchens = [KitchenEnv() for _ in seeds]
        episodes: list[dict[str, Any]] = []
        try:
            for task in settings.tasks:
                torch.manual_seed(seeds[0])
                played = play_task(actor, kitchens, task, settings.start, seeds)
                episodes += [result for result, _ in played]
                for number, (_, states) in enumerate(played[: settings.strips]):
                    draw_strip(folder / f"{split}-{task}-{number}.png", states)
        finally:
            close(kitchens)
        return episodes

    def record(
        self, actor: Any, seed: int, task: str | None = None, *, episode: int = 0
    ) -> Recording:
        """Plays the test episodes of a task again, and returns one."""
        settings = self.settings.evaluate
        task = settings.tasks[0] if task is None else task
        if task not in settings.tasks:
            raise ValueError(f"task is {task!r}, expected one of {settings.tasks}")
        seeds = self.start_seeds(seed, "test")
        check_episode(episode, len(seeds))
        kitchens = [KitchenEnv() for _ in seeds]
        try:
            torch.manual_seed(seeds[0])
            episodes = play_task(actor, kitchens, task, settings.start, seeds)
            result, states = episodes[episode]
            success, seconds = result["success"], kitchens[0].dt
            return Recording(task, states, render, success, seconds)
        finally:
            close(kitchens)

    def start_seeds(self, seed: int, split: Split) -> range:
        """Returns the seeds of the starts of a run, which no other split or run has."""
        settings = self.settings.evaluate
        first, episodes = {
            "test": (settings.seed, settings.episodes),
            "validation": (settings.validation_seed, settings.validation_episodes),
        }[split]
        seeds = range(first + seed * episodes, first + (seed + 1) * episodes)
        if split == "test" and seeds.stop > settings.validation_seed:
            raise ValueError(
                f"the test starts have the seeds {seeds.start} to {seeds.stop - 1}, "
                "which must be below those of the validation starts: raise "
                f"env.evaluate.validation_seed, which is {settings.validation_seed}"
            )
        return seeds

    def measures(self, episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Returns success over all objects, and over the task's own, by task."""
        rows = []
        for task in dict.fromkeys(episode["task"] for episode in episodes):
            mine = [episode for episode in episodes if episode["task"] == task]
            rows += [
                {
                    "task": task,
                    "measure": measure,
                    "episodes": len(mine),
                    "value": sum(episode[measure] for episode in mine) / len(mine),
                }
                for measure in ("success", "task_success")
            ]
        return rows

    def draw(self, folder: Path, name: str, *, threshold: float) -> list[str]:
        """Draws the influence along a demonstration, and counterfactual frames."""
        self._draw_influence(folder / f"{name}_influence.png", threshold)
        try:
            self._draw_counterfactuals(
                folder / f"{name}_counterfactuals.png", threshold
            )
        except RenderingUnavailable as error:
            return [f"left out: the counterfactual frames ({error})"]
        return []

    def _draw_influence(self, path: Path, threshold: float) -> None:
        """Draws the influence along a held-out demonstration (Fig. 6)."""
        data = self.held_out()
        scores = torch.load(self.folder / "held_out_scores.pt", weights_only=True)
        rows = data["episode"] == self.settings.influence_episode
        tasks = data["task"][rows].unique_consecutive()
        names = dict.fromkeys(KITCHEN_TASKS[task] for task in tasks if task >= 0)
        plot_influence(
            scores[rows].numpy(),
            LAYOUT.names,
            ground_truth=(data["oracle", "score"][rows] > 0.5).numpy(),
            threshold=threshold,
            exclude=["robot"],
            title="influence along a demonstration:\n"
            + ", ".join(names).replace("_", " "),
        ).savefig(path, dpi=150)

    def _draw_counterfactuals(self, path: Path, threshold: float) -> None:
        """Draws a frame of a demonstration of each task, and its counterfactual."""
        data = self.rows()
        torch.manual_seed(0)
        copies = 64
        transform = CAIACTransform(
            LAYOUT,
            threshold=threshold,
            counterfactual_ratio=copies / 512,
            rows="last",
        )
        states, titles = [], []
        for task in self.settings.frames:
            own = data["task"] == KITCHEN_TASKS.index(task)
            first = data["episode"][own][0]
            demonstration = (own & (data["episode"] == first)).nonzero()
            row = demonstration[int(0.75 * len(demonstration))]
            donors = torch.randint(len(data), (512 - copies,))
            batch = transform(data[torch.cat([donors, row.expand(copies)])])
            made, shown = batch["observation"][-copies:], data["observation"][row]
            states += [shown[0], made[torch.cdist(made, shown).argmax()]]
            name = task.replace("_", " ")
            titles += [f"{name}, demonstration", f"{name}, counterfactual"]
        frames = render(torch.stack(states).numpy())
        plot_frames(frames, titles).savefig(path, dpi=150, bbox_inches="tight")


class HandleDistance:
    """The rule of distance, between the hand and the handles.

    Observations contain joints; positions come from the simulator's kinematics.

    Args:
        action_only (bool): whether to score the action's links alone.
    """

    layout = LAYOUT
    in_keys = ("observation",)

    def __init__(self, *, action_only: bool) -> None:
        handles = EntityLayout(
            {name: range(3 * i, 3 * i + 3) for i, name in enumerate(LAYOUT.names)},
            observation_key="handles",
            fixed=LAYOUT.fixed,
        )
        self._rule = DistanceInfluence(
            handles, dict(handles.columns), action_only=action_only
        )
        self._kitchen = KitchenEnv()

    def __call__(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Scores rows by the rule."""
        places = self._kitchen.handle_positions(tensordict["observation"])
        handles = torch.from_numpy(places).flatten(1).float()
        return self._rule(TensorDict({"handles": handles}, tensordict.batch_size))

    def __repr__(self) -> str:
        """Returns the rule that the scores depend on."""
        return f"{type(self).__name__}({self._rule!r})"


def play_task(
    actor: Any,
    kitchens: Sequence[KitchenEnv],
    task: str,
    start: Any,
    seeds: Sequence[int],
) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Plays a task in each kitchen.

    An episode ends when all objects are at their goals, or after 280 steps.

    Args:
        actor (TensorDictModule): the policy.
        kitchens (sequence of KitchenEnv): one for each episode.
        task (str): the task.
        start (Any): of the episodes, see :class:`~torchrl_caiac.envs.KitchenEnv`.
        seeds (sequence of int): of the starts and of the noise, one for each episode.

    Returns:
        list of tuple: the result of each episode, and its states ``[L + 1, 30]``.
    """
    options = {"task": task, "start": start}
    firsts = [
        kitchen.reset(seed=seed, options=options)[0]
        for kitchen, seed in zip(kitchens, seeds, strict=True)
    ]
    states = [[first["observation"]] for first in firsts]
    flags: list[list[dict[str, Any]]] = [[] for _ in kitchens]

    def step(number: int, action: np.ndarray) -> tuple[dict[str, np.ndarray], bool]:
        state, _, terminated, truncated, info = kitchens[number].step(action)
        states[number].append(state["observation"])
        flags[number].append(info)
        return state, terminated or truncated

    play_together(actor, firsts, step)
    results = [
        {
            "task": task,
            "episode": number,
            "success": bool(mine[-1]["success"]),
            "task_success": any(bool(info["task_success"]) for info in mine),
            "wrong_tasks": [
                name
                for name, done in zip(
                    KITCHEN_TASKS, mine[-1]["wrong_tasks"], strict=True
                )
                if done
            ],
            "steps": len(mine),
        }
        for number, mine in enumerate(flags)
    ]
    return [(r, np.stack(s)) for r, s in zip(results, states, strict=True)]


def draw_strip(path: Path, states: np.ndarray) -> None:
    """Draws six states of an episode, ``[L + 1, 30]``."""
    shown = np.linspace(0, len(states) - 1, 6).round().astype(int)
    frames = render(states[shown])
    path.parent.mkdir(parents=True, exist_ok=True)
    plot_frames(frames, [f"step {i}" for i in shown]).savefig(
        path, dpi=150, bbox_inches="tight"
    )


def render(states: np.ndarray) -> np.ndarray:
    """Returns a frame ``[240, 320, 3]`` of each state ``[30]``."""
    kitchen = KitchenEnv(render_mode="rgb_array")
    try:
        return kitchen.render_states(states)
    finally:
        close([kitchen])


def close(kitchens: list[KitchenEnv]) -> None:
    """Closes kitchens, of which each has 60 MB that Python does not know of."""
    for kitchen in kitchens:
        kitchen.close()
    kitchens.clear()
    gc.collect()
