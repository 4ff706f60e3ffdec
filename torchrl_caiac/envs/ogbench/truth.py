"""The ground truth of influence in OGBench, from its simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.ogbench.simulator import ROBOT, OGBenchSimulator

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["OGBenchTruth"]

# Metres: more than the robot's links and an entity come closer in a step.
_WAY = 0.08
_STEP = 0.05  # seconds


class OGBenchTruth:
    """The simulator that :func:`~torchrl_caiac.influence.true_influence` queries.

    Its layout has the entities of the observations, in the same order, with their
    *positions* alone, not scaled, so that the distance between two outcomes is in
    metres. A button has its state too, which is 0 or 1: a press counts as a metre, also
    for the buttons next to it that a press switches.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`. Defaults to ``"cube-double"``.

    Raises:
        ValueError: ``name`` is not such an environment.
        ImportError: ``ogbench`` is not installed.

    Examples:
        >>> from torchrl_caiac.envs.ogbench import OGBenchSimulator, OGBenchTruth
        >>> from torchrl_caiac.influence import true_influence
        >>> states = OGBenchSimulator("cube-double").reset(seed=0)[None]
        >>> truth = true_influence(
        ...     OGBenchTruth, states, num_actions=4, threshold=1e-3, progress=False
        ... )
        >>> truth.influenced  # the hand is above the table
        tensor([[ True, False, False]])
    """

    def __init__(self, name: str = "cube-double") -> None:
        self._simulator = OGBenchSimulator(name)
        columns, first = {}, 0
        for entity, position in self._simulator.positions().items():
            columns[entity] = range(first, first + len(position))
            first += len(position)
        #: The positions of the hand and the entities.
        self.layout = EntityLayout(columns, fixed=(ROBOT,))
        #: The actions of OGBench.
        self.action_space = self._simulator.action_space

    def in_reach(self, state: ArrayLike, *, horizon: int = 1) -> NDArray[np.bool_]:
        """Returns which entities an action might move: a safe and fast bound.

        An entity is in reach if the gap between it and the robot, or another entity in
        reach, is smaller than 8 cm plus the distance that the fastest entity covers in
        a step. For ``horizon`` steps the gap is that many times as large.

        Args:
            state (array_like): ``[S]``, see :class:`OGBenchSimulator`.

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            numpy.ndarray: bool ``[1 + n]``, in the order of the layout; ``True`` for
            the robot.
        """
        simulator = self._simulator
        simulator.restore(state)
        way = horizon * (_WAY + _STEP * simulator.speed())
        rest, new = list(simulator.places), [ROBOT]
        reached = set(new)
        while new and rest:
            last = new.pop()
            near = [name for name in rest if simulator.is_near(last, name, way)]
            new += near
            reached.update(near)
            rest = [name for name in rest if name not in reached]
        return np.array([name in reached for name in self.layout.names])

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the positions after each of several actions from one state.

        Args:
            state (array_like): ``[S]``, see :class:`OGBenchSimulator`.
            actions (array_like): ``[K, 5]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            numpy.ndarray: ``[K, P]``, in metres, float64; see :attr:`layout`.

        Raises:
            ValueError: a shape is wrong, a value is not finite, or ``horizon`` is less
                than 1.
        """
        return np.stack(
            [
                np.concatenate(list(self._simulator.positions().values()))
                for _ in self._simulator.visit(state, actions, horizon=horizon)
            ]
        )

    def close(self) -> None:
        """Closes OGBench's environment."""
        self._simulator.close()
