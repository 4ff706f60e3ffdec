"""Environments, methods and learners, created from their configuration.

Each has a YAML file in ``conf/`` whose ``_target_`` names its class.
"""

from __future__ import annotations

import io
import logging
from contextlib import redirect_stderr
from pathlib import Path

from hydra.utils import get_class, instantiate
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError

from environments.base import Environment
from learners.base import Learner
from learners.settings import BaseSettings, Count, check_settings_of
from methods.base import Method
from torchrl_caiac._files import read_json, write_json
from torchrl_caiac.modules import faster_dtype

__all__ = [
    "candidates",
    "check_learner",
    "hidden_dtype",
    "kept_steps",
    "make_environment",
    "make_learner",
    "make_method",
    "make_methods",
    "new_learner",
    "policy_file",
    "run_folder",
]


_LOGGER = logging.getLogger(__name__)


class ValidationSettings(BaseSettings):
    """What the settings ``validation`` may be."""

    policies: Count | None


def make_environment(cfg: DictConfig) -> Environment:
    """Returns the environment ``cfg.env``."""
    # Some packages print notices when they are imported.
    with redirect_stderr(io.StringIO()) as notices:
        kind = get_class(cfg.env._target_)
    if notices.getvalue():
        _LOGGER.info("%s", notices.getvalue().strip())
    return kind(cfg.env, Path(cfg.out), workers=cfg.workers)


def make_method(cfg: DictConfig, name: str) -> Method:
    """Returns a method of ``cfg.method``."""
    if name not in cfg.method:
        raise ValueError(
            f"the method {name!r} is not configured, got {list(cfg.method)}: add it "
            f"with 'method=[{name},...]'"
        )
    return instantiate(cfg.method[name])


def make_methods(cfg: DictConfig) -> dict[str, Method]:
    """Returns all methods of ``cfg.method`` by name."""
    return {name: make_method(cfg, name) for name in cfg.method}


def new_learner(cfg: DictConfig, method: str) -> Learner:
    """Returns the learner ``cfg.learner`` for one of the methods, not checked.

    It can read rows, but not train: the methods of runs with the same data are scored
    with the settings of one of them.
    """
    learner: Learner = get_class(cfg.learner._target_)(
        cfg.learner,
        make_environment(cfg),
        make_method(cfg, method),
        cfg.env.augmentation,
    )
    return learner


def make_learner(cfg: DictConfig, method: str) -> Learner:
    """Returns the learner ``cfg.learner`` for one of the methods."""
    cfg = cfg.copy()
    learner = _checked(cfg, method)
    if cfg.learner.get("hidden_dtype") == "auto":
        learner.settings.hidden_dtype = hidden_dtype(cfg)
    return learner


def check_learner(cfg: DictConfig, method: str, further: int = 0) -> None:
    """Raises if a setting of a run is wrong; reads and writes no file.

    Args:
        cfg (DictConfig): the configuration.
        method (str): one of the methods.
        further (int): steps that follow in ``online.py``. Defaults to 0.
    """
    _checked(cfg, method, further)


def _checked(cfg: DictConfig, method: str, further: int = 0) -> Learner:
    check_settings_of("validation", cfg.validation, ValidationSettings)
    learner = new_learner(cfg, method)
    try:
        learner.environment.check()
    except ConfigAttributeError as error:
        raise ValueError(f"{error.full_key} is missing") from error
    learner.check(further)
    return learner


def hidden_dtype(cfg: DictConfig) -> str:
    """Returns the dtype in which hidden layers are trained the fastest.

    All runs of a folder use what the first one has measured, so that they can be
    compared, and those that resume continue as they began.
    """
    path = make_environment(cfg).folder / cfg.runs / "hidden_dtype.json"
    if not path.exists():
        settings = cfg.learner
        widths = [*settings.hidden_sizes, *(settings.get("policy_sizes") or [])]
        dtype = faster_dtype(settings.batch_size, max(widths))
        write_json(path, {"hidden_dtype": str(dtype).removeprefix("torch.")})
    return str(read_json(path, "dtype of hidden layers", "delete it")["hidden_dtype"])


def run_folder(cfg: DictConfig, method: str, seed: int) -> Path:
    """Returns the folder of a run: its checkpoint, policies, log and evaluation."""
    return make_environment(cfg).folder / cfg.runs / f"{method}-seed{seed}"


def policy_file(cfg: DictConfig, method: str, seed: int, step: int) -> Path:
    """Returns the file of the policy after some steps."""
    return run_folder(cfg, method, seed) / "policies" / f"{step}.pt"


def kept_steps(cfg: DictConfig) -> list[int]:
    """Returns the training steps after which policies are kept."""
    last = cfg.learner.steps
    every = cfg.learner.keep_every or last
    return list(range(every, last + 1, every))


def candidates(cfg: DictConfig) -> list[int]:
    """Returns the training steps whose policies are compared on validation starts."""
    return kept_steps(cfg)[-(cfg.validation.policies or 0) :]
