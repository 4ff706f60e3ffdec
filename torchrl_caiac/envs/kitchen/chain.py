"""Chains of tasks in the Franka-Kitchen, played by the scripted expert."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.envs.kitchen.expert import KitchenExpert, task_distance
from torchrl_caiac.envs.kitchen.tasks import SUCCESS_DISTANCE
from torchrl_caiac.envs.kitchen.waypoints import TASKS, ExpertTask, get_task

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchrl_caiac.envs.kitchen.env import KitchenEnv

__all__ = ["KitchenChain", "random_chain_start"]


class KitchenChain:
    """Plays several tasks in sequence, from the current posture of the arm.

    Each attempt plays the task's table until its object is well within the success
    threshold, or within it and moving away from its goal again, then retreats. The next
    task is the first in the order that is not solved and has attempts left: a failed
    task is repeated at once, and so is a task that was undone later. Tasks that are
    already solved are skipped.

    Args:
        env (gymnasium.Env or tuple): as for :class:`KitchenExpert`.
        tasks (sequence of str): names in
            :data:`~torchrl_caiac.envs.kitchen.waypoints.TASKS`, in the order in which
            they are played.

    Keyword Args:
        retries (int): attempts of a task after its first. Defaults to 1.
        speed (float): factor on all speeds. Defaults to 1.
        speed_range (float): the factor is drawn in each episode from
            ``speed * (1 ± speed_range)``. Defaults to 0.05.
        waypoint_noise (float): as for :class:`KitchenExpert`, drawn in every attempt.
            Defaults to 0.005.
        action_noise (float): as for :class:`KitchenExpert`. Defaults to 0.03.
        clearance (float): as for :class:`KitchenExpert`. Defaults to 0.02.
        margin (float): distance of an object to its goal at which its motion may end
            early. Defaults to 0.15.
        rng (numpy.random.Generator or int, optional): generator of all draws, or its
            seed.

    Raises:
        KeyError: unknown task.
        ValueError: no tasks, a repeated task, negative retries, or a value that
            :class:`KitchenExpert` rejects.

    Examples:
        >>> from torchrl_caiac.envs import KitchenEnv
        >>> env = KitchenEnv()
        >>> _ = env.reset(seed=0, options={"open": "hinge_cabinet"})
        >>> chain = KitchenChain(env, ["kettle", "hinge cabinet", "microwave"], rng=0)
        >>> chain.reset()
        >>> chain.task, chain.solved, chain.finished
        ('kettle', ('hinge cabinet',), False)
        >>> action = chain()
    """

    def __init__(
        self,
        env: Any,
        tasks: Sequence[str],
        *,
        retries: int = 1,
        speed: float = 1.0,
        speed_range: float = 0.05,
        waypoint_noise: float = 0.005,
        action_noise: float = 0.03,
        clearance: float = 0.02,
        margin: float = 0.15,
        rng: np.random.Generator | int | None = None,
    ) -> None:
        if retries < 0:
            raise ValueError(f"retries is {retries}, expected at least 0")
        self.tasks = self._check(tasks)
        self.retries = retries
        self.margin = margin
        self.speed = speed
        self.speed_range = speed_range
        self.rng = np.random.default_rng(rng)
        #: Plays the attempts.
        self.expert = KitchenExpert(
            env,
            self.tasks[0],
            speed=speed,
            speed_range=speed_range,
            waypoint_noise=waypoint_noise,
            action_noise=action_noise,
            clearance=clearance,
        )
        #: Name of the current task.
        self.task: str | None = None
        #: Number of attempts of each task.
        self.attempts: dict[str, int] = {}

    @staticmethod
    def _check(tasks: Sequence[str]) -> tuple[str, ...]:
        names = (tasks,) if isinstance(tasks, str) else tuple(tasks)
        if not names:
            raise ValueError(f"no tasks given, expected some of {sorted(TASKS)}")
        if len(set(names)) < len(names):
            raise ValueError(f"tasks are {names}, expected each at most once")
        for name in names:
            get_task(name)
        return names

    def reset(self, tasks: Sequence[str] | None = None) -> None:
        """Starts an episode from the current state of the simulator.

        Args:
            tasks (sequence of str, optional): the episode's tasks. Defaults to those of
                the last episode.
        """
        if tasks is not None:
            self.tasks = self._check(tasks)
        self.attempts = dict.fromkeys(self.tasks, 0)
        self._solved_before = self.solved
        self.expert.rng = self.rng
        # One draw for the whole chain.
        self.expert.speed_range = 0.0
        self.expert.speed = self.speed * (
            1 + self.speed_range * self.rng.uniform(-1.0, 1.0)
        )
        self._advance()
        if self.finished:
            # All are solved: keep this pose.
            self.expert.reset()
            self.expert.skip_to(len(self.expert.task.waypoints))

    @property
    def finished(self) -> bool:
        """Whether no task is left to play."""
        return self.task is None

    @property
    def solved(self) -> tuple[str, ...]:
        """All tasks whose objects are within FrankaKitchen's 0.3 of their goals."""
        return tuple(
            name
            for name, task in TASKS.items()
            if task_distance(self.expert.data, task) < SUCCESS_DISTANCE
        )

    @property
    def wrong_tasks(self) -> tuple[str, ...]:
        """Tasks that are solved now, were not at the start and were not requested."""
        known = {*self.tasks, *self._solved_before}
        return tuple(name for name in self.solved if name not in known)

    @property
    def success(self) -> bool:
        """Whether all the chain's tasks are solved and no wrong one is."""
        return set(self.tasks) <= set(self.solved) and not self.wrong_tasks

    def _advance(self) -> None:
        """Starts the next attempt, or finishes."""
        solved = self.solved
        left = (
            name
            for name in self.tasks
            if name not in solved and self.attempts[name] <= self.retries
        )
        self.task = next(left, None)
        if self.task is None:
            return
        self.attempts[self.task] += 1
        table = TASKS[self.task]
        if table.alternative is not None and (
            self.attempts[self.task] % 2 == 0 or self._is_obstructed(table)
        ):
            table = table.alternative
        self._table, self._nearest = table, np.inf
        self.expert.set_task(table.with_retreat())
        self.expert.reset()

    def _is_obstructed(self, table: ExpertTask) -> bool:
        if table.obstacle is None:
            return False
        joint, position = table.obstacle
        return float(self.expert.data.joint(joint).qpos[0]) > position

    def __call__(self, observation: Any = None) -> NDArray[np.float64]:
        """Returns the next action.

        Args:
            observation (Any, optional): ignored; makes the chain a policy like others.

        Returns:
            numpy.ndarray: action ``[9]`` in [-1, 1], float64. It keeps the hand in
            place when the chain is finished.

        Raises:
            RuntimeError: :meth:`reset` has not been called.
        """
        if not self.attempts:
            raise RuntimeError("call reset() before the first action of an episode")
        if self.task is not None:
            distance = self.expert.goal_distance
            self._nearest = min(self._nearest, distance)
            worse = self.expert.success and distance > self._nearest + 0.01
            if distance < self.margin or worse:
                self.expert.skip_to(len(self._table.waypoints))
            if self.expert.update():
                self._advance()
        return self.expert()


def random_chain_start(
    kitchen: KitchenEnv, tasks: Sequence[str], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draws a start for a chain, in which several objects stay unchanged.

    See :meth:`~torchrl_caiac.envs.KitchenEnv.random_start` for a single task.

    Args:
        kitchen (KitchenEnv): the environment in which the start is drawn; the chain may
            act in another.
        tasks (sequence of str): names in
            :data:`~torchrl_caiac.envs.kitchen.waypoints.TASKS`, whose objects keep
            their default configuration.

    Keyword Args:
        rng (numpy.random.Generator): the generator.

    Returns:
        numpy.ndarray: state ``[30]``, for ``set_kitchen_start(env, qpos=...)`` or the
        ``reset`` of a :class:`~torchrl_caiac.envs.KitchenEnv`.

    Raises:
        KeyError: unknown task.
        ValueError: no tasks.

    Examples:
        >>> from torchrl_caiac.envs import KitchenEnv
        >>> draw = np.random.default_rng(0)
        >>> start = random_chain_start(KitchenEnv(), ["microwave", "kettle"], rng=draw)
        >>> start.shape, bool(start[22] == KitchenEnv.default_state()[22])
        ((30,), True)
    """
    tables = [get_task(name) for name in tasks]
    if not tables:
        raise ValueError(f"no tasks given, expected some of {sorted(TASKS)}")
    # The kettle's place must be free; doors and knobs close without touching anything.
    spared = "kettle" if "kettle" in tasks else tables[0].name
    state = kitchen.random_start(spared.replace(" ", "_"), rng=rng)
    for table in tables:
        columns = list(table.columns)
        state[columns] = kitchen.default_state()[columns]
    return state
