"""Trains offline, then collects, scores and trains in turn.

``python online.py`` trains ``learner=td3_bc`` on data of Fetch-Push, with
and without counterfactuals. Then, in each round, collectors play episodes with
the policy and some noise, the method scores them, and training goes on with batches
of offline and online transitions. ``online.episodes=0`` collects nothing, for
comparison. The policies before the first and after the last round play from the test
starts. ``size=quick`` is a smoke run, with ``online.rounds=2`` and the like.

The table is ``<publish>/online.csv``, the figure ``online.png`` beside it. Rounds that
are finished are not repeated: a run resumes at the last one, with the episodes that it
has collected. Workers draw their own noise, so a resumed run does not end with the same
weights.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import hydra
import numpy as np
import torch
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import MultiSyncCollector
from torchrl.data import Bounded
from torchrl.envs import DoubleToFloat, EnvBase, TransformedEnv
from torchrl.modules import AdditiveGaussianModule

from learners.hindsight import HindsightLearner
from learners.settings import (
    BaseSettings,
    BelowOne,
    Count,
    NotNegative,
    check_settings_of,
)
from score import make_scoring
from shared.console import Console
from shared.parts import check_learner, make_environment, make_method, run_folder
from shared.settings import keep_settings
from study import prepare
from torchrl_caiac._figures import colour, finish_results, new_figure
from torchrl_caiac._files import claim_folder, read_json, whole_file, write_json
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import (
    load_transitions,
    offline_buffer,
    offline_to_online_buffer,
    write_transitions,
)
from torchrl_caiac.envs import make_fetch_push_env
from train import train

_LOGGER = logging.getLogger(__name__)
COLUMNS = ("method", "seed", "episodes", "round", "split", "starts", "value")


class OnlineSettings(BaseSettings):
    """What the settings ``online`` may be."""

    rounds: Count
    episodes: Annotated[int, Field(ge=0)]
    steps: Count
    workers: Count
    noise: NotNegative
    offline_fraction: BelowOne


class OnlineSeeds(BaseSettings):
    """What the setting ``seeds`` may be."""

    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]


def check(cfg: DictConfig, method: str) -> None:
    """Raises if a setting is wrong, before anything is collected or trained."""
    settings = cfg.online
    check_settings_of("online", settings, OnlineSettings)
    seeds = OmegaConf.masked_copy(cfg, ["seeds"])
    check_settings_of("online.py", seeds, OnlineSeeds)
    if cfg.env.name != "fetch_push":
        raise ValueError("online.py collects in Fetch-Push only: set env=fetch_push")
    if not issubclass(get_class(cfg.learner._target_), HindsightLearner):
        raise ValueError(
            f"learner={cfg.learner.name} learns from demonstrations only: choose td3, "
            "td3_bc or iql"
        )
    if settings.episodes and "truth" in make_method(cfg, method).env_settings:
        raise ValueError(
            f"method={method} reads states of the simulator, which collected episodes "
            "do not have: choose another method, or online.episodes=0"
        )
    workers = min(settings.workers, settings.episodes)
    if workers and settings.episodes % workers:
        raise ValueError(
            f"online.episodes is {settings.episodes}, expected a multiple of "
            f"online.workers, {workers}: each worker plays whole episodes"
        )
    check_learner(cfg, method, settings.rounds * settings.steps)


def make_env(steps: int) -> EnvBase:
    """Returns the environment of one worker, whose episodes have ``steps`` steps."""
    env = make_fetch_push_env(2, max_episode_steps=steps)
    return TransformedEnv(env, DoubleToFloat())


def collect_episodes(policy: Any, cfg: DictConfig, seed: int) -> TensorDict:
    """Returns whole episodes that workers play with noise, ``[T]``."""
    settings, steps = cfg.online, cfg.env.collect.steps
    workers = min(settings.workers, settings.episodes)
    frames = settings.episodes * steps
    noise = AdditiveGaussianModule(
        Bounded(-1.0, 1.0, (4,)),
        sigma_init=settings.noise,
        sigma_end=settings.noise,
        annealing_num_steps=1,
    )
    collector = MultiSyncCollector(
        [partial(make_env, steps)] * workers,
        TensorDictSequential(policy, noise),
        frames_per_batch=frames,
        total_frames=frames,
        reset_at_each_iter=True,
        cat_results=0,
    )
    try:
        collector.set_seed(seed)
        (batch,) = [part.clone() for part in collector]
    finally:
        collector.shutdown()
    batch = batch.reshape(-1)
    keys = ("observation", "achieved_goal", "desired_goal")
    ends = ("reward", "done", "terminated", "truncated")
    rows = batch.select("action", *keys, *[("next", key) for key in (*keys, *ends)])
    return rows.set("episode", torch.arange(frames) // steps)


def online_rows(
    learner: Any,
    policy: Any,
    cfg: DictConfig,
    folder: Path,
    first_seed: int,
    number: int,
) -> TensorDictBase:
    """Returns the episodes of all rounds up to a number, scored, for learning."""
    path = folder / f"round-{number}"
    if not path.exists():
        write_transitions(
            collect_episodes(policy, cfg, first_seed + number),
            path,
            action_bounds=([-1.0] * 4, [1.0] * 4),
        )
    parts, first = [], 0
    for i in range(1, number + 1):
        stored = load_transitions(folder / f"round-{i}")
        if learner.method.score_key is not None:
            learner.method.score(offline_buffer(stored, 1), make_scoring(cfg))
        part = learner.learning_rows(load_transitions(folder / f"round-{i}"))
        part["episode"] += first
        first = int(part["episode"].max()) + 1
        parts.append(part)
    return torch.cat(parts)


def success(
    policy: Any, cfg: DictConfig, seed: int, folder: Path, number: int, split: Any
) -> dict[str, Any]:
    """Plays from the starts of a split, unless this was done; returns the share."""
    path = folder / f"{split}-{number}.json"
    if not path.exists():
        environment = make_environment(cfg)
        episodes = environment.play(policy, seed, folder, split=split)
        value = float(np.mean([e[environment.success_key] for e in episodes]))
        write_json(path, {"starts": len(episodes), "value": value})
    found = read_json(path, "evaluation", "delete it")
    return {"round": number, "split": split, **found}


def run(cfg: DictConfig, method: str, seed: int) -> Iterator[dict[str, Any]]:
    """Trains offline and then online; yields the success before and after."""
    settings = cfg.online
    check(cfg, method)
    folder = run_folder(cfg, method, seed) / f"online-{settings.episodes}"
    folder.mkdir(parents=True, exist_ok=True)
    learner: Any = train(cfg, method, seed)
    kept = OmegaConf.to_container(settings, resolve=True)
    kept = {key: value for key, value in kept.items() if key != "rounds"}
    kept |= {"offline": cfg.learner.steps, **learner.kept_settings(seed)}
    keep_settings(folder, "online", kept)
    first_seed = 1000 * (seed + 1)  # of the starts of collected episodes
    checkpoint = TrainingCheckpoint(
        folder / "checkpoint.zip", settings=kept, **learner.parts
    )

    def policy() -> Any:
        return learner.load_policy(learner.policy_state())

    before = checkpoint.load(max_step=settings.rounds)
    if not before:
        for split in ("validation", "test"):
            success(policy(), cfg, seed, folder, 0, split)
    offline = learner.rb
    for number in range(before + 1, settings.rounds + 1):
        if settings.episodes:
            rows = online_rows(learner, policy(), cfg, folder, first_seed, number)
            learner.rb = offline_to_online_buffer(
                offline,
                learner.make_online_buffer(rows),
                offline_fraction=settings.offline_fraction,
                batch_size=learner.rows_at_once,
            )
        batches = learner.batches()
        torch.set_flush_denormal(True)
        try:
            for step in range(1, settings.steps + 1):
                learner.step(next(batches), step)
        finally:
            torch.set_flush_denormal(False)
        success(policy(), cfg, seed, folder, number, "validation")
        if number == settings.rounds:
            success(policy(), cfg, seed, folder, number, "test")
        checkpoint.save(number)
    common = {"method": method, "seed": seed, "episodes": settings.episodes}
    for number in range(settings.rounds + 1):
        for split in ("validation", "test"):
            if split == "validation" or number in (0, settings.rounds):
                yield {**common, **success(None, cfg, seed, folder, number, split)}


def write_results(path: Path, new: list[dict[str, Any]]) -> None:
    """Adds rows to the table, in the place of those of the same runs."""
    rows: list[dict[str, Any]] = []
    runs = {tuple(str(row[key]) for key in COLUMNS[:3]) for row in new}
    if path.exists():
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
    rows = [row for row in rows if tuple(row[k] for k in COLUMNS[:3]) not in runs]
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial_file, partial_file.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*rows, *new])


def draw(path: Path) -> None:
    """Draws the mean success of a table by round, on validation starts."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["split"] == "validation"]
    figure = new_figure(5.4, 3.2)
    axes = figure.add_subplot()
    methods = list(dict.fromkeys(row["method"] for row in rows))
    groups = dict.fromkeys((row["method"], row["episodes"] != "0") for row in rows)
    for method, collects in groups:
        values: dict[int, list[float]] = {}
        for row in rows:
            if (row["method"], row["episodes"] != "0") == (method, collects):
                values.setdefault(int(row["round"]), []).append(float(row["value"]))
        axes.plot(
            list(values),
            [np.mean(found) for found in values.values()],
            color=colour(methods.index(method)),
            linestyle="-" if collects else ":",
            marker="o",
            markersize=3,
            label=method if collects else f"{method}, no collecting",
        )
    axes.set_xlabel("round")
    axes.set_ylim(0, 1.1)
    finish_results(
        figure,
        axes,
        methods=len(groups),
        ylabel="success, validation starts",
        title="both cubes at their goals, while collecting",
    )
    with whole_file(path.with_suffix(".png")) as partial_file:
        figure.savefig(partial_file, dpi=150)


@hydra.main(version_base=None, config_path="conf", config_name="online")
def main(cfg: DictConfig) -> None:
    """Runs all methods and seeds."""
    torch.set_num_threads(1)
    path = Path(cfg.publish) / "online.csv"
    runs = [(method, seed) for seed in cfg.seeds for method in cfg.method]
    for method in cfg.method:
        check(cfg, method)
    with Console(Path(cfg.out) / "online", stages=3 + len(runs)) as console:
        prepare(cfg, console)
        for method, seed in runs:
            folder = run_folder(cfg, method, seed)
            with claim_folder(folder), console.stage(folder.name):
                write_results(path, [*run(cfg, method, seed)])
            draw(path)
        console.print(f"results: {path}; figure: {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
