"""OGBench's cubes: play data, for the comparison of influence estimators."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from omegaconf import DictConfig
from tensordict import TensorDictBase

from environments.base import Environment, Evaluation
from torchrl_caiac.data import load_ogbench, load_transitions, write_transitions
from torchrl_caiac.envs.ogbench import OGBenchTruth, create_ogbench_play
from torchrl_caiac.influence import DistanceInfluence, SimulatorInfluence
from torchrl_caiac.layouts import ready_layout

__all__ = ["OGBench"]


class OGBench(Environment):
    """Data of OGBench's own oracles; no policy is trained here.

    ``held_out`` are rows of episodes with another seed, some steps apart.
    """

    action_dim = 5
    data_name: ClassVar[str] = "play data"

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

    def collect(self, *, progress: bool = False) -> None:
        """Collects what is missing of the files, and loads them."""
        settings, out = self.settings.collect, self.out
        for name, episodes, seed, every in (
            ("rows", settings.episodes, settings.seed, 1),
            ("held_out", settings.held_out, settings.held_out_seed, settings.every),
        ):
            if (out / name).exists():
                continue
            file = out / f"{name}.npz"
            if not file.exists():
                create_ogbench_play(
                    file,
                    self.settings.scene,
                    episodes=episodes,
                    steps=settings.steps,
                    seed=seed,
                    work=out / "work" / name,
                    num_workers=self.workers,
                    progress=progress,
                )
            one = [1.0] * self.action_dim
            bounds = [-x for x in one], one
            data = load_ogbench(
                file, out / "loaded" / name, action_bounds=bounds, progress=progress
            )
            write_transitions(data[::every], out / name, action_bounds=bounds)

    def rows(self) -> TensorDictBase:
        """Returns the play data."""
        return load_transitions(self.out / "rows")

    def simulator(self, num_actions: int) -> SimulatorInfluence:
        """Returns the simulator as an estimator."""
        return SimulatorInfluence(
            partial(OGBenchTruth, self.settings.scene),
            state_key=[("info", "qpos"), ("info", "qvel")],
            num_actions=num_actions,
            threshold=self.settings.truth.threshold,
            # One worker is this process.
            num_workers=self.workers if self.workers > 1 else 0,
        )

    def distance_rule(self, *, action_only: bool) -> DistanceInfluence:
        """Returns the rule of distance between the hand and the cubes, 5 cm."""
        return DistanceInfluence(
            self.layout, self.layout.positions, distance=0.5, action_only=action_only
        )

    def play(self, actor: Any, seed: int, folder: Path) -> list[dict[str, Any]]:
        """Refuses to play."""
        raise NotImplementedError("no policy is trained on OGBench's data here")

    def results(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """Returns nothing, since nothing is played."""
        return []

    def bars(self, evaluations: Sequence[Evaluation]) -> dict[str, list[float]]:
        """Returns nothing, since nothing is played."""
        return {}

    def table(self, evaluations: Sequence[Evaluation]) -> list[str]:
        """Returns nothing, since nothing is played."""
        return []

    def answer(self, evaluations: Sequence[Evaluation]) -> str:
        """Returns nothing, since nothing is played."""
        return ""
