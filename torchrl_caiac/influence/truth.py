"""Ground truth of influence, from the simulator."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

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
    "InfluenceSimulator",
    "SimulatorInfluence",
    "TrueInfluence",
    "draw_actions",
    "oracle_score",
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
