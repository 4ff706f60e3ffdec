"""OGBench files of its manipulation environments, made by its scripted oracles."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac._files import whole_file
from torchrl_caiac.data.collect import (
    collect_episodes,
    collection_folder,
    load_episode,
)
from torchrl_caiac.envs.ogbench.registration import check_name, make_ogbench_env

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["create_ogbench_play"]

_logger = logging.getLogger("torchrl_caiac.envs.ogbench.datasets")

# The types in OGBench's files.
_TYPES = {
    "observations": np.float32,
    "actions": np.float32,
    "terminals": np.bool_,
    "qpos": np.float32,
    "qvel": np.float32,
    "button_states": np.int64,
}
_BUTTONS = "button_states"
# How often an oracle puts a cube on another one, drawn for each episode.
_STACKING = {
    "cube-single": (0.0, 0.0),
    "cube-double": (0.0, 0.25),
    "cube-triple": (0.05, 0.35),
    "cube-quadruple": (0.1, 0.5),
}
# Metres by which a cube may leave the workspace before an episode is drawn again.
_OUTSIDE = 0.2
# In the scene, where a cube can be seen: between the walls, or in the drawer.
_SCENE_SIDES = (-0.3, 0.29)
_DRAWER_HEIGHTS = (0.06, 0.08)
# The noise on positions, yaw and gripper of a noisy episode, relative to its level.
_NOISE = np.array([1.0, 1.0, 1.0, 3.0, 10.0])
# The share of random actions in OGBench's noisy datasets.
_RANDOM, _RANDOM_IN_PUZZLES = 0.1, 0.2


def create_ogbench_play(
    path: str | os.PathLike[str],
    name: str = "cube-double",
    *,
    episodes: int = 100,
    steps: int = 1000,
    seed: int = 0,
    noisy: bool = False,
    action_noise: float = 0.1,
    random_actions: float | None = None,
    work: str | os.PathLike[str] | None = None,
    num_workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Collects an OGBench dataset with OGBench's environments and oracles.

    The file has the arrays and types of OGBench's own: ``"observations"``,
    ``"actions"``, ``"terminals"``, ``"qpos"``, ``"qvel"``, and ``"button_states"`` if
    there are buttons, each ``[episodes * (steps + 1), *]``. ``"terminals"`` is ``True``
    in the last row of an episode, whose next state is not stored. An oracle carries out
    one random task after the other: it moves a cube, presses a button, or moves the
    drawer or the window.

    Args:
        path (path): the ``.npz`` file.
        name (str): one of :data:`OGBENCH_ENVS`. Defaults to ``"cube-double"``.

    Keyword Args:
        episodes (int): the number of episodes. Defaults to 100; OGBench has 1,000.
        steps (int): the number of transitions of an episode. Defaults to 1000, as in
            OGBench.
        seed (int): the seed of the collection. Give another one for validation.
            Defaults to 0.
        noisy (bool): if ``False``, an oracle follows a plan with correlated noise
            (OGBench's ``play``). If ``True``, it is a function of the state, with
            independent noise on its actions, some of which are random (OGBench's
            ``noisy``). Defaults to ``False``.
        action_noise (float): the highest standard deviation of the noise on actions of
            ``noisy`` episodes, which are in [-1, 1]. Each episode draws its own; the
            noise on the yaw is 3 times, on the gripper 10 times as large. Defaults to
            0.1.
        random_actions (float, optional): the share of actions of ``noisy`` episodes
            that are drawn uniformly instead. Defaults to ``None``: as in OGBench, 0.2
            in the puzzles and 0.1 elsewhere.
        work (path, optional): a folder for finished episodes, from which an interrupted
            collection resumes. Defaults to a temporary folder.
        num_workers (int, optional): the number of processes. The result does not depend
            on it. Defaults to one per processor.
        overwrite (bool): if ``True``, replaces an existing file. Defaults to ``False``.
        progress (bool): if ``True``, shows a progress bar. Defaults to ``True``.

    Returns:
        Path: the file.

    Raises:
        FileExistsError: the file exists and ``overwrite`` is ``False``.
        ValueError: ``name`` or ``path`` is unknown, a number is out of range, or
            ``work`` has another collection.
        ImportError: ``ogbench`` is not installed.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.envs.ogbench import create_ogbench_play
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = create_ogbench_play(
        ...         f"{folder}/play.npz", episodes=2, steps=5, num_workers=1,
        ...         progress=False)
        ...     with np.load(path, allow_pickle=False) as file:
        ...         arrays = {key: file[key] for key in file.files}
        >>> arrays["observations"].shape, int(arrays["terminals"].sum())
        ((12, 37), 2)
    """
    check_name(name)
    target = Path(path)
    if target.suffix != ".npz":
        raise ValueError(f"path is {str(path)!r}, expected a name that ends in .npz")
    if target.exists() and not overwrite:
        raise FileExistsError(
            f"{target} exists: give another path, or overwrite=True to replace it"
        )
    for argument, value in {"episodes": episodes, "steps": steps}.items():
        if value < 1:
            raise ValueError(f"{argument} is {value}, expected at least 1")
    if not (np.isfinite(action_noise) and action_noise >= 0):
        raise ValueError(f"action_noise is {action_noise}, expected at least 0")
    if random_actions is not None and not noisy:
        raise ValueError(
            f"random_actions is {random_actions}, but noisy is False: OGBench's play "
            "has none. Pass noisy=True, or leave it out"
        )
    if random_actions is None:
        random_actions = _RANDOM_IN_PUZZLES if name.startswith("puzzle") else _RANDOM
    if not 0 <= random_actions <= 1:
        raise ValueError(f"random_actions is {random_actions}, expected 0 to 1")
    spec: dict[str, Any] = {"name": name, "steps": steps, "noisy": noisy}
    if noisy:
        spec |= {"action_noise": action_noise, "random_actions": random_actions}
    with collection_folder(work) as folder:
        report = collect_episodes(
            functools.partial(_Source, name, steps + 1, noisy),
            [spec] * episodes,
            folder,
            seed=seed,
            workers=num_workers,
            progress=progress,
            description=f"{name} {'noisy' if noisy else 'play'} episodes",
        )
        target.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(target) as partial:
            _write(partial, report.files)
    _logger.info("%s: %d episodes of %d steps of %s", target, episodes, steps, name)
    return target


def _write(partial: Path, files: Sequence[Path]) -> None:
    arrays: dict[str, list[NDArray[Any]]] = {}
    for file in files:
        for key, value in load_episode(file)[0].items():
            arrays.setdefault(key, []).append(value)
    whole: dict[str, Any] = {key: np.concatenate(v) for key, v in arrays.items()}
    with partial.open("wb") as stream:  # a path would get another ending
        np.savez_compressed(stream, **whole)


class _Source:
    """Collects one episode at a time."""

    def __init__(self, name: str, rows: int, noisy: bool) -> None:
        self.name = name
        self.env = make_ogbench_env(name, max_episode_steps=rows)
        self.oracles = _oracles(name, self.env, noisy)

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        before = np.random.get_state()
        np.random.seed(seed)  # the oracles draw from the global generator
        try:
            return self._episode(spec, np.random.default_rng([seed, 1]), seed)
        finally:
            np.random.set_state(before)

    def _episode(
        self, spec: Mapping[str, Any], rng: np.random.Generator, seed: int
    ) -> dict[str, Any] | None:
        env, simulation = self.env, self.env.unwrapped
        observation, info = env.reset(seed=seed)
        stacking = rng.uniform(*_STACKING.get(self.name, (0.5, 0.5)))
        level = rng.uniform(0.0, spec.get("action_noise", 0.0))
        share = spec.get("random_actions", 0.0)
        oracle = self._start(observation, info)
        rows: dict[str, list[Any]] = {key: [] for key in _TYPES}
        over = False
        while not over:
            if share and rng.uniform() < share:
                action = rng.uniform(-1.0, 1.0, 5)
            else:
                action = np.asarray(oracle.select_action(observation, info))
                action = action + rng.normal(size=5) * level * _NOISE
            # As it is stored.
            action = np.clip(action, -1, 1).astype(np.float32)
            rows["observations"].append(observation)
            rows["actions"].append(action)
            observation, _, terminated, truncated, info = env.step(action)
            if not np.isfinite(observation).all():
                return None
            over = terminated or truncated
            rows["terminals"].append(over)
            rows["qpos"].append(info["prev_qpos"])
            rows["qvel"].append(info["prev_qvel"])
            if "prev_" + _BUTTONS in info:
                rows[_BUTTONS].append(info["prev_" + _BUTTONS])
            if self._is_lost(info):
                return None
            if oracle.done:
                observation, info = simulation.set_new_target(p_stack=stacking)
                oracle = self._start(observation, info)
        return {
            key: np.stack(values).astype(_TYPES[key])
            for key, values in rows.items()
            if values
        }

    def _start(self, observation: NDArray[Any], info: Mapping[str, Any]) -> Any:
        oracle = self.oracles[str(info["privileged/target_task"])]
        oracle.reset(observation, info)
        return oracle

    def _is_lost(self, info: Mapping[str, Any]) -> bool:
        """Returns whether a cube has been thrown out, or cannot be seen in the scene.

        OGBench draws such an episode again too.
        """
        low, high = self.env.unwrapped._workspace_bounds
        for key, cube in info.items():
            if not (key.startswith("privileged/block_") and key.endswith("_pos")):
                continue
            if (cube < low - _OUTSIDE).any() or (cube > high + _OUTSIDE).any():
                return True
            if self.name == "scene":
                left, right = _SCENE_SIDES
                bottom, top = _DRAWER_HEIGHTS
                if cube[1] >= right or (
                    cube[1] <= left and not bottom <= cube[2] <= top
                ):
                    return True
        return False

    def close(self) -> None:
        self.env.close()


def _oracles(name: str, env: Any, noisy: bool) -> dict[str, Any]:
    """Returns OGBench's oracle of each task."""
    if noisy:
        from ogbench.manipspace.oracles.markov.button_markov import ButtonMarkovOracle
        from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
        from ogbench.manipspace.oracles.markov.drawer_markov import DrawerMarkovOracle
        from ogbench.manipspace.oracles.markov.window_markov import WindowMarkovOracle

        kinds = {
            "cube": CubeMarkovOracle,
            "button": ButtonMarkovOracle,
            "drawer": DrawerMarkovOracle,
            "window": WindowMarkovOracle,
        }
    else:
        from ogbench.manipspace.oracles.plan.button_plan import ButtonPlanOracle
        from ogbench.manipspace.oracles.plan.cube_plan import CubePlanOracle
        from ogbench.manipspace.oracles.plan.drawer_plan import DrawerPlanOracle
        from ogbench.manipspace.oracles.plan.window_plan import WindowPlanOracle

        kinds = {
            "cube": CubePlanOracle,
            "button": ButtonPlanOracle,
            "drawer": DrawerPlanOracle,
            "window": WindowPlanOracle,
        }
    options = {
        # With an open gripper the fingers would press two buttons.
        "button": {"gripper_always_closed": name.startswith("puzzle")}
    }
    return {
        task: kind(env=env, **options.get(task, {})) for task, kind in kinds.items()
    }
