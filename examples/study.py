"""Runs all missing runs of a study, and reports its results.

``python study.py study=demo`` is the motivating experiment in the kitchen. A study is
one file in ``conf/study/``; ``size=quick`` makes any of them a smoke run. Without
``study=``, the study is that of one configuration, such as ``env=fetch_push learner=bc
'method=[none,caiac]' seeds=[0,1]``.

Finished runs are those whose test is in the table of results, ``<publish>/<name>.csv``;
they are not repeated. Interrupted ones resume. Several processes may run a study at the
same time: they share the preparation and the runs.

Further arguments:

- ``settings``, ``learners``, ``methods``, ``seeds``: only these runs, such as
  ``seeds=[0,1]``
- ``processes``: runs at the same time, 2 by default; 0 for this process
- ``root``: the folder of all outputs instead of ``outputs``
- ``publish``: the folder of the results
- ``stale=recompute``: results that were made with other settings than the study has
  now are removed and computed again; otherwise they are refused
- everything else is an override for Hydra, of all runs
"""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from omegaconf import DictConfig, OmegaConf

from collect import collect
from evaluate import evaluations
from figures import answer_study, draw_study, report_study
from fit import fit
from score import score
from shared.console import Console, log_in_process
from shared.parts import check_learner, make_environment, run_folder
from shared.results import add_rows, read_rows, remove_runs, state_of, unlisted
from shared.studies import Run, Study, ad_hoc_study, digest, load_study, run_settings
from torchrl_caiac._files import claim_folder, write_json
from torchrl_caiac._processes import run_in_processes
from train import train, train_seconds

_LOGGER = logging.getLogger(__name__)
_SECONDS_BETWEEN_TRIES = 2.0


@dataclass(frozen=True)
class Options:
    """The arguments of this script.

    Attributes:
        study (Study): with the overrides of the arguments.
        root (Path): the folder of all outputs.
        publish (Path): the folder of the results.
        processes (int): runs at the same time.
        only (dict): the runs that are wanted: ``settings``, ``learners``, ``methods``
            and ``seeds``, each a list of strings. Missing ones mean all.
        stale (str): ``"refuse"`` or ``"recompute"``.
    """

    study: Study
    root: Path
    publish: Path
    processes: int
    only: dict[str, list[str]]
    stale: Literal["refuse", "recompute"]

    @property
    def folder(self) -> Path:
        """The folder of the study's log and figures."""
        size = "_quick" if "size=quick" in self.study.overrides else ""
        return self.root / "studies" / f"{self.study.name}{size}"

    @property
    def table(self) -> Path:
        """The table of results."""
        return self.publish / f"{self.study.name}.csv"

    def wanted(self, run: Run) -> bool:
        """Returns whether a run was asked for."""
        return all(
            str(value) in self.only[name]
            for name, value in zip(_FILTERS, run.key, strict=True)
            if name in self.only
        )


_FILTERS = ("settings", "learners", "methods", "seeds")


def read_arguments(arguments: Sequence[str]) -> Options:
    """Returns the arguments of the script.

    Raises:
        ValueError: an argument is not known, or has a wrong value.
        FileNotFoundError: there is no such study.
    """
    own: dict[str, Any] = {}
    overrides: list[str] = []
    for argument in arguments:
        name, equals, _ = argument.partition("=")
        if not equals:
            raise ValueError(f"the argument {argument!r} has no value: name=value")
        if name in (*_FILTERS, "study", "processes", "root", "publish", "stale"):
            own[name] = OmegaConf.to_container(OmegaConf.from_dotlist([argument]))[name]
        else:
            overrides.append(argument)
    only = {name: _texts(own[name]) for name in _FILTERS if name in own}
    processes, stale = own.get("processes", 2), own.get("stale", "refuse")
    if type(processes) is not int or processes < 0:
        raise ValueError(f"processes is {processes!r}, expected an integer from 0")
    if stale not in ("refuse", "recompute"):
        raise ValueError(f"stale is {stale!r}, expected refuse or recompute")
    root = Path(str(own.get("root", "outputs")))
    quick = "size=quick" in overrides
    overrides = [item for item in overrides if item != "size=quick"]
    if own.get("study") is None:
        study = ad_hoc_study(overrides, list(map(int, only.pop("seeds", []))))
    else:
        study = load_study(str(own["study"]))
        chosen = [o for o in overrides if o.startswith(("env=", "learner=", "method="))]
        if chosen:
            raise ValueError(
                f"{chosen} with study={study.name}, which has its own: leave them out, "
                "or choose some of its runs by settings=, learners= and methods="
            )
        if overrides:  # not the study as it is published
            study = replace(
                study, overrides=(*study.overrides, *overrides), publish=None
            )
    if quick:
        study = study.quick()
    study = replace(study, overrides=(*study.overrides, f"root={root}"))
    options = Options(study, root, Path(), processes, only, stale)
    if not any(map(options.wanted, study.runs())):
        raise ValueError(f"the study {study.name} has no run of {only}")
    publish = own.get("publish") or study.publish or options.folder
    return replace(options, publish=Path(str(publish)))


def _texts(value: Any) -> list[str]:
    return [str(item) for item in (value if isinstance(value, list) else [value])]


def prepare(cfg: DictConfig, console: Console | None = None) -> None:
    """Collects, fits and scores what the runs of a configuration need, once.

    Args:
        cfg (DictConfig): the configuration, with all methods of its runs.
        console (Console, optional): for the stages. Defaults to ``None``: none.
    """
    log_in_process()
    stage = nullcontext if console is None else console.stage
    environment = make_environment(cfg)
    marker = _preparation(cfg)
    done = environment.folder / "prepared" / f"{digest(marker)}.json"
    with claim_when_free(environment.out), stage(environment.data_name):
        if not done.exists():
            collect(cfg)
            if "caiac" in cfg.method:
                # Here, since several folders may share the held-out rows.
                environment.ground_truth()
    with claim_when_free(environment.folder):
        with stage("world model"):
            if not done.exists():
                fit(cfg)
        with stage("scores"):
            if not done.exists():
                score(cfg)
                write_json(done, marker)


def _preparation(cfg: DictConfig) -> dict[str, Any]:
    """Returns what the preparation depends on."""
    env: dict[str, Any] = OmegaConf.to_container(cfg.env, resolve=True)
    for name in ("evaluate", "augmentation"):
        env.pop(name)
    methods = OmegaConf.to_container(cfg.method, resolve=True)
    # The learner decides which rows are scored.
    return {"env": env, "methods": methods, "learner": cfg.learner.name}


@contextmanager
def claim_when_free(folder: Path) -> Iterator[None]:
    """Locks a folder; waits while another process has it."""
    with ExitStack() as stack:
        told = False
        while True:
            try:
                stack.enter_context(claim_folder(folder))
                break
            except RuntimeError as error:
                if not told:
                    _LOGGER.info("waiting: %s", error)
                    told = True
                time.sleep(_SECONDS_BETWEEN_TRIES)
        yield


def run(job: Run, table: Path, commit: str) -> str:
    """Trains and evaluates one run, and adds its results to the table.

    Returns:
        str: ``"done"``; ``"busy"`` if another process has the run; or an error.
    """
    log_in_process()
    cfg, method, seed = job.cfg, job.method, job.seed
    folder = run_folder(cfg, method, seed)
    with ExitStack() as stack:
        try:
            stack.enter_context(claim_folder(folder))
        except RuntimeError:
            return "busy"
        if state_of(job, read_rows(table)) == "done":  # by another process, meanwhile
            return "done"
        try:
            write_json(folder / "settings.json", run_settings(cfg, method))
            train(cfg, method, seed)
            environment, seconds = make_environment(cfg), train_seconds(folder)
            for evaluation in evaluations(cfg, method, seed):
                common = {
                    "setting": job.setting,
                    "learner": job.learner,
                    "method": method,
                    "seed": seed,
                    "step": evaluation.step,
                    "split": evaluation.split,
                    "train_seconds": round(seconds, 1),
                    "evaluate_seconds": round(evaluation.seconds, 1),
                    "commit": commit,
                    "settings": job.digest,
                }
                measures = environment.measures(evaluation.episodes)
                add_rows(table, [{**common, **row} for row in measures])
        except Exception as error:  # the other runs go on
            _LOGGER.exception("%s failed", job)
            return f"{job}: {type(error).__name__}: {error}"
    return "done"


def git_commit() -> str:
    """Returns the commit of this code, with ``+`` if files differ from it."""
    here = Path(__file__).parent
    try:
        name, changed = (
            subprocess.run(
                ["git", *command], cwd=here, capture_output=True, text=True, check=True
            ).stdout.strip()
            for command in (
                ("rev-parse", "--short", "HEAD"),
                ("status", "--porcelain", "-uno", "--", ".", "../torchrl_caiac"),
            )
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return name + ("+" if changed else "")


def missing_runs(options: Options, runs: Sequence[Run]) -> list[Run]:
    """Returns the wanted runs that the table lacks; removes outdated results if asked.

    Raises:
        ValueError: the table has results of other settings, or of runs that the study
            does not have; or a setting is wrong of a run that is wanted, or whose
            results would be removed.
    """
    rows = read_rows(options.table)
    states = {run.key: state_of(run, rows) for run in runs}
    for job in runs:
        if options.wanted(job) or states[job.key] == "stale":
            try:
                check_learner(job.cfg, job.method)
            except ValueError as error:
                raise ValueError(f"{job}: {error}") from error
    stale = [run.key for run in runs if states[run.key] == "stale"]
    stale += unlisted(runs, rows)
    if stale and options.stale == "refuse":
        listed = "; ".join(map(", ".join, stale[:3])) + ("; ..." if stale[3:] else "")
        raise ValueError(
            f"{options.table} has results of {len(stale)} runs that the study "
            f"{options.study.name} does not have, or has with other settings now "
            f"({listed}): undo the change of the settings, give stale=recompute to "
            "remove these results, or give another folder with publish=..."
        )
    if stale:
        remove_runs(options.table, stale)
    return [run for run in runs if states[run.key] != "done" and options.wanted(run)]


def preparations(runs: Sequence[Run]) -> list[DictConfig]:
    """Returns the configurations that runs need prepared, with the methods of these."""
    by_data: dict[str, DictConfig] = {}
    for run in runs:
        needs = {**_preparation(run.cfg), "methods": None}
        found = by_data.setdefault(digest(needs), _with_methods(run.cfg, {}))
        mine = {**found.method, run.method: run.cfg.method[run.method]}
        by_data[digest(needs)] = _with_methods(found, mine)
    return list(by_data.values())


def _with_methods(cfg: DictConfig, methods: dict[str, Any]) -> DictConfig:
    changed = cfg.copy()
    changed.method = methods
    return changed


def run_study(options: Options, console: Console) -> None:
    """Does what is missing, writes the results and figures, and prints them."""
    study = options.study
    runs = study.runs()
    missing = missing_runs(options, runs)  # removes outdated results if asked
    needed = preparations(missing)
    console.stages = {0: 1, 1: 5}.get(len(needed), 3)
    if len(needed) == 1:
        torch.set_num_threads(max(1, options.processes))  # nothing else runs
        try:
            prepare(needed[0], console)
        finally:
            torch.set_num_threads(1)
    elif needed:
        with console.stage(f"preparation of {len(needed)} settings"):
            jobs = [(cfg,) for cfg in needed]
            list(run_in_processes(prepare, jobs, processes=options.processes))
    ended: Counter[str] = Counter()
    if missing:
        commit = git_commit()
        jobs = [(job, options.table, commit) for job in missing]
        with console.stage(f"training and evaluation, {len(jobs)} runs"):
            for _, how in run_in_processes(run, jobs, processes=options.processes):
                ended[how] += 1
    with console.stage("figures"):
        lines = report_study(study, runs, options.publish)
        files = draw_study(study, runs, options.publish)
    remarks = draw_environment(options, needed)
    console.print("")
    for line in (*lines, *remarks):
        console.print(line)
    if busy := ended.pop("busy", 0):
        console.print(f"{busy} runs belong to another process, which is still running")
    ended.pop("done", None)
    console.print(f"results: {options.table}; figures: {', '.join(map(str, files))}")
    if ended:
        raise RuntimeError(
            f"{len(ended)} runs failed, see {console.log}; run again to resume. The "
            f"first one: {next(iter(ended))}"
        )
    console.print(answer_study(study, runs, options.publish))


def draw_environment(options: Options, prepared: Sequence[DictConfig]) -> list[str]:
    """Draws the environment's own figures, if it is only one; returns remarks."""
    if len(prepared) != 1:
        return []
    (cfg,) = prepared
    options.folder.mkdir(parents=True, exist_ok=True)
    return make_environment(cfg).draw(
        options.folder, options.study.name, threshold=cfg.env.augmentation.threshold
    )


def main(arguments: Sequence[str]) -> None:
    """Runs the study of the arguments."""
    options = read_arguments(arguments)
    torch.set_num_threads(1)
    with Console(options.folder) as console:
        run_study(options, console)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (ValueError, FileNotFoundError, RuntimeError) as error:
        sys.exit(f"error: {error}")
