"""The ground truth of influence in Fetch-Push, from its simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from gymnasium.spaces import Box

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.fetch_push.model import COLLIDING_BODIES
from torchrl_caiac.envs.fetch_push.simulator import ACTION_SCALE, FetchPushSimulator
from torchrl_caiac.envs.fetch_push.task import (
    CUBE_WIDTH,
    GRIPPER_WIDTH,
    fetch_push_layout,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["FetchPushTruth"]


class FetchPushTruth:
    """The simulator that :func:`torchrl_caiac.influence.truth.true_influence` queries.

    Its layout has the entities of :func:`fetch_push_layout`, in the same order, with
    their *positions* alone, so that the distance between two outcomes is in metres.
    (Over all columns it would mix metres with radians, and Euler angles jump.)

    Args:
        num_cubes (int): the number of cubes ``n``. Defaults to 2.
        cube_friction (float, optional): that of the environment. Defaults to ``None``.

    Examples:
        >>> from torchrl_caiac.envs import FetchPushCubes, FetchPushTruth
        >>> from torchrl_caiac.influence.truth import true_influence
        >>> env = FetchPushCubes(2)
        >>> _ = env.reset(seed=0)  # the gripper is above the table, far from the cubes
        >>> states = env.simulator_state()[None]
        >>> truth = true_influence(
        ...     FetchPushTruth, states, num_actions=4, threshold=1e-3, progress=False
        ... )
        >>> truth.influenced
        tensor([[ True, False, False]])
    """

    def __init__(self, num_cubes: int = 2, cube_friction: float | None = None) -> None:
        columns = fetch_push_layout(num_cubes).columns
        #: The positions of the gripper and the cubes.
        self.layout = EntityLayout(
            {name: owned[:3] for name, owned in columns.items()}, fixed=("gripper",)
        )
        #: The actions of :class:`FetchPushCubes`.
        self.action_space = Box(-1.0, 1.0, (4,), np.float32)
        self._simulator = FetchPushSimulator(num_cubes, cube_friction)
        model = self._simulator.model
        self._cubes = [model.geom(f"object{i}").id for i in range(num_cubes)]
        self._robot = [
            geom
            for geom in range(model.ngeom)
            if model.body(model.geom_bodyid[geom]).name in COLLIDING_BODIES
            and model.geom_contype[geom]
        ]

    def in_reach(self, state: ArrayLike, *, horizon: int = 1) -> NDArray[np.bool_]:
        """Returns which entities an action might move: a safe and fast bound.

        A cube is in reach if the gap between it and a link that collides, or another
        cube in reach, is smaller than the distance that both can move: an action moves
        the target of the gripper by at most 5 cm along each axis, the gripper does not
        overshoot it, and cubes that move continue to move. The bound is 8.7 cm if the
        cubes rest. In 7,500 states (of episodes, and with a fast gripper next to moving
        cubes) no action bridged a gap wider than 4.9 cm. Actions that are repeated for
        several steps were not measured.

        Args:
            state (array): ``[S]``, from :meth:`FetchPushCubes.simulator_state`.

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            NDArray: bool ``[1 + n]``, in the order of the layout; ``True`` for the
            gripper.

        Examples:
            >>> from torchrl_caiac.envs import FetchPushCubes, FetchPushTruth
            >>> env = FetchPushCubes(2)
            >>> _ = env.reset(seed=0, options={"cubes": [[1.3, 0.7], [1.3, 1.0]]})
            >>> FetchPushTruth(2).in_reach(env.simulator_state())
            array([ True,  True, False])
        """
        simulator = self._simulator
        simulator.restore(state)
        cubes = simulator.observation()[GRIPPER_WIDTH:].reshape(-1, CUBE_WIDTH)
        speed = np.linalg.norm(cubes[:, 6:9], axis=1).max()
        way = horizon * (np.sqrt(3) * ACTION_SCALE + speed)

        def near(first: int, second: int) -> bool:
            gap = mujoco.mj_geomDistance(
                simulator.model, simulator.data, first, second, way, None
            )
            return bool(gap < way)

        reached = {c for c in self._cubes if any(near(g, c) for g in self._robot)}
        new = reached
        while new:
            rest = [c for c in self._cubes if c not in reached]
            new = {c for c in rest if any(near(c, other) for other in reached)}
            reached = reached | new
        return np.array([True, *(cube in reached for cube in self._cubes)])

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next observation after each of several actions from one state.

        Args:
            state (array): ``[S]``, from :meth:`FetchPushCubes.simulator_state`.
            actions (array): ``[K, 4]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            NDArray: observations ``[K, 10 + 12 n]``, in double precision.
        """
        return self._simulator.outcomes(state, actions, horizon=horizon)
