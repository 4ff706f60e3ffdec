"""Ground truth of influence, from the simulator."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from tqdm import tqdm

from torchrl_caiac._keys import as_key, get_leaf
from torchrl_caiac._processes import run_in_processes

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
_CHUNK = 8  # states in one job


class InfluenceSimulator(Protocol):
    """The interface of environments for :func:`true_influence`.

    It may also have ``in_reach(state, *, horizon=1)``, which returns bool ``[N]``:
    ``False`` for an entity that no action can move. A state in which all entities that
    are not fixed are out of reach is not simulated. The bound must be conservative,
    since influence that it misses is not detected.
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
        """Returns the noise-free next states ``[K, D]`` after actions ``[K, A]``."""


class TrueInfluence(NamedTuple):
    """The ground truth for some states.

    Attributes:
        influenced (torch.Tensor): bool ``[S, N]``, in the order of the layout; fixed
            entities (the robot) are always influenced.
        displacement (torch.Tensor): float32 ``[S, N]``, the largest distance between
            the next states of an entity under any two of the actions, in metres or
            radians; 0 in states that were not simulated because of ``in_reach``.
    """

    influenced: torch.Tensor
    displacement: torch.Tensor


def draw_actions(
    low: ArrayLike, high: ArrayLike, num_actions: int, *, seed: int = 0
) -> NDArray[np.float64]:
    """Draws uniform actions from a box.

    Args:
        low (array_like): the lower bounds, ``[A]``.
        high (array_like): the upper bounds, ``[A]``.
        num_actions (int): the number of actions, at least 2.

    Keyword Args:
        seed (int): equal seeds give equal actions. Defaults to 0.

    Returns:
        numpy.ndarray: actions, float64 ``[num_actions, A]``.

    Raises:
        ValueError: a bound is not finite, or there are fewer than two actions.

    Examples:
        >>> from torchrl_caiac.influence.truth import draw_actions
        >>> draw_actions([-1, -1], [1, 1], 16).shape
        (16, 2)
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if num_actions < 2:
        raise ValueError(
            f"num_actions is {num_actions}, expected at least 2: influence is a "
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
    """Queries the simulator for the entities that an action can move, state by state.

    From each state, every one of ``num_actions`` uniform actions (the same for all
    states) is simulated without noise. An entity is influenced if two of the actions
    bring it to places more than ``threshold`` apart. This is the ground truth that
    estimators of eq. 3 approximate. Motion that does not depend on the action (a kettle
    that keeps sliding after a push) is the same under every action and does not count.

    The default of 2 mm (or mrad) separates contact from no contact. Without contact,
    entities differ by less than 1e-8 between actions. In the states of scripted
    microwave and kettle demonstrations, 146 of the 147 displacements above 1e-8 are
    above 2 mm, and every threshold from 0.3 to 4 mm gives the same masks. Smaller
    differences are irrelevant: the observation noise of an object is up to 0.05 mm, a
    task tolerates 0.3, and the world models treat differences below their floor of 2 mm
    as noise. Sixteen actions miss 3 of 27 contacts that 48 actions find in every sixth
    of these states.

    Args:
        env (InfluenceSimulator or callable): a simulator, or a picklable function
            without arguments that creates one, such as the class
            :class:`~torchrl_caiac.envs.kitchen.KitchenEnv`.
        states (array_like or sequence): ``[S, ...]``, what ``env.outcomes`` takes. For
            the kitchen positions ``[S, 30]``, positions and velocities ``[S, 59]``, or
            a list of snapshots.

    Keyword Args:
        num_actions (int): actions for each state, at least 2. Defaults to 16.
        threshold (float or mapping of str to float): the distance from which an entity
            is influenced, one for all or one for each entity that is not fixed.
            Defaults to 2e-3.
        horizon (int): the number of steps for which each action is held. Defaults to 1.
        seed (int): the seed of the actions. Defaults to 0.
        num_workers (int): the number of processes; 0 uses this process. More than 0
            needs a function for ``env``, and a script with
            ``if __name__ == "__main__":``. The result does not depend on it. Defaults
            to 0.
        progress (bool): show a progress bar. Defaults to ``True``.

    Returns:
        TrueInfluence: masks and displacements.

    Raises:
        ValueError: there are no states, a state is not finite, or an argument is out of
            range.

    Examples:
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> from torchrl_caiac.influence import true_influence
        >>> start = KitchenEnv.default_state()[None]
        >>> truth = true_influence(KitchenEnv, start, num_actions=2, progress=False)
        >>> truth.influenced.sum().item()  # the robot only
        1
    """
    rows = _checked_states(states)
    if num_workers < 0:
        raise ValueError(f"num_workers is {num_workers}, expected 0 or more")
    if num_workers and not callable(env):
        raise ValueError(
            "num_workers > 0 needs a picklable function that creates the environment, "
            f"such as its class, got {env!r}"
        )
    simulator: InfluenceSimulator = env() if callable(env) else env
    try:
        layout, space = simulator.layout, simulator.action_space
        if not layout.is_flat:
            raise ValueError(
                "the layout of the simulator is nested, expected a flat one: its "
                "states are vectors"
            )
        limits = _limits(layout, threshold)
        actions = draw_actions(space.low, space.high, num_actions, seed=seed)
        columns = [list(layout.columns[name]) for name in layout.names]
        free = [i for i, name in enumerate(layout.names) if name not in layout.fixed]
        displacement = np.empty((len(rows), len(layout)), dtype=np.float32)
        starts = range(0, len(rows), _CHUNK)
        jobs = (
            (rows[start : start + _CHUNK], actions, columns, free, horizon)
            for start in starts
        )
        found = (
            run_in_processes(
                _displacements,
                jobs,
                processes=num_workers,
                setup=env,  # type: ignore[arg-type]
            )
            if num_workers
            else run_in_processes(partial(_displacements, simulator), jobs, processes=0)
        )
        with tqdm(
            total=len(rows),
            desc="ground truth",
            unit="state",
            disable=not progress,
            leave=False,
        ) as bar:
            for number, values in found:
                start = starts[number]
                displacement[start : start + len(values)] = values
                bar.update(len(values))
    finally:
        if callable(env) and hasattr(simulator, "close"):
            simulator.close()
    influenced = displacement > limits
    _logger.info(
        "ground truth of %d states: influenced %s",
        len(rows),
        dict(zip(layout.names, influenced.mean(0).round(3).tolist(), strict=True)),
    )
    return TrueInfluence(torch.from_numpy(influenced), torch.from_numpy(displacement))


def _checked_states(
    states: ArrayLike | Sequence[Any],
) -> Sequence[Any] | NDArray[np.float64]:
    rows: Sequence[Any] | NDArray[np.float64]
    if isinstance(states, torch.Tensor):
        rows = states.detach().cpu().numpy()
    elif isinstance(states, np.ndarray):
        rows = states
    else:
        rows = list(states)  # type: ignore[arg-type]
    if len(rows) == 0:
        raise ValueError("states is empty: give at least one state")
    if isinstance(rows, np.ndarray):
        bad = ~np.isfinite(rows.reshape(len(rows), -1)).all(-1)
        if bad.any():
            raise ValueError(
                f"states has non-finite values in {int(bad.sum())} rows, the first at "
                f"{int(bad.argmax())}: drop them"
            )
    return rows


def _limits(
    layout: EntityLayout, threshold: float | Mapping[str, float]
) -> NDArray[np.float32]:
    free = [name for name in layout.names if name not in layout.fixed]
    if isinstance(threshold, Mapping):
        if set(threshold) != set(free):
            raise ValueError(
                f"threshold names {sorted(threshold)}, expected every entity that is "
                f"not fixed: {sorted(free)}"
            )
        values = dict(threshold)
    else:
        values = dict.fromkeys(free, float(threshold))
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(
                f"the threshold of {name!r} is {value}, expected a positive distance"
            )
    # Below every displacement: a fixed entity is always influenced.
    return np.array([values.get(name, -1.0) for name in layout.names], dtype=np.float32)


def _displacements(
    simulator: InfluenceSimulator,
    states: Sequence[Any] | NDArray[np.float64],
    actions: NDArray[np.float64],
    columns: list[list[int]],
    free: list[int],
    horizon: int,
) -> NDArray[np.float64]:
    """Returns the displacements ``[S, N]`` of the entities in some states."""
    in_reach = getattr(simulator, "in_reach", None)
    result = np.zeros((len(states), len(columns)))
    for values, state in zip(result, states, strict=True):
        if in_reach is not None and not in_reach(state, horizon=horizon)[free].any():
            continue
        after = simulator.outcomes(state, actions, horizon=horizon)
        for i, own in enumerate(columns):
            part = after[:, own]
            gap = np.linalg.norm(part[:, None] - part[None, :], axis=-1)
            values[i] = gap.max()
    return result


def oracle_score(influenced: torch.Tensor) -> torch.Tensor:
    """Returns ground truth masks as scores: 1 where influenced, else 0.

    Args:
        influenced (torch.Tensor): bool ``[T, N]``.

    Returns:
        torch.Tensor: float32 ``[T, N]``, for any threshold between 0 and 1.

    Raises:
        ValueError: ``influenced`` is not bool.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence import oracle_score
        >>> oracle_score(torch.tensor([[True, False]]))
        tensor([[1., 0.]])
    """
    if influenced.dtype != torch.bool:
        raise ValueError(
            f"influenced has dtype {influenced.dtype}, expected torch.bool"
        )
    return influenced.to(torch.float32)


class SimulatorInfluence:
    """An estimator that queries the simulator: 1 where influenced, else 0.

    :func:`~torchrl_caiac.influence.score_buffer` writes its scores next to the data,
    resumes interrupted calls, and never mixes scores of different settings. Use
    ``lookahead=0`` for the ground truth of each row's state, and the same ``lookahead``
    as for learned scores to train with the ground truth. ``score_buffer(..., every=n)``
    queries only every ``n``-th state of a trajectory; a state in between counts as
    influenced if one of the two around it is.

    Args:
        factory (callable): creates the simulator, such as its class; see
            :func:`true_influence`.

    Keyword Args:
        state_key (NestedKey or list of NestedKey): what ``outcomes`` takes, ``[*B,
            S]``; the leaves of a list are concatenated. Defaults to ``"simulator"``.
        num_actions (int): actions for each state. Defaults to 16.
        threshold (float or mapping of str to float): the distance from which an entity
            is influenced, one for all or one for each entity that is not fixed.
            Defaults to 2e-3.
        seed (int): the seed of the actions. Defaults to 0.
        num_workers (int): the number of processes; 0 uses this process. Defaults to 0.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> from torchrl_caiac.influence import SimulatorInfluence
        >>> oracle = SimulatorInfluence(
        ...     KitchenEnv, state_key=["qpos", "qvel"], num_actions=2
        ... )
        >>> start = torch.tensor(KitchenEnv.default_state())
        >>> rows = TensorDict({"qpos": start[None], "qvel": torch.zeros(1, 29)}, [1])
        >>> oracle(rows).sum()  # the robot only
        tensor(1.)
    """

    def __init__(
        self,
        factory: Callable[[], InfluenceSimulator],
        *,
        state_key: NestedKey | list[NestedKey] = "simulator",
        num_actions: int = 16,
        threshold: float | Mapping[str, float] = INFLUENCE_DISTANCE,
        seed: int = 0,
        num_workers: int = 0,
    ) -> None:
        self.factory = factory
        self.state_key: NestedKey | list[NestedKey] = (
            [as_key(key) for key in state_key]
            if isinstance(state_key, list)
            else as_key(state_key)
        )
        self.num_actions = num_actions
        self.threshold = threshold
        self.seed = seed
        self.num_workers = num_workers
        self._simulator = factory()

    def __getstate__(self) -> dict[str, Any]:
        """Returns all but the simulator, which the factory makes again."""
        return {k: v for k, v in vars(self).items() if k != "_simulator"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Sets what was pickled, and makes a simulator."""
        vars(self).update(state)
        self._simulator = self.factory()

    @property
    def layout(self) -> EntityLayout:
        """The layout of the simulator."""
        return self._simulator.layout

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the simulator's state."""
        key = self.state_key
        return list(key) if isinstance(key, list) else [key]

    def __call__(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Queries the simulator.

        Args:
            tensordict (TensorDictBase): rows ``[T]`` with ``state_key``.

        Returns:
            torch.Tensor: float32 ``[T, N]``, 0 or 1.

        Raises:
            KeyError: the rows lack the state.
        """
        leaves = [
            get_leaf(
                tensordict,
                key,
                "the data lack the state of the simulator",
                "name the leaf with state_key",
            )
            for key in self.in_keys
        ]
        truth = true_influence(
            self.factory if self.num_workers else self._simulator,
            leaves[0] if len(leaves) == 1 else torch.cat(leaves, -1),
            num_actions=self.num_actions,
            threshold=self.threshold,
            seed=self.seed,
            num_workers=self.num_workers,
            progress=False,
        )
        return oracle_score(truth.influenced)

    def __repr__(self) -> str:
        """Returns the settings that the result depends on."""
        return (
            f"{type(self).__name__}({self.factory!r}, state_key={self.state_key!r}, "
            f"num_actions={self.num_actions}, threshold={self.threshold}, "
            f"seed={self.seed})"
        )
