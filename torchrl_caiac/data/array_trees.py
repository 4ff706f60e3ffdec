"""Nested mappings of arrays of any library, which may be larger than the memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import is_tensor_collection

__all__ = [
    "check_arrays",
    "copied",
    "cut",
    "entries",
    "episode_list",
    "is_floating",
    "joined",
    "plain_tree",
    "row_bytes",
    "to_numpy",
    "with_goals",
]


def to_numpy(value: Any) -> NDArray[Any]:
    """Returns an array as NumPy's, on the CPU, with its type where NumPy has it.

    Args:
        value (array): a tensor, or what ``numpy.asarray`` converts.

    Returns:
        numpy.ndarray: the array. bfloat16, which NumPy lacks, becomes float32; lists of
        different lengths become an empty array of objects.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.data.array_trees import to_numpy
        >>> to_numpy(torch.ones(2, requires_grad=True))
        array([1., 1.], dtype=float32)
    """
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().as_subclass(torch.Tensor)
        return (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    try:
        return np.asarray(value)
    except ValueError:  # lists of different lengths
        return np.empty(0, object)


def plain_tree(tree: Any) -> Any:
    """Returns tensordicts as nested mappings, and everything else as it is.

    Args:
        tree (tree or list of trees): arrays, mappings and tensordicts ``[T]``.

    Returns:
        tree or list of trees: the same without tensordicts. No array is copied.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.array_trees import plain_tree
        >>> plain_tree([TensorDict({"a": torch.zeros(2)}, [2])])
        [{'a': tensor([0., 0.])}]
    """
    if is_tensor_collection(tree):
        # Not to_dict(), which would give the data of entries that are not tensors.
        return {key: plain_tree(tree.get(key)) for key in tree.keys()}  # noqa: SIM118
    if isinstance(tree, Mapping):
        return {key: plain_tree(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)) and any(
        isinstance(item, Mapping) or is_tensor_collection(item) for item in tree
    ):
        return [plain_tree(item) for item in tree]
    return tree


def is_floating(value: Any) -> bool:
    """Returns whether an array has floating-point numbers.

    Args:
        value (array): the array, of any library.

    Returns:
        bool: ``False`` also if it does not tell.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.data.array_trees import is_floating
        >>> is_floating(torch.zeros(3))
        True
    """
    dtype = getattr(value, "dtype", None)
    return bool(
        getattr(dtype, "kind", "") == "f" or getattr(dtype, "is_floating_point", False)
    )


def cut(tree: Any, rows: slice) -> Any:
    """Returns some rows of an array, or of all arrays of a nested mapping.

    Args:
        tree (array or mapping of str to tree, optional): arrays ``[T, ...]``.
        rows (slice): the rows.

    Returns:
        array or dict: the rows; ``None`` for ``None``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import cut
        >>> cut({"a": np.arange(4)}, slice(1, 3))
        {'a': array([1, 2])}
    """
    if tree is None:
        return None
    if isinstance(tree, Mapping):
        return {key: cut(value, rows) for key, value in tree.items()}
    return tree[rows]


def copied(tree: Any) -> Any:
    """Returns a copy of an array, or of all arrays of a nested mapping, on the CPU.

    Args:
        tree (array or mapping of str to tree, optional): arrays ``[T, ...]``.

    Returns:
        numpy.ndarray or dict: the copy; ``None`` for ``None``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import copied
        >>> copied({"a": np.arange(2)})
        {'a': array([0, 1])}
    """
    if tree is None:
        return None
    if isinstance(tree, Mapping):
        return {key: copied(value) for key, value in tree.items()}
    # Masks are kept: masked values are refused later.
    return tree.copy() if isinstance(tree, np.ma.MaskedArray) else to_numpy(tree).copy()


def joined(before: Any, after: Any) -> Any:
    """Returns the rows of one tree followed by those of another.

    Args:
        before (array or mapping of str to tree, optional): arrays ``[T, ...]``.
        after (array or mapping of str to tree, optional): arrays ``[U, ...]``, with the
            same entries and shapes after the first dimension.

    Returns:
        numpy.ndarray or dict: ``[T + U, ...]``; ``None`` for two ``None``.

    Raises:
        ValueError: they have other entries or shapes.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import joined
        >>> joined({"a": np.arange(2)}, {"a": np.arange(1)})
        {'a': array([0, 1, 0])}
    """
    if before is None and after is None:
        return None
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        if before.keys() != after.keys():
            raise ValueError(
                f"the entries {sorted(before)} are followed by {sorted(after)}"
            )
        return {key: joined(before[key], after[key]) for key in before}
    if isinstance(before, Mapping) or isinstance(after, Mapping):
        raise ValueError("a mapping is followed by an array, or an array by a mapping")
    arrays = [
        part if isinstance(part, np.ma.MaskedArray) else to_numpy(part)
        for part in (before, after)
    ]
    if arrays[0].shape[1:] != arrays[1].shape[1:] or arrays[0].dtype != arrays[1].dtype:
        kinds = [f"{array.dtype} {list(array.shape)}" for array in arrays]
        raise ValueError(f"{kinds[0]} is followed by {kinds[1]}")
    has_mask = any(isinstance(array, np.ma.MaskedArray) for array in arrays)
    return np.ma.concatenate(arrays) if has_mask else np.concatenate(arrays)


def row_bytes(tree: Any) -> int:
    """Returns the size of one row of all arrays of a tree.

    Args:
        tree (array or mapping of str to tree): arrays ``[T, ...]``.

    Returns:
        int: bytes; of arrays that do not tell, 8 for each number.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import row_bytes
        >>> row_bytes({"a": np.zeros((5, 3), np.float32)})
        12
    """
    return sum(
        math.prod(leaf.shape[1:]) * getattr(getattr(leaf, "dtype", None), "itemsize", 8)
        for _, leaf in _leaves(tree, "")
    )


def entries(tree: Any, name: str, where: str) -> int:
    """Returns the number of rows that all arrays of a tree have.

    Args:
        tree (array or mapping of str to tree): arrays ``[T, ...]``.
        name (str): the tree's name in the error message.
        where (str): the name of the data in the error message.

    Returns:
        int: the number, ``T``.

    Raises:
        ValueError: the arrays have different numbers of rows.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import entries
        >>> entries({"a": np.zeros((5, 3))}, "observations", "the arrays")
        5
    """
    counts = {key: int(leaf.shape[0]) for key, leaf in _leaves(tree, name)}
    if len(set(counts.values())) > 1:
        raise ValueError(
            f"the arrays of {name} in {where} have different numbers of entries: "
            f"{counts}; correct them"
        )
    return next(iter(counts.values()))


def check_arrays(tree: Any, name: str, where: str) -> None:
    """Raises if a tree has something else than arrays with rows.

    Args:
        tree (array or mapping of str to tree): what the user gave.
        name (str): the tree's name in the error message.
        where (str): the name of the data in the error message.

    Raises:
        ValueError: a leaf is not an array with at least one dimension, or has Python
            objects; or a mapping is empty or has a key that is not a str.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import check_arrays
        >>> check_arrays({"a": np.zeros((5, 3))}, "observations", "the arrays")
    """
    if isinstance(tree, Mapping) and not tree:
        raise ValueError(f"{name} of {where} has no entries: give at least one array")
    for key, leaf in _leaves(tree, name):
        if not hasattr(leaf, "shape") or not hasattr(leaf, "__getitem__"):
            raise ValueError(
                f"{key} of {where} is a {type(leaf).__name__}, expected an array: "
                "convert it with numpy.asarray, or give lists with one array for each "
                "episode for everything"
            )
        if not len(leaf.shape):
            raise ValueError(
                f"{key} of {where} is one number, expected an array with one entry for "
                "each step"
            )
        if getattr(getattr(leaf, "dtype", None), "kind", "") == "O":
            raise ValueError(
                f"{key} of {where} has Python objects, expected numbers: if they are "
                f"the arrays of episodes, pass list({key}), else convert them"
            )


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yields all arrays, with their names for messages."""
    if not isinstance(tree, Mapping):
        yield name, tree
        return
    for key, value in tree.items():
        if not isinstance(key, str):
            raise ValueError(
                f"an entry of {name} is named {key!r}, a {type(key).__name__}, "
                "expected a str: rename it"
            )
        yield from _leaves(value, f"{name}[{key!r}]")


def episode_list(tree: Any, name: str) -> list[Any] | None:
    """Returns the tree of each episode, of a list or of a mapping of lists.

    Args:
        tree (list of trees, mapping of lists, array or mapping of arrays): what the
            user gave.
        name (str): its name in error messages.

    Returns:
        list of trees, optional: one for each episode; ``None`` for flat arrays.

    Raises:
        ValueError: a mapping has lists and arrays, or lists of different lengths; or a
            list has something else than arrays.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import episode_list
        >>> episode_list({"a": [np.zeros(3), np.zeros(2)]}, "observations")
        [{'a': array([0., 0., 0.])}, {'a': array([0., 0.])}]
        >>> episode_list(np.zeros((5, 3)), "observations")
    """
    if isinstance(tree, (list, tuple)):
        return [_episode(item, f"{name}[{n}]") for n, item in enumerate(tree)]
    if not isinstance(tree, Mapping) or not tree:
        return None
    parts = {key: episode_list(tree[key], f"{name}[{key!r}]") for key in tree}
    counts = {key: None if part is None else len(part) for key, part in parts.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(
            f"the entries of {name} are lists of these lengths (None: no list): "
            f"{counts}; give a list with one array for each episode for all of them, "
            "or flat arrays"
        )
    number = next(iter(counts.values()))
    if number is None:
        return None
    return [{k: (part or [])[n] for k, part in parts.items()} for n in range(number)]


def _episode(item: Any, name: str) -> Any:
    if isinstance(item, Mapping):
        return item
    array = item if hasattr(item, "shape") else to_numpy(item)
    if not len(array.shape) or getattr(array.dtype, "kind", "") in {"O", "U", "S"}:
        raise ValueError(
            f"{name} is a {type(item).__name__}, expected the array of one episode: a "
            "list has one array for each episode; for flat arrays, convert the list "
            "with numpy.asarray"
        )
    return array


def with_goals(observations: Any, achieved: Any, desired: Any) -> Any:
    """Returns observations as in goal environments, if there are goals.

    Args:
        observations (tree or list of trees): the observations.
        achieved (tree or list of trees, optional): the achieved goals.
        desired (tree or list of trees, optional): the desired goals.

    Returns:
        tree or list of trees: a mapping with the entries ``"observation"``,
        ``"achieved_goal"`` and ``"desired_goal"``, for each episode of a list; the
        observations themselves without goals.

    Raises:
        ValueError: the observations have goals already, or lists are mixed with arrays
            or have different lengths.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_trees import with_goals
        >>> sorted(with_goals(np.zeros((5, 3)), np.zeros((5, 2)), None))
        ['achieved_goal', 'observation']
    """
    goals = {"achieved_goal": achieved, "desired_goal": desired}
    goals = {key: value for key, value in goals.items() if value is not None}
    if not goals:
        return observations
    states = episode_list(observations, "observations")
    lists = {key: episode_list(value, f"{key}s") for key, value in goals.items()}
    if states is None and not any(lists.values()):
        return _named(observations, goals)
    counts = {key: -1 if part is None else len(part) for key, part in lists.items()}
    if states is None or any(count != len(states) for count in counts.values()):
        raise ValueError(
            f"observations has {'no list' if states is None else len(states)} and the "
            f"goals have {counts} episodes (-1: no list): give a list with one array "
            "for each episode for all of them, or flat arrays"
        )
    return [
        _named(state, {key: (part or [])[n] for key, part in lists.items()})
        for n, state in enumerate(states)
    ]


def _named(state: Any, goals: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(state, Mapping) or "observation" not in state:
        return {"observation": state, **goals}
    both = sorted(goals.keys() & state.keys())
    if both:
        raise ValueError(
            f"the observations have {both} already: leave out "
            f"{' and '.join(f'{key}s=' for key in both)}"
        )
    return {**state, **goals}
