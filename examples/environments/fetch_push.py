"""Fetch-Push with two cubes: episodes of an expert and random ones (A.6.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from environments.base import Environment
from environments.playing import Recording, Split, check_episode, play_together
from shared.settings import keep_settings
from torchrl_caiac.data import (
    load_minari,
    load_transitions,
    mix_trajectories,
    select_successful,
)
from torchrl_caiac.data.digests import data_digest, data_source
from torchrl_caiac.envs.fetch_push import (
    FetchPushCubes,
    FetchPushTruth,
    create_fetch_push_expert,
    create_fetch_push_random,
    fetch_push_layout,
    fetch_push_reward,
)
from torchrl_caiac.influence import DistanceInfluence, SimulatorInfluence

__all__ = ["FetchPush"]

LAYOUT = fetch_push_layout(2)
# The columns of the gripper and its fingers, and of the cubes.
POSITIONS = {
    name: LAYOUT.columns[name][:n]
    for name, n in {"gripper": 5, "cube0": 3, "cube1": 3}.items()
}
MEASURES = ("full", "cube0", "cube1")
TASK = "two cubes"
MAKERS = {"expert": create_fetch_push_expert, "random": create_fetch_push_random}


class FetchPush(Environment):
    """Two cubes, and a number of successful demonstrations, ``env.demonstrations``.

    ``rows`` are the demonstrations, whole, and random episodes; ``demonstrations`` are
    the demonstrations up to their first success. ``held_out`` are episodes with other
    seeds, which only check the scores. With ``null``, ``rows`` are all episodes of the
    expert, successful or not, and all random ones, and there are no demonstrations.
    """

    layout = LAYOUT
    action_dim = 4
    predicted = POSITIONS
    goal_reference = "gripper"
    reward_fn = staticmethod(fetch_push_reward)
    data_name = "episodes"
    success_key = "full"

    @property
    def folder(self) -> Path:
        """The folder of this number of demonstrations."""
        number = self.settings.demonstrations
        return self.out / ("all" if number is None else f"demonstrations-{number}")

    @property
    def cubes(self) -> dict[str, float]:
        """How the cubes differ from those of Fetch-Push, if they do."""
        settings = self.settings.collect
        names = ("cube_friction", "cube_speed")
        return {name: settings[name] for name in names if name in settings}

    def check(self) -> None:
        """Raises if the splits have starts in common."""
        super().check()
        self._starts("test")

    def collect(self, *, progress: bool = False) -> None:
        """Collects what is missing of the datasets, and selects the transitions."""
        settings, out = self.settings.collect, self.out
        share = settings.expert / (settings.expert + settings.random)
        held_out = round(settings.held_out * share)
        parts = {
            "expert": (settings.expert, settings.seed),
            "random": (settings.random, settings.seed + 1),
            "held_out_expert": (held_out, settings.seed + 2),
            "held_out_random": (settings.held_out - held_out, settings.seed + 3),
        }
        for name, (episodes, seed) in parts.items():
            if (out / name).exists():
                continue
            dataset = MAKERS[name.removeprefix("held_out_")](
                f"fetch-push-2/{name.replace('_', '-')}-v0",
                **self.cubes,
                episodes=episodes,
                steps=settings.steps,
                root=out / "minari",
                work=out / "work",
                seed=seed,
                workers=self.workers,
                overwrite=True,
                progress=progress,
            )
            load_minari(dataset, out / name, infos=["simulator"], progress=progress)
        self._mix(out / "held_out", ("held_out_expert", "held_out_random"))
        number, folder = self.settings.demonstrations, self.folder
        if number is None:
            self._mix(folder / "rows", ("expert", "random"))
            return
        source = {"expert": data_digest(out / "expert"), "demonstrations": number}
        keep_settings(folder, "demonstrations_source", source)
        expert = load_transitions(out / "expert")
        for name, cut in (("successful", False), ("demonstrations", True)):
            if not (folder / name).exists():
                select_successful(
                    expert,
                    ("next", "reward"),
                    above=-0.5,
                    cut=cut,
                    trajectories=number,
                    path=folder / name,
                )
        names = (f"{folder.name}/successful", "random")
        self._mix(folder / "rows", names, settings.random_ratio)

    def _mix(
        self, path: Path, names: Sequence[str], ratio: float | None = None
    ) -> None:
        """Mixes datasets; with all of the first, and ``ratio`` times as many others."""
        out, shares, trajectories = self.out, None, None
        parts = [load_transitions(out / name) for name in names]
        mixed: dict[str, Any] = {"mixed": [data_digest(out / name) for name in names]}
        if path.exists():
            if data_source(path) != mixed:
                raise ValueError(
                    f"{path} was mixed from other data than {list(names)} in {out} "
                    "have now: delete it, or set another folder with out=..."
                )
            return
        if ratio is not None:
            first = len(parts[0]["episode"].unique_consecutive())
            trajectories = round(first * (1 + ratio))
            shares = [first / trajectories, 1 - first / trajectories]
        mix_trajectories(
            parts,
            shares=shares,
            trajectories=trajectories,
            seed=self.settings.collect.seed,
            path=path,
        )

    def rows(self) -> TensorDictBase:
        """Returns the demonstrations and the random episodes."""
        return load_transitions(self.folder / "rows")

    def demonstrations(self) -> TensorDictBase:
        """Returns the demonstrations up to their first success."""
        if not self.has_demonstrations:
            raise ValueError(
                "env.demonstrations is null, so that there are none: set a number"
            )
        return load_transitions(self.folder / "demonstrations")

    @property
    def has_demonstrations(self) -> bool:
        """Whether a number of successful episodes is set."""
        return self.settings.demonstrations is not None

    def simulator(self, num_actions: int) -> SimulatorInfluence:
        """Returns the simulator as an estimator."""
        return SimulatorInfluence(
            partial(FetchPushTruth, 2, self.cubes.get("cube_friction")),
            state_key=("info", "simulator"),
            num_actions=num_actions,
            threshold=self.settings.truth.threshold,
            # One worker is this process.
            num_workers=self.workers if self.workers > 1 else 0,
        )

    def distance_rule(self, *, action_only: bool) -> DistanceInfluence:
        """Returns the rule of distance between the gripper and the cubes."""
        positions = {name: LAYOUT.columns[name][:3] for name in LAYOUT.names}
        return DistanceInfluence(LAYOUT, positions, action_only=action_only)

    def play(
        self, actor: Any, seed: int, folder: Path, *, split: Split = "test"
    ) -> list[dict[str, Any]]:
        """Plays episodes from the same starts for all runs."""
        starts = self._starts(split)
        torch.manual_seed(seed)  # for policies that draw
        return play(
            actor,
            episodes=len(starts),
            steps=self.settings.collect.steps,
            seed=starts.start,
            **self.cubes,
        )

    def _starts(self, split: Split) -> range:
        """Returns the seeds of the starts, which the other split does not have."""
        settings = self.settings.evaluate
        starts = {
            "test": range(settings.seed, settings.seed + settings.episodes),
            "validation": range(
                settings.validation_seed,
                settings.validation_seed + settings.validation_episodes,
            ),
        }
        if set(starts["test"]) & set(starts["validation"]):
            raise ValueError(
                "env.evaluate: the seeds of the validation starts, "
                f"{starts['validation']}, are also some of the test starts, "
                f"{starts['test']}: change validation_seed"
            )
        return starts[split]

    def record(
        self, actor: Any, seed: int, task: str | None = None, *, episode: int = 0
    ) -> Recording:
        """Plays the test episodes again, and returns one."""
        if task not in (None, TASK):
            raise ValueError(f"task is {task!r}, expected {TASK!r}")
        settings = self.settings.evaluate
        check_episode(episode, settings.episodes)
        watched = FetchPushCubes(2, render_mode="rgb_array", **self.cubes)
        states: list[np.ndarray] = []
        torch.manual_seed(seed)
        episodes = play(
            actor,
            episodes=settings.episodes,
            steps=self.settings.collect.steps,
            seed=settings.seed,
            recorded=(episode, states),
            **self.cubes,
        )
        watched.reset(seed=settings.seed + episode)  # its goals
        success, render = episodes[episode]["full"], watched.render_states
        return Recording(TASK, np.stack(states), render, success, watched.dt)

    def measures(self, episodes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Returns the shares of episodes in which both, and each, cube arrived."""
        return [
            {
                "task": TASK,
                "measure": name,
                "episodes": len(episodes),
                "value": float(np.mean([episode[name] for episode in episodes])),
            }
            for name in MEASURES
        ]


def play(
    actor: Any,
    *,
    episodes: int,
    steps: int,
    seed: int,
    recorded: tuple[int, list[np.ndarray]] | None = None,
    **cubes: float,
) -> list[dict[str, bool]]:
    """Plays episodes in parallel, from the starts that the seed determines.

    An episode ends as soon as all cubes are at their goals. ``recorded`` is the number
    of one, and a list to which its states of the simulator are added.

    Returns:
        list of dict: for each episode whether all cubes were at their goals at some
        step (``full``), and whether each cube was.
    """
    make = partial(FetchPushCubes, 2, max_episode_steps=steps, **cubes)
    envs = [make() for _ in range(episodes)]
    reached = np.zeros((episodes, 2), dtype=np.bool_)
    full = np.zeros(episodes, dtype=np.bool_)

    def step(number: int, action: np.ndarray) -> tuple[dict[str, Any], bool]:
        state, _, terminated, truncated, info = envs[number].step(action)
        reached[number] |= info["cube_success"]
        full[number] = info["cube_success"].all()
        if recorded is not None and number == recorded[0]:
            recorded[1].append(envs[number].simulator_state())
        return state, bool(full[number] or terminated or truncated)

    starts = [env.reset(seed=seed + number)[0] for number, env in enumerate(envs)]
    if recorded is not None:
        recorded[1].append(envs[recorded[0]].simulator_state())
    play_together(actor, starts, step)
    for env in envs:
        env.close()
    return [
        {"full": bool(all_), "cube0": bool(first), "cube1": bool(second)}
        for all_, (first, second) in zip(full, reached, strict=True)
    ]
