"""Nested mappings of NumPy arrays: copies, stacks and their entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["copy_tree", "index_tree", "stack_trees"]


def copy_tree(tree: Any) -> Any:
    """Copies an array, or all arrays of a nested mapping.

    Args:
        tree (array or mapping of str to tree): the arrays. Some environments return
            views of simulator memory.

    Returns:
        numpy.ndarray or dict: the copies.

    Examples:
        >>> from torchrl_caiac.data.trees import copy_tree
        >>> copy_tree({"a": {"b": 1}})
        {'a': {'b': array(1)}}
    """
    if isinstance(tree, Mapping):
        return {key: copy_tree(value) for key, value in tree.items()}
    return np.array(tree)


def stack_trees(trees: Sequence[Any]) -> Any:
    """Stacks arrays, or nested mappings of arrays with the same keys.

    Args:
        trees (sequence of arrays or mappings of str to tree): ``M`` trees of arrays
            with shapes ``[*]``.

    Returns:
        numpy.ndarray or dict: one tree of arrays with shapes ``[M, *]``.

    Examples:
        >>> from torchrl_caiac.data.trees import stack_trees
        >>> stack_trees([{"a": 1}, {"a": 2}])
        {'a': array([1, 2])}
    """
    if isinstance(trees[0], Mapping):
        return {key: stack_trees([tree[key] for tree in trees]) for key in trees[0]}
    return np.stack(trees)


def index_tree(tree: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Returns one entry of a nested mapping of arrays, as before :func:`stack_trees`.

    Args:
        tree (mapping of str to tree): arrays with shapes ``[M, *]``.
        index (int): the entry.

    Returns:
        dict: the same mapping, with arrays of shapes ``[*]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.trees import index_tree
        >>> index_tree({"a": np.array([1, 2])}, 1)["a"].item()
        2
    """
    return {
        key: index_tree(value, index) if isinstance(value, Mapping) else value[index]
        for key, value in tree.items()
    }
