"""Chooses what computes products of linear layers, by measuring on this processor."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import re
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from filelock import FileLock

from torchrl_caiac._files import UnreadableFileError, read_json, write_json

__all__ = [
    "UsedKernels",
    "cache_folder",
    "check_kernels",
    "choose",
    "keep_kernels",
    "kernel_mode",
    "known_kernel",
    "linear_kernel",
    "machine",
    "onednn_has_float32",
    "only_kernels",
    "processor_slug",
    "through_onednn",
]

_logger = logging.getLogger("torchrl_caiac.modules.linear")

_FORMAT = "torchrl_caiac.linear_kernels/1"
_CHOICES = ("plain", "onednn", "float32", "bfloat16")
# The time of another candidate, to that of the first, for it to be chosen.
_MARGIN = 0.9
_LEAST_ROUNDS, _MOST_ROUNDS, _SECONDS = 5, 20, 0.02


@dataclass
class _State:
    """What this process uses.

    Args:
        mode (str): ``"auto"``, or the kernel of all products.
        kept (dict): kernels of a checkpoint or of earlier scores, by name.
        only (bool): whether what is not kept gets the default.
        known (dict): what was found, by the key of :func:`known_kernel`.
    """

    mode: str = "auto"
    kept: dict[str, str] = field(default_factory=dict)
    only: bool = False
    known: dict[Any, str] = field(default_factory=dict)


_base = _State()
# Of the threads and tasks in one of the context managers below.
_scoped: ContextVar[_State | None] = ContextVar("linear_kernels", default=None)
_files: dict[Path | None, dict[str, str]] = {}
_watching: weakref.WeakSet[UsedKernels] = weakref.WeakSet()


def _state() -> _State:
    return _scoped.get() or _base


def _forget() -> None:
    """Has every kind of product looked up again."""
    _base.known.clear()
    _state().known.clear()


class UsedKernels:
    """Collects what is used from now on, for a checkpoint or a record of scores."""

    def __init__(self) -> None:
        self._chosen: dict[str, str] = {}
        _watching.add(self)
        _forget()

    def add(self, name: str, kernel: str) -> None:
        """Adds a choice."""
        self._chosen[name] = kernel

    def state(self) -> dict[str, Any]:
        """Returns what :func:`keep_kernels` and :func:`only_kernels` take, for JSON."""
        return {"kernel": _state().mode, "chosen": dict(sorted(self._chosen.items()))}


@contextmanager
def linear_kernel(kernel: Literal["auto", "plain", "onednn"]) -> Iterator[None]:
    """Context manager that sets what computes large products of linear layers.

    The goal-conditioned networks and the world models multiply float32 matrices on a
    CPU by one of two libraries. Which one is faster depends on the processor and on the
    shapes. Their results differ by rounding.

    - ``"plain"`` is :func:`torch.nn.functional.linear`, which takes MKL.
    - ``"onednn"`` is the same with ``torch.backends.mkldnn.matmul.fp32_precision`` set
      to ``"bf16"`` during the call, for which torch takes oneDNN. Processors without
      AMX then still compute in float32. Those with AMX would round to bfloat16, so
      there this kernel is refused. Scores are computed by oneDNN's own operator.
    - ``"auto"``, the default without this context manager, measures both when a shape
      occurs for the first time, in some milliseconds, and takes oneDNN if that saves
      10 % of the time. The choice is kept in a file in ``~/.cache/torchrl_caiac`` (or
      ``$XDG_CACHE_HOME/torchrl_caiac``), one for each processor, version of torch and
      number of threads, so that later runs make the same choices. Delete the file to
      measure again.

    :class:`~torchrl_caiac.checkpoint.TrainingCheckpoint` and the record of scores
    contain what was used, and a run that resumes, or a process that goes on scoring,
    uses the same.

    Args:
        kernel (str): ``"auto"``, ``"plain"`` or ``"onednn"``.

    Raises:
        ValueError: the kernel is unknown, or would round here.

    Examples:
        >>> from torchrl_caiac.modules import linear_kernel
        >>> with linear_kernel("plain"):
        ...     pass  # train
    """
    if kernel not in ("auto", "plain", "onednn"):
        raise ValueError(
            f'linear_kernel is {kernel!r}, expected "auto", "plain" or "onednn"'
        )
    if kernel == "onednn" and not onednn_has_float32():
        raise ValueError(
            "linear_kernel is 'onednn', but on this processor oneDNN would round "
            'float32 factors to bfloat16: use "auto" or "plain"'
        )
    with _using(_State(kernel, _state().kept)):
        yield


def kernel_mode() -> str:
    """Returns what :func:`linear_kernel` has set."""
    return _state().mode


@contextmanager
def only_kernels(state: Mapping[str, Any]) -> Iterator[None]:
    """Context manager that uses what is recorded, and the default for the rest.

    So several processes compute the same bits, whatever they would measure.

    Args:
        state (Mapping): as from :meth:`UsedKernels.state`.
    """
    state = _usable(state)
    with _using(_State(state["kernel"], dict(state["chosen"]), only=True)):
        yield


@contextmanager
def _using(state: _State) -> Iterator[None]:
    token = _scoped.set(state)
    try:
        yield
    finally:
        _scoped.reset(token)


def check_kernels(state: Any) -> None:
    """Raises if a value is not what :meth:`UsedKernels.state` returns.

    Raises:
        ValueError: it is another one, for example of a later version.
    """
    fits = (
        isinstance(state, dict)
        and state.get("kernel") in ("auto", "plain", "onednn")
        and _are_choices(state.get("chosen"))
    )
    if not fits:
        raise ValueError(f"the kernels of linear layers are {state!r}")


def keep_kernels(state: Mapping[str, Any]) -> None:
    """Uses what is recorded in this process from now on, where it occurs.

    Args:
        state (Mapping): as from :meth:`UsedKernels.state`.
    """
    _state().kept.update(_usable(state)["chosen"])
    _forget()


def _usable(state: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the kernels with those replaced that would round on this processor."""
    used = (state["kernel"], *state["chosen"].values())
    if "onednn" not in used or onednn_has_float32():
        return state
    _logger.warning(
        "products were computed by oneDNN on another processor, which would round them "
        "to bfloat16 on this one: they are computed by torch's F.linear, and results "
        "differ by rounding"
    )
    there = {"onednn": "plain"}
    return {
        "kernel": there.get(state["kernel"], state["kernel"]),
        "chosen": {name: there.get(x, x) for name, x in state["chosen"].items()},
    }


def known_kernel(
    key: Any, name: Callable[[], str], others: Callable[[], Mapping[str, Any]]
) -> str:
    """Returns what computes a product: ``"plain"``, or another kernel.

    Args:
        key (Any): the kind of product, hashable, with the number of threads.
        name (callable): returns a name of the kind for files.
        others (callable): as :func:`choose` takes it.
    """
    state = _state()
    kernel = state.known.get(key)
    if kernel is None:
        kernel = state.mode
        if kernel == "auto":
            kernel = choose(name(), "plain", others)
        state.known[key] = kernel
    return kernel


def choose(
    name: str, default: str, candidates: Callable[[], Mapping[str, Callable[[], Any]]]
) -> str:
    """Returns the fastest candidate: as recorded, from the file, or by measuring.

    Args:
        name (str): what is computed.
        default (str): the candidate that is taken unless another one takes less than
            0.9 of its time.
        candidates (callable): returns the candidates by name. It is called to measure
            them.

    Returns:
        str: the name of one.
    """
    state = _state()
    kernel = state.kept.get(name)
    if kernel is None and state.only:
        return default
    if kernel is None:
        file = _cache_file()
        kernel = _stored(file).get(name)
        if kernel is None:
            with torch.inference_mode(False):
                kernel = _fastest(default, candidates())
            kernel = _store(file, name, kernel)
    for used in list(_watching):
        used.add(name, kernel)
    return kernel


def _fastest(default: str, candidates: Mapping[str, Callable[[], Any]]) -> str:
    """Measures in turns, so that other load affects all, and takes the least times."""
    if len(candidates) == 1:
        return default
    # What other processes take does not count in the time of the only thread.
    clock = time.thread_time if torch.get_num_threads() == 1 else time.perf_counter
    times = dict.fromkeys(candidates, math.inf)
    begin = time.perf_counter()
    for number in range(_MOST_ROUNDS + 1):
        for name, call in candidates.items():
            start = clock()
            call()
            if number:  # the first call of a shape prepares it
                times[name] = min(times[name], clock() - start)
        if number >= _LEAST_ROUNDS and time.perf_counter() - begin > _SECONDS:
            break
    best = min(times, key=times.__getitem__)
    return best if times[best] < _MARGIN * times[default] else default


# --- the file ------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    """Returns what decides which kernel is the fastest, JSON-compatible.

    Examples:
        >>> from torchrl_caiac._kernels import machine
        >>> list(machine())
        ['processor', 'units', 'torch', 'threads']
    """
    capabilities = torch.cpu.get_capabilities()
    names = [str(capabilities.get("cpu_name", "unknown")), *_generation()]
    return {
        "processor": ", ".join(names),
        "units": sorted(name for name, has in capabilities.items() if has is True),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
    }


@cache
def _generation() -> list[str]:
    """Returns family and model, since virtual machines give many the same name."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # another system
        return []
    found = [
        re.search(rf"^{label}\s*: (\d+)$", text, re.MULTILINE)
        for label in ("cpu family", "model")
    ]
    return [
        f"{name} {match[1]}"
        for name, match in zip(("family", "model"), found, strict=True)
        if match
    ]


def processor_slug(name: str) -> str:
    """Returns the name of a processor for the name of a file.

    Examples:
        >>> from torchrl_caiac._kernels import processor_slug
        >>> processor_slug("Intel(R) Xeon(R) CPU @ 2.00GHz")
        'intel_r_xeon_r_cpu_2_00ghz'
    """
    return re.sub("[^a-z0-9]+", "_", name.lower()).strip("_") or "unknown"


def cache_folder() -> Path | None:
    """Returns the folder of what is kept for later processes, ``None`` without a home.

    Examples:
        >>> from torchrl_caiac._kernels import cache_folder
        >>> cache_folder().name
        'torchrl_caiac'
    """
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder, "torchrl_caiac") if os.path.isabs(folder) else None


def _cache_file() -> Path | None:
    """Returns the file of this processor's choices, ``None`` without a home."""
    folder = cache_folder()
    if folder is None:
        return None
    own = machine()
    digest = hashlib.sha256(json.dumps(own).encode()).hexdigest()[:12]
    slug = processor_slug(own["processor"])
    return folder / f"linear-{slug}-{digest}.json"


def _stored(file: Path | None) -> dict[str, str]:
    """Returns the choices in a file, which is read once."""
    if file not in _files:
        try:
            _files[file] = {} if file is None else _read(file)
        except (OSError, UnreadableFileError) as error:
            _logger.warning("%s: it is ignored, and written anew", error)
            _files[file] = {}
    return _files[file]


def _read(file: Path) -> dict[str, str]:
    try:
        content = read_json(file, "file of measured kernels", "delete it")
    except FileNotFoundError:
        return {}
    choices: Any = content.get("choices") if isinstance(content, dict) else None
    if not _are_choices(choices) or content != _content(choices):
        raise UnreadableFileError(
            f"{file} has no kernels that were measured with this processor, torch and "
            "number of threads"
        )
    return choices


def _store(file: Path | None, name: str, kernel: str) -> str:
    """Adds a choice to a file, unless another process has; returns what it contains."""
    if file is None:
        return _stored(file).setdefault(name, kernel)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(file.with_suffix(".lock"), timeout=1.0):
            try:
                choices = _read(file)
            except UnreadableFileError:
                choices = {}
            kernel = choices.setdefault(name, kernel)
            write_json(file, _content(choices))
            _files[file] = choices
    except (OSError, NotImplementedError) as error:  # a home without writing or locks
        _logger.info("cannot keep measured kernels in %s: %s", file, error)
        _stored(file)[name] = kernel
    return kernel


def _content(choices: Mapping[str, str]) -> dict[str, Any]:
    return {"format": _FORMAT, "machine": machine(), "choices": choices}


def _are_choices(value: Any) -> bool:
    return isinstance(value, dict) and all(x in _CHOICES for x in value.values())


# --- oneDNN --------------------------------------------------------------------------


@cache
def onednn_has_float32() -> bool:
    """Returns whether oneDNN multiplies in float32 on this processor."""
    if not torch.backends.mkldnn.is_available():
        return False
    # Not torch's generators, which a torch.vmap around this may refuse.
    draw = np.random.default_rng(0).random((2, 256, 256), dtype=np.float32)
    one, other = (torch.from_numpy(x) for x in draw)
    with through_onednn():
        product = one @ other
    exact = one.double() @ other.double()
    # The error of float32 is at most 2**-16 of it, that of bfloat16 2**-9 of a term.
    return bool((product - exact).abs().max() <= 2.0**-18 * exact.max())


_lock = threading.Lock()
_inside = 0  # calls of this process, in all threads
_precision = "none"  # before the first of them


@contextmanager
def through_onednn() -> Iterator[None]:
    """Context manager in which torch multiplies float32 matrices by oneDNN."""
    global _inside, _precision
    # torch's type hints lack it.
    setting: Any = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    with _lock:
        if not _inside:
            _precision = setting.fp32_precision
            setting.fp32_precision = "bf16"
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                setting.fp32_precision = _precision
