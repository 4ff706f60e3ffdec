"""Fetch-Push with several cubes as an environment (sections 4.3 and A.6.2)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import mujoco
import numpy as np

from torchrl_caiac.envs.fetch_push.simulator import START, FetchPushSimulator
from torchrl_caiac.envs.fetch_push.starts import Region, check_positions
from torchrl_caiac.envs.fetch_push.task import (
    CUBE_WIDTH,
    DISTANCE_THRESHOLD,
    GRIPPER_WIDTH,
    fetch_push_distances,
    fetch_push_layout,
    fetch_push_reward,
)
from torchrl_caiac.envs.rendering import OffscreenRenderer

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["FetchPushCubes", "FetchPushState"]

_EPISODE_STEPS = 100
_MAX_GRIPPER_NOISE = 0.1
_MAX_CUBE_SPEED = 0.5  # m/s
# The noise of the start along each axis, as a share of ``gripper_noise``.
_NOISE_SCALE = np.array([1.0, 1.0, 0.3])
_CAMERA = {
    "lookat": np.array([1.3, 0.75, 0.47]),
    "distance": 1.25,
    "azimuth": 145.0,
    "elevation": -32.0,
}


@dataclass(frozen=True)
class FetchPushState:
    """Everything that an episode depends on: an exact, picklable snapshot.

    Attributes:
        simulator (NDArray): the simulator state ``[S]``, see
            :meth:`FetchPushCubes.simulator_state`.
        goal (NDArray): the desired goal ``[3 n]``.
        steps (int): the number of environment steps so far.
        generator (dict): the state of the random generator of starts and goals.
    """

    simulator: NDArray[np.float64]
    goal: NDArray[np.float64]
    steps: int
    generator: dict[str, Any] = field(repr=False)


class FetchPushCubes(gymnasium.Env[dict[str, Any], Any]):
    """Pushes several cubes, each to its own goal on the table (A.6.2).

    The robot, the cubes and the action are those of ``FetchPush`` in
    gymnasium-robotics. An action moves the target of the gripper by up to 5 cm; the arm
    moves up to 3.3 cm in a step of 0.04 s. The fingers stay closed, so the fourth
    number of the action has no effect. The table is larger than in ``FetchPush``, so
    that cubes stay on it, and links of the robot that never touch anything do not
    collide.

    The observation has ``10 + 12 n`` columns, which :attr:`layout` names: gripper
    position (3), finger positions (2), gripper velocity (3), finger velocities (2),
    then for each cube position (3), Euler angles (3; about x, then the new y, then the
    new z), linear velocity (3) and angular velocity (3). All are in the world frame,
    unlike in ``FetchPush``: coordinates relative to the gripper would entangle the
    entities. Positions are in metres, angles in radians, and velocities per step
    (0.04 s) as in ``FetchPush``. The goal contains the positions of all cubes.

    Args:
        num_cubes (int): the number of cubes ``n``. Defaults to 2.

    Keyword Args:
        max_episode_steps (int): the number of steps after which an episode is
            truncated. Defaults to 100.
        distance_threshold (float): a cube that is closer to its goal than this has
            reached it, in metres. Defaults to 0.05.
        terminate_on_success (bool): if ``True``, an episode ends when all cubes are at
            their goals. Defaults to ``False``.
        cube_range (float): cubes are drawn from a square around the centre of the
            table; half the side of the square, in metres. Defaults to 0.15.
        goal_range (float): the same for goals. Defaults to 0.15.
        gripper_noise (float): the gripper starts up to this far from the centre of the
            table along x and y, in metres, and 0.3 of it in height. Defaults to 0.05.
        cube_friction (float, optional): the coefficient of sliding friction of the
            cubes on everything. With a low one, such as 0.02, they slide on by
            themselves. Defaults to ``None``: that of gymnasium-robotics, with which
            they stop at once.
        cube_speed (float): the speed at which cubes start, in random directions, in
            metres per second. Defaults to 0.
        render_mode (str, optional): ``None`` or ``"rgb_array"``.
        render_size (tuple of int): width and height of rendered frames, in pixels.
            Defaults to ``(320, 240)``.

    ``reset`` takes ``options`` with the keys ``"cubes"`` and ``"goals"``, positions
    ``[n, 2]`` or ``[n, 3]``. Drawn cubes are at least 10 cm from each other and from
    the gripper, drawn goals are at least 10 cm from each other, and no cube starts at
    its goal. ``reset`` and ``step`` return in ``info``:

    - ``"success"``: whether all cubes are at their goals;
    - ``"cube_success"``: bool ``[n]``, which cubes are;
    - ``"is_success"``: ``"success"`` as float32, as in gymnasium-robotics.

    Raises:
        ValueError: an argument is out of range, or the cubes or goals do not fit into
            their regions.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs import FetchPushCubes
        >>> env = FetchPushCubes(2)
        >>> observation, info = env.reset(
        ...     seed=0, options={"cubes": [[1.3, 0.7], [1.4, 0.8]]}
        ... )
        >>> observation["observation"].shape, observation["desired_goal"].shape
        ((34,), (6,))
        >>> observation["achieved_goal"].round(2)
        array([1.3 , 0.7 , 0.42, 1.4 , 0.8 , 0.42], dtype=float32)
        >>> observation, reward, terminated, truncated, info = env.step(np.zeros(4))
        >>> reward, bool(info["success"])
        (-1.0, False)
        >>> env.layout.names
        ('gripper', 'cube0', 'cube1')
    """

    # gymnasium declares it without ClassVar, which mypy reports
    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 25,
    }

    def __init__(
        self,
        num_cubes: int = 2,
        *,
        max_episode_steps: int = _EPISODE_STEPS,
        distance_threshold: float = DISTANCE_THRESHOLD,
        terminate_on_success: bool = False,
        cube_range: float = 0.15,
        goal_range: float = 0.15,
        gripper_noise: float = 0.05,
        cube_friction: float | None = None,
        cube_speed: float = 0.0,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (320, 240),
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode is {render_mode!r}, expected None or 'rgb_array'"
            )
        if max_episode_steps < 1:
            raise ValueError(
                f"max_episode_steps is {max_episode_steps}, expected at least 1"
            )
        if not (np.isfinite(distance_threshold) and distance_threshold > 0):
            raise ValueError(
                f"distance_threshold is {distance_threshold}, expected a positive "
                "distance"
            )
        if not 0 <= gripper_noise <= _MAX_GRIPPER_NOISE:
            raise ValueError(
                f"gripper_noise is {gripper_noise}, expected between 0 and "
                f"{_MAX_GRIPPER_NOISE}"
            )
        if cube_friction is not None and not 0 < cube_friction < np.inf:
            raise ValueError(
                f"cube_friction is {cube_friction}, expected None or a positive number"
            )
        if not 0 <= cube_speed <= _MAX_CUBE_SPEED:
            raise ValueError(
                f"cube_speed is {cube_speed}, expected between 0 and {_MAX_CUBE_SPEED}"
            )
        #: The entities of the observation and their goal columns.
        self.layout = fetch_push_layout(num_cubes)
        self.num_cubes = num_cubes
        self.max_episode_steps = max_episode_steps
        self.distance_threshold = distance_threshold
        self.terminate_on_success = terminate_on_success
        self.cube_range = cube_range
        self.goal_range = goal_range
        self.gripper_noise = gripper_noise
        self.cube_friction = cube_friction
        self.cube_speed = cube_speed
        self.render_mode = render_mode
        self.render_size = render_size
        self._renderer: OffscreenRenderer | None = None
        self._simulator = FetchPushSimulator(num_cubes, cube_friction)
        self._goal = np.zeros((num_cubes, 3))
        self._steps = 0
        self._ready = False
        self._cube_region, self._goal_region = (
            Region(name, num_cubes, half=half, distance_threshold=distance_threshold)
            for name, half in (("cubes", cube_range), ("goals", goal_range))
        )
        # Draws once, so that a region that is too small is reported here.
        rng = np.random.default_rng(0)
        cubes = self._cube_region.draw(rng, away_from=[START[:2]])
        self._goal_region.draw(rng, own=cubes)

        def box(width: int) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)

        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "observation": box(self._simulator.width),
                "achieved_goal": box(3 * num_cubes),
                "desired_goal": box(3 * num_cubes),
            }
        )

    @property
    def model(self) -> Any:
        """The MuJoCo model, which all environments share: do not change it."""
        return self._simulator.model

    @property
    def data(self) -> Any:
        """The MuJoCo data."""
        return self._simulator.data

    @property
    def dt(self) -> float:
        """The duration of an environment step, in seconds."""
        return self._simulator.dt

    @property
    def goal(self) -> NDArray[np.float64]:
        """The desired goal ``[3 n]`` of this episode, a copy."""
        return self._goal.flatten()

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Starts an episode.

        Keyword Args:
            seed (int, optional): seeds starts and goals; equal seeds give equal
                episodes.
            options (dict, optional): ``"cubes"`` and ``"goals"``, positions ``[n, 2]``
                or ``[n, 3]``. Missing ones are drawn.

        Returns:
            tuple[dict, dict]: the observation and the info.

        Raises:
            ValueError: a position is off the table, out of reach or overlaps another.
        """
        options = dict(options or {})
        unknown = sorted(set(options) - {"cubes", "goals"})
        if unknown:
            raise ValueError(
                f"reset options have {unknown}, expected only 'cubes' and 'goals'"
            )
        cubes = self._given("cubes", options, height_tolerance=1e-3)
        goals = self._given("goals", options, height_tolerance=self.distance_threshold)
        super().reset(seed=seed)
        rng = self.np_random
        gripper = START + self.gripper_noise * _NOISE_SCALE * rng.uniform(-1, 1, 3)
        if cubes is None:
            cubes = self._cube_region.draw(rng, away_from=[gripper[:2]], own=goals)
        if goals is None:
            goals = self._goal_region.draw(rng, own=cubes)
        self._simulator.start(cubes, gripper)
        if self.cube_speed:
            angle = rng.uniform(0, 2 * np.pi, self.num_cubes)
            directions = np.stack([np.cos(angle), np.sin(angle)], 1)
            self._simulator.push_cubes(self.cube_speed * directions)
        self._set_goal(goals)
        self._steps = 0
        self._ready = True
        observation = self._observe()
        return observation, self._info(observation)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Moves the gripper for 0.04 s.

        Args:
            action (array): ``[4]``, clipped to [-1, 1]: the displacement of the gripper
                in units of 5 cm, and its opening, which has no effect.

        Returns:
            tuple: observation, reward (0 on success, else -1), terminated, truncated
            and info.

        Raises:
            ValueError: the action has another shape or non-finite values.
            RuntimeError: there is no episode, or the simulation diverged.
        """
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (4,):
            raise ValueError(f"action has shape {values.shape}, expected (4,)")
        if not np.isfinite(values).all():
            raise ValueError(
                f"action has non-finite values: {values.tolist()}, expected finite "
                "ones: check the inputs of the policy"
            )
        self._check_ready()
        self._simulator.act(np.clip(values, -1.0, 1.0))
        if self._simulator.diverged:
            self._ready = False
            raise RuntimeError(
                "the simulation diverged: call reset() and leave this episode out"
            )
        self._steps += 1
        observation = self._observe()
        info = self._info(observation)
        success = bool(info["success"])
        return (
            observation,
            0.0 if success else -1.0,
            success and self.terminate_on_success,
            self._steps >= self.max_episode_steps,
            info,
        )

    def compute_reward(self, achieved: Any, desired: Any, info: Any = None) -> Any:
        """Returns the reward for a batch of goals; see :func:`fetch_push_reward`.

        Args:
            achieved (np.ndarray or torch.Tensor): achieved goals ``[*B, 3 n]``.
            desired (np.ndarray or torch.Tensor): desired goals ``[*B, 3 n]``.
            info (Any, optional): ignored.

        Returns:
            np.ndarray or torch.Tensor: rewards ``[*B]``, float32: 0 if all cubes are at
            their goals, else -1.

        Raises:
            ValueError: the goals are not those of ``n`` cubes.
        """
        for name, value in (("achieved", achieved), ("desired", desired)):
            shape = tuple(np.shape(value))
            if not shape or shape[-1] != 3 * self.num_cubes:
                raise ValueError(
                    f"{name} goal has shape {shape}, expected "
                    f"[*B, {3 * self.num_cubes}]: the positions of "
                    f"{self.num_cubes} cubes"
                )
        return fetch_push_reward(
            achieved, desired, info, threshold=self.distance_threshold
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Renders the current state.

        A goal is a translucent ball in the colour of its cube.

        Returns:
            NDArray: an RGB frame ``[height, width, 3]``; ``None`` without a render
            mode.

        Raises:
            RenderingUnavailable: there is no OpenGL context.
        """
        if self.render_mode is None:
            return None
        self._check_ready()
        return self._frame(self._simulator)

    def render_states(
        self, states: ArrayLike, goals: ArrayLike | None = None
    ) -> NDArray[np.uint8]:
        """Renders recorded states; the current episode is not changed.

        Args:
            states (array): ``[R, S]``, from :meth:`simulator_state`.
            goals (array, optional): ``[3 n]`` or ``[R, 3 n]``. Defaults to the goal of
                the current episode.

        Returns:
            NDArray: RGB frames ``[R, height, width, 3]``.

        Raises:
            RenderingUnavailable: there is no OpenGL context.
        """
        vectors = np.atleast_2d(np.asarray(states, dtype=np.float64))
        shown = np.broadcast_to(
            self.goal if goals is None else np.asarray(goals, dtype=np.float64),
            (len(vectors), 3 * self.num_cubes),
        )
        frames = np.empty(
            (len(vectors), self.render_size[1], self.render_size[0], 3), dtype=np.uint8
        )
        for frame, vector, goal in zip(frames, vectors, shown, strict=True):
            self._other_simulator.restore(vector)
            self._other_simulator.show_goals(goal.reshape(-1, 3))
            frame[:] = self._frame(self._other_simulator)
        return frames

    def close(self) -> None:
        """Frees the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    # Snapshots.

    def simulator_state(self) -> NDArray[np.float64]:
        """Returns everything that the simulator's next steps depend on, as one vector.

        These are positions, velocities and the warm start of the solver. After
        :meth:`set_simulator_state`, the same actions give the same states, bit for bit.

        Returns:
            NDArray: ``[S]``, float64; ``S`` is 83 for two cubes.
        """
        self._check_ready()
        return self._simulator.state()

    def set_simulator_state(
        self, state: ArrayLike, *, goal: ArrayLike | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Restores a recorded simulator state within the current episode.

        Args:
            state (array): ``[S]``, from :meth:`simulator_state` of an environment with
                the same number of cubes.

        Keyword Args:
            goal (array, optional): the desired goal ``[3 n]``. Defaults to the current
                one.

        Returns:
            dict: the observation of the state.

        Raises:
            ValueError: the state or the goal has another shape or non-finite values.
        """
        if goal is not None:
            given = np.asarray(goal, dtype=np.float64)
            if given.shape != (3 * self.num_cubes,) or not np.isfinite(given).all():
                raise ValueError(
                    f"goal has shape {given.shape}, expected ({3 * self.num_cubes},) "
                    "and finite values"
                )
        self._simulator.restore(state)
        self._set_goal(self._goal if goal is None else given.reshape(-1, 3))
        self._ready = True
        return self._observe()

    def get_state(self) -> FetchPushState:
        """Returns a snapshot of the episode; :meth:`set_state` restores it exactly.

        Returns:
            FetchPushState: the snapshot.
        """
        return FetchPushState(
            simulator=self.simulator_state(),
            goal=self.goal,
            steps=self._steps,
            generator=dict(self.np_random.bit_generator.state),
        )

    def set_state(self, state: FetchPushState) -> None:
        """Restores a snapshot exactly.

        Args:
            state (FetchPushState): from :meth:`get_state` of an environment with the
                same number of cubes.
        """
        self.set_simulator_state(state.simulator, goal=state.goal)
        self._steps = state.steps
        self.np_random.bit_generator.state = state.generator

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next observation after each of several actions from one state.

        The current episode is not changed. To find what an action influences, use
        :class:`~torchrl_caiac.envs.FetchPushTruth`, which compares positions.

        Args:
            state (array): ``[S]``, from :meth:`simulator_state`.
            actions (array): ``[K, 4]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            NDArray: observations ``[K, 10 + 12 n]``, in double precision.

        Raises:
            ValueError: the state or the actions have a wrong shape or non-finite
                values, or ``horizon`` is less than 1.

        Examples:
            >>> import numpy as np
            >>> from torchrl_caiac.envs import FetchPushCubes
            >>> env = FetchPushCubes(2)
            >>> _ = env.reset(seed=0)
            >>> env.outcomes(env.simulator_state(), np.zeros((3, 4))).shape
            (3, 34)
        """
        return self._other_simulator.outcomes(state, actions, horizon=horizon)

    # Internals.

    @functools.cached_property
    def _other_simulator(self) -> FetchPushSimulator:
        """A simulator for states that are not those of the episode."""
        return FetchPushSimulator(self.num_cubes, self.cube_friction)

    def _given(
        self, name: str, options: dict[str, Any], *, height_tolerance: float
    ) -> NDArray[np.float64] | None:
        positions = options.get(name)
        if positions is None:
            return None
        return check_positions(
            name, positions, self.num_cubes, height_tolerance=height_tolerance
        )

    def _frame(self, simulator: FetchPushSimulator) -> NDArray[np.uint8]:
        if self._renderer is None:
            self._renderer = OffscreenRenderer(
                self.model, *self.render_size, camera=_CAMERA
            )
        # The goals may have moved.
        mujoco.mj_kinematics(self.model, simulator.data)
        mujoco.mj_camlight(self.model, simulator.data)
        return self._renderer.frame(simulator.data)

    def _set_goal(self, goals: NDArray[np.float64]) -> None:
        self._goal = np.array(goals, dtype=np.float64)
        self._simulator.show_goals(self._goal)

    def _check_ready(self) -> None:
        if not self._ready:
            raise RuntimeError("the environment has no episode: call reset() first")

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        observation = self._simulator.observation().astype(np.float32)
        cubes = observation[GRIPPER_WIDTH:].reshape(-1, CUBE_WIDTH)
        return {
            "observation": observation,
            "achieved_goal": cubes[:, :3].flatten(),
            "desired_goal": self._goal.flatten().astype(np.float32),
        }

    def _info(self, observation: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
        distances = fetch_push_distances(
            observation["achieved_goal"], observation["desired_goal"]
        )
        reached = distances < self.distance_threshold
        success = reached.all()
        return {
            "success": success,
            "cube_success": reached,
            "is_success": np.float32(success),
        }
