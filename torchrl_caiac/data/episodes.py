"""Arrays of one episode as TorchRL transitions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.utils import NestedKey

from torchrl_caiac.data.array_trees import cut, plain_tree, to_numpy

__all__ = ["episode_transitions"]

# The names that entries of an observation must not have.
_TAKEN = {"action", "done", "episode", "info", "next"}
_TAKEN |= {"reward", "terminated", "truncated"}


def episode_transitions(
    observations: Any,
    actions: Any,
    *,
    where: str,
    rewards: Any = None,
    next_observations: Any = None,
    terminated: Any = None,
    truncated: Any = None,
    info: Mapping[str, Any] | None = None,
    ends: bool = True,
    remove: str = "remove the episode",
    leave_out: str = "leave it out",
) -> TensorDict:
    """Converts the arrays of one episode to TorchRL transitions.

    The result ``[L]`` has ``"observation"``, ``"action"`` and, under ``"next"``, the
    observation after the action, ``"reward"`` (where rewards are given),
    ``"terminated"``, ``"truncated"`` and ``"done"``, each ``[L, 1]``. The last row is
    always done: it counts as truncated if it is not terminated.

    If the observations are a mapping with the entry ``"observation"``, as in goal
    environments, its entries become entries of the root, such as ``"achieved_goal"``
    and ``"desired_goal"``. Any other mapping becomes a nested ``"observation"``.

    Floating-point numbers become float32, integers and booleans stay (unsigned integers
    of more than one byte become signed, with the same values). The arrays are
    NumPy arrays, tensors, or what ``numpy.asarray`` converts to numbers, such as the
    arrays of an HDF5 file. They are copied.

    Args:
        observations (array or mapping of str to arrays): ``[L + 1, ...]``, the states
            before and after each action; or ``[L, ...]`` with ``next_observations``.
            Here and below, a tensordict counts as a mapping.
        actions (array or mapping of str to arrays): ``[L, ...]``.

    Keyword Args:
        where (str): the episode's name in error messages, such as
            ``"episode 3 of file.npz"``.
        rewards (array, optional): the rewards after the actions, ``[L]`` or ``[L, 1]``.
            They become float32. Defaults to ``None``: the result has no rewards.
        next_observations (array or mapping of str to arrays, optional): the states
            after the actions, ``[L, ...]``, with the entries of ``observations``.
            Defaults to ``None``: rows ``1`` to ``L`` of ``observations``.
        terminated (array of bool, optional): ``[L]`` or ``[L, 1]``. Defaults to
            ``None``: no row is terminated.
        truncated (array of bool, optional): ``[L]`` or ``[L, 1]``. Defaults to
            ``None``: the last row is truncated, if it is not terminated.
        info (mapping of str to arrays, optional): further entries, ``[L, ...]``, or
            ``[L + 1, ...]``, of which the last one is left out. They are kept under
            ``"info"``, with their types. Defaults to ``None``.
        ends (bool): whether the episode ends with these rows. ``False``: they are a
            part of a long episode, and the last row is not made done. Defaults to
            ``True``.
        remove (str): what to do about a bad episode, for error messages. Defaults to
            ``"remove the episode"``.
        leave_out (str): what to do about a bad entry, for error messages;
            ``{key!r}`` becomes its key. Defaults to ``"leave it out"``.

    Returns:
        TensorDict: the transitions, ``[L]``, without ``"episode"``.

    Raises:
        ValueError: there are no actions; an array has another number of entries than
            the others need, NaN, infinite or masked values, texts or objects; a flag is
            not 0 or 1; an entry has the name of a key of transitions; the next
            observations have other entries or shapes than the observations.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.episodes import episode_transitions
        >>> rows = episode_transitions(
        ...     {"arm": np.zeros((4, 2)), "cup": np.zeros((4, 3))},
        ...     np.zeros((3, 2)),
        ...     where="episode 0",
        ... )
        >>> rows["next", "observation", "cup"].shape
        torch.Size([3, 3])
        >>> rows["next", "truncated"].squeeze(-1)
        tensor([False, False,  True])
    """
    reader = _Reader(where, remove, leave_out)
    observations, actions = plain_tree(observations), plain_tree(actions)
    next_observations, info = plain_tree(next_observations), plain_tree(info)
    action = reader.arrays({"action": actions})
    length = _length(action["action"])
    if not length:
        raise ValueError(
            f"{where} has no steps: {remove}, or give at least one action and the "
            "states before and after it"
        )
    reader.check_lengths(action, length)
    state = reader.arrays(reader.named(observations))
    if next_observations is None:
        reader.check_lengths(state, length + 1, _NEXT)
        states = TensorDict(reader.tensors(state), [length + 1])
        td, after = states[:-1].clone(), states[1:].clone()
    else:
        reader.check_lengths(state, length)
        following = reader.arrays(reader.named(next_observations), ("next",))
        reader.check_same(state, following)
        reader.check_lengths(following, length, above=("next",))
        td = TensorDict(reader.tensors(state), [length])
        after = TensorDict(reader.tensors(following, ("next",)), [length])
    td["action"] = reader.tensors(action)["action"]
    td["next"] = after
    if rewards is not None:
        # In float32 even if they are integers: they are added to values.
        reward = reader.column("reward", rewards, length).astype(float)
        td["next", "reward"] = reader.tensors({"reward": reward})["reward"]
    for name, flags in (("terminated", terminated), ("truncated", truncated)):
        td["next", name] = reader.flags(name, flags, length)
    if ends:
        td["next", "truncated"][-1] |= ~td["next", "terminated"][-1]
    td["next", "done"] = td["next", "terminated"] | td["next", "truncated"]
    if info:
        kept = reader.arrays(info, ("info",))
        reader.check_lengths(kept, (length, length + 1), above=("info",))
        kept = cut(kept, slice(0, length))
        td["info"] = reader.tensors(kept, ("info",), cast=False)
    return td


_NEXT = ", one state more than actions (or give next_observations)"


# torch cannot subtract unsigned integers of more than one byte, or write to some rows.
_WIDER = {2: np.int32, 4: np.int64, 8: np.int64}


class _Reader:
    """Converts arrays, and names the episode and the key in errors."""

    def __init__(self, where: str, remove: str, leave_out: str) -> None:
        self.where, self.remove, self._leave_out = where, remove, leave_out

    def leave_out(self, key: NestedKey) -> str:
        return self._leave_out.format(key=key)

    def named(self, states: Any) -> Mapping[str, Any]:
        """Returns observations as the entries of the root."""
        if not isinstance(states, Mapping) or "observation" not in states:
            return {"observation": states}
        taken = sorted(_TAKEN & set(states))
        if taken:
            raise ValueError(
                f"the observations in {self.where} have entries named {taken}, which "
                "are keys of transitions: rename them in the dataset"
            )
        return states

    def arrays(
        self, tree: Mapping[str, Any], above: tuple[str, ...] = ()
    ) -> dict[str, Any]:
        """Returns a nested mapping with NumPy arrays of numbers."""
        result: dict[str, Any] = {}
        if not tree:
            raise ValueError(
                f"{_key(above)!r} in {self.where} has no entries: "
                f"{self.leave_out(_key(above))}"
            )
        for name, value in tree.items():
            if not isinstance(name, str):
                raise ValueError(
                    f"an entry of {_key(above)!r} in {self.where} is named {name!r}, a "
                    f"{type(name).__name__}, expected a str: rename it"
                )
            key = (*above, name)
            if isinstance(value, Mapping):
                result[name] = self.arrays(value, key)
            else:
                result[name] = self._array(value, _key(key))
        return result

    def _array(self, value: Any, key: NestedKey) -> NDArray[Any]:
        if isinstance(value, tuple) and not all(np.isscalar(x) for x in value):
            raise ValueError(
                f"{key!r} in {self.where} is a tuple of spaces, which has no keys: "
                f"convert it to a dict, or {self.leave_out(key)}"
            )
        if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
            raise ValueError(
                f"{key!r} in {self.where} has masked values: {self.remove}"
            )
        array = to_numpy(value)
        if array.dtype.kind not in "biuf" or array.dtype == np.longdouble:
            kind = {"O": "Python objects", "S": "bytes", "U": "text"}
            raise ValueError(
                f"{key!r} in {self.where} has "
                f"{kind.get(array.dtype.kind, array.dtype)}, expected numbers: "
                f"{self.leave_out(key)}, or convert it in the dataset"
            )
        return array

    def check_lengths(
        self,
        tree: Mapping[str, Any],
        length: int | tuple[int, ...],
        remedy: str = "",
        above: tuple[str, ...] = (),
    ) -> None:
        """Raises if arrays have other numbers of entries."""
        wanted = (length,) if isinstance(length, int) else length
        for name, value in tree.items():
            key = (*above, name)
            if isinstance(value, dict):
                self.check_lengths(value, length, remedy, key)
            elif _length(value) not in wanted:
                entries = len(value) if value.ndim else "no"
                expected = " or ".join(map(str, wanted))
                raise ValueError(
                    f"{_key(key)!r} in {self.where} has {entries} entries, expected "
                    f"{expected}{remedy}: correct it, or {self.remove}"
                )

    def check_same(
        self,
        now: Mapping[str, Any],
        after: Mapping[str, Any],
        above: tuple[str, ...] = (),
    ) -> None:
        """Raises if the next observations have another structure."""
        lacking = sorted(set(now) ^ set(after))
        if lacking:
            raise ValueError(
                f"in {self.where}, only one of the observations and the next "
                f"observations has {lacking}"
                f"{f' under {_key(above)!r}' if above else ''}: give both"
            )
        for name, value in now.items():
            key, other = (*above, name), after[name]
            nested = isinstance(value, dict), isinstance(other, dict)
            if all(nested):
                self.check_same(value, other, key)
            elif any(nested) or (value.shape[1:] != other.shape[1:]):
                shapes = [_shape(item) for item in (value, other)]
                raise ValueError(
                    f"{_key(key)!r} in {self.where} has shape {shapes[0]} in the "
                    f"observations and {shapes[1]} in the next observations: give the "
                    "same columns"
                )

    def column(self, name: str, value: Any, length: int) -> NDArray[Any]:
        """Returns one number a step, ``[L, 1]``."""
        array = self._array(value, name)
        if array.shape not in ((length,), (length, 1)):
            found = f"{len(array)} entries" if array.ndim == 1 else list(array.shape)
            raise ValueError(
                f"{name!r} in {self.where} has {found}, expected {length}, one number "
                f"for each action: {self.remove}"
            )
        return array.reshape(length, 1)

    def flags(self, name: str, value: Any, length: int) -> torch.Tensor:
        """Returns flags, bool ``[L, 1]``."""
        if value is None:
            return torch.zeros(length, 1, dtype=torch.bool)
        array = self.column(name, value, length)
        flags = array.astype(bool)
        if not (flags == array).all():
            wrong = array[flags != array].flat[0]
            raise ValueError(
                f"{name!r} in {self.where} has the value {wrong}, expected flags (0 or "
                "1): convert it"
            )
        return torch.from_numpy(np.array(flags))

    def tensors(
        self, tree: Mapping[str, Any], above: tuple[str, ...] = (), *, cast: bool = True
    ) -> dict[str, Any]:
        """Returns a nested mapping with tensors, after checking the numbers."""
        result: dict[str, Any] = {}
        for name, value in tree.items():
            key = (*above, name)
            if isinstance(value, dict):
                result[name] = self.tensors(value, key, cast=cast)
                continue
            # Copied, because a library may return read-only arrays, in this machine's
            # byte order, because torch has no other one.
            dtype = (
                _WIDER.get(value.dtype.itemsize) if value.dtype.kind == "u" else None
            )
            array = np.array(value, dtype or value.dtype.newbyteorder("="))
            if value.dtype.itemsize == 8 and dtype and (array < 0).any():
                raise ValueError(
                    f"{_key(key)!r} in {self.where} has numbers above 2**63, which no "
                    f"tensor can hold: {self.leave_out(_key(key))}"
                )
            if np.issubdtype(array.dtype, np.floating):
                with np.errstate(over="ignore"):
                    array = array.astype(np.float32, copy=False) if cast else array
                if not np.isfinite(array).all():
                    raise ValueError(
                        f"{_key(key)!r} in {self.where} has NaN or infinite values "
                        f"(as {array.dtype}): {self.remove}"
                    )
            result[name] = torch.from_numpy(array)
        return result


def _key(path: tuple[str, ...]) -> NestedKey:
    return path[0] if len(path) == 1 else path


def _length(value: Any) -> int:
    """Returns the number of entries of an array, or of the first one of a mapping."""
    while isinstance(value, dict):
        value = next(iter(value.values()))
    return len(value) if value.ndim else -1


def _shape(value: Any) -> Any:
    return sorted(value) if isinstance(value, dict) else list(value.shape)
