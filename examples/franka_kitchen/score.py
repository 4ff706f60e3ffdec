"""Scores every row of the demonstrations, and compares scores with the truth.

Run after ``fit_world_model.py``: ``python score.py``. The learned scores go into the
leaf ``("caiac", "score")`` of the demonstrations. The arms ``coda`` and ``coda_action``
also have the attention of a transformer scored, ``("coda", "graph")`` and ``("coda",
"action")``, and ``oracle`` the simulator asked for the truth, ``("oracle", "score")``.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import hydra
import torch
from fit_world_model import fit, fit_transformer
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.experiments import keep_settings, whole_file, write_json
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    influence_report,
    oracle_score,
    score_buffer,
    true_influence,
)

_LOGGER = logging.getLogger(__name__)


def simulator_truth(
    data: TensorDictBase, path: Path, cfg: DictConfig, actions: int, every: int = 1
) -> torch.Tensor:
    """Which entities the action can move in each row, bool ``[T, N]``; kept on disk.

    Only every ``every``-th row of a trajectory is asked about. A row in between counts
    as influenced where one of the two rows around it is.
    """
    if not path.exists():
        counts = data["episode"].unique_consecutive(return_counts=True)[1]
        position = torch.cat([torch.arange(count) for count in counts])
        asked = position % every == 0
        states = torch.cat([data["sim", "qpos"], data["sim", "qvel"]], -1)
        truth = true_influence(
            KitchenEnv,
            states[asked],
            num_actions=actions,
            # One worker is this process.
            num_workers=cfg.collect.workers if cfg.collect.workers > 1 else 0,
        )
        known = torch.zeros(len(data), len(KitchenEnv.layout), dtype=torch.bool)
        known[asked] = truth.influenced
        before = torch.arange(len(data)) - position % every
        after = (before + every).clamp(max=len(data) - 1)
        alone = asked | (data["episode"][after] != data["episode"])
        with whole_file(path) as partial:
            torch.save(known[before] | known[before.where(alone, after)], partial)
    influenced = torch.load(path, weights_only=True)
    if influenced.shape != (len(data), len(KitchenEnv.layout)):
        raise ValueError(
            f"{path} has the shape {list(influenced.shape)}, the data have {len(data)} "
            "rows: it is of other data, delete it"
        )
    return influenced


class _Truth:
    """Scores of rows whose observation is the truth."""

    layout = EntityLayout({name: [i] for i, name in enumerate(KitchenEnv.layout.names)})

    def __call__(self, td: TensorDictBase) -> torch.Tensor:
        return td["observation"]


def store_oracle(
    data: TensorDictBase, influenced: torch.Tensor, lookahead: int
) -> None:
    """Adds the truth as scores, with the lookahead of the learned ones."""
    truth = oracle_score(influenced)
    after = TensorDict({"observation": truth, "done": data["next", "done"]}, data.shape)
    rb = offline_buffer(
        TensorDict(
            {"observation": truth, "episode": data["episode"], "next": after},
            data.shape,
        )
    )
    score_buffer(rb, _Truth(), lookahead=lookahead, progress=False)
    scores = rb.storage[:]["caiac", "score"]
    if data.get(("oracle", "score"), None) is None:
        data.make_memmap(("oracle", "score"), shape=scores.shape, dtype=scores.dtype)
    data["oracle", "score"].copy_(scores)


def score(cfg: DictConfig) -> dict[str, Any]:
    """Scores the demonstrations and reports how good scores are on held-out ones."""
    settings = cfg.score
    out = Path(cfg.out)
    keep_settings(settings, out / "score.json")
    estimator = CAI(fit(cfg), num_actions=settings.num_actions)
    options = {"batch_size": settings.batch_size, "smoothing": settings.smoothing}
    demonstrations = load_transitions(out / "demonstrations")
    rb = offline_buffer(demonstrations, batch_size=1)
    score_buffer(rb, estimator, lookahead=settings.lookahead, **options)
    arms = {cfg.arm, *cfg.demo.arms}
    if arms & {"coda", "coda_action"}:
        model = fit_transformer(cfg)
        for name in ("graph", "action"):
            attention = AttentionInfluence(model, action_only=name == "action")
            score_buffer(
                rb,
                attention,
                lookahead=settings.lookahead,
                key=("coda", name),
                **options,
            )
    if "oracle" in arms:
        influenced = simulator_truth(
            demonstrations,
            out / "truth.pt",
            cfg,
            settings.oracle_actions,
            settings.oracle_every,
        )
        store_oracle(demonstrations, influenced, settings.lookahead)
    held_out = load_transitions(out / "held_out")
    # The truth is about a row's own state, so the next one is left out here.
    score_buffer(
        offline_buffer(held_out, batch_size=1), estimator, lookahead=0, **options
    )
    scores = load_transitions(out / "held_out")["caiac", "score"]
    report: dict[str, Any] = dict(
        influence_report(
            scores,
            simulator_truth(
                held_out, out / "held_out_truth.pt", cfg, settings.truth_actions
            ),
            KitchenEnv.layout.names,
            threshold=settings.threshold,
        )
    )
    write_json(out / "influence.json", report)
    for name in cfg.evaluate.tasks:
        _LOGGER.info("%s: %s", name, report[name])
    return report


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Scores the demonstrations."""
    torch.set_num_threads(1)
    score(cfg)


if __name__ == "__main__":
    main()
