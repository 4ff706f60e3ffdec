"""The goal-conditioned Franka-Kitchen of the paper (sections 4.1 and A.6.1)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium
import mujoco
import numpy as np
from gymnasium_robotics.envs.franka_kitchen.franka_env import DEFAULT_CAMERA_CONFIG

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.kitchen import starts
from torchrl_caiac.envs.kitchen.simulator import (
    HANDLES,
    KitchenRobot,
    KitchenState,
    as_states,
    default_state,
    handle_positions,
)
from torchrl_caiac.envs.kitchen.tasks import (
    KITCHEN_LAYOUT,
    KITCHEN_TASKS,
    OBJECTS,
    STATE_COLUMNS,
    SUCCESS_DISTANCE,
    check_task,
    done_tasks,
    kitchen_distances,
    kitchen_reward,
    solved,
)
from torchrl_caiac.envs.kitchen.truth import KitchenTruth
from torchrl_caiac.envs.rendering import OffscreenRenderer

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["KitchenEnv"]

_EPISODE_STEPS = 280
_STATE_INDEX = np.array(STATE_COLUMNS)


class KitchenEnv(gymnasium.Env[dict[str, Any], Any]):
    """Franka-Kitchen with one task per episode and every object in the goal (A.6.1).

    The dynamics are those of gymnasium-robotics' ``FrankaKitchen-v1``, noise included.
    The 30-column state contains the joint positions of the robot (0-8) and of all
    objects (9-29, which are the goal's 21 columns); :attr:`layout` names them. The goal
    of an episode is the start configuration of every object except the task's, which
    gets its solved configuration. The episode succeeds when *all* objects are within
    0.3 of it.

    Observations are float32 copies: transitions are stored and learned from in float32,
    and its rounding (1e-7) is far below the noise of the observations (5e-5).

    ``reset`` takes ``options`` with the keys ``"task"``, ``"start"``, ``"open"`` and
    ``"goal"``, for one episode. ``reset`` and ``step`` return in ``info``:

    - ``"success"``: all objects are at their goals;
    - ``"task_success"``: the task's own criterion, regardless of the other objects;
    - ``"wrong_tasks"``: bool ``[7]``, other tasks that became done in this episode
      (they were not done at its start);
    - ``"task"``: the index of the task in :data:`KITCHEN_TASKS`.

    Args:
        task (str, optional): one of :data:`KITCHEN_TASKS`, or ``None`` to draw one in
            each episode. Defaults to ``"microwave"``.

    Keyword Args:
        start (str, ArrayLike or Mapping): where episodes start: ``"default"`` (all
            closed), ``"random"`` (see :meth:`random_start`), a state ``[30]``, or a
            mapping of entity names to their values, which replace those of the default
            start. Defaults to ``"default"``.
        open (str or iterable of str): entities that start in their solved
            configuration, for example ``("slide_cabinet",)``; applied after ``start``.
            Defaults to none.
        goal (str or ArrayLike): ``"start"`` (the objects stay as they started, the
            paper's choice), ``"default"`` (they get their default configuration) or a
            goal ``[21]``. Defaults to ``"start"``.
        robot_noise_ratio (float): scale of the noise on the robot's joints. The next
            action starts from the noisy positions, so the noise is part of the
            dynamics. Defaults to 0.01.
        object_noise_ratio (float): scale of the noise on the objects.
            Defaults to 0.0005.
        max_episode_steps (int): number of steps after which an episode is truncated.
            Defaults to 280.
        terminate_on_success (bool): whether an episode ends when all objects are at
            their goals. Defaults to ``True``.
        threshold (float): distance below which an object is at its goal.
            Defaults to 0.3.
        render_mode (str, optional): ``None`` or ``"rgb_array"``. Defaults to ``None``.
        render_size (tuple of int): width and height of rendered frames, in pixels.
            Defaults to ``(320, 240)``.

    Raises:
        ValueError: an argument has a value that is not allowed.

    Examples:
        >>> import numpy as np
        >>> env = KitchenEnv("microwave")
        >>> observation, info = env.reset(seed=0, options={"open": ["slide_cabinet"]})
        >>> observation["observation"].shape, observation["desired_goal"].shape
        ((30,), (21,))
        >>> observation, reward, terminated, truncated, info = env.step(np.zeros(9))
        >>> float(reward), bool(info["success"])
        (0.0, False)
        >>> env.layout.names[:3]
        ('robot', 'bottom_right_burner', 'bottom_burner')
    """

    # gymnasium declares it without ClassVar, which mypy reports
    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 12,
    }
    #: The entities of the state and their goal columns.
    layout: ClassVar[EntityLayout] = KITCHEN_LAYOUT
    #: Sites of the model where the robot touches and where each object is touched.
    handles: ClassVar[dict[str, str]] = HANDLES
    default_state = staticmethod(default_state)
    solved = staticmethod(solved)

    def __init__(
        self,
        task: str | None = "microwave",
        *,
        start: Literal["default", "random"] | ArrayLike | Mapping[str, Any] = "default",
        open: str | Iterable[str] = (),
        goal: Literal["start", "default"] | ArrayLike = "start",
        robot_noise_ratio: float = 0.01,
        object_noise_ratio: float = 0.0005,
        max_episode_steps: int = _EPISODE_STEPS,
        terminate_on_success: bool = True,
        threshold: float = SUCCESS_DISTANCE,
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
        for name, ratio in (
            ("robot_noise_ratio", robot_noise_ratio),
            ("object_noise_ratio", object_noise_ratio),
        ):
            if not (np.isfinite(ratio) and ratio >= 0):
                raise ValueError(f"{name} is {ratio}, expected a finite number >= 0")
        self.robot_env = KitchenRobot(robot_noise_ratio)
        self.object_noise_ratio = object_noise_ratio
        self.max_episode_steps = max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.threshold = threshold
        self.render_mode = render_mode
        self.render_size = render_size
        self._renderer: OffscreenRenderer | None = None
        self._truth: KitchenTruth | None = None

        self._task_option = None if task is None else check_task(task)
        self._start_option = start
        self._open_option = starts.as_names(open)
        self._goal_option = goal
        # Computed here so that a wrong argument is reported here.
        if not isinstance(start, str) or start != "random":
            self.start_state(start, open=self._open_option)

        self.task = KITCHEN_TASKS[0] if task is None else task
        self._goal = np.zeros(21)
        self._start = default_state()
        self._steps = 0
        self._wrong = np.zeros(len(KITCHEN_TASKS), dtype=np.bool_)
        self._full = np.zeros(59)
        self._ready = False

        def box(width: int) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)

        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (9,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "observation": box(30),
                "achieved_goal": box(21),
                "desired_goal": box(21),
            }
        )

    # The simulator.

    @property
    def model(self) -> Any:
        """The MuJoCo model, this environment's own copy."""
        return self.robot_env.model

    @property
    def data(self) -> Any:
        """The MuJoCo data; its arrays are views of simulator memory."""
        return self.robot_env.data

    @property
    def dt(self) -> float:
        """Duration of an environment step in seconds."""
        return float(self.robot_env.dt)

    @property
    def qpos(self) -> NDArray[np.float64]:
        """The state ``[30]`` without noise, a copy."""
        return self.data.qpos.copy()

    @property
    def qvel(self) -> NDArray[np.float64]:
        """The velocities ``[29]`` without noise, a copy."""
        return self.data.qvel.copy()

    @property
    def full_observation(self) -> NDArray[np.float64]:
        """The last noisy observation in ``FrankaKitchen-v1``'s 59 columns, a copy."""
        return self._full.copy()

    @property
    def goal(self) -> NDArray[np.float64]:
        """The desired goal ``[21]`` of this episode, a copy."""
        return self._goal.copy()

    # Starts.

    def start_state(
        self,
        start: Any = "default",
        *,
        open: str | Iterable[str] = (),
        task: str | None = None,
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.float64]:
        """Returns the simulator positions that a start describes.

        Args:
            start (str, ArrayLike or Mapping): see the class. Defaults to ``"default"``.

        Keyword Args:
            open (str or iterable of str): entities in their solved configuration,
                applied after ``start``. Defaults to none.
            task (str, optional): the task whose object a random start leaves unchanged.
            rng (numpy.random.Generator, optional): the generator of random starts.
                Defaults to the environment's own.

        Returns:
            numpy.ndarray: state ``[30]``, float64.
        """
        rng = self.np_random if rng is None else rng
        return starts.start_state(self.model, start, open=open, task=task, rng=rng)

    def random_start(
        self, task: str, *, p: float = 0.5, rng: np.random.Generator | None = None
    ) -> NDArray[np.float64]:
        """Draws a start in which objects other than the task's are randomized (A.6.1).

        See :func:`torchrl_caiac.envs.kitchen.starts.random_start` for the ranges.

        Args:
            task (str): the task whose object keeps its default configuration.

        Keyword Args:
            p (float): probability that an object is randomized. Defaults to 0.5.
            rng (numpy.random.Generator, optional): the generator. Defaults to the
                environment's own.

        Returns:
            numpy.ndarray: state ``[30]``, float64.
        """
        rng = self.np_random if rng is None else rng
        return starts.random_start(self.model, task, p=p, rng=rng)

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Starts an episode.

        Keyword Args:
            seed (int, optional): seed of tasks, starts and noise; equal seeds give
                equal episodes.
            options (dict, optional): ``"task"``, ``"start"``, ``"open"`` and ``"goal"``
                of this episode (see the class). Defaults to the constructor's.

        Returns:
            tuple: observation dictionary and info.
        """
        options = dict(options or {})
        unknown = sorted(set(options) - {"task", "start", "open", "goal"})
        if unknown:
            raise ValueError(
                f"reset options contain {unknown}, expected only 'task', 'start', "
                "'open' and 'goal'"
            )
        super().reset(seed=seed)
        if seed is not None:
            # The noise has the same random stream as upstream; starts and tasks have a
            # stream far ahead of it.
            bits: Any = self.np_random.bit_generator
            self.np_random = np.random.Generator(bits.jumped())
        task = options.get("task", self._task_option)
        self.task = (
            str(self.np_random.choice(KITCHEN_TASKS))
            if task is None
            else check_task(task)
        )
        self._start = self.start_state(
            options.get("start", self._start_option),
            open=options.get("open", self._open_option),
            task=self.task,
        )
        self._goal = starts.episode_goal(
            options.get("goal", self._goal_option), start=self._start, task=self.task
        )
        self._steps = 0
        self._wrong = np.zeros(len(KITCHEN_TASKS), dtype=np.bool_)
        robot_observation = self.robot_env.restart(self._start, seed=seed)
        self._ready = True
        observation = self._observe(robot_observation)
        return observation, self._info(observation)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Moves the joints for 0.08 s.

        Args:
            action (ArrayLike): joint velocities ``[9]`` in [-1, 1] (times 2 rad/s),
                clipped.

        Returns:
            tuple: observation, reward (1 on success, else 0), terminated, truncated,
            info.

        Raises:
            RuntimeError: no episode has been started, or the simulation diverged.
            ValueError: the action has the wrong shape or is not finite.
        """
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (9,):
            raise ValueError(f"action has shape {values.shape}, expected (9,)")
        if not np.isfinite(values).all():
            raise ValueError(
                f"action has non-finite values: {values.tolist()}; check the input of "
                "the policy"
            )
        self._check_ready()
        robot_observation = self.robot_env.step(values)[0]
        if self.robot_env.diverged:
            self._ready = False
            raise RuntimeError(
                "the simulation diverged: call reset() and discard this episode"
            )
        self._steps += 1
        observation = self._observe(robot_observation)
        info = self._info(observation)
        reward = float(
            self.compute_reward(
                observation["achieved_goal"], observation["desired_goal"]
            )
        )
        terminated = bool(info["success"]) and self.terminate_on_success
        truncated = self._steps >= self.max_episode_steps
        return observation, reward, terminated, truncated, info

    def compute_reward(self, achieved: Any, desired: Any, info: Any = None) -> Any:
        """Returns the reward of a batch of goals; see :func:`kitchen_reward`.

        Args:
            achieved (torch.Tensor or numpy.ndarray): achieved goals ``[*B, 21]``.
            desired (torch.Tensor or numpy.ndarray): desired goals ``[*B, 21]``.
            info (Any, optional): ignored.

        Returns:
            torch.Tensor or numpy.ndarray: ``[*B]`` float32: 1 where all objects are at
            their goals, else 0.
        """
        return kitchen_reward(achieved, desired, info, threshold=self.threshold)

    def render(self) -> NDArray[np.uint8] | None:
        """Renders the current state without shadows and reflections, which are slow.

        Returns:
            numpy.ndarray: RGB frame ``[height, width, 3]``; ``None`` without a render
            mode.

        Raises:
            RenderingUnavailable: no OpenGL context could be created.
        """
        if self.render_mode is None:
            return None
        return self._get_renderer().frame(self.data)

    def close(self) -> None:
        """Frees the OpenGL context, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.robot_env.close()

    # States other than the current one.

    def render_states(self, states: ArrayLike) -> NDArray[np.uint8]:
        """Renders states and leaves the running episode unchanged.

        Args:
            states (ArrayLike): ``[S, 30]``, for example of a demonstration or of
                counterfactual transitions.

        Returns:
            numpy.ndarray: RGB frames ``[S, height, width, 3]``.

        Raises:
            RenderingUnavailable: no OpenGL context could be created.
        """
        states = as_states(states)
        renderer = self._get_renderer()
        scratch = mujoco.MjData(self.model)
        frames = np.empty(
            (len(states), self.render_size[1], self.render_size[0], 3), dtype=np.uint8
        )
        for frame, state in zip(frames, states, strict=True):
            scratch.qpos[:] = state
            mujoco.mj_forward(self.model, scratch)
            frame[:] = renderer.frame(scratch)
        return frames

    def handle_positions(self, states: ArrayLike) -> NDArray[np.float64]:
        """Returns where :attr:`handles` are and leaves the running episode unchanged.

        Args:
            states (ArrayLike): ``[S, 30]``.

        Returns:
            numpy.ndarray: positions ``[S, N, 3]`` in metres, entities in the order of
            the layout.

        Examples:
            >>> env = KitchenEnv()
            >>> env.handle_positions(env.default_state()).shape
            (1, 10, 3)
        """
        return handle_positions(self.model, states)

    def outcomes(
        self, state: ArrayLike | KitchenState, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next states without noise; see :meth:`KitchenTruth.outcomes`.

        The running episode is left unchanged.

        Args:
            state (ArrayLike or KitchenState): positions ``[30]``, positions and
                velocities ``[59]``, or a snapshot of :meth:`get_state`.
            actions (ArrayLike): ``[K, 9]`` in [-1, 1].

        Keyword Args:
            horizon (int): number of steps for which each action is held. Defaults to 1.

        Returns:
            numpy.ndarray: states ``[K, 30]``, float64.

        Examples:
            >>> import numpy as np
            >>> env = KitchenEnv()
            >>> env.outcomes(env.default_state(), np.zeros((2, 9))).shape
            (2, 30)
        """
        if self._truth is None:
            self._truth = KitchenTruth(self.robot_env)
        return self._truth.outcomes(state, actions, horizon=horizon)

    # Snapshots.

    def get_state(self) -> KitchenState:
        """Returns a snapshot.

        After :meth:`set_state`, the same actions lead to the same episode.

        Returns:
            KitchenState: the snapshot.

        Raises:
            RuntimeError: no episode has been started.
        """
        self._check_ready()
        return KitchenState(
            physics=self.robot_env.read_physics(),
            last_robot_qpos=np.array(self.robot_env._last_robot_qpos),
            full_observation=self._full.copy(),
            goal=self._goal.copy(),
            start=self._start.copy(),
            task=self.task,
            steps=self._steps,
            wrong_tasks=self._wrong.copy(),
            generators=(
                dict(self.robot_env.np_random.bit_generator.state),
                dict(self.np_random.bit_generator.state),
            ),
        )

    def set_state(self, state: KitchenState) -> None:
        """Restores a snapshot of :meth:`get_state` exactly.

        Args:
            state (KitchenState): the snapshot, of this or of another environment.
        """
        self.robot_env.write_physics(state.physics)
        self.robot_env._last_robot_qpos = state.last_robot_qpos.copy()
        self._full = state.full_observation.copy()
        self._goal = state.goal.copy()
        self._start = state.start.copy()
        self.task = state.task
        self._steps = state.steps
        self._wrong = state.wrong_tasks.copy()
        self.robot_env.np_random.bit_generator.state = state.generators[0]
        self.np_random.bit_generator.state = state.generators[1]
        self._ready = True

    def set_simulator(
        self, qpos: ArrayLike, qvel: ArrayLike | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Puts the simulator into a recorded state within the current episode.

        Unlike a snapshot, positions and velocities lack the solver's warm start: what
        follows agrees with the recording closely, not exactly.

        Args:
            qpos (ArrayLike): positions ``[30]``.
            qvel (ArrayLike, optional): velocities ``[29]``. Defaults to zeros.

        Returns:
            dict: the observation of the state.

        Raises:
            ValueError: a shape is wrong or a value is not finite.
        """
        position = self.start_state(np.asarray(qpos))
        velocity = np.zeros(self.model.nv) if qvel is None else np.asarray(qvel)
        if velocity.shape != (self.model.nv,) or not np.isfinite(velocity).all():
            raise ValueError(
                f"qvel has shape {velocity.shape}, expected ({self.model.nv},) and "
                "finite values"
            )
        robot_observation = self.robot_env.place(position, velocity)
        self._ready = True
        return self._observe(robot_observation)

    def _check_ready(self) -> None:
        if not self._ready:
            raise RuntimeError("no episode has been started: call reset() first")

    def _observe(
        self, robot_observation: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float32]]:
        self._full = self.robot_env.full_observation(
            robot_observation, self.object_noise_ratio
        )
        state = self._full[_STATE_INDEX].astype(np.float32)
        return {
            "observation": state,
            "achieved_goal": state[OBJECTS].copy(),
            "desired_goal": self._goal.astype(np.float32),
        }

    def _info(self, observation: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
        done = done_tasks(observation["observation"], threshold=self.threshold)
        index = KITCHEN_TASKS.index(self.task)
        wrong = done & ~done_tasks(self._start, threshold=self.threshold)
        wrong[index] = False
        self._wrong = self._wrong | wrong
        distances = kitchen_distances(
            observation["achieved_goal"], observation["desired_goal"]
        )
        return {
            "success": np.bool_((distances < self.threshold).all()),
            "task_success": np.bool_(done[index]),
            "wrong_tasks": self._wrong.copy(),
            "task": np.int64(index),
        }

    def _get_renderer(self) -> OffscreenRenderer:
        if self._renderer is None:
            self._renderer = OffscreenRenderer(
                self.model, *self.render_size, camera=DEFAULT_CAMERA_CONFIG
            )
        return self._renderer
