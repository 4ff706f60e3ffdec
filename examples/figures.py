"""Draws the figures and tables of studies, from their tables of results.

``python figures.py`` does so for every study with a table in ``docs/results``;
``python figures.py demo --results outputs/studies/demo`` for the named ones. Intervals
are rliable's: 95 %, by a bootstrap over seeds that is stratified by task.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hydra.utils import get_class

from shared.results import Row, read_rows, run_key, state_of
from shared.studies import CONF, Run, Study, load_study
from torchrl_caiac._figures import (
    NUM_COLOURS,
    colour,
    finish_results,
    name_label,
    new_figure,
)
from torchrl_caiac._files import whole_file

__all__ = ["answer_study", "draw_study", "main", "report_study"]

BASELINE = "none"  # differences are to this method
RESAMPLES = 2000


class Estimate(NamedTuple):
    """A mean and its 95 % interval.

    Attributes:
        mean (float): over seeds and tasks.
        low (float): the lower end; NaN with one seed, which has no interval.
        high (float): the upper end.
    """

    mean: float
    low: float
    high: float

    def text(self, form: str = ".2f") -> str:
        """Returns ``mean [low, high]``, or the mean alone."""
        if math.isnan(self.low):
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} [{self.low:{form}}, {self.high:{form}}]"


def estimate(values: np.ndarray) -> Estimate:
    """Returns the mean of values ``[seeds, tasks]`` and rliable's interval."""
    return _estimate(tuple(map(tuple, values.tolist())))


@cache  # tables and figures have the same ones
def _estimate(rows: tuple[tuple[float, ...], ...]) -> Estimate:
    values = np.array(rows)
    mean = float(values.mean())
    if len(values) == 1:
        return Estimate(mean, math.nan, math.nan)
    if (values == values[:1]).all():  # every resample is the same
        return Estimate(mean, mean, mean)
    if sys.version_info < (3, 11):  # for which there is no rliable: the same by hand
        seeds, tasks = values.shape
        draws = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds, tasks))
        means = values[draws, np.arange(tasks)].mean((1, 2))
        return Estimate(mean, *map(float, np.percentile(means, [2.5, 97.5])))
    try:
        from rliable.library import get_interval_estimates
    except ImportError as error:
        raise ImportError(
            "the intervals need rliable: pip install 'torchrl-caiac[examples]'"
        ) from error
    state = np.random.get_state()
    try:
        np.random.seed(0)  # rliable draws from the global generator
        _, intervals = get_interval_estimates(
            {"": values}, lambda x: np.array([x.mean()]), reps=RESAMPLES
        )
    finally:
        np.random.set_state(state)
    return Estimate(mean, *map(float, intervals[""][:, 0]))


Group = tuple[str, str, str]  # setting, learner, method


@dataclass(frozen=True)
class Results:
    """The tests of a study.

    Attributes:
        study (Study): the study.
        runs (sequence of Run): all of its runs.
        rows (sequence of dict): the table of results.
    """

    study: Study
    runs: Sequence[Run]
    rows: Sequence[Row]

    @classmethod
    def read(cls, study: Study, runs: Sequence[Run], folder: Path) -> Results:
        """Reads the results, which must be of the study's present settings."""
        path = folder / f"{study.name}.csv"
        rows = read_rows(path)
        stale = [run for run in runs if state_of(run, rows) == "stale"]
        if stale:
            raise ValueError(
                f"{path} has results of {len(stale)} runs with other settings than the "
                f"study has now ({stale[0]}): undo the change of the settings, or "
                f"compute them again with python examples/study.py "
                f"study={study.name} stale=recompute"
            )
        known = {run.key for run in runs}
        tests = [row for row in rows if row["split"] == "test"]
        return cls(study, runs, [row for row in tests if run_key(row) in known])

    @cached_property
    def groups(self) -> list[Group]:
        """Settings, learners and methods with results, in the order of the study."""
        found = {(row["setting"], row["learner"], row["method"]) for row in self.rows}
        order = dict.fromkeys((r.setting, r.learner, r.method) for r in self.runs)
        settings = list(self.study.settings)
        listed = sorted(order, key=lambda group: settings.index(group[0]))
        return [group for group in listed if group in found]

    @cached_property
    def measures(self) -> list[str]:
        """The names of the measures of all settings."""
        return list(dict.fromkeys(row["measure"] for row in self.rows))

    @cached_property
    def success(self) -> dict[str, str]:
        """The first measure of each setting, which is that of success."""
        return {row["setting"]: row["measure"] for row in reversed(self.rows)}

    def tasks(self, setting: str, measure: str) -> list[str]:
        """Returns the tasks of a setting."""
        return list(
            dict.fromkeys(
                row["task"]
                for row in self.rows
                if (row["setting"], row["measure"]) == (setting, measure)
            )
        )

    def values(
        self, group: Group, measure: str, tasks: Sequence[str] | None = None
    ) -> dict[int, list[float]]:
        """Returns by seed the value in each task."""
        tasks = self.tasks(group[0], measure) if tasks is None else tasks
        cells: dict[int, dict[str, float]] = {}
        for row in self.rows:
            mine = row["setting"], row["learner"], row["method"]
            if mine == group and row["measure"] == measure:
                cells.setdefault(int(row["seed"]), {})[row["task"]] = float(
                    row["value"]
                )
        return {
            seed: [cells[seed][task] for task in tasks]
            for seed in sorted(cells)
            if all(task in cells[seed] for task in tasks)
        }

    def mean(
        self, group: Group, measure: str, tasks: Sequence[str] | None = None
    ) -> Estimate | None:
        """Returns the mean of a measure over seeds and tasks, if there is any."""
        values = self.values(group, measure, tasks)
        if not values or not next(iter(values.values())):
            return None
        return estimate(np.array(list(values.values())))

    def difference(self, group: Group, measure: str) -> Estimate | None:
        """Returns how much better it is than the baseline, over common seeds."""
        if group[2] == BASELINE:
            return None
        values = self.values(group, measure)
        base = self.values((*group[:2], BASELINE), measure)
        common = sorted(values.keys() & base.keys())
        if not common:
            return None
        pairs = [np.subtract(values[seed], base[seed]) for seed in common]
        return estimate(np.array(pairs))


def report_study(study: Study, runs: Sequence[Run], folder: Path) -> list[str]:
    """Writes the tables of a study to ``<folder>/<name>.md``, and returns the lines."""
    results = Results.read(study, runs, folder)
    lines = _table(results)
    tasks = {s: results.tasks(s, measure) for s, measure in results.success.items()}
    if any(len(names) > 1 for names in tasks.values()):
        lines += ["", *_task_table(results, tasks)]
    done = {run_key(row) for row in results.rows}
    missing = len(runs) - len(done)
    ended = (
        f"All {len(runs)} runs are done."
        if not missing
        else (f"{missing} of {len(runs)} runs are missing.")
    )
    lines += ["", ended]
    with whole_file(folder / f"{study.name}.md") as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return lines


def _table(results: Results) -> list[str]:
    """Returns every measure of every group, and the difference of the first one."""
    if not results.rows:
        return ["There are no results yet."]
    heads = ["setting", "learner", "method", "seeds", *results.measures]
    lines = _heads([*heads, f"success, minus {BASELINE}"], text=3)
    for group in results.groups:
        success = results.success[group[0]]
        means = [results.mean(group, measure) for measure in results.measures]
        cells = [*group, str(len(results.values(group, success)))]
        cells += ["" if mean is None else mean.text() for mean in means]
        difference = results.difference(group, success)
        cells += ["" if difference is None else difference.text("+.2f")]
        lines.append(_line(cells))
    return lines


def _task_table(results: Results, tasks: Mapping[str, Sequence[str]]) -> list[str]:
    """Returns the first measure of each setting by task."""
    names = list(dict.fromkeys(name for part in tasks.values() for name in part))
    lines = ["success by task:", ""]
    lines += _heads(["setting", "learner", "method", *names], text=3)
    for group in results.groups:
        cells = list(group)
        for name in names:
            known = name in tasks[group[0]]
            measure = results.success[group[0]]
            mean = results.mean(group, measure, [name]) if known else None
            cells.append("" if mean is None else mean.text())
        lines.append(_line(cells))
    return lines


def _heads(names: Sequence[str], *, text: int) -> list[str]:
    ruler = ["---"] * text + ["---:"] * (len(names) - text)
    return [_line([name.replace("_", " ") for name in names]), _line(ruler)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def answer_study(study: Study, runs: Sequence[Run], folder: Path) -> str:
    """Returns the main result of a study in one line."""
    results = Results.read(study, runs, folder)
    answer = study.answer
    counts: dict[str, tuple[int, int]] = {}
    wanted = {name: getattr(answer, name) for name in ("setting", "learner", "task")}
    for row in results.rows:
        measure = answer.measure or results.success[row["setting"]]
        if row["measure"] == measure and all(
            value in ("", row[name]) for name, value in wanted.items()
        ):
            solved, total = counts.get(row["method"], (0, 0))
            episodes = int(row["episodes"])
            solved += round(float(row["value"]) * episodes)
            counts[row["method"]] = solved, total + episodes
    order = [name for name in dict.fromkeys(r.method for r in runs) if name in counts]
    shares = {name: "{}/{}".format(*counts[name]) for name in order}
    if set(shares) == {BASELINE, "caiac"}:
        both = f"{shares[BASELINE]} without, {shares['caiac']} with counterfactuals"
        return f"{answer.text}: {both}"
    found = ", ".join(f"{share} ({name})" for name, share in shares.items())
    return f"{answer.text}: {found or 'no results yet'}"


def draw_study(study: Study, runs: Sequence[Run], folder: Path) -> list[Path]:
    """Draws success, one figure for each learner; returns the files."""
    results = Results.read(study, runs, folder)
    learners = list(dict.fromkeys(learner for _, learner, _ in results.groups))
    files = []
    for learner in learners:
        suffix = f"_{learner}" if len(learners) > 1 else ""
        files.append(folder / f"{study.name}{suffix}.png")
        title = f"{study.title}, {learner}" if suffix else study.title
        with whole_file(files[-1]) as partial:
            _figure(results, learner, title).savefig(partial, dpi=150)
    return files


def _figure(results: Results, learner: str, title: str) -> Any:
    """Draws lines over settings that are numbers, else bars by setting or task."""
    groups = [group for group in results.groups if group[1] == learner]
    methods = list(dict.fromkeys(group[2] for group in groups))
    settings = list(dict.fromkeys(group[0] for group in groups))
    labels = {run.method: _label(run) for run in results.runs}
    if len(settings) > 1 and all(map(_is_number, settings)):
        draw, width = _draw_lines, 6.4
        places = {s: (s, None) for s in sorted(settings, key=float)}
    else:
        draw = _draw_bars
        if len(settings) > 1:
            places = {name_label(s): (s, None) for s in settings}
        else:
            tasks = results.tasks(settings[0], results.success[settings[0]])
            places = {name_label(t): (settings[0], [t]) for t in tasks}
        width = max(3.6, 1.5 + 0.42 * len(places) * len(methods))
    figure = new_figure(width, 3.4)
    axes = figure.add_subplot()
    for number, method in enumerate(methods):
        found = {
            place: mean
            for place, (setting, tasks) in places.items()
            if (setting, learner, method) in groups
            and (
                mean := results.mean(
                    (setting, learner, method), results.success[setting], tasks
                )
            )
        }
        draw(axes, list(places), found, number, len(methods), labels[method])
    axes.set_ylim(0, 1.1)
    axes.set_yticks(np.linspace(0, 1, 5))
    return finish_results(
        figure,
        axes,
        methods=len(methods),
        ylabel="success, test starts",
        title=title,
    )


def _draw_lines(
    axes: Any,
    places: Sequence[str],
    found: Mapping[str, Estimate],
    number: int,
    methods: int,
    label: str,
) -> None:
    at = [float(place) for place in found]
    axes.plot(
        at,
        [mean.mean for mean in found.values()],
        color=colour(number),
        linewidth=1.8,
        linestyle="--" if number >= NUM_COLOURS else "-",
        marker="o",
        markersize=3,
        label=label,
    )
    ends = [(mean.low, mean.high) for mean in found.values()]
    low, high = np.reshape(ends, (-1, 2)).T
    axes.fill_between(at, low, high, color=colour(number), alpha=0.15, linewidth=0)
    numbers = list(map(float, places))
    if min(numbers) > 0 and max(numbers) >= 8 * min(numbers):
        axes.set_xscale("log")
    axes.set_xticks(numbers, places)
    axes.minorticks_off()


def _draw_bars(
    axes: Any,
    places: Sequence[str],
    found: Mapping[str, Estimate],
    number: int,
    methods: int,
    label: str,
) -> None:
    width = 0.8 / methods
    at = [places.index(p) + (number - (methods - 1) / 2) * width for p in found]
    means = [mean.mean for mean in found.values()]
    hatch = "////" if number >= NUM_COLOURS else None
    fill = {"facecolor": colour(number), "edgecolor": "white", "linewidth": 0}
    axes.bar(at, means, 0.9 * width, label=label, hatch=hatch, **fill)
    ends = [(m.mean - m.low, m.high - m.mean) for m in found.values()]
    axes.errorbar(
        at,
        means,
        yerr=np.maximum(np.reshape(ends, (-1, 2)).T, 0),  # rounding: -1e-17
        fmt="none",
        ecolor="#222222",
        elinewidth=1.0,
        capsize=2,
    )
    axes.set_xticks(range(len(places)), places)
    axes.tick_params(axis="x", length=0)


def _label(run: Run) -> str:
    # A method that extends another one does not take over its label.
    kind = get_class(run.cfg.method[run.method]._target_)
    return vars(kind).get("label") or name_label(run.method)


def _is_number(name: str) -> bool:
    try:
        float(name)
    except ValueError:
        return False
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """Draws the studies of the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("studies", nargs="*", help="their names; default: all")
    parser.add_argument("--results", type=Path, default=Path("docs/results"))
    options = parser.parse_args(arguments)
    names = options.studies or [
        file.stem
        for file in sorted((CONF / "study").glob("*.yaml"))
        if (options.results / f"{file.stem}.csv").exists()
        and load_study(file.stem).publish is not None  # else it is another table
    ]
    for name in names:
        study = load_study(name)
        runs = study.runs()
        lines = report_study(study, runs, options.results)
        files = draw_study(study, runs, options.results)
        sys.stdout.write(f"{name}: {lines[-1]} {', '.join(map(str, files))}\n")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")
