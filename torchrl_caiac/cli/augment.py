"""``caiac augment``: counterfactuals as files, to train with other libraries."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any, Literal

from tensordict import TensorDict, TensorDictBase

from torchrl_caiac._files import remove_leftovers_in, whole_file
from torchrl_caiac.augment import (
    augment_dataset,
    export_hdf5,
    export_npz,
    needs_reward,
)
from torchrl_caiac.augment.dataset import check_target
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import OK, UsageError
from torchrl_caiac.cli.sources import scored_folder
from torchrl_caiac.data import action_bounds, to_minari
from torchrl_caiac.data.minari_files import dataset_path
from torchrl_caiac.scored import ScoredDataset, open_scored

__all__ = ["add_parser", "run"]

_EPILOG = """\
examples:
  caiac augment scored --out augmented.npz
  caiac augment scored --out minari://cube/augmented-v0 --trajectories --ratio 0.3
"""


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "augment",
        help="write counterfactual transitions or trajectories to a file",
        description="Writes a scored dataset with counterfactuals: transitions as the "
        "replay buffer samples them in training, or whole trajectories. Goals follow "
        "the swap; entries under `info` are left out. Every transition has a flag that "
        "says whether it is counterfactual.",
        epilog=_EPILOG,
        **options,
    )
    parser.add_argument("folder", metavar="DIR", help="what `caiac score` wrote")
    parser.add_argument(
        "--out",
        required=True,
        metavar="OUT",
        help="FILE.npz or FILE.hdf5 with the names of D4RL, minari://ID for a local "
        "Minari dataset, or a folder for TorchRL transitions",
    )
    parser.add_argument(
        "--ratio",
        type=float,
        default=0.5,
        metavar="R",
        help="the share of counterfactuals in originals and counterfactuals together "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--trajectories",
        action="store_true",
        help="write whole trajectories: entities that are uninfluenced in all of a "
        "trajectory come from another one",
    )
    parser.add_argument(
        "--no-originals",
        action="store_true",
        help="write the counterfactuals alone",
    )
    parser.add_argument(
        "--reward",
        choices=["stored", "sparse"],
        help="rewards of counterfactuals: those of the original, or sparse ones of the "
        "new goals, with the ends of tasks that end there; must be given if the data "
        "have goals and rewards",
    )
    parser.add_argument(
        "--reward-tolerance",
        type=float,
        metavar="X",
        help="the distance at which a sparse goal is reached; default: found in the "
        "stored rewards",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="the seed (default: %(default)s)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace OUT if it exists"
    )
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    folder = scored_folder(args.folder)
    if not 0 < args.ratio < 1:
        raise UsageError(f"--ratio is {args.ratio}, expected between 0 and 1")
    if args.reward_tolerance is not None and args.reward != "sparse":
        raise UsageError("--reward-tolerance is an option of --reward sparse")
    kind = _kind(args.out)
    is_minari = kind == "minari"
    target = dataset_path(_minari_id(args.out)) if is_minari else Path(args.out)
    if target.exists() and not args.overwrite:
        raise UsageError(f"{args.out} exists: give another name, or pass --overwrite")
    if _is_inside(target, folder):
        raise UsageError(f"--out {args.out} is inside of {folder}: write elsewhere")
    with console.step("reading the scored dataset"):
        scored = open_scored(folder)
    try:
        check_target(target, scored)
    except ValueError as error:
        raise UsageError(f"--out {args.out}: {error}") from error
    source = str(scored.source.get("source"))
    if is_minari and _minari_id(source) == _minari_id(args.out):
        raise UsageError(
            f"--out {args.out} is the data that were scored: write another"
        )
    if args.reward is None and needs_reward(scored):
        raise UsageError(
            "the data have goals and rewards: pass --reward sparse, or --reward stored "
            "to keep the rewards of the originals"
        )
    if args.reward is None and ("next", "reward") in scored.data.keys(True):
        console.warn(
            "counterfactuals keep the rewards of their originals, which is right only "
            "if these do not depend on what was swapped (--reward stored says that "
            "this is meant)"
        )
    summary = _write(args, kind, scored, console)
    console.text(
        f"{summary['num_counterfactual']} counterfactual of "
        f"{summary['num_transitions']} transitions, written to {args.out}"
    )
    width = max(map(len, scored.layout.names)) + 1
    for name, share in summary["swapped"].items():
        console.text(f"  {name:<{width}}{share:>7.1%} of the counterfactual ones")
    console.document(summary)
    return OK


def _kind(out: str) -> str:
    scheme, sign, _ = out.partition("://")
    suffix = Path(out).suffix.lower()
    if sign and scheme == "minari":
        return "minari"
    if sign:
        raise UsageError(f"--out {out}: of addresses, only minari://ID can be written")
    if suffix == ".npz":
        return "npz"
    if suffix in (".hdf5", ".h5"):
        return "hdf5"
    if suffix:
        raise UsageError(
            f"--out {out}: the format {suffix} is not known; known are .npz, .hdf5, "
            ".h5, minari://ID, and a folder without a suffix"
        )
    return "folder"


def _minari_id(out: str) -> str:
    return out.removeprefix("minari://")


def _is_inside(out: Path, folder: Path) -> bool:
    return out.resolve().is_relative_to(folder.resolve())


def _write(
    args: argparse.Namespace, kind: str, scored: ScoredDataset, console: Console
) -> dict[str, Any]:
    names = scored.layout.names
    if kind == "folder":
        return _summary(_augmented(args, scored, Path(args.out), console), scored, args)
    if kind == "minari":
        with tempfile.TemporaryDirectory(prefix="caiac-") as folder:
            data = _augmented(args, scored, Path(folder) / "data", console)
            with console.step("writing the Minari dataset"):
                to_minari(
                    _with_infos(data),
                    _minari_id(args.out),
                    action_bounds=action_bounds(data),
                    overwrite=args.overwrite,
                    progress=console.progress,
                )
            return _summary(data, scored, args)
    export = export_npz if kind == "npz" else export_hdf5
    out = Path(args.out)
    remove_leftovers_in(out.parent)
    with whole_file(out) as partial:
        # Beside the result, where there is space for it.
        work = partial.with_name(f"{partial.name}.work-0")
        try:
            data = _augmented(args, scored, work, console)
            with console.step("writing the file"):
                export(data, partial, entities=names, overwrite=True)
            if out.exists() and not args.overwrite:
                raise UsageError(
                    f"{out} has appeared in the meantime, and stays as it is: give "
                    "another name, or pass --overwrite"
                )
            return _summary(data, scored, args)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _with_infos(data: TensorDictBase) -> TensorDict:
    """Returns the same transitions with their flags under ``"info"``, for Minari."""
    entries = dict(data.items())
    entries["info"] = entries.pop("caiac")
    return TensorDict(entries, data.batch_size)


def _augmented(
    args: argparse.Namespace, scored: ScoredDataset, path: Path, console: Console
) -> Any:
    kind: Literal["transitions", "trajectories"] = (
        "trajectories" if args.trajectories else "transitions"
    )
    with console.step(f"making counterfactual {kind}"):
        return augment_dataset(
            scored,
            path,
            args.ratio,
            kind=kind,
            reward=args.reward,
            tolerance=args.reward_tolerance,
            originals=not args.no_originals,
            seed=args.seed,
            overwrite=args.overwrite,
            progress=console.progress,
        )


def _summary(data: Any, scored: ScoredDataset, args: argparse.Namespace) -> Any:
    flags = data["caiac", "counterfactual"].squeeze(-1)
    share = data["caiac", "swapped"][flags].double().mean(0).tolist()
    return {
        "written": args.out,
        "kind": "trajectories" if args.trajectories else "transitions",
        "num_transitions": len(data),
        "num_counterfactual": int(flags.sum()),
        "swapped": {
            name: value
            for name, value in zip(scored.layout.names, share, strict=True)
            if name not in scored.layout.fixed
        },
    }
