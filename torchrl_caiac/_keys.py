"""Nested keys: their canonical form, their JSON form, and errors for missing ones."""

from __future__ import annotations

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
    """Returns a key in its canonical form, a ``str`` or a flat ``tuple`` of them.

    Args:
        key (NestedKey): the key given by the user.

    Returns:
        NestedKey: the canonical key.

    Raises:
        TypeError: ``key`` is not a key.

    Examples:
        >>> from torchrl_caiac._keys import as_key
        >>> as_key((("next", "observation"),)), as_key(("done",))
        (('next', 'observation'), 'done')
    """
    if not _is_key(key):
        raise TypeError(f"a key must be a str or a tuple of str, got {key!r}")
    return unravel_key(key)


def _is_key(key: Any) -> bool:
    # unravel_key leaves out what is not a str.
    return isinstance(key, str) or (
        isinstance(key, tuple) and bool(key) and all(map(_is_key, key))
    )


def path(key: NestedKey) -> tuple[str, ...]:
    """Returns a canonical key as a tuple, even if it has only one part.

    Args:
        key (NestedKey): the canonical key.

    Returns:
        tuple of str: its parts.

    Examples:
        >>> from torchrl_caiac._keys import path
        >>> path("done"), path(("next", "done"))
        (('done',), ('next', 'done'))
    """
    return (key,) if isinstance(key, str) else tuple(key)


def join(*keys: NestedKey) -> NestedKey:
    """Returns the key of an entry below other entries.

    Args:
        *keys (NestedKey): the keys, from the outermost to the innermost.

    Returns:
        NestedKey: the canonical key.

    Examples:
        >>> from torchrl_caiac._keys import join
        >>> join("next", ("observation", "arm"))
        ('next', 'observation', 'arm')
    """
    return unravel_key(tuple(part for key in keys for part in path(key)))


def jsonable(key: NestedKey | None) -> Any:
    """Returns a key in its JSON form, in which a tuple becomes a list.

    Args:
        key (NestedKey, optional): the key.

    Returns:
        str, list of str or None: the JSON form.

    Examples:
        >>> from torchrl_caiac._keys import jsonable
        >>> jsonable(("next", "done")), jsonable("done")
        (['next', 'done'], 'done')
    """
    return list(key) if isinstance(key, tuple) else key


def key_from_json(value: Any) -> Any:
    """Returns the key that :func:`jsonable` converted.

    Args:
        value (Any): the JSON form.

    Returns:
        NestedKey: the key.

    Examples:
        >>> from torchrl_caiac._keys import key_from_json
        >>> key_from_json(["next", "done"])
        ('next', 'done')
    """
    return tuple(value) if isinstance(value, list) else value


def leaf_names(td: TensorDictBase) -> list[str]:
    """Returns the keys of all leaves of a tensordict, sorted, for error messages.

    Args:
        td (TensorDictBase): the data.

    Returns:
        list of str: the key of each leaf, as text.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._keys import leaf_names
        >>> leaf_names(TensorDict({"b": 0, "a": {"c": 1}}))
        ["('a', 'c')", 'b']
    """
    return sorted(map(str, td.keys(include_nested=True, leaves_only=True)))


def missing_key(
    td: TensorDictBase, keys: NestedKey | list[NestedKey], what: str, remedy: str
) -> KeyError:
    """Returns the error to raise if data lack a key.

    Args:
        td (TensorDictBase): the data.
        keys (NestedKey or list of NestedKey): the missing key or keys.
        what (str): the beginning of the message, which names the data and the meaning
            of the key, such as ``"the storage lacks the observation"``.
        remedy (str): the end of the message, which says what to do.

    Returns:
        KeyError: the error.

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
    """Returns a tensor of a tensordict.

    Args:
        td (TensorDictBase): the data.
        key (NestedKey): the key of the tensor.
        what (str): as in :func:`missing_key`.
        remedy (str): as in :func:`missing_key`.

    Returns:
        torch.Tensor: the tensor.

    Raises:
        KeyError: the key is missing.
        TypeError: the entry is not a tensor.

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
        raise TypeError(f"{key!r} is a {type(value).__name__}, expected a tensor")
    return value


def flatten(value: Any, batch_dims: int) -> torch.Tensor:
    """Flattens an entry after its batch dimensions.

    Args:
        value (torch.Tensor or TensorDictBase): ``[*B, ...]``. The leaves of a
            tensordict are concatenated in the order of their sorted keys.
        batch_dims (int): the number of batch dimensions.

    Returns:
        torch.Tensor: ``[*B, W]``. Integers and booleans become floating point, see
        :func:`floating`.

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
    return floating(value).reshape(*value.shape[:batch_dims], -1)


def floating(value: torch.Tensor) -> torch.Tensor:
    """Returns a tensor to compute with: integers and booleans become floating point.

    Differences of unsigned integers would wrap around, and booleans have none.

    Args:
        value (torch.Tensor): ``[*]``, of any dtype.

    Returns:
        torch.Tensor: ``[*]``, the same tensor if it is in floating point; float64 for
        integers of 32 and 64 bits, and float32 for shorter ones, which it holds
        exactly.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._keys import floating
        >>> before, after = torch.tensor([[7], [6]], dtype=torch.uint8)
        >>> floating(after) - floating(before)
        tensor([-1.])
    """
    if value.is_floating_point():
        return value
    short = value.dtype.itemsize <= 2
    return value.to(torch.float32 if short else torch.float64)
