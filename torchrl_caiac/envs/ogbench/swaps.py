"""Whether swapped transitions are possible, by simulating them in OGBench."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from torchrl_caiac._processes import run_in_processes
from torchrl_caiac.envs.ogbench.simulator import OGBenchSimulator

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from torchrl_caiac.entities import EntityLayout

__all__ = ["resimulate_swaps"]

_CHUNK = 64  # rows in one job


def resimulate_swaps(
    env: str | OGBenchSimulator,
    states: ArrayLike,
    actions: ArrayLike,
    next_states: ArrayLike,
    swapped: ArrayLike,
    donors: ArrayLike,
    *,
    num_workers: int = 0,
    progress: bool = True,
) -> NDArray[np.float32]:
    """Simulates counterfactual transitions, and compares their next states.

    A counterfactual transition takes some entities from a donor, before and after the
    action, and keeps the action and the other entities. This function restores the
    state with swapped entities (positions and velocities, and the states of buttons),
    applies the action, and returns how far each entity then is from its place in the
    counterfactual next state. The distance is large if a cube was swapped into another
    one, into the hand, or off the cube that it lies on. Without swaps, the distances
    are below 0.1 mm, see :class:`OGBenchSimulator`.

    Args:
        env (str or OGBenchSimulator): one of :data:`OGBENCH_ENVS`, or its simulator.
        states (array_like): the simulator's states ``[T, S]``, see
            :func:`ogbench_states`.
        actions (array_like): the actions ``[T, 5]``.
        next_states (array_like): the states after the actions ``[T, S]``.
        swapped (array_like): bool ``[T, N]``, the entities that row ``t`` takes from
            its donor, in the order of the layout; never the robot.
        donors (array_like): int ``[T]``, the row that is the donor of row ``t``; or
            ``[T, N]``, one for each entity.

    Keyword Args:
        num_workers (int): the number of processes; 0 uses this process. Defaults to 0.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        numpy.ndarray: distances in metres, float32 ``[T, N]``, in the order of the
        layout; the robot's is that of its hand. A button in the wrong state counts as
        a metre.

    Raises:
        ValueError: ``env`` is unknown, a shape is wrong, the robot is swapped, or a
            donor is not a row.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.ogbench import OGBenchSimulator, resimulate_swaps
        >>> simulator = OGBenchSimulator("cube-single")
        >>> before = np.stack([simulator.reset(seed=i) for i in range(2)])
        >>> after = []
        >>> for state in before:
        ...     _ = simulator.restore(state)
        ...     _ = simulator.step(np.zeros(5))
        ...     after.append(simulator.state())
        >>> errors = resimulate_swaps(
        ...     "cube-single", before, np.zeros((2, 5)), after, [[False, True]] * 2,
        ...     donors=[1, 0], progress=False,
        ... )
        >>> bool((errors < 1e-4).all())  # the hand is far from both places
        True
    """
    before, after, action = (
        np.asarray(values, dtype=np.float64)
        for values in (states, next_states, actions)
    )
    taken, donor = np.asarray(swapped), np.asarray(donors)
    is_own = isinstance(env, str)
    simulator = OGBenchSimulator(env) if isinstance(env, str) else env
    try:
        layout, total = simulator.layout, len(before)
        for what, array, width in (
            ("states", before, simulator.state_width),
            ("next_states", after, simulator.state_width),
            ("actions", action, 5),
            ("swapped", taken, len(layout)),
        ):
            if array.shape != (total, width):
                raise ValueError(
                    f"{what} have shape {array.shape}, expected ({total}, {width})"
                )
        if donor.shape == (total,):
            donor = np.repeat(donor[:, None], len(layout), 1)
        _check_swaps(taken, donor, layout)
        start, claim = before.copy(), after.copy()
        for number, entity in enumerate(layout.names):
            rows = np.flatnonzero(taken[:, number])
            if not len(rows):
                continue
            own = np.array(simulator.state_columns(entity))
            givers = donor[rows, number]
            start[np.ix_(rows, own)] = before[np.ix_(givers, own)]
            claim[np.ix_(rows, own)] = after[np.ix_(givers, own)]
        starts = range(0, total, _CHUNK)
        jobs = (
            (start[i : i + _CHUNK], action[i : i + _CHUNK], claim[i : i + _CHUNK])
            for i in starts
        )
        found = (
            run_in_processes(
                _errors,
                jobs,
                processes=num_workers,
                setup=partial(OGBenchSimulator, simulator.name),
            )
            if num_workers
            else run_in_processes(partial(_errors, simulator), jobs, processes=0)
        )
        result = np.empty(taken.shape, np.float32)
        with tqdm(
            total=total, desc="simulating swaps", disable=not progress, leave=False
        ) as bar:
            for number, errors in found:
                first = starts[number]
                result[first : first + len(errors)] = errors
                bar.update(len(errors))
    finally:
        if is_own:
            simulator.close()
    return result


def _check_swaps(
    taken: NDArray[Any], donor: NDArray[Any], layout: EntityLayout
) -> None:
    if donor.shape != taken.shape or donor.dtype.kind not in "iu":
        raise ValueError(
            f"donors have shape {donor.shape} and type {donor.dtype}, expected "
            f"integers ({len(taken)},) or {taken.shape}"
        )
    if taken.dtype != bool:
        raise ValueError(f"swapped has type {taken.dtype}, expected bool")
    if taken[:, [name in layout.fixed for name in layout.names]].any():
        raise ValueError("swapped has the robot, whose action is kept: leave it out")
    if ((donor < 0) | (donor >= len(taken)))[taken].any():
        raise ValueError(f"donors has rows outside of 0 to {len(taken) - 1}")


def _errors(
    simulator: OGBenchSimulator,
    states: NDArray[np.float64],
    actions: NDArray[np.float64],
    claims: NDArray[np.float64],
) -> NDArray[np.float64]:
    rows = []
    for state, action, claim in zip(states, actions, claims, strict=True):
        simulator.restore(claim)
        claimed = simulator.positions()
        simulator.restore(state)
        simulator.step(action)
        found = simulator.positions()
        rows.append([np.linalg.norm(found[k] - claimed[k]) for k in claimed])
    return np.array(rows)
