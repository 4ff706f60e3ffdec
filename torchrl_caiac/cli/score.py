"""``caiac score``: the influence of the action on each entity, in each row."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl.data import ReplayBuffer

from torchrl_caiac._files import read_json, write_json
from torchrl_caiac.check import check_dataset
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import OK, UsageError
from torchrl_caiac.cli.estimators import (
    ESTIMATORS,
    Context,
    add_options,
    estimator_settings,
)
from torchrl_caiac.cli.sources import (
    SETTINGS_FILE,
    add_data,
    add_layout,
    convert,
    describe_source,
    loader_options,
    open_named,
    own_folder,
    read_layout,
    remove_scores,
)
from torchrl_caiac.cli.workers import Ranks, ranks_of_torchrun, score_in_workers
from torchrl_caiac.data import action_bounds, load_transitions, offline_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import (
    action_coverage,
    score_buffer,
    suggest_thresholds,
)
from torchrl_caiac.scored import DATA_FOLDER, ScoredDataset, write_scored

__all__ = ["add_parser", "run"]

# A folder with such a name would be taken for a file by other commands.
_FILES = (".npz", ".npy", ".hdf5", ".h5", ".json", ".yaml", ".yml", ".html")
_EPILOG = """\
example:
  caiac score episodes.npz --layout ogbench/cube-double --out scored
To resume an interrupted call, repeat it. In several processes, on one machine or more:
  caiac score DATA --layout L --out scored --workers 2
  torchrun --nproc-per-node=2 -m torchrl_caiac score DATA ...
"""


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "score",
        help="score a dataset, and suggest thresholds",
        description="Writes a folder with the transitions, the influence of the action "
        "on every entity in each of them, the layout, and suggested thresholds. The "
        "dataset itself is not changed.",
        epilog=_EPILOG,
        **options,
    )
    add_data(parser)
    add_layout(parser)
    parser.add_argument(
        "--out", required=True, metavar="DIR", help="the folder to write"
    )
    add_options(parser)
    group = parser.add_argument_group("scores")
    group.add_argument(
        "--lookahead",
        type=int,
        default=1,
        metavar="N",
        help="an entity counts as influenced if it is in this state or in one of the "
        "next N (default: %(default)s)",
    )
    group.add_argument(
        "--smoothing",
        type=int,
        default=1,
        metavar="N",
        help="the width of a moving average of the scores along the episode "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="score in N processes on this machine, with one thread each (default: "
        "%(default)s)",
    )
    group.add_argument(
        "--overwrite",
        action="store_true",
        help="replace the output of an earlier call with other data or settings",
    )
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    ranks = ranks_of_torchrun()
    if args.workers < 1:
        raise UsageError("--workers must be at least 1")
    if ranks is None:
        return _run(args, console, None)
    if args.workers > 1:
        raise UsageError("--workers is for a call without torchrun: leave it out")
    if ranks.rank:
        console.be_quiet()
    with ranks.connected():
        if ranks.rank:
            return _take_part(ranks)
        sent = False

        def send(value: Any) -> None:
            nonlocal sent
            sent = True
            ranks.send(value)

        try:
            return _run(args, console, (ranks, send))
        except BaseException as error:
            if not sent:
                ranks.send_failure(error)
            raise


_Team = tuple[Ranks, Callable[[Any], None]]


def _take_part(ranks: Ranks) -> int:
    """Scores what the first process of ``torchrun`` has prepared."""
    folder, estimator, arguments = ranks.receive()
    rb = offline_buffer(load_transitions(folder))
    with _no_default_threshold():
        score_buffer(rb, ranks.on_device(estimator), shard=ranks.shard, **arguments)
    return OK


def _run(args: argparse.Namespace, console: Console, team: _Team | None) -> int:
    layout = read_layout(args.layout, console)
    for name, least in (("lookahead", 0), ("smoothing", 1)):
        if getattr(args, name) < least:
            raise UsageError(f"--{name} must be at least {least}")
    own = estimator_settings(args, layout)
    described = describe_source(args.data, args.format, loader_options(args.option))
    more = [describe_source(source) for source in args.more_data]
    settings = {
        **own,
        **({"more_data": more} if more else {}),
        "lookahead": args.lookahead,
        "smoothing": args.smoothing,
    }
    folder = Path(args.out)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file: give a folder")
    if folder.suffix.lower() in _FILES:
        raise UsageError(f"--out {folder} has the name of a file: give a folder")
    with own_folder(folder):
        data = convert(args.data, folder, described, console, overwrite=args.overwrite)
        replace = _settle(args, layout, settings, folder)
        context = Context(
            layout,
            data,
            [open_named(source, args.cache, console) for source in args.more_data],
            folder,
            settings,
            console,
        )
        scored = _score(args, context, described, team, replace=replace)
    _show(scored, console)
    return OK


def _settle(
    args: argparse.Namespace,
    layout: EntityLayout,
    settings: dict[str, Any],
    folder: Path,
) -> bool:
    """Keeps the settings of a folder, and returns whether they replace others.

    Raises:
        UsageError: the folder is of a call with other settings.
    """
    file = folder / SETTINGS_FILE
    kept: dict[str, Any] = {
        "estimator": args.estimator,
        "layout": layout.to_dict(),
        "settings": settings,
        "replaces": False,
    }
    if file.exists():
        remedy = f"delete {folder}"
        before = read_json(file, "file of settings", remedy)
        before = before if isinstance(before, dict) else {}
        kept["replaces"] = bool(before.get("replaces"))
        if {**before, "replaces": kept["replaces"]} != kept:
            if not args.overwrite:
                raise UsageError(
                    f"{folder} was scored with other settings "
                    f"({_differences(before, kept)}): give another folder, or pass "
                    "--overwrite to replace the scores"
                )
            remove_scores(folder)
            kept["replaces"] = True
    write_json(file, kept)
    return bool(kept["replaces"])


def _differences(before: dict[str, Any], now: dict[str, Any]) -> str:
    found = []
    if before.get("estimator") != now["estimator"]:
        found.append(f"estimator was {before.get('estimator')}, is {now['estimator']}")
    if before.get("layout") != now["layout"]:
        found.append("the layout was another")
    old = before.get("settings")
    old = old if isinstance(old, dict) else {}
    new = now["settings"]
    if not found:
        found += [
            f"{name.replace('_', '-')} was {old.get(name)}, is {new.get(name)}"
            for name in {**old, **new}
            if old.get(name) != new.get(name)
        ]
    return "; ".join(found)


def _score(
    args: argparse.Namespace,
    context: Context,
    described: dict[str, Any],
    team: _Team | None,
    *,
    replace: bool,
) -> ScoredDataset:
    layout, data, console = context.layout, context.data, context.console
    with console.step("checking"):
        report = check_dataset(
            data,
            layout,
            action_spec=action_bounds(data),
            variance_floor=layout.variance_floor or None,
        )
    report.raise_if_errors()
    for finding in report.warnings:
        console.warn(f"{finding.message} ({finding.code}; to do: {finding.remedy})")
    estimator = ESTIMATORS[args.estimator].make(context)
    with console.step("scoring"):
        rb = _write_scores(args.workers, estimator, context, team, replace=replace)
    with console.step("suggesting thresholds"):
        suggestions = suggest_thresholds(rb, layout)
    coverage = _coverage(context)
    return write_scored(
        context.folder,
        layout,
        suggestions,
        estimator=args.estimator,
        settings=context.settings,
        source=described,
        warnings=console.warnings,
        coverage=coverage,
    )


def _write_scores(
    workers: int,
    estimator: Any,
    context: Context,
    team: _Team | None,
    *,
    replace: bool,
) -> ReplayBuffer:
    arguments: dict[str, Any] = {
        "smoothing": context.settings["smoothing"],
        "lookahead": context.settings["lookahead"],
        "check": False,
        "progress": context.console.progress,
    }
    folder = context.folder / DATA_FOLDER
    rb = offline_buffer(context.data)
    with _no_default_threshold():
        if team is not None:
            ranks, send = team
            arguments["overwrite"] = replace
            send((folder.resolve(), estimator, {**arguments, "progress": False}))
            estimator = ranks.on_device(estimator)
            score_buffer(rb, estimator, shard=ranks.shard, **arguments)
        elif workers > 1:
            arguments["overwrite"] = replace
            score_in_workers(folder, estimator, workers, arguments)
            rb = offline_buffer(load_transitions(folder))
        else:
            try:
                score_buffer(rb, estimator, **arguments)
            except ValueError:
                # Of other settings, which --overwrite has replaced; an interrupted call
                # that has begun to replace them does not come here, and resumes.
                if not replace:
                    raise
                score_buffer(rb, estimator, overwrite=True, **arguments)
    return rb


@contextmanager
def _no_default_threshold() -> Iterator[None]:
    """Thresholds are suggested next, and shown with what they make swappable."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="with the default threshold")
        yield


def _coverage(context: Context) -> dict[str, Any] | None:
    """Returns how many different actions the data hold, if a world model is used."""
    if "num_actions" not in context.settings and "steps" not in context.settings:
        return None
    with context.console.step("looking at the actions"):
        try:
            found = action_coverage([context.data, *context.more], context.layout)
        except (ImportError, ValueError) as error:
            context.console.warn(
                f"whether the data hold different actions is not known: {error}"
            )
            return None
    if found.verdict != "many":
        context.console.warn(found.advice)
    return found.to_dict()


def _show(scored: ScoredDataset, console: Console) -> None:
    console.text(f"{len(scored.data)} transitions, scored by {scored.estimator}\n")
    width = max(map(len, ("entity", *scored.thresholds))) + 2
    console.text(f"{'entity':<{width}}{'threshold':>10}{'swappable':>11}   confidence")
    for name, threshold in scored.thresholds.items():
        console.text(
            f"{name:<{width}}{threshold:>10.4g}{scored.free[name]:>11.1%}   "
            f"{scored.confidence[name]}"
        )
    for name, found in scored.confidence.items():
        if found == "unclear":
            console.text(f"{name} is unclear: {scored.reasons[name]}")
    console.text(f"\nwritten to {scored.path}; next: caiac report {scored.path}")
    console.document(
        {
            "written": str(scored.path),
            "num_transitions": len(scored.data),
            "estimator": scored.estimator,
            "settings": scored.settings,
            "thresholds": scored.thresholds,
            "confidence": scored.confidence,
            "reasons": scored.reasons,
            "free": scored.free,
            "coverage": scored.coverage,
            "warnings": list(scored.warnings),
        }
    )
