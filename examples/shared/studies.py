"""Studies: which runs they have, read from one YAML file each in ``conf/study/``."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from shared.parts import make_method
from torchrl_caiac._files import plain

__all__ = [
    "Answer",
    "Arm",
    "Run",
    "Study",
    "ad_hoc_study",
    "compose",
    "digest",
    "load_study",
    "run_settings",
]

CONF = Path(__file__).parents[1] / "conf"
# Settings of an environment on which no result depends.
_SHOWN = ("name", "folder", "title", "frames", "influence_episode")
_MODELS = ("world_model", "transformer")


@dataclass(frozen=True)
class Arm:
    """Runs of a study that share a learner.

    Attributes:
        learner (str): its name, a file of ``conf/learner/``.
        methods (tuple of str): their names, files of ``conf/method/``.
        seeds (tuple of int): of the runs.
        settings (tuple of str): names of settings; empty for all of the study.
        overrides (tuple of str): Hydra overrides of these runs.
    """

    learner: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """The one line that a study ends with.

    Attributes:
        text (str): what was counted.
        measure (str): the measure; empty for the first.
        setting (str): the setting; empty for all.
        learner (str): the learner; empty for all.
        task (str): the task; empty for all.
    """

    text: str
    measure: str = ""
    learner: str = ""
    setting: str = ""
    task: str = ""


class Run(NamedTuple):
    """One run of a study.

    Attributes:
        setting (str): the name of the setting.
        learner (str): the name of the learner.
        method (str): the name of the method.
        seed (int): of the run.
        cfg (DictConfig): the whole configuration.
        digest (str): of everything in it that the results depend on but the seed.
    """

    setting: str
    learner: str
    method: str
    seed: int
    cfg: DictConfig
    digest: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """The cells of the table of results that identify the run."""
        return self.setting, self.learner, self.method, str(self.seed)

    def __str__(self) -> str:
        """Returns its name in messages."""
        return f"{self.setting}, {self.learner}, {self.method}, seed {self.seed}"


@dataclass(frozen=True)
class Study:
    """What a study compares, and how.

    Attributes:
        name (str): of the study and its files.
        title (str): of the figure.
        claim (str): what the paper says about it.
        settings (dict): Hydra overrides of each setting, by name.
        arms (tuple of Arm): the runs.
        validation (dict): ``policies``, how many of the last kept policies of a run
            are compared on validation starts (``None``: all), and ``episodes``, on how
            many starts (of each task).
        test (dict): ``episodes``, on how many starts (of each task) the best policy is
            played.
        answer (Answer): the one line at the end.
        publish (str, optional): the folder of the results. ``None``: a folder of the
            study below ``outputs/studies``.
        overrides (tuple of str): Hydra overrides of all runs.
    """

    name: str
    title: str
    settings: Mapping[str, tuple[str, ...]]
    arms: tuple[Arm, ...]
    answer: Answer
    claim: str = ""
    validation: Mapping[str, Any] = field(default_factory=dict)
    test: Mapping[str, Any] = field(default_factory=dict)
    publish: str | None = "docs/results"
    overrides: tuple[str, ...] = ()

    def runs(self) -> list[Run]:
        """Returns all runs: every arm with a seed before those with the next one.

        Raises:
            ValueError: a run occurs twice.
        """
        order = list(self.settings)
        runs: list[Run] = []
        for arm in self.arms:
            for setting in arm.settings or order:
                runs += self._runs_of(arm, setting)
        twice = [k for k, n in Counter(run.key for run in runs).items() if n > 1]
        if twice:
            raise ValueError(
                f"the study {self.name} has the run {twice[0]} twice: each setting, "
                "learner, method and seed may be in one arm only"
            )
        return sorted(runs, key=attrgetter("seed"))  # else in the same order

    def _runs_of(self, arm: Arm, setting: str) -> list[Run]:
        protocol = [
            f"validation.policies={_null(self.validation.get('policies'))}",
        ]
        for key, part in (
            ("validation_episodes", self.validation),
            ("episodes", self.test),
        ):
            if part.get("episodes") is not None:
                protocol.append(f"env.evaluate.{key}={part['episodes']}")
        cfg = compose(
            *protocol,  # settings and arms may have others
            *self.settings[setting],
            f"learner={arm.learner}",
            f"method=[{','.join(arm.methods)}]",
            *arm.overrides,
            *self.overrides,
        )
        runs = []
        for method in arm.methods:
            mine = cfg.copy()
            made_with = run_settings(mine, method)
            mine.runs = f"runs/{arm.learner}-{digest(made_with)}"
            evaluated = {
                "steps": mine.learner.steps,
                "evaluate": {**mine.env.evaluate, "strips": None},
                "validation": mine.validation,
            }
            mine.evaluations = f"evaluation-{digest(evaluated)}"
            whole = digest({**made_with, **evaluated})
            runs += [
                Run(setting, arm.learner, method, seed, mine, whole)
                for seed in arm.seeds
            ]
        return runs

    def quick(self) -> Study:
        """Returns a smoke run of the study: smaller, with the first seed of each arm.

        Overrides of values are left out, since the values of ``size=quick`` count.
        Settings that are the same without them are left out too.
        """
        settings: dict[str, tuple[str, ...]] = {}
        same: dict[str, str] = {}
        for name, overrides in self.settings.items():
            kept = tuple(o for o in overrides if _is_choice(o))
            same[name] = next((n for n, o in settings.items() if o == kept), name)
            settings[same[name]] = kept
        seeds: dict[tuple[str, str], dict[str, int]] = {}
        for arm in self.arms:
            for name in dict.fromkeys(same[n] for n in arm.settings or same):
                methods = seeds.setdefault((name, arm.learner), {})
                methods.update(dict.fromkeys(arm.methods, arm.seeds[0]))
        arms = [
            Arm(learner, tuple(methods), (min(methods.values()),), (name,))
            for (name, learner), methods in seeds.items()
        ]
        answer = replace(self.answer, setting=same.get(self.answer.setting, ""))
        return replace(
            self,
            settings=settings,
            arms=tuple(arms),
            validation={},
            test={},
            publish=None,
            answer=answer,
            overrides=(*self.overrides, "size=quick"),
        )


def run_settings(cfg: DictConfig, method: str) -> dict[str, Any]:
    """Returns all settings that the policies of a run depend on.

    Other methods and models that only they need are left out, and so is ``steps`` of
    learners whose runs can be extended.
    """
    made = make_method(cfg, method)
    env: dict[str, Any] = OmegaConf.to_container(cfg.env, resolve=True)
    unused = {*_SHOWN, *_MODELS, "evaluate", "residual", "score", "truth"}
    unused -= {*made.models, *made.env_settings}
    if made.score_key is not None:
        unused.discard("score")
    env = {name: value for name, value in env.items() if name not in unused}
    for name in ("score", "truth"):
        if name in env:
            env[name].pop("batch_size", None)  # changes no result
    learner: dict[str, Any] = OmegaConf.to_container(cfg.learner, resolve=True)
    if get_class(cfg.learner._target_).extendable:
        learner.pop("steps")
    method_settings = OmegaConf.to_container(cfg.method[method], resolve=True)
    return {"env": env, "learner": learner, "method": method_settings}


def digest(settings: Any) -> str:
    """Returns a short hash of settings. One of ``None`` counts as one that is missing.

    So a new setting whose default is ``None`` leaves older results valid.
    """
    text = json.dumps(_without_none(plain(settings)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list):
        return [_without_none(item) for item in value]
    return value


def compose(*overrides: str) -> DictConfig:
    """Returns the configuration of Hydra overrides; a later one replaces an earlier."""
    latest = {override.partition("=")[0]: override for override in overrides}
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base=None):
        return hydra.compose("config", list(latest.values()))


def load_study(name: str) -> Study:
    """Returns the study of a name, or of a YAML file.

    Raises:
        FileNotFoundError: there is no such study.
        ValueError: the file does not describe a study.
    """
    path = Path(name) if name.endswith(".yaml") else CONF / "study" / f"{name}.yaml"
    if not path.exists():
        names = sorted(file.stem for file in (CONF / "study").glob("*.yaml"))
        raise FileNotFoundError(
            f"there is no study {name!r} ({path}): choose one of {names}, or give the "
            "path of a YAML file"
        )
    content = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    try:
        study = _read_study(content)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a study: {error}") from error
    if study.name != path.stem:
        raise ValueError(
            f"{path} is not a study: its name is {study.name!r}, expected that of the "
            f"file, {path.stem!r}"
        )
    return study


def ad_hoc_study(overrides: Sequence[str], seeds: Sequence[int]) -> Study:
    """Returns the study of one configuration: its environment, learner and methods."""
    cfg = compose(*overrides)
    chosen = [o for o in overrides if o.partition("=")[0] not in ("learner", "method")]
    choices = dict(o.split("=", 1) for o in overrides if "=" in o)
    learner = choices.get("learner", cfg.learner.name)
    return Study(
        name=f"{cfg.env.name}_{learner}",
        title=cfg.env.title,
        settings={cfg.env.name: tuple(filter(_is_choice, chosen))},
        arms=(Arm(learner, tuple(cfg.method), tuple(seeds or [cfg.seed])),),
        answer=Answer(cfg.env.title),
        publish=None,
        overrides=tuple(o for o in chosen if not _is_choice(o)),
    )


def _read_study(content: Any) -> Study:
    _check_names("it", content, Study)
    settings = {
        str(name): tuple(map(str, overrides))
        for name, overrides in _mapping("settings", content["settings"]).items()
    }
    if not settings or not content["arms"]:
        raise ValueError("it has no settings or no arms, expected at least one of each")
    arms = []
    for part in content["arms"]:
        _check_names("an arm", part, Arm)
        arm = Arm(
            part["learner"],
            tuple(part["methods"]),
            tuple(part["seeds"]),
            tuple(map(str, part.get("settings", ()))),
            tuple(part.get("overrides", ())),
        )
        if unknown := [name for name in arm.settings if name not in settings]:
            raise ValueError(
                f"an arm has the settings {unknown}, expected some of {list(settings)}"
            )
        if not arm.methods or not arm.seeds:
            raise ValueError(f"an arm has no methods or no seeds: {part}")
        if not all(type(seed) is int and seed >= 0 for seed in arm.seeds):
            raise ValueError(f"seeds are {list(arm.seeds)}, expected integers from 0")
        arms.append(arm)
    _check_names("answer", content["answer"], Answer)
    answer = Answer(**{k: str(v) for k, v in content["answer"].items()})
    for name, known in (
        ("validation", ("policies", "episodes")),
        ("test", ("episodes",)),
    ):
        part = _mapping(name, content.get(name, {}))
        for key, value in part.items():
            if key not in known:
                raise ValueError(f"{name} has {key!r}, expected {' and '.join(known)}")
            if value is not None and (type(value) is not int or value < 1):
                raise ValueError(f"{name}.{key} is {value!r}, expected an integer > 0")
    return Study(
        **{**content, "settings": settings, "arms": tuple(arms), "answer": answer}
    )


def _check_names(what: str, content: Any, kind: type) -> None:
    content = _mapping(what, content)
    known = {item.name: item for item in fields(kind) if item.name != "overrides"}
    if kind is Arm:
        known["overrides"] = fields(Arm)[-1]
    needed = set(list(known)[: {Study: 5, Arm: 3, Answer: 1}[kind]])
    if unknown := sorted(set(content) - set(known)):
        raise ValueError(f"{what} has {unknown}, expected some of {list(known)}")
    if missing := sorted(needed - set(content)):
        raise ValueError(f"{what} lacks {missing}")


def _mapping(what: str, content: Any) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"{what} is a {type(content).__name__}, expected a mapping")
    return content


def _is_choice(override: str) -> bool:
    return "." not in override.partition("=")[0]


def _null(value: Any) -> str:
    return "null" if value is None else str(value)
