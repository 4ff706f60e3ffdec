"""Start states and goals of episodes in the Franka-Kitchen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from torchrl_caiac.envs.kitchen.simulator import default_state
from torchrl_caiac.envs.kitchen.tasks import (
    BURNER_RATIO,
    KITCHEN_LAYOUT,
    LIGHT_RATIO,
    OBJECTS,
    TASK_COLUMNS,
    TASK_GOALS,
    check_task,
    solved,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "as_names",
    "episode_goal",
    "random_start",
    "set_kitchen_start",
    "start_state",
]

# A random start in which two bodies overlap by more than this, in metres, is drawn
# again. The kettle of the default start is 1.5 mm deep in the hob.
_MAX_OVERLAP = 4e-3
_MAX_DRAWS = 100
# Where a random start may put the kettle, in metres: the rectangle between the four
# burners, out of the reach of the microwave on its left.
_KETTLE_X = (-0.25, 0.22)
_KETTLE_Y = (0.34, 0.78)


def as_names(value: str | Iterable[str]) -> tuple[str, ...]:
    """Returns one name or several as a tuple.

    Args:
        value (str or iterable of str): the names.

    Returns:
        tuple of str: the names.

    Examples:
        >>> as_names("kettle"), as_names(["kettle", "microwave"])
        (('kettle',), ('kettle', 'microwave'))
    """
    return (value,) if isinstance(value, str) else tuple(value)


def start_state(
    model: Any,
    start: Any = "default",
    *,
    open: str | Iterable[str] = (),
    task: str | None = None,
    rng: np.random.Generator | None = None,
) -> NDArray[np.float64]:
    """Returns the simulator positions that a start describes.

    Args:
        model (mujoco.MjModel): the kitchen's model, for random starts.
        start (str, ArrayLike or Mapping): as for
            :class:`~torchrl_caiac.envs.KitchenEnv`. Defaults to ``"default"``.

    Keyword Args:
        open (str or iterable of str): entities in their solved configuration, applied
            after ``start``. Defaults to none.
        task (str, optional): the task whose object a random start leaves unchanged.
        rng (numpy.random.Generator, optional): the generator of random starts.

    Returns:
        numpy.ndarray: state ``[30]``, float64.

    Raises:
        ValueError: the start is unknown, has the wrong shape or is not finite.

    Examples:
        >>> from torchrl_caiac.envs.kitchen.simulator import KitchenRobot
        >>> state = start_state(KitchenRobot().model, {"microwave": -0.3})
        >>> float(state[22])
        -0.3
    """
    state = default_state()
    if isinstance(start, str):
        if start == "random":
            if task is None or rng is None:
                raise ValueError(
                    "a random start needs the task whose object stays unchanged, and a "
                    "generator"
                )
            state = random_start(model, task, rng=rng)
        elif start != "default":
            raise ValueError(
                f"start is {start!r}, expected 'default', 'random', a state [30] or "
                "a mapping of entity names to values"
            )
    elif isinstance(start, Mapping):
        for name, value in start.items():
            columns = list(KITCHEN_LAYOUT.columns.get(name, ()))
            if not columns:
                raise ValueError(
                    f"start names the entity {name!r}, expected one of "
                    f"{KITCHEN_LAYOUT.names}"
                )
            values = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if values.shape != (len(columns),):
                raise ValueError(
                    f"start gives {name!r} values of shape {values.shape}, expected "
                    f"({len(columns)},)"
                )
            state[columns] = values
    else:
        state = np.asarray(start, dtype=np.float64).copy()
        if state.shape != (30,):
            raise ValueError(
                f"start has shape {state.shape}, expected (30,): 9 robot joints and "
                "21 object joints"
            )
    for name in as_names(open):
        state[list(KITCHEN_LAYOUT.columns.get(name, ()))] = solved(name)
    if not np.isfinite(state).all():
        raise ValueError(
            f"start has non-finite values in columns "
            f"{np.flatnonzero(~np.isfinite(state)).tolist()}"
        )
    return state


def random_start(
    model: Any, task: str, *, rng: np.random.Generator, p: float = 0.5
) -> NDArray[np.float64]:
    """Draws a start in which objects other than the task's are randomized (A.6.1).

    The paper does not state its ranges. Here doors, knobs and the switch are uniform
    between the default and the solved configuration, and coupled joints agree with each
    other. The kettle is placed upright anywhere between the four burners (x in
    [-0.25, 0.22], y in [0.34, 0.78] metres). A start in which bodies overlap by more
    than 4 mm is drawn again. The robot keeps its default posture.

    Args:
        model (mujoco.MjModel): the kitchen's model.
        task (str): the task whose object keeps its default configuration.

    Keyword Args:
        rng (numpy.random.Generator): the generator.
        p (float): probability that an object is randomized. Defaults to 0.5.

    Returns:
        numpy.ndarray: state ``[30]``, float64.

    Raises:
        ValueError: ``task`` is unknown or ``p`` is not a probability.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.kitchen.simulator import KitchenRobot
        >>> rng = np.random.default_rng(0)
        >>> random_start(KitchenRobot().model, "kettle", rng=rng).shape
        (30,)
    """
    check_task(task)
    if not 0 <= p <= 1:
        raise ValueError(f"p is {p}, expected a probability in [0, 1]")
    scratch = mujoco.MjData(model)
    for _ in range(_MAX_DRAWS):
        state = default_state()
        for name in KITCHEN_LAYOUT.names[1:]:
            # Always drawn, so that one object's draw does not change the next.
            chosen, fraction, x, y = rng.random(4)
            if name == task or chosen >= p:
                continue
            columns = list(KITCHEN_LAYOUT.columns[name])
            if name == "kettle":
                state[columns[:2]] = (
                    _KETTLE_X[0] + x * (_KETTLE_X[1] - _KETTLE_X[0]),
                    _KETTLE_Y[0] + y * (_KETTLE_Y[1] - _KETTLE_Y[0]),
                )
            elif name == "hinge_cabinet":  # only its right door has a task
                state[columns[1]] += fraction * (solved(name)[1] - state[columns[1]])
            else:
                state[columns] = fraction * solved(name)
        scratch.qpos[:] = state
        mujoco.mj_kinematics(model, scratch)
        mujoco.mj_collision(model, scratch)
        depth = scratch.contact.dist[: scratch.ncon]
        if depth.min(initial=0.0) > -_MAX_OVERLAP:
            return state
    raise RuntimeError(  # pragma: no cover (nearly every draw is free)
        f"no start without overlapping bodies in {_MAX_DRAWS} draws"
    )


def episode_goal(
    goal: Any, *, start: NDArray[np.float64], task: str
) -> NDArray[np.float64]:
    """Returns the goal of an episode.

    Args:
        goal (str or ArrayLike): ``"start"`` (all objects but the task's stay where the
            episode starts), ``"default"`` (they are in their default configuration) or
            a goal ``[21]``.

    Keyword Args:
        start (numpy.ndarray): the positions ``[30]`` in which the episode starts.
        task (str): the episode's task.

    Returns:
        numpy.ndarray: goal ``[21]``, float64.

    Raises:
        ValueError: the goal is unknown, has the wrong shape or is not finite.

    Examples:
        >>> goal = episode_goal("default", start=default_state(), task="microwave")
        >>> float(goal[13])
        -0.75
    """
    if isinstance(goal, str):
        if goal not in ("start", "default"):
            raise ValueError(
                f"goal is {goal!r}, expected 'start', 'default' or a goal [21]"
            )
        values = (start if goal == "start" else default_state())[OBJECTS].copy()
        values[TASK_COLUMNS[task] - OBJECTS.start] = TASK_GOALS[task]
        return values
    values = np.asarray(goal, dtype=np.float64).copy()
    if values.shape != (21,) or not np.isfinite(values).all():
        raise ValueError(
            f"goal has shape {values.shape}, expected (21,) and finite values: columns "
            "9 to 29 of a state"
        )
    return values


def set_kitchen_start(
    env: Any,
    positions: Mapping[str, float] | None = None,
    *,
    qpos: ArrayLike | None = None,
    qvel: ArrayLike | None = None,
) -> dict[str, Any]:
    """Puts ``FrankaKitchen-v1`` into a start state, ready for the next ``step``.

    Joints that are coupled to each other are set together: a burner with its knob, the
    light with its switch. For a :class:`~torchrl_caiac.envs.KitchenEnv`, pass the
    start to its ``reset`` instead.

    Args:
        env (gymnasium.Env): ``FrankaKitchen-v1``, wrapped or not, after a ``reset``.
        positions (Mapping of str to float, optional): object joints by name, for
            example ``{"slide_cabinet": 0.37}``.

    Keyword Args:
        qpos (ArrayLike, optional): positions ``[30]`` of the whole model, to which
            ``positions`` are applied. Defaults to the current ones.
        qvel (ArrayLike, optional): velocities ``[29]`` of the whole model. Defaults to
            zeros.

    Returns:
        dict: the environment's observation of the state.

    Raises:
        TypeError: not a FrankaKitchen environment.
        ValueError: wrong shape, unknown joint, or values that are not finite.

    Examples:
        >>> import gymnasium, gymnasium_robotics
        >>> gymnasium.register_envs(gymnasium_robotics)
        >>> env = gymnasium.make("FrankaKitchen-v1", disable_env_checker=True)
        >>> _ = env.reset(seed=0)
        >>> _ = set_kitchen_start(env, {"slide_cabinet": 0.37})
        >>> float(env.unwrapped.data.qpos[19])
        0.37
    """
    kitchen = env.unwrapped
    if not hasattr(kitchen, "robot_env") or not hasattr(kitchen, "_get_obs"):
        raise TypeError(
            f"{type(kitchen).__name__} is not gymnasium-robotics' FrankaKitchen; for "
            'a KitchenEnv use reset(options={"start": ...})'
        )
    robot = kitchen.robot_env
    model, data = robot.model, robot.data
    start = np.array(data.qpos if qpos is None else qpos, dtype=np.float64)
    speeds = np.zeros(model.nv) if qvel is None else np.array(qvel, dtype=np.float64)
    for name, value, size in (("qpos", start, model.nq), ("qvel", speeds, model.nv)):
        if value.shape != (size,):
            raise ValueError(f"{name} has shape {value.shape}, expected ({size},)")
    names = {model.joint(i).name for i in range(model.njnt)}
    for name, position in (positions or {}).items():
        if name not in names:
            raise ValueError(
                f"the kitchen has no joint {name!r}; it has {sorted(names)}"
            )
        start[model.joint(name).qposadr[0]] = position
        if name.startswith("knob_Joint_"):
            start[model.joint(name).qposadr[0] + 1] = position / BURNER_RATIO
        elif name == "light_switch":
            start[model.joint("light_joint").qposadr[0]] = position / LIGHT_RATIO
    for name, value in (("qpos", start), ("qvel", speeds)):
        if not np.isfinite(value).all():
            raise ValueError(
                f"{name} has values that are not finite at positions "
                f"{np.flatnonzero(~np.isfinite(value)).tolist()}"
            )
    robot.set_state(start, speeds)
    # Also updates the joint positions that the next action starts from.
    observation: dict[str, Any] = kitchen._get_obs(robot._get_obs())
    return observation
