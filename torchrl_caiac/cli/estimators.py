"""The estimators that ``caiac score`` offers, and how each is built and fitted."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_caiac._files import UnreadableFileError, read_json, write_json
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import UsageError
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    DistanceInfluence,
    MotionInfluence,
    ResidualInfluence,
    default_world_model,
)
from torchrl_caiac.influence.default_world_model import DEFAULT_FIT
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel
from torchrl_caiac.scored import MODEL_FOLDER

__all__ = [
    "ESTIMATORS",
    "Context",
    "EstimatorEntry",
    "add_options",
    "estimator_settings",
]

_CHECKPOINT, _MODEL, _CONFIG = "checkpoint.zip", "model.zip", "model.json"
_AGAIN = "fit it again, with `caiac score`"


@dataclass(frozen=True)
class Context:
    """What an estimator is built from.

    Args:
        layout (EntityLayout): the entities.
        data (TensorDict): the transitions that are scored, ``[T]``.
        more (sequence of TensorDict): further transitions that models are fitted to.
        folder (Path): where models are kept.
        settings (dict): from :func:`estimator_settings`.
        console (Console): shows progress.
    """

    layout: EntityLayout
    data: TensorDict
    more: Sequence[TensorDictBase]
    folder: Path
    settings: dict[str, Any]
    console: Console


@dataclass(frozen=True)
class EstimatorEntry:
    """One estimator of the command line.

    Args:
        summary (str): one line of help: what it does, and what it needs.
        make (callable): builds it from a :class:`Context`, and fits what it needs.
        options (dict): the options that it has, with their defaults; ``None`` if there
            is none.
        needs_positions (bool): whether the layout must name positions. Defaults to
            ``False``.
    """

    summary: str
    make: Callable[[Context], Any]
    options: dict[str, Any]
    needs_positions: bool = False


# --- one function an estimator -----------------------------------------------------


def _motion(context: Context) -> MotionInfluence:
    tolerance = context.settings["tolerance"]
    return MotionInfluence(context.layout, tolerance=tolerance).fit(context.data)


def _residual(context: Context) -> ResidualInfluence:
    estimator = ResidualInfluence(
        context.layout,
        tolerance=context.settings["tolerance"],
        far=context.settings["far"],
    )
    with context.console.step("fitting each entity alone"):
        return estimator.fit(
            context.data,
            seed=context.settings["seed"],
            progress=context.console.progress,
        )


def _distance(context: Context) -> DistanceInfluence:
    return DistanceInfluence(
        context.layout, distance=context.settings["distance"], action_only=True
    )


def _cai(context: Context) -> CAI:
    def new() -> GaussianWorldModel:
        return default_world_model(
            context.layout, _action_dim(context.data), widths=_widths(context)
        )

    model = _fitted(context, new)
    return CAI(model, num_actions=context.settings["num_actions"])


def _attention(context: Context) -> AttentionInfluence:
    def new() -> TransformerWorldModel:
        return TransformerWorldModel(
            context.layout,
            _action_dim(context.data),
            widths=_widths(context),
            variance_floor=None if context.layout.variance_floor else "auto",
        )

    model = _fitted(context, new)
    return AttentionInfluence(model, action_only=True)


_FIT: dict[str, Any] = {"steps": DEFAULT_FIT["steps"], "seed": 0, "world_model": None}

#: By name. The first one is the default.
ESTIMATORS: dict[str, EstimatorEntry] = {
    "motion": EstimatorEntry(
        "an entity that moves is influenced (needs no model)",
        _motion,
        {"tolerance": "auto"},
    ),
    "residual": EstimatorEntry(
        "an entity that does not move as it would alone is influenced (for objects "
        "that roll or fall; needs velocities in the observation)",
        _residual,
        {"tolerance": "auto", "far": None, "seed": 0},
    ),
    "cai": EstimatorEntry(
        "causal action influence by a world model (takes minutes; needs data with "
        "different actions in similar states)",
        _cai,
        {**_FIT, "num_actions": 64},
    ),
    "attention": EstimatorEntry(
        "attention of a transformer, as in CoDA-action (needs the same as cai)",
        _attention,
        _FIT,
    ),
    "distance": EstimatorEntry(
        "an entity near the robot is influenced (needs positions and --distance)",
        _distance,
        {"distance": None},
        needs_positions=True,
    ),
}


# --- options -----------------------------------------------------------------------


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of all estimators to a parser."""
    lines = "; ".join(f"{name}: {entry.summary}" for name, entry in ESTIMATORS.items())
    parser.add_argument(
        "--estimator",
        choices=list(ESTIMATORS),
        default=next(iter(ESTIMATORS)),
        help=f"{lines} (default: %(default)s)",
    )
    group = parser.add_argument_group("options of estimators")
    group.add_argument(
        "--tolerance",
        type=_tolerance,
        metavar="X",
        help="motion, residual: the largest change that does not count as motion, in "
        "the units of the data; auto takes it from the layout, or from the noise at "
        "rest (default: auto)",
    )
    group.add_argument(
        "--far",
        type=_positive,
        metavar="X",
        help="residual: fit to transitions in which the robot is at least this far "
        "away, in the units of the positions (default: all transitions)",
    )
    group.add_argument(
        "--distance",
        type=_positive,
        metavar="X",
        help="distance: an entity is influenced up to this distance from the robot, in "
        "the units of the positions",
    )
    group.add_argument(
        "--steps",
        type=_count,
        metavar="N",
        help=f"cai, attention: gradient steps of the fit (default: {_FIT['steps']})",
    )
    group.add_argument(
        "--seed",
        type=int,
        metavar="N",
        help="residual, cai, attention: the seed of the fit (default: 0)",
    )
    group.add_argument(
        "--num-actions",
        type=_count,
        metavar="N",
        help="cai: the number of sampled actions for each state (default: 64)",
    )
    group.add_argument(
        "--world-model",
        metavar="DIR",
        help="cai, attention: use the model that an earlier call fitted in DIR",
    )
    group.add_argument(
        "--more-data",
        action="append",
        default=[],
        metavar="DATA",
        help="cai, attention: fit to this dataset too, such as one with random "
        "actions; may be repeated",
    )


def estimator_settings(
    args: argparse.Namespace, layout: EntityLayout
) -> dict[str, Any]:
    """Returns the settings of the chosen estimator.

    Args:
        args (Namespace): with those of :func:`add_options`.
        layout (EntityLayout): the entities.

    Returns:
        dict: JSON values.

    Raises:
        UsageError: an option of another estimator is given, one is missing, or the
            layout does not have what the estimator needs.
    """
    name, entry = args.estimator, ESTIMATORS[args.estimator]
    known = {option for other in ESTIMATORS.values() for option in other.options}
    given = {option for option in known if getattr(args, option) is not None}
    if args.more_data and "steps" not in entry.options:
        given.add("more_data")
    for option in sorted(given - set(entry.options)):
        users = [n for n, other in ESTIMATORS.items() if option in other.options]
        users = users or [n for n, e in ESTIMATORS.items() if "steps" in e.options]
        raise UsageError(
            f"--{option.replace('_', '-')} is an option of --estimator "
            f"{' and '.join(users)}, not of {name}: leave it out"
        )
    if args.world_model is not None:
        unused = [o for o in ("steps", "seed") if getattr(args, o) is not None]
        unused += ["more_data"] * bool(args.more_data)
        if unused:
            raise UsageError(
                f"--{unused[0].replace('_', '-')} is for the fit of a world model, but "
                "--world-model has one that is fitted: leave one of them out"
            )
    if args.num_actions == 1:
        raise UsageError("--num-actions is 1, expected at least 2, to compare them")
    if set(layout.fixed) == set(layout.names):
        raise UsageError(
            f"all entities of the layout are fixed, {list(layout.names)}, so that "
            "nothing is swapped: remove the objects from fixed"
        )
    if args.far is not None and len(layout.fixed) != 1:
        raise UsageError(
            "--far needs a layout with one fixed entity, the robot, but it has "
            f"{list(layout.fixed)}: describe the robot as one entity, or leave it out"
        )
    settings = {
        option: default if getattr(args, option) is None else getattr(args, option)
        for option, default in entry.options.items()
    }
    if name == "distance" and settings["distance"] is None:
        raise UsageError(
            "--estimator distance needs --distance, in the units of the positions"
        )
    missing = [n for n in layout.names if n not in layout.positions]
    if entry.needs_positions and missing:
        raise UsageError(
            f"--estimator {name} needs the positions of all entities, and the layout "
            f"has none of {missing}: add them to the layout, or use --estimator motion"
        )
    return settings


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _positive(text: str) -> float:
    value = _number(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not positive and finite")
    return value


def _tolerance(text: str) -> float | str:
    return text if text == "auto" else _positive(text)


def _count(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return value


# --- world models ------------------------------------------------------------------


def _action_dim(data: TensorDictBase) -> int:
    shape = data["action"].shape[1:]
    if len(shape) != 1:
        raise ValueError(
            f"'action' has shape {['T', *shape]}, expected [T, A]: a world model reads "
            "vectors. For discrete actions use --estimator motion or residual"
        )
    return int(shape[0])


def _widths(context: Context) -> dict[str, int] | None:
    return None if context.layout.is_flat else context.layout.widths(context.data[:1])


def _fitted(
    context: Context, new: Callable[[], EntityDynamicsModel]
) -> EntityDynamicsModel:
    """Returns a fitted model: one that was given, or a new one."""
    settings = context.settings
    if settings["world_model"] is not None:
        return _load(Path(settings["world_model"]), context)
    folder = context.folder / MODEL_FOLDER
    folder.mkdir(exist_ok=True)
    torch.manual_seed(settings["seed"])
    model = new()
    with context.console.step(f"fitting the world model, {settings['steps']} steps"):
        fit_world_model(
            model,
            [context.data, *context.more],
            **{**DEFAULT_FIT, "steps": settings["steps"]},
            seed=settings["seed"],
            checkpoint=folder / _CHECKPOINT,
            progress=context.console.progress,
            check=False,
        )
    write_json(folder / _CONFIG, model.config)
    _keeper(folder, model).save(settings["steps"])
    return model


def _keeper(folder: Path, model: EntityDynamicsModel) -> TrainingCheckpoint:
    return TrainingCheckpoint(
        folder / _MODEL, settings={"model": model.config}, rng=False, model=model
    )


def _load(source: Path, context: Context) -> EntityDynamicsModel:
    """Loads the model of another folder.

    Raises:
        UsageError: there is none, or it is of another layout.
    """
    folder = source / MODEL_FOLDER
    file = folder / _CONFIG
    if not file.exists():
        raise UsageError(
            f"--world-model {source}: {file} is missing; give a folder in which "
            "`caiac score --estimator cai` (or attention) has ended"
        )
    config = read_json(file, "description of a world model", _AGAIN)
    kinds = {
        kind.__name__: kind for kind in (GaussianWorldModel, TransformerWorldModel)
    }
    try:
        model: EntityDynamicsModel = kinds[config["class"]].from_config(config)
    except (KeyError, TypeError, ValueError) as error:
        raise UnreadableFileError(
            f"{file} is not a readable description of a world model ({error!r}): "
            f"{_AGAIN}"
        ) from error
    if model.layout != context.layout:
        raise UsageError(
            f"--world-model {source} is of another layout: fit one for this layout"
        )
    if not (folder / _MODEL).exists():
        raise UnreadableFileError(f"{folder / _MODEL} is missing: {_AGAIN}")
    _keeper(folder, model).load()
    model.eval()
    return model
