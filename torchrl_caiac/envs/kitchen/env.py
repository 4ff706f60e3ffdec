"""The goal-conditioned Franka-Kitchen of the paper (section 4.1 and A.6.1)."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

# First: where mujoco cannot be imported, it says why.
from torchrl_caiac.envs.rendering import OffscreenRenderer, RenderingUnavailable

# isort: split
import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import torch
from gymnasium_robotics.envs.franka_kitchen.franka_env import (
    DEFAULT_CAMERA_CONFIG,
    FrankaRobot,
)
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    OBS_ELEMENT_GOALS,
    OBS_ELEMENT_INDICES,
)
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    KitchenEnv as _UpstreamKitchen,
)

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.goal_env import make_goal_env

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from torchrl.envs import EnvBase

__all__ = [
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "KitchenEnv",
    "KitchenState",
    "RenderingUnavailable",
    "kitchen_distances",
    "kitchen_reward",
    "make_kitchen_env",
    "register_kitchen",
]

KITCHEN_ENV_ID = "torchrl_caiac/FrankaKitchen-v0"

#: The tasks, in the order of ``info["task"]`` and ``info["wrong_tasks"]``.
KITCHEN_TASKS: tuple[str, ...] = (
    "microwave",
    "kettle",
    "slide_cabinet",
    "hinge_cabinet",
    "light_switch",
    "bottom_burner",
    "top_burner",
)

_ROBOT = slice(0, 9)
_OBJECTS = slice(9, 30)
_SUCCESS_DISTANCE = 0.3
_EPISODE_STEPS = 280
# A burner's flame is geared to its knob, the lamp to its switch (equality constraints
# of the model): a state that sets one without the other jumps on the first step.
_KNOB_RATIO = 174.0
_SWITCH_RATIO = 14.0
# Overlap of two bodies, in metres, above which a random start is drawn again. The
# kettle of the default start stands 1.5 mm deep in the hob.
_MAX_OVERLAP = 4e-3
_MAX_DRAWS = 100
# Where a random start may put the kettle, in metres: the rectangle between the four
# burners, which the microwave on its left does not reach into.
_KETTLE_X = (-0.25, 0.22)
_KETTLE_Y = (0.34, 0.78)
# Columns of the simulator's 59 (positions, velocities of the robot; positions,
# velocities of the objects) that make the 30-column state.
_STATE_COLUMNS = np.r_[0:9, 18:39]

_LAYOUT_COLUMNS: dict[str, range] = {
    "robot": range(0, 9),
    "bottom_right_burner": range(9, 11),
    "bottom_burner": range(11, 13),
    "top_right_burner": range(13, 15),
    "top_burner": range(15, 17),
    "light_switch": range(17, 19),
    "slide_cabinet": range(19, 20),
    "hinge_cabinet": range(20, 22),
    "microwave": range(22, 23),
    "kettle": range(23, 30),
}
_OBJECT_NAMES = tuple(name for name in _LAYOUT_COLUMNS if name != "robot")
_TASK_COLUMNS = {
    task: np.asarray(OBS_ELEMENT_INDICES[task.replace("_", " ")])
    for task in KITCHEN_TASKS
}
_TASK_GOALS = {
    task: np.asarray(OBS_ELEMENT_GOALS[task.replace("_", " ")], dtype=np.float64)
    for task in KITCHEN_TASKS
}
# [21, 9]: 1 where a goal column belongs to an object.
_MEMBERSHIP = np.zeros((21, len(_OBJECT_NAMES)), dtype=np.float64)
for _i, _name in enumerate(_OBJECT_NAMES):
    _MEMBERSHIP[[_c - 9 for _c in _LAYOUT_COLUMNS[_name]], _i] = 1.0
# Each object's configuration with its task done, coupled joints in step. The two right
# burners have no task of their own and turn like the left ones.
_SOLVED: dict[str, NDArray[np.float64]] = {
    **_TASK_GOALS,
    "bottom_burner": np.array([-0.88, -0.88 / _KNOB_RATIO]),
    "top_burner": np.array([-0.92, -0.92 / _KNOB_RATIO]),
    "bottom_right_burner": np.array([-0.88, -0.88 / _KNOB_RATIO]),
    "top_right_burner": np.array([-0.92, -0.92 / _KNOB_RATIO]),
    "light_switch": np.array([-0.69, -0.69 / _SWITCH_RATIO]),
}


def kitchen_distances(achieved: Any, desired: Any) -> Any:
    """Return each object's distance to its goal configuration.

    Args:
        achieved: object configurations ``[*B, 21]`` (numpy or torch).
        desired: goal configurations ``[*B, 21]`` (numpy or torch, as ``achieved``).

    Returns:
        ``[*B, 9]``, in the order of the layout without the robot: the Euclidean norm
        over an object's columns (metres, radians and quaternion entries alike, as in
        the original tasks).

    Example:
        >>> import numpy as np
        >>> achieved, desired = np.zeros((2, 21)), np.zeros(21)
        >>> desired[13] = -0.75  # the microwave
        >>> kitchen_distances(achieved, desired).max(-1)
        array([0.75, 0.75])
    """
    for name, value in (("achieved", achieved), ("desired", desired)):
        shape = tuple(np.shape(value))
        if not shape or shape[-1] != 21:
            raise ValueError(
                f"{name} goal has shape {shape}, wanted [*B, 21]: columns 9 to 29 of "
                "the state"
            )
    if isinstance(achieved, torch.Tensor) or isinstance(desired, torch.Tensor):
        achieved = torch.as_tensor(achieved)
        difference = achieved - torch.as_tensor(desired, device=achieved.device)
        member = torch.as_tensor(
            _MEMBERSHIP, dtype=difference.dtype, device=difference.device
        )
        return (difference.square() @ member).sqrt()
    difference = np.asarray(achieved) - np.asarray(desired)
    return np.sqrt(np.square(difference) @ _MEMBERSHIP.astype(difference.dtype))


def kitchen_reward(
    achieved: Any,
    desired: Any,
    info: Any = None,
    *,
    threshold: float = _SUCCESS_DISTANCE,
) -> Any:
    """Return the sparse reward: 1 where every object is at its goal, else 0.

    Args:
        achieved: object configurations ``[*B, 21]`` (numpy or torch).
        desired: goal configurations ``[*B, 21]``.
        info: ignored; there because goal environments pass it.

    Keyword Args:
        threshold: distance below which an object is at its goal (A.6.1).

    Returns:
        ``[*B]`` float32, numpy or torch as the input.

    Example:
        >>> import torch
        >>> achieved = torch.zeros(2, 5, 21)
        >>> kitchen_reward(achieved, achieved).shape
        torch.Size([2, 5])
    """
    reached = (kitchen_distances(achieved, desired) < threshold).all(-1)
    if isinstance(reached, torch.Tensor):
        return reached.to(torch.float32)
    return np.asarray(reached).astype(np.float32)


@functools.cache
def _upstream() -> tuple[Any, NDArray[np.float64]]:
    """Compile the model once a process (0.3 s); return it with the default start."""
    gymnasium.register_envs(gymnasium_robotics)
    kitchen = _UpstreamKitchen()
    return kitchen.model, kitchen.robot_env.init_qpos.copy()


class _Robot(FrankaRobot):
    """Gymnasium-robotics' robot with the same dynamics and noise, stepped faster."""

    def _initialize_simulation(self) -> tuple[Any, Any]:
        # A copy: one environment's changes to its model stay its own.
        model = mujoco.MjModel.__copy__(_upstream()[0])
        return model, mujoco.MjData(model)

    def _step_mujoco_simulation(self, ctrl: NDArray[np.float64], n_frames: int) -> None:
        # Upstream adds mj_rnePostConstraint, whose forces nobody reads here.
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, nstep=n_frames)

    def _get_obs(self) -> NDArray[np.float64]:
        # Upstream looks 18 joints up by name; they are the first nine of each.
        low_high = {"low": -1.0, "high": 1.0, "size": 9}
        positions = self.data.qpos[:9] + (
            self.robot_noise_ratio
            * self.robot_pos_noise_amp[:9]
            * self.np_random.uniform(**low_high)
        )
        velocities = self.data.qvel[:9] + (
            self.robot_noise_ratio
            * self.robot_vel_noise_amp[:9]
            * self.np_random.uniform(**low_high)
        )
        self._last_robot_qpos = positions
        return np.concatenate((positions, velocities))


@dataclass(frozen=True)
class KitchenState:
    """Everything an episode depends on: an exact, picklable snapshot.

    Attributes:
        physics: MuJoCo's integration state (positions, velocities, controls, warm
            start).
        last_robot_qpos: the noisy joint positions ``[9]`` that the next action starts
            from.
        full_observation: the last 59-column noisy observation.
        goal: the desired goal ``[21]``.
        start: the simulator positions ``[30]`` that the episode started from.
        task: the task's name.
        steps: environment steps taken.
        wrong_tasks: which other tasks were done so far ``[7]``.
        generators: states of the random generators (noise; starts and tasks).
    """

    physics: NDArray[np.float64]
    last_robot_qpos: NDArray[np.float64]
    full_observation: NDArray[np.float64]
    goal: NDArray[np.float64]
    start: NDArray[np.float64]
    task: str
    steps: int
    wrong_tasks: NDArray[np.bool_]
    generators: tuple[dict[str, Any], dict[str, Any]] = field(repr=False)


class KitchenEnv(gymnasium.Env[dict[str, Any], Any]):
    """Franka-Kitchen with one task an episode and every object in the goal (A.6.1).

    The dynamics are those of gymnasium-robotics' ``FrankaKitchen-v1``, noise included.
    The 30-column state holds joint positions of the robot (0-8) and of all objects
    (9-29, which are the goal's 21 columns); :attr:`layout` names them. The goal of an
    episode is the start configuration of every object except the task's, which gets
    its solved configuration. The episode succeeds when *all* objects are within 0.3
    of it.

    Observations are float32 copies: what is stored and fed to networks is float32
    anyway, and its rounding (1e-7) is far below the noise of the observations (5e-5).

    Args:
        task: one of :data:`KITCHEN_TASKS`, or ``None`` to draw one each episode.

    Keyword Args:
        start: where episodes start: ``"default"`` (all closed), ``"random"`` (see
            :meth:`random_start`), a state ``[30]``, or a mapping of entity names to
            their values, laid over the default start.
        open: entities that start in their solved configuration (say
            ``("slide_cabinet",)``), laid over ``start``.
        goal: ``"start"`` (the objects stay as they started, the paper's choice),
            ``"default"`` (they get their default configuration) or a goal ``[21]``.
        robot_noise_ratio: scale of the noise on the robot's joints. The next action
            starts from the noisy positions, so it is part of the dynamics.
        object_noise_ratio: scale of the noise on the objects.
        max_episode_steps: steps after which an episode is truncated.
        terminate_on_success: end the episode when all objects are at their goals.
        threshold: distance below which an object is at its goal.
        render_mode: ``None`` or ``"rgb_array"``.
        render_size: width and height of rendered frames, in pixels.

    ``reset`` takes ``options`` with the keys ``"task"``, ``"start"``, ``"open"`` and
    ``"goal"``, for one episode. ``reset`` and ``step`` return in ``info``:

    - ``"success"``: all objects at their goals;
    - ``"task_success"``: the task's own criterion, whatever happened to the others;
    - ``"wrong_tasks"``: bool ``[7]``, tasks that were not asked for and that became
      done in this episode (they were not at its start);
    - ``"task"``: the task's place in :data:`KITCHEN_TASKS`.

    Example:
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

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 12,
    }
    #: The entities of the state and their goal columns.
    layout: ClassVar[EntityLayout] = EntityLayout(
        _LAYOUT_COLUMNS,
        goal={name: [c - 9 for c in _LAYOUT_COLUMNS[name]] for name in _OBJECT_NAMES},
        achieved={name: _LAYOUT_COLUMNS[name] for name in _OBJECT_NAMES},
        fixed=("robot",),
    )
    tasks: ClassVar[tuple[str, ...]] = KITCHEN_TASKS
    #: Where the robot touches, and where each object is touched: sites of the model.
    handles: ClassVar[dict[str, str]] = {
        "robot": "end_effector",
        "bottom_right_burner": "knob1_site",
        "bottom_burner": "knob2_site",
        "top_right_burner": "knob3_site",
        "top_burner": "knob4_site",
        "light_switch": "light_site",
        "slide_cabinet": "slide_site",
        "hinge_cabinet": "hinge_site2",
        "microwave": "microhandle_site",
        "kettle": "kettle_site",
    }

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
        threshold: float = _SUCCESS_DISTANCE,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (320, 240),
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode is {render_mode!r}, wanted None or 'rgb_array'"
            )
        if max_episode_steps < 1:
            raise ValueError(
                f"max_episode_steps is {max_episode_steps}, wanted at least 1"
            )
        for name, ratio in (
            ("robot_noise_ratio", robot_noise_ratio),
            ("object_noise_ratio", object_noise_ratio),
        ):
            if not (np.isfinite(ratio) and ratio >= 0):
                raise ValueError(f"{name} is {ratio}, wanted a finite number >= 0")
        self.robot_env = _Robot(
            model_path="../assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml",
            robot_noise_ratio=robot_noise_ratio,
        )
        self.robot_env.init_qpos = self.default_state()
        self.robot_env.init_qvel = np.zeros(self.model.nv)
        self.object_noise_ratio = object_noise_ratio
        self.max_episode_steps = max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.threshold = threshold
        self.render_mode = render_mode
        self.render_size = render_size
        self._renderer: OffscreenRenderer | None = None
        self._scratch: Any = None

        self._task_option = None if task is None else self._check_task(task)
        self._start_option = start
        self._open_option: tuple[str, ...] = _names(open)
        self._goal_option = goal
        # Asked for now, so that a wrong argument is reported here.
        if not isinstance(start, str) or start != "random":
            self.start_state(start, open=self._open_option)

        self.task = KITCHEN_TASKS[0] if task is None else task
        self._goal = np.zeros(21)
        self._start = self.default_state()
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
        """The MuJoCo model (this environment's own copy)."""
        return self.robot_env.model

    @property
    def data(self) -> Any:
        """The MuJoCo data; its arrays are views of simulator memory."""
        return self.robot_env.data

    @property
    def dt(self) -> float:
        """Seconds of an environment step."""
        return float(self.robot_env.dt)

    @property
    def qpos(self) -> NDArray[np.float64]:
        """The noise-free state ``[30]``, a copy."""
        return self.data.qpos.copy()

    @property
    def qvel(self) -> NDArray[np.float64]:
        """The noise-free velocities ``[29]``, a copy."""
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

    @staticmethod
    def default_state() -> NDArray[np.float64]:
        """Return the default start ``[30]``: all closed, kettle bottom left."""
        return _upstream()[1].copy()

    @staticmethod
    def solved(entity: str) -> NDArray[np.float64]:
        """Return the configuration of an entity with its task done.

        Args:
            entity: name of an entity other than the robot.

        Returns:
            the values of the entity's state columns, coupled joints in step.

        Example:
            >>> KitchenEnv.solved("slide_cabinet")
            array([0.37])
        """
        if entity not in _SOLVED:
            raise ValueError(
                f"entity {entity!r} has no solved configuration, wanted one of "
                f"{sorted(_SOLVED)}"
            )
        return _SOLVED[entity].copy()

    def start_state(
        self,
        start: Any = "default",
        *,
        open: str | Iterable[str] = (),
        task: str | None = None,
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.float64]:
        """Return the simulator positions that a start describes.

        Args:
            start: see the class.

        Keyword Args:
            open: entities in their solved configuration, laid over ``start``.
            task: the task that a random start leaves alone.
            rng: generator for a random start.

        Returns:
            state ``[30]``, float64.
        """
        state = self.default_state()
        if isinstance(start, str):
            if start == "random":
                if task is None:
                    raise ValueError(
                        "a random start needs the task whose object it leaves alone"
                    )
                state = self.random_start(task, rng=rng)
            elif start != "default":
                raise ValueError(
                    f"start is {start!r}, wanted 'default', 'random', a state [30] or "
                    "a mapping of entity names to values"
                )
        elif isinstance(start, Mapping):
            for name, value in start.items():
                columns = list(_LAYOUT_COLUMNS.get(name, ()))
                if not columns:
                    raise ValueError(
                        f"start names the entity {name!r}, wanted one of "
                        f"{self.layout.names}"
                    )
                values = np.atleast_1d(np.asarray(value, dtype=np.float64))
                if values.shape != (len(columns),):
                    raise ValueError(
                        f"start gives {name!r} values of shape {values.shape}, wanted "
                        f"({len(columns)},)"
                    )
                state[columns] = values
        else:
            state = np.asarray(start, dtype=np.float64).copy()
            if state.shape != (30,):
                raise ValueError(
                    f"start has shape {state.shape}, wanted (30,): 9 robot joints and "
                    "21 object joints"
                )
        for name in _names(open):
            state[list(_LAYOUT_COLUMNS.get(name, ()))] = self.solved(name)
        if not np.isfinite(state).all():
            raise ValueError(
                f"start holds non-finite values in columns "
                f"{np.flatnonzero(~np.isfinite(state)).tolist()}"
            )
        return state

    def random_start(
        self, task: str, *, p: float = 0.5, rng: np.random.Generator | None = None
    ) -> NDArray[np.float64]:
        """Draw an unseen kitchen: each object except the task's, with ``p`` (A.6.1).

        The paper does not state its ranges. Here doors, knobs and the switch are
        uniform between the default and the solved configuration, with coupled joints
        in step; the kettle stands upright anywhere between the four burners (x in
        [-0.25, 0.22], y in [0.34, 0.78] metres). A start in which bodies overlap by
        more than 4 mm is drawn again. The robot keeps its default posture.

        Args:
            task: the task whose object keeps its default configuration.

        Keyword Args:
            p: probability of an object being randomised.
            rng: the generator; the environment's own by default.

        Returns:
            state ``[30]``, float64.
        """
        self._check_task(task)
        if not 0 <= p <= 1:
            raise ValueError(f"p is {p}, wanted a probability in [0, 1]")
        rng = self.np_random if rng is None else rng
        scratch = mujoco.MjData(self.model)
        for _ in range(_MAX_DRAWS):
            state = self.default_state()
            for name in _OBJECT_NAMES:
                # Always drawn, so that one object's draw does not shift the next.
                chosen, fraction, x, y = rng.random(4)
                if name == task or chosen >= p:
                    continue
                columns = list(_LAYOUT_COLUMNS[name])
                if name == "kettle":
                    state[columns[:2]] = (
                        _KETTLE_X[0] + x * (_KETTLE_X[1] - _KETTLE_X[0]),
                        _KETTLE_Y[0] + y * (_KETTLE_Y[1] - _KETTLE_Y[0]),
                    )
                elif name == "hinge_cabinet":  # only its right door has a task
                    state[columns[1]] += fraction * (
                        self.solved(name)[1] - state[columns[1]]
                    )
                else:
                    state[columns] = fraction * self.solved(name)
            scratch.qpos[:] = state
            mujoco.mj_kinematics(self.model, scratch)
            mujoco.mj_collision(self.model, scratch)
            depth = scratch.contact.dist[: scratch.ncon]
            if depth.min(initial=0.0) > -_MAX_OVERLAP:
                return state
        raise RuntimeError(  # pragma: no cover (nearly every draw is free)
            f"no start without overlapping bodies in {_MAX_DRAWS} draws"
        )

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Start an episode.

        Keyword Args:
            seed: seeds tasks, starts and noise; equal seeds give equal episodes.
            options: ``"task"``, ``"start"``, ``"open"``, ``"goal"`` of this episode
                (see the class); those left out are the constructor's.

        Returns:
            observation dictionary and info.
        """
        options = dict(options or {})
        unknown = sorted(set(options) - {"task", "start", "open", "goal"})
        if unknown:
            raise ValueError(
                f"reset options hold {unknown}, wanted among 'task', 'start', 'open', "
                "'goal'"
            )
        super().reset(seed=seed)
        if seed is not None:
            # The noise gets the stream that upstream's gets; starts and tasks one far
            # ahead of it.
            bits: Any = self.np_random.bit_generator
            self.np_random = np.random.Generator(bits.jumped())
        task = options.get("task", self._task_option)
        self.task = (
            str(self.np_random.choice(KITCHEN_TASKS))
            if task is None
            else self._check_task(task)
        )
        self._start = self.start_state(
            options.get("start", self._start_option),
            open=options.get("open", self._open_option),
            task=self.task,
            rng=self.np_random,
        )
        self._goal = self._goal_of(options.get("goal", self._goal_option))
        self._steps = 0
        self._wrong = np.zeros(len(KITCHEN_TASKS), dtype=np.bool_)
        self.robot_env.init_qpos = self._start.copy()
        # Upstream's may be a view of the velocities that it means to reset.
        self.robot_env.init_qvel = np.zeros(self.model.nv)
        robot_observation, _ = self.robot_env.reset(seed=seed)
        self._ready = True
        observation = self._observe(robot_observation)
        return observation, self._info(observation)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Move the joints for 0.08 s.

        Args:
            action: joint velocities ``[9]`` in [-1, 1] (times 2 rad/s), clipped.

        Returns:
            observation, reward (1 on success, else 0), terminated, truncated, info.
        """
        action = self._check_action(action)
        self._check_ready()
        robot_observation = self.robot_env.step(action)[0]
        self._check_stable()
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
        """Return the reward of goals in a batch; see :func:`kitchen_reward`.

        Args:
            achieved: achieved goals ``[*B, 21]``, numpy or torch.
            desired: desired goals ``[*B, 21]``.
            info: ignored.

        Returns:
            ``[*B]`` float32: 1 where all objects are at their goals, else 0.
        """
        return kitchen_reward(achieved, desired, info, threshold=self.threshold)

    def render(self) -> NDArray[np.uint8] | None:
        """Render the present state, without shadows and reflections (they cost 10x).

        Returns:
            RGB frame ``[height, width, 3]``; ``None`` without a render mode.

        Raises:
            RenderingUnavailable: no OpenGL context could be made.
        """
        if self.render_mode is None:
            return None
        return self._get_renderer().frame(self.data)

    def render_states(self, states: ArrayLike) -> NDArray[np.uint8]:
        """Render states without touching the running episode.

        Args:
            states: ``[S, 30]``, say of a demonstration or of counterfactual rows.

        Returns:
            RGB frames ``[S, height, width, 3]``.

        Raises:
            RenderingUnavailable: no OpenGL context could be made.
        """
        states = _as_states(states)
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
        """Return where :attr:`handles` are, without touching the running episode.

        Args:
            states: ``[S, 30]``.

        Returns:
            positions ``[S, N, 3]`` in metres, entities in layout order.

        Example:
            >>> env = KitchenEnv()
            >>> places = env.handle_positions(env.default_state())
            >>> places.shape
            (1, 10, 3)
        """
        states = _as_states(states)
        sites = [self.model.site(self.handles[name]).id for name in self.layout.names]
        scratch = mujoco.MjData(self.model)
        positions = np.empty((len(states), len(sites), 3))
        for position, state in zip(positions, states, strict=True):
            scratch.qpos[:] = state
            mujoco.mj_kinematics(self.model, scratch)
            position[:] = scratch.site_xpos[sites]
        return positions

    def close(self) -> None:
        """Free the OpenGL context, if one was made."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.robot_env.close()

    # Snapshots.

    def get_state(self) -> KitchenState:
        """Return a snapshot; the same actions after :meth:`set_state` give the same."""
        self._check_ready()
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        physics = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, physics, spec)
        return KitchenState(
            physics=physics,
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
        """Restore a snapshot of :meth:`get_state`, exactly.

        Args:
            state: the snapshot, of this or of another kitchen.
        """
        self._set_physics(state.physics)
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
        """Put the simulator into a recorded state, within the present episode.

        Unlike a snapshot, positions and velocities do not hold the solver's warm
        start: what follows agrees with the recording closely, not exactly.

        Args:
            qpos: positions ``[30]``.
            qvel: velocities ``[29]``, zero by default.

        Returns:
            the observation there.
        """
        position = self.start_state(np.asarray(qpos))
        velocity = np.zeros(self.model.nv) if qvel is None else np.asarray(qvel)
        if velocity.shape != (self.model.nv,) or not np.isfinite(velocity).all():
            raise ValueError(
                f"qvel has shape {velocity.shape}, wanted ({self.model.nv},), finite"
            )
        mujoco.mj_resetData(self.model, self.data)
        self.robot_env.set_state(position, velocity)
        # Also renews the joint positions that the next action starts from.
        self._ready = True
        return self._observe(self.robot_env._get_obs())

    def outcomes(
        self, state: ArrayLike | KitchenState, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Return the next state after each of several actions from one state.

        Without noise, and without touching the running episode: what
        :func:`torchrl_caiac.influence.truth.true_influence` asks of a simulator.

        Args:
            state: positions ``[30]``, positions and velocities ``[59]``, or a snapshot
                of :meth:`get_state`.
            actions: ``[K, 9]`` in [-1, 1].

        Keyword Args:
            horizon: steps for which each action is held.

        Returns:
            states ``[K, 30]``.

        Example:
            >>> env = KitchenEnv()
            >>> env.outcomes(env.default_state(), np.zeros((2, 9))).shape
            (2, 30)
        """
        model, robot = self.model, self.robot_env
        width = model.nq + model.nv
        if isinstance(state, KitchenState):
            vector, physics = np.zeros(width), state.physics
        else:
            vector, physics = np.asarray(state, dtype=np.float64), None
            if vector.shape == (model.nq,):
                vector = np.concatenate((vector, np.zeros(model.nv)))
            if vector.shape != (width,):
                raise ValueError(
                    f"state has shape {vector.shape}, wanted ({model.nq},) positions "
                    f"or ({width},) positions and velocities"
                )
        actions = np.asarray(actions, dtype=np.float64)
        if actions.ndim != 2 or actions.shape[1] != 9:
            raise ValueError(f"actions have shape {actions.shape}, wanted [K, 9]")
        if not (np.isfinite(vector).all() and np.isfinite(actions).all()):
            raise ValueError("state and actions must be finite")
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, wanted at least 1")
        if self._scratch is None:
            self._scratch = mujoco.MjData(model)
        data, last_robot_qpos = self._scratch, robot.__dict__.get("_last_robot_qpos")
        states = np.empty((len(actions), model.nq))
        try:
            for next_state, action in zip(states, actions, strict=True):
                mujoco.mj_resetData(model, data)
                if physics is None:
                    data.qpos[:] = vector[: model.nq]
                    data.qvel[:] = vector[model.nq :]
                else:
                    mujoco.mj_setState(
                        model, data, physics, mujoco.mjtState.mjSTATE_INTEGRATION
                    )
                velocity = robot.act_mid + np.clip(action, -1, 1) * robot.act_rng
                for _ in range(horizon):
                    robot._last_robot_qpos = data.qpos[:9].copy()
                    data.ctrl[:] = robot._ctrl_position_limits(
                        robot._ctrl_velocity_limits(velocity)
                    )
                    mujoco.mj_step(model, data, nstep=robot.frame_skip)
                next_state[:] = data.qpos
        finally:
            robot._last_robot_qpos = last_robot_qpos
        return states

    def _set_physics(self, physics: NDArray[np.float64]) -> None:
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        size = mujoco.mj_stateSize(self.model, spec)
        if np.shape(physics) != (size,):
            raise ValueError(
                f"the snapshot's physics have shape {np.shape(physics)}, wanted "
                f"({size},): is it another environment's?"
            )
        mujoco.mj_setState(self.model, self.data, physics, spec)
        # mj_forward fills in what follows from the state (sites, contacts), and
        # overwrites the warm start, which the second call brings back.
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, spec)

    # Internals.

    @staticmethod
    def _check_task(task: str) -> str:
        if task not in KITCHEN_TASKS:
            raise ValueError(f"task is {task!r}, wanted one of {KITCHEN_TASKS}")
        return task

    def _check_action(self, action: ArrayLike) -> NDArray[np.float64]:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (9,):
            raise ValueError(f"action has shape {values.shape}, wanted (9,)")
        if not np.isfinite(values).all():
            raise ValueError(
                f"action holds non-finite values: {values.tolist()}; look at what the "
                "policy was given"
            )
        return values

    def _check_ready(self) -> None:
        if not self._ready:
            raise RuntimeError("the kitchen has no episode: call reset() first")

    def _check_stable(self) -> None:
        # MuJoCo resets a diverged simulation with a warning only: the transition would
        # be recorded as if the kitchen had jumped.
        warning = self.data.warning
        for kind in (
            mujoco.mjtWarning.mjWARN_BADQPOS,
            mujoco.mjtWarning.mjWARN_BADQVEL,
            mujoco.mjtWarning.mjWARN_BADQACC,
        ):
            if warning[kind].number:
                self._ready = False
                raise RuntimeError(
                    "the simulation diverged; call reset() and leave this episode out"
                )

    def _goal_of(self, option: Any) -> NDArray[np.float64]:
        if isinstance(option, str):
            if option not in ("start", "default"):
                raise ValueError(
                    f"goal is {option!r}, wanted 'start', 'default' or a goal [21]"
                )
            base = self._start if option == "start" else self.default_state()
            goal = base[_OBJECTS].copy()
            goal[_TASK_COLUMNS[self.task] - 9] = _TASK_GOALS[self.task]
            return goal
        goal = np.asarray(option, dtype=np.float64).copy()
        if goal.shape != (21,) or not np.isfinite(goal).all():
            raise ValueError(
                f"goal has shape {goal.shape}, wanted (21,) and finite: columns 9 to "
                "29 of a state"
            )
        return goal

    def _observe(
        self, robot_observation: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float32]]:
        robot, ratio = self.robot_env, self.object_noise_ratio
        positions = self.data.qpos[_OBJECTS] + (
            ratio
            * robot.robot_pos_noise_amp[8:]
            * robot.np_random.uniform(low=-1.0, high=1.0, size=21)
        )
        velocities = self.data.qvel[9:] + (
            ratio
            * robot.robot_vel_noise_amp[9:]
            * robot.np_random.uniform(low=-1.0, high=1.0, size=20)
        )
        self._full = np.concatenate((robot_observation, positions, velocities))
        state = self._full[_STATE_COLUMNS].astype(np.float32)
        return {
            "observation": state,
            "achieved_goal": state[_OBJECTS].copy(),
            "desired_goal": self._goal.astype(np.float32),
        }

    def _done_tasks(self, state: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
        return np.array(
            [
                np.linalg.norm(state[_TASK_COLUMNS[task]] - _TASK_GOALS[task])
                < self.threshold
                for task in KITCHEN_TASKS
            ]
        )

    def _info(self, observation: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
        done = self._done_tasks(observation["observation"])
        index = KITCHEN_TASKS.index(self.task)
        wrong = done & ~self._done_tasks(self._start)
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


def _as_states(states: ArrayLike) -> NDArray[np.float64]:
    states = np.atleast_2d(np.asarray(states, dtype=np.float64))
    if states.ndim != 2 or states.shape[1] != 30:
        raise ValueError(f"states have shape {states.shape}, wanted [S, 30]")
    return states


def _names(value: str | Iterable[str]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def register_kitchen() -> None:
    """Register :class:`KitchenEnv` with gymnasium as :data:`KITCHEN_ENV_ID`.

    Importing ``torchrl_caiac.envs`` does this; calling it again changes nothing. A
    worker process started by ``spawn`` registers through the import too, or through
    ``gymnasium.make("torchrl_caiac.envs:torchrl_caiac/FrankaKitchen-v0")``.
    """
    if KITCHEN_ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=KITCHEN_ENV_ID, entry_point="torchrl_caiac.envs.kitchen:KitchenEnv"
        )


def make_kitchen_env(
    task: str | None = "microwave", *, device: Any = "cpu", **kwargs: Any
) -> EnvBase:
    """Make the kitchen as a TorchRL environment.

    Args:
        task: one of :data:`KITCHEN_TASKS`, or ``None`` to draw one each episode.

    Keyword Args:
        device: where tensors go.
        **kwargs: of :class:`KitchenEnv`.

    Returns:
        a ``TransformedEnv`` whose tensordicts hold ``"observation"``,
        ``"achieved_goal"``, ``"desired_goal"``, ``"is_init"`` and, from ``info``,
        ``"success"``, ``"task_success"`` (bool ``[1]``), ``"wrong_tasks"`` (bool
        ``[7]``) and ``"task"`` (int64 ``[1]``). ``env.reset(options={...})`` takes the
        options of :meth:`KitchenEnv.reset`.

    Example:
        >>> env = make_kitchen_env("kettle")
        >>> rollout = env.rollout(3)
        >>> rollout["next", "success"].shape
        torch.Size([3, 1])
        >>> rollout["is_init"].flatten().tolist()
        [True, False, False]
    """
    from torchrl.data import Binary, Unbounded

    register_kitchen()
    flag = functools.partial(Binary, dtype=torch.bool, device=device)
    info = {
        "success": flag(1),
        "task_success": flag(1),
        "wrong_tasks": flag(len(KITCHEN_TASKS)),
        "task": Unbounded((1,), dtype=torch.int64, device=device),
    }
    return make_goal_env(KITCHEN_ENV_ID, info, task=task, device=device, **kwargs)


register_kitchen()
