"""What actions truly influence, asked of the simulator, and scores judged by it."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypedDict

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from tqdm import tqdm

from torchrl_caiac.experiments import end_with_parent

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from torchrl_caiac.entities import EntityLayout

__all__ = [
    "EntityReport",
    "InfluenceSimulator",
    "SimulatorInfluence",
    "TrueInfluence",
    "best_threshold",
    "draw_actions",
    "influence_report",
    "oracle_score",
    "roc_auc",
    "true_influence",
]

_logger = logging.getLogger("torchrl_caiac.truth")

#: Default distance, in metres or radians, from which an entity counts as influenced.
INFLUENCE_DISTANCE = 2e-3


class InfluenceSimulator(Protocol):
    """What :func:`true_influence` needs of an environment.

    It may also have ``in_reach(state, *, horizon=1)``, which returns bool ``[N]``:
    false for an entity that no action can possibly move. A state in which all entities
    that are not fixed are out of reach is then not simulated; this has to be a safe
    bound, since nothing else notices influence there.
    """

    @property
    def layout(self) -> EntityLayout:
        """A flat layout over the columns of :meth:`outcomes`."""

    @property
    def action_space(self) -> Any:
        """A box with ``low`` and ``high`` ``[A]``."""

    def outcomes(
        self, state: Any, actions: NDArray[np.float64], *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Return the noise-free next states ``[K, D]`` after actions ``[K, A]``."""


class TrueInfluence(NamedTuple):
    """The simulator's answer.

    Attributes:
        influenced: bool ``[S, N]``, in the order of the layout; fixed entities (the
            robot) are always influenced.
        displacement: float32 ``[S, N]``, the largest distance between an entity's next
            states under any two of the actions (metres and radians alike); 0 in states
            whose simulation was spared by ``in_reach``.
    """

    influenced: torch.Tensor
    displacement: torch.Tensor


class EntityReport(TypedDict):
    """How well a score finds one entity's true influence.

    Shares are ``nan`` where no row, or every row, is truly influenced.
    """

    auc: float
    best_threshold: float
    best_balanced_accuracy: float
    hit_rate: float
    false_alarms: float
    influenced: float
    below_threshold: float


def draw_actions(
    low: ArrayLike, high: ArrayLike, num_actions: int, *, seed: int = 0
) -> NDArray[np.float64]:
    """Draw uniform actions from a box.

    Args:
        low: lower bounds ``[A]``.
        high: upper bounds ``[A]``.
        num_actions: how many.

    Keyword Args:
        seed: equal seeds give equal actions.

    Returns:
        actions ``[num_actions, A]``.

    Example:
        >>> draw_actions([-1, -1], [1, 1], 16).shape
        (16, 2)
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if num_actions < 2:
        raise ValueError(
            f"num_actions is {num_actions}, wanted at least 2: influence is a "
            "difference between actions"
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"action bounds must be finite, got {low} and {high}")
    return np.random.default_rng(seed).uniform(low, high, (num_actions, *low.shape))


def true_influence(
    env: InfluenceSimulator | Callable[[], InfluenceSimulator],
    states: ArrayLike | Sequence[Any],
    *,
    num_actions: int = 16,
    threshold: float | Mapping[str, float] = INFLUENCE_DISTANCE,
    horizon: int = 1,
    seed: int = 0,
    num_workers: int = 0,
    progress: bool = True,
) -> TrueInfluence:
    """Ask the simulator which entities an action can move, in each of many states.

    From each state every one of ``num_actions`` uniform actions (the same for all
    states) is simulated without noise. An entity is influenced if two of the actions
    lead it to places more than ``threshold`` apart: the truth that the estimators of
    eq. 3 approximate. What an entity does on its own (a kettle that slides on after a
    push) is the same under every action and does not count.

    Why 2 mm (or mrad): the solver adds no noise to tell from contact (entities that the
    robot does not touch differ by less than 1e-8 between actions), and contact is not
    subtle. In the states of scripted microwave and kettle demonstrations, 146 of the
    147 displacements above 1e-8 are above 2 mm and every threshold from 0.3 to 4 mm
    gives the same masks. Below that, nobody could use the difference: the observation
    noise of an object is up to 0.05 mm, a task needs 0.3, and the world models take
    differences under their floor of 2 mm for noise. The tests measure both. Sixteen
    actions miss 3 of 27 contacts that 48 actions find in every sixth of these states.

    Args:
        env: a simulator, or a picklable function without arguments that makes one (the
            class :class:`~torchrl_caiac.envs.kitchen.KitchenEnv` itself will do).
        states: ``[S, ...]``, whatever ``env.outcomes`` takes: for the kitchen
            positions ``[S, 30]``, positions and velocities ``[S, 59]``, or a list of
            snapshots.

    Keyword Args:
        num_actions: actions a state, at least 2.
        threshold: distance, one for all or one for each entity that is not fixed.
        horizon: steps for which each action is held.
        seed: of the actions.
        num_workers: processes; 0 works in this one. More than 0 needs a function for
            ``env``, and a script guarded by ``if __name__ == "__main__":``. The result
            does not depend on it.
        progress: show a progress bar.

    Returns:
        masks and displacements, see :class:`TrueInfluence`.

    Example:
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> start = KitchenEnv.default_state()[None]
        >>> truth = true_influence(KitchenEnv, start, num_actions=2, progress=False)
        >>> truth.influenced.sum().item()  # the robot only
        1
    """
    rows: Sequence[Any] | NDArray[np.float64]
    if isinstance(states, torch.Tensor):
        rows = states.detach().cpu().numpy()
    elif isinstance(states, np.ndarray):
        rows = states
    else:
        rows = list(states)  # type: ignore[arg-type]
    if len(rows) == 0:
        raise ValueError("states is empty: there is nothing to ask the simulator")
    if isinstance(rows, np.ndarray):
        bad = ~np.isfinite(rows.reshape(len(rows), -1)).all(-1)
        if bad.any():
            raise ValueError(
                f"states holds non-finite values in {int(bad.sum())} rows, the first "
                f"at {int(bad.argmax())}: drop them"
            )
    if num_workers < 0:
        raise ValueError(f"num_workers is {num_workers}, wanted 0 or more")
    factory = env if callable(env) else None
    if num_workers and factory is None:
        raise ValueError(
            "num_workers > 0 needs a picklable function that makes the environment "
            f"(say its class), got {env!r}"
        )
    simulator: InfluenceSimulator = env() if callable(env) else env
    layout = simulator.layout
    if not layout.is_flat:
        raise ValueError("the simulator's layout must be flat: its states are vectors")
    limits = _limits(layout, threshold)
    columns = [list(layout.columns[name]) for name in layout.names]
    free = [i for i, name in enumerate(layout.names) if name not in layout.fixed]
    space = simulator.action_space
    actions = draw_actions(space.low, space.high, num_actions, seed=seed)
    displacement = np.empty((len(rows), len(layout)), dtype=np.float32)
    bar = tqdm(
        total=len(rows),
        desc="true influence",
        unit="state",
        disable=not progress,
        leave=False,
    )
    with bar:
        done: Iterator[NDArray[np.float64]]
        if factory is None or num_workers == 0:
            for i, row in enumerate(rows):
                displacement[i] = _displacement(
                    simulator, row, actions, columns, free, horizon
                )
                bar.update()
        else:
            if hasattr(simulator, "close"):
                simulator.close()
            # spawn: forked copies of torch's and OpenGL's threads may hang.
            with ProcessPoolExecutor(
                num_workers,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_start_worker,
                initargs=(factory, actions, columns, free, horizon),
            ) as pool:
                done = pool.map(_work, rows, chunksize=8)
                for i, values in enumerate(done):
                    displacement[i] = values
                    bar.update()
    influenced = displacement > limits
    _logger.info(
        "true influence of %d states: %s",
        len(rows),
        dict(zip(layout.names, influenced.mean(0).round(3).tolist(), strict=True)),
    )
    return TrueInfluence(torch.from_numpy(influenced), torch.from_numpy(displacement))


def _limits(
    layout: EntityLayout, threshold: float | Mapping[str, float]
) -> NDArray[np.float32]:
    free = [name for name in layout.names if name not in layout.fixed]
    if isinstance(threshold, Mapping):
        if set(threshold) != set(free):
            raise ValueError(
                f"threshold names {sorted(threshold)}, wanted every entity that is not "
                f"fixed: {sorted(free)}"
            )
        values = dict(threshold)
    else:
        values = dict.fromkeys(free, float(threshold))
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(
                f"the threshold of {name!r} is {value}, wanted a positive distance"
            )
    # Below every displacement: a fixed entity is always influenced.
    return np.array([values.get(name, -1.0) for name in layout.names], dtype=np.float32)


def _displacement(
    simulator: InfluenceSimulator,
    state: Any,
    actions: NDArray[np.float64],
    columns: list[list[int]],
    free: list[int],
    horizon: int,
) -> NDArray[np.float64]:
    in_reach = getattr(simulator, "in_reach", None)
    if in_reach is not None and not in_reach(state, horizon=horizon)[free].any():
        return np.zeros(len(columns))
    after = simulator.outcomes(state, actions, horizon=horizon)
    values = np.empty(len(columns))
    for i, own in enumerate(columns):
        part = after[:, own]
        gap = np.linalg.norm(part[:, None] - part[None, :], axis=-1)
        values[i] = gap.max()
    return values


_WORKER: dict[str, Any] = {}


def _start_worker(
    factory: Callable[[], InfluenceSimulator],
    actions: NDArray[np.float64],
    columns: list[list[int]],
    free: list[int],
    horizon: int,
) -> None:
    end_with_parent()
    torch.set_num_threads(1)
    _WORKER["arguments"] = (actions, columns, free, horizon)
    _WORKER["simulator"] = factory()


def _work(state: Any) -> NDArray[np.float64]:
    return _displacement(_WORKER["simulator"], state, *_WORKER["arguments"])


def oracle_score(influenced: torch.Tensor) -> torch.Tensor:
    """Return true masks as scores: 1 where influenced, else 0.

    Args:
        influenced: bool ``[T, N]``.

    Returns:
        float32 ``[T, N]``, to be used with any threshold between 0 and 1.

    Example:
        >>> oracle_score(torch.tensor([[True, False]]))
        tensor([[1., 0.]])
    """
    if influenced.dtype != torch.bool:
        raise ValueError(f"influenced has dtype {influenced.dtype}, wanted torch.bool")
    return influenced.to(torch.float32)


class SimulatorInfluence:
    """The simulator's truth as an estimator: scores of 1 where influenced, else 0.

    For :func:`~torchrl_caiac.influence.score_buffer.score_buffer`, which then keeps the
    truth beside the data, takes a killed call up again, and tells truths of different
    settings apart. Use ``lookahead=0`` to judge other scores by it.

    Args:
        factory: makes the simulator, see :func:`true_influence`; its class will do.

    Keyword Args:
        state_key: where each row has what ``outcomes`` takes, ``[*B, S]``.
        num_actions: actions a state.
        threshold: distance from which an entity is influenced, one for all or one for
            each entity that is not fixed.
        seed: of the actions.
        num_workers: processes; 0 works in this one.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> oracle = SimulatorInfluence(KitchenEnv, state_key="qpos", num_actions=2)
        >>> start = torch.tensor(KitchenEnv.default_state())
        >>> rows = TensorDict({"qpos": start[None]}, [1])
        >>> oracle(rows).sum()  # the robot only
        tensor(1.)
    """

    def __init__(
        self,
        factory: Callable[[], InfluenceSimulator],
        *,
        state_key: NestedKey = "simulator",
        num_actions: int = 16,
        threshold: float | Mapping[str, float] = INFLUENCE_DISTANCE,
        seed: int = 0,
        num_workers: int = 0,
    ) -> None:
        self.factory = factory
        self.state_key = unravel_key(state_key)
        self.num_actions = num_actions
        self.threshold = threshold
        self.seed = seed
        self.num_workers = num_workers
        self._simulator = factory()

    @property
    def layout(self) -> EntityLayout:
        """The simulator's layout."""
        return self._simulator.layout

    @property
    def in_keys(self) -> list[NestedKey]:
        """The simulator's state."""
        return [self.state_key]

    def __call__(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Asks the simulator.

        Args:
            tensordict: rows ``[T]`` with ``state_key``.

        Returns:
            float32 ``[T, N]``, 0 or 1.
        """
        truth = true_influence(
            self.factory if self.num_workers else self._simulator,
            tensordict[self.state_key],
            num_actions=self.num_actions,
            threshold=self.threshold,
            seed=self.seed,
            num_workers=self.num_workers,
            progress=False,
        )
        return oracle_score(truth.influenced)

    def __repr__(self) -> str:
        """The settings that the result depends on."""
        return (
            f"{type(self).__name__}({self.factory!r}, state_key={self.state_key!r}, "
            f"num_actions={self.num_actions}, threshold={self.threshold}, "
            f"seed={self.seed})"
        )


def _pair(score: Any, truth: Any) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    values = np.asarray(score, dtype=np.float64)
    mask = np.asarray(truth)
    if values.ndim != 1 or mask.shape != values.shape:
        raise ValueError(
            f"score and truth have shapes {values.shape} and {mask.shape}, wanted the "
            "same [S]"
        )
    if mask.dtype != np.bool_:
        raise ValueError(f"truth has dtype {mask.dtype}, wanted bool")
    if not len(values):
        raise ValueError("score is empty")
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise ValueError(
            f"score is NaN (not scored) or infinite in {bad} rows: score them, or drop "
            "them here"
        )
    return values, mask


def roc_auc(score: ArrayLike | torch.Tensor, truth: ArrayLike | torch.Tensor) -> float:
    """Return the area under the ROC curve of a score.

    Args:
        score: ``[S]``, finite; higher means more influence. Ties count half.
        truth: bool ``[S]``.

    Returns:
        the probability that an influenced row scores above an uninfluenced one;
        ``nan`` if the rows are all of one kind.

    Example:
        >>> roc_auc([0.1, 0.4, 0.35, 0.8], np.array([False, False, True, True]))
        0.75
    """
    from scipy.stats import mannwhitneyu

    values, mask = _pair(score, truth)
    positive, negative = values[mask], values[~mask]
    if not len(positive) or not len(negative):
        return float("nan")
    wins = mannwhitneyu(positive, negative, method="asymptotic").statistic
    return float(wins / (len(positive) * len(negative)))


def best_threshold(
    score: ArrayLike | torch.Tensor, truth: ArrayLike | torch.Tensor
) -> tuple[float, float]:
    """Return the threshold of highest balanced accuracy.

    Rows with a score above the threshold are called influenced; balanced accuracy is
    the mean of hit rate and one minus false alarms. Among equally good thresholds the
    one in the middle of the widest gap between scores is taken.

    Args:
        score: ``[S]``, finite.
        truth: bool ``[S]``.

    Returns:
        threshold and its balanced accuracy; ``(nan, nan)`` if the rows are all of one
        kind.

    Example:
        >>> best_threshold([0.0, 0.1, 0.5, 0.6], np.array([False, False, True, True]))
        (0.3, 1.0)
    """
    values, mask = _pair(score, truth)
    positives = int(mask.sum())
    negatives = len(mask) - positives
    if not positives or not negatives:
        return float("nan"), float("nan")
    levels, inverse = np.unique(values, return_inverse=True)
    # Cutting above level i: what lies at or below it is called uninfluenced. The last
    # cut calls nothing influenced.
    misses = np.cumsum(np.bincount(inverse, weights=mask))
    rejected = np.cumsum(np.bincount(inverse, weights=~mask))
    accuracy = ((1 - misses / positives) + rejected / negatives) / 2
    gaps = np.append(np.diff(levels), 0.0)
    best = int(np.lexsort((gaps, accuracy))[-1])
    middle = (levels[best] + levels[min(best + 1, len(levels) - 1)]) / 2
    return float(middle), float(accuracy[best])


def influence_report(
    scores: ArrayLike | torch.Tensor,
    truth: ArrayLike | torch.Tensor,
    names: Sequence[str],
    threshold: float,
) -> dict[str, EntityReport]:
    """Judge a score by the truth, entity by entity.

    Args:
        scores: ``[S, N]``, finite.
        truth: bool ``[S, N]``, of :func:`true_influence`.
        names: the ``N`` entities.
        threshold: θ; influenced is what scores above it.

    Returns:
        per entity: ``auc``; ``best_threshold`` and ``best_balanced_accuracy``
        (:func:`best_threshold`); at θ the ``hit_rate`` (influenced rows called so)
        and ``false_alarms`` (uninfluenced rows called influenced); ``influenced``, the
        share of rows that truly are; ``below_threshold``, the share of rows at or
        under θ.

    Example:
        >>> truth = np.array([[True, False], [False, False]])
        >>> report = influence_report(
        ...     [[0.9, 0.1], [0.0, 0.0]], truth, ["kettle", "microwave"], 0.3
        ... )
        >>> report["kettle"]["auc"], report["microwave"]["below_threshold"]
        (1.0, 1.0)
    """
    values, mask = np.asarray(scores, dtype=np.float64), np.asarray(truth)
    wanted = (len(values), len(names))
    if values.shape != wanted or mask.shape != wanted:
        raise ValueError(
            f"scores and truth have shapes {values.shape} and {mask.shape}, wanted "
            f"[S, {len(names)}] for the entities {tuple(names)}"
        )
    report: dict[str, EntityReport] = {}
    for i, name in enumerate(names):
        score, own = _pair(values[:, i], mask[:, i])
        called = score > threshold
        best, accuracy = best_threshold(score, own)
        report[name] = EntityReport(
            auc=roc_auc(score, own),
            best_threshold=best,
            best_balanced_accuracy=accuracy,
            hit_rate=_share(called, own),
            false_alarms=_share(called, ~own),
            influenced=float(own.mean()),
            below_threshold=float(1 - called.mean()),
        )
    return report


def _share(called: NDArray[np.bool_], among: NDArray[np.bool_]) -> float:
    return float(called[among].mean()) if among.any() else float("nan")
