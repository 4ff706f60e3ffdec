"""The scripts of the examples as modules, and small configurations of them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
import pytest
from omegaconf import DictConfig, OmegaConf

EXAMPLES = Path(__file__).parents[2] / "examples"
SCRIPTS = ("collect", "fit", "score", "train", "evaluate", "study", "figures")
SCRIPTS += ("compare_influence", "compare_precision", "online")
SCRIPTS += ("suggest_thresholds", "sweep_variance_floor")
SHARED = ("console", "log", "parts", "results", "settings", "studies", "tables")
SHARED += ("thresholds",)
SMALL_ENV = {
    "kitchen": {
        "collect": {"episodes": 2, "held_out": 1},
        "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
        "transformer": {"steps": 10, "eval_every": 5, "layers": 1, "width": 16},
        "score": {"num_actions": 8},
        "truth": {"actions": 2, "oracle_actions": 2},
        "evaluate": {"episodes": 2, "tasks": ["kettle"]},
    },
    "fetch_push": {
        "demonstrations": 3,
        "collect": {"expert": 4, "random": 7, "held_out": 2, "steps": 100},
        "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
        "transformer": {"steps": 20, "eval_every": 10, "layers": 1, "width": 16},
        "score": {"num_actions": 8},
        "truth": {"actions": 4, "oracle_actions": 3},
        "augmentation": {"counterfactual_ratio": 0.5},
        "evaluate": {"episodes": 3, "validation_episodes": 2},
    },
    "ogbench_cube_double": {
        "collect": {"episodes": 3, "steps": 40, "held_out": 2},
        "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
        "transformer": {"steps": 10, "eval_every": 5, "layers": 1, "width": 16},
        "score": {"num_actions": 8},
        "truth": {"actions": 2},
    },
}
SMALL_ENV["kitchen_all_tasks"] = SMALL_ENV["kitchen"]
SMALL_ENV["ogbench_scene"] = SMALL_ENV["ogbench_cube_double"]
SMALL_ENV["ogbench_cube_double_play"] = SMALL_ENV["ogbench_cube_double"] | {
    "demonstrations": 2,
    "evaluate": {"episodes": 2, "validation_episodes": 1},
}
SMALL_ENV["ogbench_cube_double_noisy"] = SMALL_ENV["ogbench_cube_double_play"]
_SMALL = {
    "steps": 12,
    "batch_size": 32,
    "batches_at_once": 2,
    "hidden_sizes": [16, 16],
    "log_every": 4,
    "checkpoint_every": 6,
    "keep_every": 4,
}
SMALL_LEARNER = {
    **{name: _SMALL for name in ("bc", "diffusion_bc", "td3_bc", "iql")},
    "lmp": {
        "steps": 12,
        "windows": 16,
        "batches_at_once": 2,
        "hidden_size": 16,
        "checkpoint_every": 6,
        "log_every": 6,
    },
    "td3": {
        "steps": 12,
        "batch_size": 64,
        "batches_at_once": 2,
        "hidden_sizes": [16, 16],
        "log_every": 4,
        "checkpoint_every": 6,
        "keep_every": 4,
    },
}


@pytest.fixture(scope="session")
def steps() -> Iterator[SimpleNamespace]:
    """The scripts and what they share, as modules."""
    before = set(sys.modules)
    sys.path.insert(0, str(EXAMPLES))
    yield SimpleNamespace(
        **{name: importlib.import_module(name) for name in SCRIPTS},
        **{name: importlib.import_module(f"shared.{name}") for name in SHARED},
    )
    sys.path.remove(str(EXAMPLES))
    for name in set(sys.modules) - before:
        if str(EXAMPLES) in (getattr(sys.modules[name], "__file__", None) or ""):
            del sys.modules[name]


@pytest.fixture(scope="session")
def compose() -> Callable[..., DictConfig]:
    """Composes a configuration as the scripts do, of small size with ``out``."""

    def composed(
        *overrides: str, out: Path | None = None, config: str = "config"
    ) -> Any:
        with hydra.initialize_config_dir(str(EXAMPLES / "conf"), version_base=None):
            cfg = hydra.compose(config, list(overrides))
        if out is not None:
            small = {
                "out": str(out),
                "workers": 1,
                "env": SMALL_ENV[cfg.env.name],
                "learner": SMALL_LEARNER[cfg.learner.name],
            }
            cfg = OmegaConf.merge(cfg, small)
        return cfg

    return composed
