"""OGBench's manipulation environments by name."""

from __future__ import annotations

import copy
from typing import Any

from torchrl_caiac.layouts import layout_names

__all__ = ["OGBENCH_ENVS", "make_ogbench_env", "make_ogbench_task"]

_PREFIX = "ogbench/"
#: The names of the environments, without OGBench's version.
OGBENCH_ENVS = tuple(
    name.removeprefix(_PREFIX) for name in layout_names() if name.startswith(_PREFIX)
)
_VERSION = "-v0"


def make_ogbench_env(name: str, *, max_episode_steps: int | None = None) -> Any:
    """Creates an OGBench environment as OGBench collects its datasets.

    Episodes start from random states and do not end at a goal.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`.

    Keyword Args:
        max_episode_steps (int, optional): the steps after which an episode is
            truncated. Defaults to OGBench's number for evaluation.

    Returns:
        gymnasium.Env: the environment.

    Raises:
        ValueError: ``name`` is not such an environment.
        ImportError: ``ogbench`` is not installed, or does not work here.

    Examples:
        >>> from torchrl_caiac.envs.ogbench import make_ogbench_env
        >>> env = make_ogbench_env("cube-double")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["qpos"].shape
        ((37,), (28,))
        >>> env.close()
    """
    check_name(name)
    gymnasium = _import_ogbench()
    options: dict[str, Any] = {}
    if max_episode_steps is not None:
        options["max_episode_steps"] = max_episode_steps
    return gymnasium.make(
        name + _VERSION,
        terminate_at_goal=False,
        mode="data_collection",
        visualize_info=False,
        # It warns of the bounds of the action space at every step.
        disable_env_checker=True,
        **options,
    )


def make_ogbench_task(name: str) -> Any:
    """Creates an OGBench environment as OGBench evaluates policies.

    ``reset(seed=..., options={"task_id": i})`` starts one of the five tasks, ``i`` from
    1 to 5. The seed moves and turns the cubes and the arm a little, and permutes the
    cubes; equal seeds give equal episodes. An episode ends at its goal, or after
    OGBench's number of steps. ``info["success"]`` is OGBench's success.

    The goal, ``info["goal"]``, has the goal columns of
    :func:`~torchrl_caiac.layouts.ready_layout`: OGBench's variant ``oraclerep``, such
    as ``cube-double-oraclerep-v0``. In OGBench's other datasets the goal is a whole
    observation. Counterfactuals of such goals would need the robot of the goal to fit
    the swapped entities.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`.

    Returns:
        gymnasium.Env: the environment.

    Raises:
        ValueError: ``name`` is not such an environment.
        ImportError: ``ogbench`` is not installed, or does not work here.

    Examples:
        >>> from torchrl_caiac.envs.ogbench import make_ogbench_task
        >>> env = make_ogbench_task("cube-double")
        >>> observation, info = env.reset(seed=0, options={"task_id": 5})
        >>> float(info["goal"].max().round(1))  # a tower: 6 cm, in 10 x m
        0.6
        >>> env.close()
    """
    check_name(name)
    gymnasium = _import_ogbench()
    spec = copy.deepcopy(gymnasium.spec(name + _VERSION))
    load = gymnasium.envs.registration.load_env_creator
    spec.entry_point = _with_equal_goals(load(spec.entry_point))
    return gymnasium.make(
        spec,
        use_oracle_rep=True,
        visualize_info=False,
        disable_env_checker=True,
    )


def _with_equal_goals(kind: Any) -> Any:
    """Returns a class of environments whose goals depend on the seed alone.

    To find a goal, OGBench takes two random steps, with actions that nothing seeds.
    """

    class EqualGoals(kind):
        _actions: Any = None

        @property
        def action_space(self) -> Any:
            if self._actions is None:
                self._actions = super().action_space
            return self._actions

        def reset(self, *args: Any, seed: int | None = None, **options: Any) -> Any:
            if seed is not None:
                self.action_space.seed(seed)
            return super().reset(*args, seed=seed, **options)

    return EqualGoals


def check_name(name: str) -> None:
    """Raises if there is no environment of a name.

    Args:
        name (str): the name.

    Raises:
        ValueError: ``name`` is not one of :data:`OGBENCH_ENVS`.

    Examples:
        >>> from torchrl_caiac.envs.ogbench.registration import check_name
        >>> check_name("scene")
    """
    if name not in OGBENCH_ENVS:
        raise ValueError(
            f"there is no OGBench environment {name!r}, expected one of "
            f"{list(OGBENCH_ENVS)}: a dataset's name without '-play-v0' and the like"
        )


def _import_ogbench() -> Any:
    try:
        import gymnasium
        import ogbench.manipspace  # noqa: F401  registers the environments
    except (ImportError, AttributeError) as error:
        raise ImportError(
            f"OGBench's environments could not be imported ({error}): pip install "
            "'torchrl-caiac[ogbench]', which pins the dm_control that works with it; "
            "without a display set MUJOCO_GL=egl"
        ) from error
    return gymnasium
