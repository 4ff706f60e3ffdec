"""A digest of what an estimator computes, which tells its scores from others."""

from __future__ import annotations

import functools
import hashlib
import re
import types
from collections.abc import Iterator, Mapping, Set
from typing import Any

import numpy as np
import torch
from torch import nn

from torchrl_caiac.entities import EntityLayout

__all__ = ["estimator_digest"]

# What torch itself keeps in modules; parameters, buffers and modules are in the state.
_OF_TORCH = frozenset(vars(nn.Module()))


def estimator_digest(estimator: Any) -> str:
    """Returns a digest of what an estimator computes.

    Its type, ``repr`` and ``state_dict`` enter the digest. So do its attributes, unless
    its class has a ``__repr__`` (a module: an ``extra_repr``) of its own, which then
    names the settings. Models and tensors among its attributes always do, with their
    content. Of a function, the code and the values that it has bound enter.

    Args:
        estimator (callable): the estimator.

    Returns:
        str: hexadecimal SHA-256.

    Examples:
        >>> from torchrl_caiac.influence.estimator_digest import estimator_digest
        >>> class Height:
        ...     def __init__(self, scale):
        ...         self.scale = scale
        >>> estimator_digest(Height(1.0)) == estimator_digest(Height(1.0))
        True
        >>> estimator_digest(Height(1.0)) == estimator_digest(Height(2.0))
        False
    """
    digest = hashlib.sha256()
    kind = estimator if hasattr(estimator, "__qualname__") else type(estimator)
    digest.update(f"{kind.__module__}.{kind.__qualname__}".encode())
    for part in _of_estimator(estimator):
        digest.update(part)
    return digest.hexdigest()


def _of_estimator(estimator: Any) -> Iterator[bytes]:
    """Yields the parts of an estimator, and models that its ``repr`` leaves out."""
    if isinstance(estimator, types.MethodType):
        yield from _parts(estimator.__func__, set())
        yield from _of_estimator(estimator.__self__)
        return
    yield from _parts(estimator, set())
    if _is_described(estimator):
        for name, value in sorted(_attributes(estimator).items()):
            if isinstance(value, (nn.Module, torch.Tensor, np.ndarray)):
                yield name.encode()
                yield from _parts(value, set())


def _parts(value: Any, seen: set[int]) -> Iterator[bytes]:
    """Yields what the behaviour of a value depends on, as far as it can be known."""
    if isinstance(value, torch.Tensor):
        yield f"{value.dtype}{list(value.shape)}".encode()
        flat = value.detach().cpu().contiguous().reshape(-1)
        yield flat.view(torch.uint8).numpy().tobytes()
        return
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
        return
    if isinstance(value, EntityLayout):
        return  # has a digest of its own
    if id(value) in seen:  # it is part of itself
        return
    seen = {*seen, id(value)}
    if isinstance(value, nn.Module):
        yield _text(value)
        state = value.state_dict()
        for name in sorted(state):
            yield name.encode()
            yield from _parts(state[name], seen)
        for name, module in value.named_modules():
            if not _is_described(module):
                yield name.encode()
                yield from _parts(_attributes(module), seen)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            yield repr(key).encode()
            yield from _parts(value[key], seen)
    elif isinstance(value, Set):
        yield repr(sorted(map(repr, value))).encode()
    elif isinstance(value, (list, tuple)):
        yield f"{type(value).__qualname__}{len(value)}".encode()
        for item in value:
            yield from _parts(item, seen)
    elif isinstance(value, types.MethodType):
        yield from _parts(value.__func__, seen)
        yield from _parts(value.__self__, seen)
    elif isinstance(value, functools.partial):
        yield from _parts([value.func, value.args, value.keywords], seen)
    elif isinstance(value, types.FunctionType):
        yield from _parts(value.__code__, seen)
        bound = [cell.cell_contents for cell in value.__closure__ or ()]
        defaults = [value.__defaults__, value.__kwdefaults__]
        yield from _parts([bound, defaults, vars(value)], seen)
    elif isinstance(value, types.CodeType):
        yield value.co_code
        yield from _parts([value.co_names, value.co_consts], seen)
    else:
        yield _text(value)
        if hasattr(value, "state_dict"):
            yield from _parts(value.state_dict(), seen)
        if not _is_described(value):
            yield from _parts(_attributes(value), seen)


def _text(value: Any) -> bytes:
    """Returns the ``repr`` of a value without addresses, which change."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value)).encode()


def _is_described(value: Any) -> bool:
    """Returns whether the ``repr`` of a value is one that its class was given."""
    kind = type(value)
    if isinstance(value, nn.Module):
        return (
            kind.extra_repr is not nn.Module.extra_repr
            or kind.__repr__ is not nn.Module.__repr__
        )
    return kind.__repr__ is not object.__repr__


def _attributes(value: Any) -> dict[str, Any]:
    slots = (getattr(kind, "__slots__", ()) for kind in type(value).__mro__)
    names = [name for names in slots for name in np.atleast_1d(names).tolist()]
    found = {name: getattr(value, name) for name in names if hasattr(value, name)}
    found |= getattr(value, "__dict__", {})
    if isinstance(value, nn.Module):
        found = {name: v for name, v in found.items() if name not in _OF_TORCH}
    return found
