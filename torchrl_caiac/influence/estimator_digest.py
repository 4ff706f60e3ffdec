"""A digest of what an estimator computes, which tells its scores from others."""

from __future__ import annotations

import functools
import hashlib
import re
import sys
import types
from collections.abc import Iterator, Mapping, Set
from typing import Any

import numpy as np
import torch
from tensordict import is_tensor_collection
from torch import nn

from torchrl_caiac._torchrl import tensor_version
from torchrl_caiac.entities import EntityLayout

__all__ = ["DigestCache", "estimator_digest"]

# What torch itself keeps in modules; parameters, buffers and modules are in the state.
_OF_TORCH = frozenset(vars(nn.Module()))
# The globals of these packages are no settings of an estimator.
_LIBRARIES = sys.stdlib_module_names | {"numpy", "scipy", "tensordict", "torch"}
_LIBRARIES |= {"torchrl"}
_PLAIN = (str, bytes, int, float, complex, type(None))
_FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial)
# Functions that are settings as they are, like models.
_SETTINGS = (types.FunctionType, types.BuiltinFunctionType, functools.partial)
_CONTAINERS = (Mapping, list, tuple, Set)
_MODELS = (nn.Module, torch.Tensor, np.ndarray)


def estimator_digest(estimator: Any) -> str:
    """Returns a digest of what an estimator computes.

    Its type, ``repr`` and ``state_dict`` enter the digest. So do its attributes, unless
    its class has a ``__repr__`` (a module: an ``extra_repr``) of its own, which then
    names the settings. Models, tensors and functions in its attributes always do, with
    their content, also those inside of containers and other objects. Of a function, the
    code, the values that it has bound, and the global models, tensors, functions,
    numbers and texts that it names enter. Attributes that a ``__getstate__`` leaves
    out, such as a simulator, do not.

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
    kind = estimator if hasattr(estimator, "__qualname__") else type(estimator)
    name = f"{kind.__module__}.{kind.__qualname__}".encode()
    return hashlib.sha256(name + _Contents().digest(estimator)).hexdigest()


class DigestCache:
    """Returns digests of an estimator, and reads its weights only if they changed.

    A change of a parameter or buffer is noticed by its address and by torch's count of
    the writes to it. So a write to ``parameter.data`` in place is not noticed: write to
    the parameter itself, under :func:`torch.no_grad`. Everything else is looked at in
    each call. The cache is empty after pickling.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.estimator_digest import DigestCache
        >>> model, cache = torch.nn.Linear(2, 2), DigestCache()
        >>> before = cache.digest(model)
        >>> cache.digest(model) == before
        True
        >>> _ = torch.nn.init.zeros_(model.weight)
        >>> cache.digest(model) == before
        False
    """

    def __init__(self) -> None:
        # With the weights, whose addresses would be used again if they were freed.
        self._last: tuple[bytes, list[torch.Tensor], str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Returns an empty cache, since addresses are those of this process."""
        return {"_last": None}

    def digest(self, estimator: Any) -> str:
        """Returns the same as :func:`estimator_digest`.

        Args:
            estimator (callable): the estimator.

        Returns:
            str: hexadecimal SHA-256.
        """
        contents = _Contents(versions=True)
        version = contents.digest(estimator)
        if self._last is None or self._last[0] != version:
            self._last = version, contents.weights, estimator_digest(estimator)
        return self._last[2]


class _Contents:
    """Digests of values, by what their behaviour depends on as far as it can be known.

    A value is looked at once. So values that are part of themselves have a digest, and
    equal values have the same digest, whether or not they are the same object.

    Keyword Args:
        versions (bool): weights of modules enter with their versions, instead of their
            values, and are listed in ``weights``. Defaults to ``False``.
    """

    def __init__(self, *, versions: bool = False) -> None:
        self._versions = versions
        self.weights: list[torch.Tensor] = []
        # With the values, whose ids would be used again if they were freed.
        self._known: dict[tuple[int, bool], tuple[Any, bytes]] = {}

    def digest(self, value: Any, *, models: bool = False) -> bytes:
        """Returns the digest of a value.

        Args:
            value (object): the value.

        Keyword Args:
            models (bool): of the models and tensors in it only. The digest is
                empty if there are none.
        """
        known = (id(value), models)
        if known not in self._known:
            self._known[known] = (value, b"" if models else b"itself")
            parts = self._models(value) if models else self._parts(value)
            digest, is_empty = hashlib.sha256(), models
            for part in parts:
                digest.update(f"{len(part)}:".encode())
                digest.update(part)
                is_empty = False
            self._known[known] = (value, b"" if is_empty else digest.digest())
        return self._known[known][1]

    def _parts(self, value: Any) -> Iterator[bytes]:
        if isinstance(value, torch.Tensor):
            yield f"{value.dtype}{list(value.shape)}".encode()
            flat = value.detach().cpu().contiguous().reshape(-1)
            yield flat.view(torch.uint8).numpy().tobytes()
        elif isinstance(value, np.ndarray):
            yield f"{value.dtype}{value.shape}".encode()
            if value.dtype.hasobject:
                yield self.digest(value.tolist())
            else:
                yield np.ascontiguousarray(value).tobytes()
        elif isinstance(value, EntityLayout):
            return  # has a digest of its own
        elif isinstance(value, nn.Module):
            yield _text(value)
            weights: dict[str, torch.Tensor] = {
                **dict(value.named_parameters(remove_duplicate=False)),
                **dict(value.named_buffers(remove_duplicate=False)),
            }
            state = {**value.state_dict(), **weights}
            for name in sorted(state):
                yield name.encode()
                version = tensor_version(weights[name]) if name in weights else None
                if self._versions and version is not None:
                    self.weights.append(weights[name])
                    yield repr(version).encode()
                else:
                    yield self.digest(state[name])
            for name, module in value.named_modules():
                yield name.encode()
                described = _is_described(module)
                yield self.digest(_attributes(module), models=described)
        elif _is_tensordict(value):
            yield str(list(value.batch_size)).encode()
            yield self.digest(dict(value.items()))
        elif isinstance(value, _CONTAINERS):
            yield type(value).__qualname__.encode()
            for label, item in self._items(value):
                yield label
                yield self.digest(item)
        elif isinstance(value, types.MethodType):
            yield self.digest(value.__func__)
            yield self.digest(value.__self__)
        elif isinstance(value, functools.partial):
            yield self.digest([value.func, value.args, value.keywords])
        elif isinstance(value, types.FunctionType):
            yield self.digest(value.__code__)
            bound = [cell.cell_contents for cell in value.__closure__ or ()]
            defaults = [value.__defaults__, value.__kwdefaults__]
            yield self.digest([bound, defaults, vars(value)])
            yield from self._globals(value)
        elif isinstance(value, types.CodeType):
            yield value.co_code
            yield self.digest([value.co_names, value.co_consts])
        else:
            yield _text(value)
            if isinstance(value, (*_PLAIN, type, types.ModuleType)):
                return
            if hasattr(value, "state_dict"):
                yield self.digest(value.state_dict())
            yield self.digest(_attributes(value), models=_is_described(value))

    def _models(self, value: Any) -> Iterator[bytes]:
        """Yields the models, tensors and functions that the ``repr`` leaves out."""
        if isinstance(value, (*_PLAIN, type, types.ModuleType, EntityLayout)):
            return
        if isinstance(value, (*_SETTINGS, *_MODELS)) or _is_tensordict(value):
            found = self.digest(value)
            if found != b"itself":
                yield found
        else:
            inside = value if isinstance(value, _CONTAINERS) else _attributes(value)
            if isinstance(value, types.MethodType):
                inside = [value.__func__, value.__self__]
            for label, item in self._items(inside):
                found = self.digest(item, models=True)
                if found:
                    yield label
                    yield found

    def _items(self, value: Any) -> Iterator[tuple[bytes, Any]]:
        """Yields the items of a container in an order that is always the same."""
        if isinstance(value, Mapping):
            for key in sorted(value, key=repr):
                yield _text(key), value[key]
        else:
            items = sorted(value, key=self.digest) if isinstance(value, Set) else value
            for i, item in enumerate(items):
                yield str(i).encode(), item

    def _globals(self, function: types.FunctionType) -> Iterator[bytes]:
        """Yields the models, functions and constants that a function names."""
        known = function.__globals__
        if str(known.get("__name__")).partition(".")[0] in _LIBRARIES:
            return
        for name in sorted(_names(function.__code__) & known.keys()):
            value = known[name]
            if isinstance(value, _PLAIN):
                yield name.encode()
                yield self.digest(value)
            elif isinstance(value, (*_MODELS, *_FUNCTIONS, *_CONTAINERS)):
                yield name.encode()
                yield self.digest(value, models=not isinstance(value, _FUNCTIONS))


def _names(code: types.CodeType) -> set[str]:
    """Returns the names of globals and attributes in a code object."""
    inside = (part for part in code.co_consts if isinstance(part, types.CodeType))
    return set(code.co_names).union(*map(_names, inside))


def _is_tensordict(value: Any) -> bool:
    return is_tensor_collection(value) and not isinstance(value, type)


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
    """Returns the attributes of a value, without those that it does not pickle."""
    found = _pickled(value)
    if found is None:
        found = _all_attributes(value)
    if isinstance(value, nn.Module):
        found = {name: v for name, v in found.items() if name not in _OF_TORCH}
    return found


def _pickled(value: Any) -> dict[str, Any] | None:
    """Returns what a ``__getstate__`` of the value's own class returns."""
    get = getattr(type(value), "__getstate__", None)
    if get is None or get is getattr(object, "__getstate__", None):
        return None
    found = get(value)
    return dict(found) if isinstance(found, dict) else None


def _all_attributes(value: Any) -> dict[str, Any]:
    slots = (getattr(kind, "__slots__", ()) for kind in type(value).__mro__)
    names = [n for own in slots for n in ((own,) if isinstance(own, str) else own)]
    found = {name: getattr(value, name) for name in names if hasattr(value, name)}
    return found | getattr(value, "__dict__", {})
