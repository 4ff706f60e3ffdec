"""Nested keys: one form, one way to look them up, one message when one is missing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey, unravel_key

__all__ = [
    "as_key",
    "flatten",
    "get_leaf",
    "join",
    "jsonable",
    "key_from_json",
    "leaf_names",
    "missing_key",
    "path",
]


def as_key(key: Any) -> NestedKey:
    """A key in its canonical form, a ``str`` or a flat ``tuple`` of them.

    Args:
        key (NestedKey): the key as a user gave it.

    Returns:
        NestedKey: the canonical key.

    Raises:
        TypeError: it is no key.

    Examples:
        >>> from torchrl_caiac._keys import as_key
        >>> as_key((("next", "observation"),)), as_key(("done",))
        (('next', 'observation'), 'done')
    """
    if not isinstance(key, (str, tuple)):
        raise TypeError(f"a key is a str or a tuple of str, got {key!r}")
    return unravel_key(key)


def path(key: NestedKey) -> tuple[str, ...]:
    """A canonical key as a tuple, even where it has one part.

    Args:
        key (NestedKey): the key.

    Returns:
        tuple of str: its parts.

    Examples:
        >>> from torchrl_caiac._keys import path
        >>> path("done"), path(("next", "done"))
        (('done',), ('next', 'done'))
    """
    return (key,) if isinstance(key, str) else tuple(key)


def join(*keys: NestedKey) -> NestedKey:
    """The key of an entry below other entries.

    Args:
        *keys (NestedKey): from the outermost to the innermost.

    Returns:
        NestedKey: the canonical key.

    Examples:
        >>> from torchrl_caiac._keys import join
        >>> join("next", ("observation", "arm"))
        ('next', 'observation', 'arm')
    """
    return unravel_key(tuple(part for key in keys for part in path(key)))


def jsonable(key: NestedKey | None) -> Any:
    """A key as JSON keeps it: a tuple becomes a list.

    Examples:
        >>> from torchrl_caiac._keys import jsonable
        >>> jsonable(("next", "done")), jsonable("done")
        (['next', 'done'], 'done')
    """
    return list(key) if isinstance(key, tuple) else key


def key_from_json(value: Any) -> Any:
    """The key that :func:`jsonable` described.

    Examples:
        >>> from torchrl_caiac._keys import key_from_json
        >>> key_from_json(["next", "done"])
        ('next', 'done')
    """
    return tuple(value) if isinstance(value, list) else value


def leaf_names(td: TensorDictBase) -> list[str]:
    """The leaves of a tensordict, sorted, to be named in an error.

    Args:
        td (TensorDictBase): the data.

    Returns:
        list of str: one text for each leaf.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._keys import leaf_names
        >>> leaf_names(TensorDict({"b": 0, "a": {"c": 1}}))
        ["('a', 'c')", 'b']
    """
    return sorted(map(str, td.keys(include_nested=True, leaves_only=True)))


def missing_key(
    td: TensorDictBase, keys: NestedKey | Iterable[NestedKey], what: str, remedy: str
) -> KeyError:
    """The error to raise where data lack what is read from them.

    Args:
        td (TensorDictBase): the data.
        keys (NestedKey or list of NestedKey): what is missing.
        what (str): the data and who reads them, such as ``"the storage lacks the
            observation"``.
        remedy (str): what to do about it.

    Returns:
        KeyError: to be raised.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._keys import missing_key
        >>> td = TensorDict({"obs": 0})
        >>> raise missing_key(td, "action", "the data lack the action", "rename it")
        Traceback (most recent call last):
        ...
        KeyError: "the data lack the action 'action'; they have ['obs']: rename it"
    """
    names = " and ".join(map(repr, keys)) if isinstance(keys, list) else repr(keys)
    return KeyError(f"{what} {names}; they have {leaf_names(td)}: {remedy}")


def get_leaf(
    td: TensorDictBase, key: NestedKey, what: str, remedy: str
) -> torch.Tensor:
    """A tensor of some data.

    Args:
        td (TensorDictBase): the data.
        key (NestedKey): where it is.
        what (str): as in :func:`missing_key`.
        remedy (str): as in :func:`missing_key`.

    Returns:
        torch.Tensor: the leaf.

    Raises:
        KeyError: there is none.
        TypeError: it is no tensor.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._keys import get_leaf
        >>> td = TensorDict({"action": torch.ones(2)})
        >>> get_leaf(td, "action", "the data lack", "rename it")
        tensor([1., 1.])
    """
    value = td.get(key, None)
    if value is None:
        raise missing_key(td, key, what, remedy)
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{key!r} is a {type(value).__name__}, wanted a tensor")
    return value


def flatten(value: Any, batch_dims: int) -> torch.Tensor:
    """The features of an entry side by side, in the order of their sorted names.

    Args:
        value (torch.Tensor or TensorDictBase): ``[*B, ...]``; a tensordict's leaves
            are flattened one after another.
        batch_dims (int): the number of batch dimensions.

    Returns:
        torch.Tensor: ``[*B, W]``; integers become floating point.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._keys import flatten
        >>> td = TensorDict({"b": torch.ones(2, 1), "a": torch.zeros(2, 2)}, [2])
        >>> flatten(td, 1)
        tensor([[0., 0., 1.],
                [0., 0., 1.]])
    """
    if is_tensor_collection(value):
        leaves = [value.get(key) for key in sorted(value.keys(), key=str)]
        return torch.cat([flatten(leaf, batch_dims) for leaf in leaves], -1)
    value = value if value.is_floating_point() else value.to(torch.get_default_dtype())
    return value.reshape(*value.shape[:batch_dims], -1)
