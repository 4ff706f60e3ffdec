"""Random actions from saved simulator states, in any environment that restores them."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_caiac._keys import as_key
from torchrl_caiac.data.collect import (
    collect_episodes,
    collection_folder,
    load_episode,
    record_episode,
)
from torchrl_caiac.data.trees import copy_tree
from torchrl_caiac.data.write_transitions import check_free, write_transitions

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from tensordict.utils import NestedKey

__all__ = ["RestorableEnv", "keep_array", "random_episodes", "random_transitions"]

_ROOT = "rows"
_STATES, _OBSERVATIONS = "states.npy", "observations.npy"


class RestorableEnv(Protocol):
    """What :func:`random_transitions` needs of an environment.

    It may also have ``record()``, which returns the entries of the simulator's state to
    keep, a mapping of arrays; ``seed(seed)``, called before the first state of a file,
    where observations or goals are random; ``has_rewards``, ``False`` where the rewards
    mean nothing; and ``close()``.

    Examples:
        >>> import gymnasium
        >>> import numpy as np
        >>> class Pendulum:
        ...     def __init__(self):
        ...         self.env = gymnasium.make("Pendulum-v1").unwrapped
        ...         self.action_space = self.env.action_space
        ...     def restore(self, state):  # angle and angular velocity
        ...         self.env.state = np.array(state)
        ...         return self.env._get_obs()
        ...     def step(self, action):
        ...         return self.env.step(action)
        >>> Pendulum().restore([0.0, 1.0]).tolist()
        [1.0, 0.0, 1.0]
    """

    @property
    def action_space(self) -> Any:
        """A box with finite ``low`` and ``high`` ``[A]``."""

    def restore(self, state: NDArray[Any]) -> Any:
        """Puts the simulator into a state ``[S]``; returns the observation of it."""

    def step(self, action: NDArray[Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Simulates an action ``[A]``, and returns what Gymnasium's ``step`` does."""


def random_transitions(
    env: Callable[[], RestorableEnv],
    states: ArrayLike,
    actions_per_state: int = 1,
    *,
    path: str | os.PathLike[str] | None = None,
    steps: int = 1,
    observations: ArrayLike | None = None,
    info_key: NestedKey | None = "info",
    seed: int = 0,
    work: str | os.PathLike[str] | None = None,
    num_workers: int | None = None,
    states_per_file: int = 256,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Collects transitions of uniformly random actions from saved simulator states.

    A world model that is queried with uniform actions has to know their effects in the
    states of the data (paper A.7), and expert data hold no other actions. Collect about
    as many rows as the data have. They are for the world model only: pass both to
    :func:`~torchrl_caiac.fit.fit_world_model` as a list.

    The transitions ``[T]`` with ``T = S * actions_per_state * steps`` have
    ``"observation"``, ``"action"``, ``"episode"`` (int64 ``[T]``) and, under
    ``"next"``, the observation after the action, ``"reward"`` (unless the environment
    has none), ``"terminated"``, ``"truncated"`` and ``"done"`` (each ``[T, 1]``). If
    the observation is a mapping with the entry ``"observation"``, its entries become
    entries of the root.
    Floating-point numbers become float32, except what the environment records.

    Args:
        env (callable): makes the environment, in each process: a class or a
            ``functools.partial`` of one, such as
            :class:`~torchrl_caiac.envs.OGBenchSimulator`,
            :class:`~torchrl_caiac.envs.RestorableKitchen` or
            :class:`~torchrl_caiac.envs.RestorableFetchPush`. For others a
            class of a few lines is enough, see :class:`RestorableEnv`.
        states (array_like): the states ``[M, S]``.
        actions_per_state (int): the number of times that each state is restored, for
            another action. Defaults to 1.

    Keyword Args:
        path (path, optional): the folder of a memory-mapped result, written atomically.
            Defaults to ``None``: in memory.
        steps (int): the number of random actions after each restore, which are one
            trajectory. Defaults to 1.
        observations (array_like, optional): the recorded observations ``[M, D]`` of
            ``states``, for simulators whose restored states are observed differently
            in some column; the next observations are simulated in any case. Defaults to
            ``None``: what ``restore`` returns.
        info_key (NestedKey, optional): where to put what ``env.record()`` returns for
            each row. ``None`` leaves it out. Defaults to ``"info"``.
        seed (int): the seed. Defaults to 0.
        work (path, optional): a folder for finished parts, from which an interrupted
            call resumes. Defaults to a temporary folder.
        num_workers (int, optional): the number of processes; with 1, this one. The
            result does not depend on it. More need a picklable ``env``, and a script
            with ``if __name__ == "__main__":``. Defaults to one per processor.
        states_per_file (int): the number of states that a process collects at a time.
            The actions depend on it. Defaults to 256.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the transitions ``[T]``, memory-mapped if ``path`` is given.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        ValueError: there are no states, or an array has a wrong shape or values that
            are not finite; a number is less than 1; the bounds of the actions are not
            finite; ``work`` has parts of another call.
        TypeError: ``work`` is given and ``env`` cannot be pickled.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs import OGBenchSimulator, random_transitions
        >>> simulator = OGBenchSimulator("cube-double")
        >>> states = np.stack([simulator.reset(seed=i) for i in range(3)])
        >>> rows = random_transitions(
        ...     OGBenchSimulator, states, 2, num_workers=1, progress=False
        ... )
        >>> rows["observation"].shape, rows["action"].shape
        (torch.Size([6, 37]), torch.Size([6, 5]))
        >>> bool((rows["observation"][0] == rows["observation"][1]).all())
        True
    """
    check_free(path, overwrite)
    for name, value in {
        "actions_per_state": actions_per_state,
        "steps": steps,
        "states_per_file": states_per_file,
    }.items():
        if value < 1:
            raise ValueError(f"{name} is {value}, expected at least 1")
    key = None if info_key is None else as_key(info_key)
    arrays = {_STATES: _matrix(states, "states", None)}
    if observations is not None:
        count = len(arrays[_STATES])
        arrays[_OBSERVATIONS] = _matrix(observations, "observations", count)
    spec: dict[str, Any] = {"actions": actions_per_state, "steps": steps}
    if work is not None:
        spec["env"] = _digest(env)
    total = len(arrays[_STATES])
    specs = [
        {**spec, "first": first, "last": min(first + states_per_file, total)}
        for first in range(0, total, states_per_file)
    ]
    with collection_folder(work) as folder:
        for name, array in arrays.items():
            keep_array(folder / name, array)
        report = collect_episodes(
            functools.partial(_Source, env, str(folder), observations is not None),
            specs,
            folder,
            seed=seed,
            workers=num_workers,
            progress=progress,
            description=f"random actions, {states_per_file} states at a time",
        )
        parts = [load_episode(file)[0] for file in report.files]
    rows: TensorDict = torch.cat([_transitions(part[_ROOT], key) for part in parts])
    lengths = torch.from_numpy(np.concatenate([part["lengths"] for part in parts]))
    rows["episode"] = torch.arange(len(lengths)).repeat_interleave(lengths)
    if path is None:
        return rows
    bounds = (parts[0]["low"], parts[0]["high"])
    return write_transitions(rows, path, overwrite=overwrite, action_bounds=bounds)


def random_episodes(
    env: RestorableEnv,
    states: NDArray[Any],
    *,
    steps: int,
    rng: np.random.Generator,
    record: bool = True,
) -> Iterator[dict[str, Any]]:
    """Plays random actions from each of several states.

    Args:
        env (RestorableEnv): the environment.
        states (numpy.ndarray): ``[M, S]``.

    Keyword Args:
        steps (int): the number of actions from each state.
        rng (numpy.random.Generator): draws the actions.
        record (bool): whether the infos have what ``env.record()`` returns, if the
            environment has it. Defaults to ``True``.

    Yields:
        dict: the episode of a state, as
        :func:`~torchrl_caiac.data.collect.record_episode` returns it.

    Raises:
        ValueError: the action space is not a box, or its bounds are not finite.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.fetch_push import RestorableFetchPush
        >>> from torchrl_caiac.envs.random_transitions import random_episodes
        >>> env = RestorableFetchPush()
        >>> states = env.env.simulator_state()[None]
        >>> rng = np.random.default_rng(0)
        >>> [episode] = random_episodes(env, states, steps=3, rng=rng)
        >>> episode["actions"].shape
        (3, 4)
    """
    space = env.action_space
    if not (hasattr(space, "low") and hasattr(space, "high")):
        raise ValueError(
            f"the action space is {space}, expected a box: uniform actions need bounds"
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ValueError(
            f"the bounds of the actions are {space.low} and {space.high}, expected "
            "finite ones: uniform actions need them"
        )
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)

    def act(_: Any) -> NDArray[Any]:
        # In the type of the space: the stored action is the executed one.
        return np.asarray(rng.uniform(low, high).astype(space.dtype))

    for state in states:
        observation = env.restore(np.array(state))
        yield record_episode(
            env,
            act,
            observation,
            max_steps=steps,
            state=getattr(env, "record", None) if record else None,
        )


def keep_array(file: Path, array: NDArray[Any]) -> None:
    """Stores an array for the processes of a collection that can be resumed.

    Args:
        file (Path): the file, in the folder of the collection.
        array (numpy.ndarray): the array.

    Raises:
        ValueError: the folder has a collection that used another array.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.envs.random_transitions import keep_array
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep_array(Path(folder) / "states.npy", np.zeros((3, 2)))
        ...     np.load(f"{folder}/states.npy", allow_pickle=False).shape
        (3, 2)
    """
    if _is_same(file, array):
        return
    if (file.parent / "collection.json").exists():
        raise ValueError(
            f"{file.parent} contains random actions from other {file.stem}; give "
            "another folder or delete this one"
        )
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, array)


def _is_same(file: Path, array: NDArray[Any]) -> bool:
    try:
        stored = np.load(file, mmap_mode="r", allow_pickle=False)
        return np.array_equal(stored, array)
    except (OSError, ValueError, EOFError):
        return False


def _matrix(values: ArrayLike, name: str, rows: int | None) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or not array.size or rows not in (None, len(array)):
        raise ValueError(
            f"{name} have shape {array.shape}, expected "
            f"[{'M' if rows is None else rows}, width]: give one row for each state"
        )
    bad = ~np.isfinite(array).all(1)
    if bad.any():
        raise ValueError(
            f"{name} have non-finite values in {int(bad.sum())} rows, the first at "
            f"{int(bad.argmax())}: drop them"
        )
    return array


def _digest(env: Callable[[], RestorableEnv]) -> str:
    try:
        return hashlib.sha256(pickle.dumps(env)).hexdigest()
    except Exception as error:  # __reduce__ of any class may raise anything
        raise TypeError(
            f"env is {env!r}, which cannot be pickled ({error}), so work= cannot tell "
            "its parts from those of another environment: give a class or a "
            "functools.partial of one, or leave out work="
        ) from error


class _Source:
    """Collects the rows of several states at a time."""

    def __init__(
        self, env: Callable[[], RestorableEnv], folder: str, has_observations: bool
    ) -> None:
        self.env = env()
        # Mapped: an array's header could ask for any amount of memory.
        self.states = np.load(f"{folder}/{_STATES}", mmap_mode="r", allow_pickle=False)
        self.observations = (
            np.load(f"{folder}/{_OBSERVATIONS}", mmap_mode="r", allow_pickle=False)
            if has_observations
            else None
        )

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        env, space = self.env, self.env.action_space
        if hasattr(env, "seed"):
            env.seed(seed)
        numbers = np.arange(spec["first"], spec["last"]).repeat(spec["actions"])
        rng = np.random.default_rng([seed, 1])
        episodes = random_episodes(
            env, self.states[numbers], steps=spec["steps"], rng=rng
        )
        rows = [
            self._rows(episode, int(number))
            for episode, number in zip(episodes, numbers, strict=True)
        ]
        return {
            _ROOT: _concatenate(rows),
            "lengths": np.array([len(row["action"]) for row in rows]),
            "low": space.low,
            "high": space.high,
        }

    def _rows(self, episode: dict[str, Any], number: int) -> dict[str, Any]:
        observations = episode["observations"]
        if not isinstance(observations, Mapping) or "observation" not in observations:
            observations = {"observation": observations}
        before = _part(observations, slice(None, -1))
        if self.observations is not None:
            given, found = self.observations[number], before["observation"]
            if isinstance(found, Mapping) or found.shape[1:] != given.shape:
                raise ValueError(
                    f"observations have rows of shape {given.shape}, but the "
                    f"environment's are {np.shape(found)[1:]}: give its observations"
                )
            before = {**before, "observation": found.copy()}
            before["observation"][0] = given
        rows = {
            "state": before,
            "action": episode["actions"],
            "next": _part(observations, slice(1, None)),
            "terminated": episode["terminations"],
            "truncated": episode["truncations"],
        }
        if getattr(self.env, "has_rewards", True):
            rows["reward"] = episode["rewards"]
        if "infos" in episode:
            rows["info"] = _part(episode["infos"], slice(None, -1))
        return rows

    def close(self) -> None:
        if hasattr(self.env, "close"):
            self.env.close()


def _part(tree: Mapping[str, Any], part: slice) -> dict[str, Any]:
    return {
        key: _part(value, part) if isinstance(value, Mapping) else value[part]
        for key, value in tree.items()
    }


def _concatenate(trees: list[Any]) -> Any:
    if isinstance(trees[0], Mapping):
        return {key: _concatenate([tree[key] for tree in trees]) for key in trees[0]}
    return np.concatenate(trees)


def _transitions(rows: Mapping[str, Any], info_key: NestedKey | None) -> TensorDict:
    length = len(rows["action"])
    flags = {
        key: torch.from_numpy(np.array(rows[key])).reshape(length, 1)
        for key in ("reward", "terminated", "truncated")
        if key in rows
    }
    flags["done"] = flags["terminated"] | flags["truncated"]
    if "reward" in flags:
        flags["reward"] = flags["reward"].float()
    result = TensorDict(
        {
            **_tensors(rows["state"]),
            "action": _tensor(rows["action"]),
            "next": {**_tensors(rows["next"]), **flags},
        },
        [length],
    )
    if info_key is not None and "info" in rows:
        info = copy_tree(rows["info"])
        result[info_key] = TensorDict(info, [length])
    return result


def _tensors(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _tensors(value) if isinstance(value, Mapping) else _tensor(value)
        for key, value in tree.items()
    }


def _tensor(array: NDArray[Any]) -> torch.Tensor:
    tensor = torch.from_numpy(np.array(array))
    return tensor.float() if tensor.is_floating_point() else tensor
