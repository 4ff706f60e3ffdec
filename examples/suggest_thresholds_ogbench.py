"""Suggested thresholds on OGBench, next to the best ones by its simulator.

``python suggest_thresholds_ogbench.py --out outputs/ogbench --publish docs/results``
collects play data, fits a world model, asks the simulator for the truth in held-out
states, and adds its rows to the table of ``suggest_thresholds.py``. Files that
``--play`` and ``--held-out`` name are used instead of collected ones.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded

from shared.tables import update_csv
from shared.thresholds import COLUMNS, compare_thresholds
from torchrl_caiac._files import whole_file
from torchrl_caiac.data import load_ogbench, offline_buffer
from torchrl_caiac.envs.ogbench import OGBenchTruth, create_ogbench_play, ogbench_states
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import (
    CAI,
    MotionInfluence,
    score_buffer,
    suggest_thresholds,
    true_influence,
)
from torchrl_caiac.layouts import ready_layout
from torchrl_caiac.modules import GaussianWorldModel

_SPEC = Bounded(-1.0, 1.0, (5,))


def transitions(out: Path, name: str, files: list[Path]) -> list[TensorDictBase]:
    """Loads files as transitions."""
    return [load_ogbench(file, out / f"{name}_{i}") for i, file in enumerate(files)]


def ground_truth(
    file: Path, env: str, data: TensorDictBase, rows: torch.Tensor
) -> torch.Tensor:
    """Returns what the action moves in some rows, bool ``[S, N]``, kept in a file."""
    if file.exists():
        with np.load(file, allow_pickle=False) as known:
            if np.array_equal(known["rows"], rows.numpy()):
                return torch.from_numpy(known["influenced"])
    states = ogbench_states(data[rows])
    # A cube counts as moved from 1 mm on.
    influenced = true_influence(
        partial(OGBenchTruth, env), states, num_actions=16, threshold=1e-3
    ).influenced
    with whole_file(file) as partial_file, partial_file.open("wb") as stream:
        np.savez(stream, rows=rows.numpy(), influenced=influenced.numpy())
    return influenced


def main() -> None:
    """Compares the thresholds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="cube-double", help="default: cube-double")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--publish", type=Path, help="default: the folder of --out")
    parser.add_argument("--play", type=Path, nargs="*", help="files to learn from")
    parser.add_argument("--held-out", type=Path, help="a file of other episodes")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--states", type=int, default=1500, help="of the truth")
    parser.add_argument("--steps", type=int, default=15_000, help="of the world model")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.play:
        args.play = [args.out / "play.npz", args.out / "noisy.npz"]
        for seed, file in enumerate(args.play):
            if not file.exists():
                is_noisy = file.stem == "noisy"
                episodes = args.episodes // 2 if is_noisy else args.episodes
                create_ogbench_play(
                    file, args.env, episodes=episodes, noisy=is_noisy, seed=seed
                )
    if args.held_out is None:
        args.held_out = args.out / "held_out.npz"
        if not args.held_out.exists():
            create_ogbench_play(args.held_out, args.env, episodes=10, seed=100)
    layout = ready_layout(f"ogbench/{args.env}")
    play = transitions(args.out, "play", args.play)
    (held_out,) = transitions(args.out, "held_out", [args.held_out])
    torch.manual_seed(0)
    objects = {name: layout.positions[name] for name in layout.names[1:]}
    model = GaussianWorldModel(
        layout, 5, predict=objects, inputs={"robot": layout.columns["robot"][12:]}
    )
    fit_world_model(
        model,
        play,
        action_spec=_SPEC,
        steps=args.steps,
        checkpoint=args.out / "world_model",
    )
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(len(held_out), generator=generator)[: args.states]
    truth = ground_truth(args.out / "truth.npz", args.env, held_out, rows)
    table = []
    for name, estimator in (
        ("caiac", CAI(model, num_actions=32, action_spec=_SPEC)),
        ("motion", MotionInfluence(layout).fit(play[0])),
    ):
        scored = []
        for data in (play[0], held_out):
            rb = offline_buffer(data.clone(), 1)
            score_buffer(rb, estimator, lookahead=0, check=False)
            scored.append(rb)
        found = suggest_thresholds(scored[0], layout)
        found.plot(args.out / f"thresholds_{args.env}_{name}.png")
        held_scores = scored[1].storage[:]["caiac", "score"][rows]
        table += compare_thresholds(found, held_scores, truth, layout, estimator=name)
    path = (args.publish or args.out) / "thresholds.csv"
    update_csv(path, table, COLUMNS, experiment=f"ogbench_{args.env}")


if __name__ == "__main__":
    main()
