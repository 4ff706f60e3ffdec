"""All private names of torch, torchrl and tensordict that this package uses.

They have no public counterpart in torch 2.14, torchrl 0.14 and tensordict 0.14. After
an update of one of them, run ``tests/test_torchrl.py``: it tests each function here,
and that no other module uses such a name.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict._utils_key_json import _encode_key_for_filesystem
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import (
    OfflineToOnlineReplayBuffer,
    ReplayBuffer,
    Storage,
    TensorDictMaxValueWriter,
    TensorStorage,
)
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import _vmap_func

__all__ = [
    "add_revision",
    "compile_cuda",
    "cuda_stream",
    "drop_memmap_leaf",
    "drop_prefetched",
    "entries_of",
    "file_name",
    "forget_leaves",
    "is_in_another_process",
    "is_in_order_of_time",
    "last_written",
    "lazy_rows",
    "leaf_of",
    "loss_masks",
    "mark_memmap",
    "member_storages",
    "memmap_folder",
    "names_of",
    "packed_linear",
    "priority_weight",
    "reduce_loss",
    "sampled_rows",
    "sampling_buffer",
    "set_memmap_entry",
    "set_online_buffer",
    "storage_data",
    "storage_revision",
    "storage_rows",
    "tensor_version",
    "tensordict_of",
    "transforms_are_active",
    "vmap_loss",
    "without_generator",
    "writes_paused",
]


# --- buffers of other processes ------------------------------------------------------


def is_in_another_process(source: Any) -> bool:
    """Returns whether a replay buffer only forwards calls to another process.

    Args:
        source (Any): a :class:`~torchrl.data.RayReplayBuffer`, one of its clients, or
            anything else.

    Returns:
        bool: true for these, and for a reference of :mod:`torch.distributed.rpc`.

    Examples:
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl_caiac._torchrl import is_in_another_process
        >>> is_in_another_process(ReplayBuffer())
        False
    """
    if isinstance(source, ReplayBuffer):
        # Of the class, since a subclass may forward every attribute.
        return any(_forwards(kind) for kind in type(source).__mro__)
    kinds = type(source).__mro__
    return any(
        _forwards(kind)
        or (kind.__module__, kind.__name__) == ("ray.actor", "ActorHandle")
        or kind.__name__ in ("RRef", "PyRRef")
        for kind in kinds
    )


def _forwards(kind: type) -> bool:
    # By its name, because importing the module starts to look for ray.
    return kind.__module__ == "torchrl.data.replay_buffers.ray_buffer"


# --- storages of replay buffers ------------------------------------------------------


def storage_data(storage: Any, what: str = "the storage") -> TensorDictBase:
    """Returns the tensordict of a storage at its full capacity, without copying it.

    ``storage[:]`` is public, but raises for some index types and copies for others.

    Args:
        storage (TensorStorage): the storage.
        what (str): the storage's name in error messages.

    Returns:
        TensorDictBase: the storage's own tensordict.

    Raises:
        TypeError: it is not a :class:`~torchrl.data.TensorStorage` of tensordicts.
        ValueError: it is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac._torchrl import storage_data
        >>> storage = LazyTensorStorage(5)
        >>> storage.set(range(2), TensorDict({"a": torch.zeros(2)}, [2]))
        >>> storage_data(storage)["a"].shape
        torch.Size([5])
    """
    if not isinstance(storage, TensorStorage):
        raise TypeError(
            f"{what} is a {type(storage).__name__}, expected one with a tensordict of "
            "all rows: LazyTensorStorage, LazyMemmapStorage or TensorStorage"
        )
    if not storage.initialized or not len(storage):
        raise ValueError(f"{what} is empty: extend it with data first")
    data = storage._storage
    if not is_tensor_collection(data):
        raise TypeError(
            f"{what} contains a {type(data).__name__}, expected a TensorDict: extend "
            "the buffer with tensordicts"
        )
    return data


def storage_rows(storage: Any, what: str = "the storage") -> TensorDictBase:
    """Returns the rows of a storage at its full capacity, without copying them.

    Args:
        storage (TensorStorage): the storage.
        what (str): the storage's name in error messages.

    Returns:
        TensorDictBase: the storage's own tensordict ``[T]``, or a view of it with its
        dimensions flattened. Adding a leaf to the view does not add it to the storage.

    Raises:
        TypeError: it is not a :class:`~torchrl.data.TensorStorage` of tensordicts.
        ValueError: it is empty, or its dimensions are transposed in memory.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac._torchrl import storage_rows
        >>> storage = LazyTensorStorage(6, ndim=2)
        >>> storage.set(range(2), TensorDict({"a": torch.zeros(2, 3)}, [2, 3]))
        >>> storage_rows(storage)["a"].shape
        torch.Size([6])
    """
    data = storage_data(storage, what)
    dims = storage.ndim
    if dims == 1:
        return data
    rows = data.batch_size[:dims].numel()

    def flat(key: NestedKey, leaf: Tensor) -> Tensor:
        try:
            return leaf.as_subclass(Tensor).view(rows, *leaf.shape[dims:])
        except RuntimeError:
            raise ValueError(
                f"the dimensions {list(leaf.shape[:dims])} of {key!r} in {what} are "
                f"transposed in memory, strides {list(leaf.stride()[:dims])}: use "
                "LazyMemmapStorage, or a buffer with dim_extend=0 that is extended "
                "with data [T, *B]"
            ) from None

    flattened = data.named_apply(
        flat, nested_keys=True, batch_size=[rows], device=data.device
    )
    assert flattened is not None  # it would be None without leaves
    return flattened


def storage_revision(storage: TensorStorage) -> tuple[Any, ...]:
    """Returns a value that changes with every write through the storage."""
    return (
        int(storage._mutation_revision),
        len(storage),
        storage._last_cursor_index,
    )


def add_revision(storage: TensorStorage) -> None:
    """Notifies a storage that its tensors were written to directly."""
    storage._bump_mutation_revision()


def forget_leaves(storage: TensorStorage) -> None:
    """Notifies a storage, which caches the names of its leaves, of added leaves."""
    storage._storage_keys = None
    add_revision(storage)


def last_written(source: ReplayBuffer | TensorStorage) -> int | None:
    """Returns the row, in the first dimension, that was written last.

    The writer of the buffer records it. A storage does too, but forgets it when it is
    saved and loaded.

    Args:
        source (ReplayBuffer or TensorStorage): the buffer, or its storage.

    Returns:
        int, optional: the row; ``None`` if neither a writer nor the storage records
        it, as in a buffer over an existing dataset.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac._torchrl import last_written
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(4))
        >>> _ = rb.extend(TensorDict({"a": torch.zeros(6)}, [6])[:3])
        >>> last_written(rb)
        2
    """
    cursors = [
        int(writer._cursor)
        for writer in _writers(source)
        if getattr(writer, "_cursor", None) is not None and writer._write_count
    ]
    storage = source.storage if isinstance(source, ReplayBuffer) else source
    if len(cursors) == 1 and len(storage):
        steps = len(storage)
        if storage.ndim > 1:
            steps //= storage.shape[1:].numel()
        return (cursors[0] - 1) % steps
    newest = getattr(storage, "_last_cursor_index", None)
    return None if newest is None else int(newest)


def is_in_order_of_time(source: ReplayBuffer | TensorStorage) -> bool:
    """Returns whether no writer of a storage replaces rows out of turn.

    Args:
        source (ReplayBuffer or TensorStorage): the buffer, or its storage.

    Returns:
        bool: false if one of them is a :class:`~torchrl.data.TensorDictMaxValueWriter`.
    """
    return not any(isinstance(w, TensorDictMaxValueWriter) for w in _writers(source))


def _writers(source: ReplayBuffer | TensorStorage) -> list[Any]:
    """Returns the writers of the buffers that use a storage."""
    storage = source.storage if isinstance(source, ReplayBuffer) else source
    attached = getattr(storage, "_attached_entities", [])
    buffers = [rb for rb in attached if isinstance(rb, ReplayBuffer)]
    if isinstance(source, ReplayBuffer) and source not in buffers:
        buffers.append(source)
    return [rb.writer for rb in buffers]


def sampling_buffer() -> ReplayBuffer | None:
    """Returns the buffer that is sampling in this thread, found in the call stack.

    A buffer does not make itself known to its transforms.
    """
    found = sampled_rows()
    return None if found is None else found[0]


def sampled_rows() -> tuple[ReplayBuffer, Any, Any] | None:
    """Returns the buffer that is sampling in this thread, and the rows that it drew.

    Returns:
        tuple, optional: the buffer; the index into its storage, integer ``[B]`` or the
        coordinates in each dimension; and the batch that it read there, which its
        transforms may have changed in place. ``None`` if no buffer is sampling.

    Examples:
        >>> import torch
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac._torchrl import sampled_rows
        >>> found = []
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=2)
        >>> _ = rb.extend(torch.arange(4))
        >>> _ = rb.append_transform(lambda td: found.append(sampled_rows()) or td)
        >>> batch = rb.sample()
        >>> found[0][0] is rb, torch.equal(found[0][1], batch)
        (True, True)
    """
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_name == "_sample":
            variables = frame.f_locals
            buffer = variables.get("self")
            if isinstance(buffer, ReplayBuffer):
                return buffer, variables.get("index"), variables.get("data")
        frame = frame.f_back  # type: ignore[assignment]
    return None


def member_storages(storage: Storage) -> list[Storage]:
    """Returns the storages of an ensemble, or the one that is given.

    Examples:
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac._torchrl import member_storages
        >>> len(member_storages(LazyTensorStorage(4)))
        1
    """
    return list(getattr(storage, "_storages", [storage]))


@contextmanager
def writes_paused(
    source: ReplayBuffer | TensorStorage, *, processes: bool = False
) -> Iterator[None]:
    """Has others wait before they write through a buffer.

    Batches may be prefetched by threads, while the main one extends the buffer.

    Args:
        source (ReplayBuffer or TensorStorage): the buffer; a storage has no lock.

    Keyword Args:
        processes (bool): whether other processes wait too, if the buffer is shared.
            Unlike that of threads, this lock is not reentrant. Defaults to ``False``.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac._torchrl import writes_paused
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(4))
        >>> with writes_paused(rb):
        ...     len(rb)
        0
    """
    if isinstance(source, ReplayBuffer):
        others = source._write_lock if processes else nullcontext()
        with source._replay_lock, others:
            yield
    else:
        yield


def drop_prefetched(rb: ReplayBuffer) -> None:
    """Discards the batches that a buffer has prefetched."""
    with rb._futures_lock:
        rb._clear_prefetch_queue_locked()


def without_generator(state: dict[str, Any]) -> dict[str, Any]:
    """Returns the state with which a buffer is pickled, without its generator."""
    return {**state, "_rng": None}


def set_online_buffer(mixed: OfflineToOnlineReplayBuffer, online: ReplayBuffer) -> None:
    """Replaces the online buffer, which the constructor makes of a storage only."""
    mixed._online_buffer = online


# --- batches -------------------------------------------------------------------------


def leaf_of(td: TensorDictBase, key: NestedKey) -> Any:
    """Returns an entry of a tensordict: ``td.get(key, None)``, in half of the time.

    Args:
        td (TensorDictBase): the tensordict.
        key (NestedKey): the entry.

    Returns:
        Any: the entry, ``None`` if there is none.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._torchrl import leaf_of
        >>> td = TensorDict({"a": {"b": torch.zeros(2)}}, [2])
        >>> leaf_of(td, ("a", "b")), leaf_of(td, ("c", "b"))
        (tensor([0., 0.]), None)
    """
    node: Any = td
    for part in (key,) if isinstance(key, str) else key:
        if type(node) is not TensorDict:
            return td.get(key, None)
        node = node._tensordict.get(part)
        if node is None:
            return None
    return node if type(node) is Tensor else td.get(key, None)


def entries_of(td: Any) -> dict[str, Any] | None:
    """Returns the entries of a tensordict, not copied; ``None`` for other classes."""
    return td._tensordict if type(td) is TensorDict else None


def tensordict_of(
    entries: dict[str, Any],
    size: torch.Size,
    device: torch.device | None,
    names: list[str] | None = None,
) -> TensorDict:
    """Returns a tensordict of entries that are known to fit, without checking them."""
    return TensorDict._new_unsafe(entries, size, device=device, names=names)


def names_of(td: TensorDict) -> list[str] | None:
    """Returns the names of the dimensions, ``None`` if they have none."""
    names: list[str] | None = td._maybe_names()
    return names


def lazy_rows(td: TensorDictBase, rows: Tensor) -> TensorDictBase:
    """Returns ``td[rows]``, of which entries are read when they are asked for."""
    found: TensorDictBase = td._get_sub_tensordict(rows)
    return found


# --- memory-mapped tensordicts -------------------------------------------------------


def file_name(key: str) -> str:
    """Returns the file name, without suffix, of an entry in a memory-mapped folder."""
    name: str = _encode_key_for_filesystem(key)
    return name


def memmap_folder(td: TensorDictBase) -> str | None:
    """Returns the folder of a memory-mapped tensordict, ``None`` if it has none."""
    prefix = getattr(td, "_memmap_prefix", None)
    return None if prefix is None else str(prefix)


def mark_memmap(td: TensorDictBase) -> None:
    """Flags a loaded tensordict, and those nested in it, as memory-mapped.

    ``load_memmap`` does not set this flag. ``memmap_`` does, but rewrites the folder's
    ``meta.json``, which other processes may be reading.
    """
    nodes = (v for v in td.values(True) if isinstance(v, TensorDictBase))
    for node in (td, *nodes):
        node._is_memmap = True


def drop_memmap_leaf(td: TensorDictBase, key: NestedKey) -> None:
    """Removes a leaf from a memory-mapped tensordict, but not from its folder.

    ``del_`` needs an unlocked tensordict, and unlocking clears the memory-mapped flag.
    """
    parents, name = ((), key) if isinstance(key, str) else (key[:-1], key[-1])
    node = td.get(parents) if parents else td
    node._tensordict.pop(name)
    td._erase_cache()
    node._erase_cache()


def set_memmap_entry(td: TensorDictBase, key: NestedKey, entry: Any) -> None:
    """Sets an entry that the folder of a memory-mapped tensordict has already.

    ``set`` needs an unlocked tensordict, see :func:`drop_memmap_leaf`.
    """
    parents, name = ((), key) if isinstance(key, str) else (key[:-1], key[-1])
    node = td.get(parents) if parents else td
    node._tensordict[name] = entry
    td._erase_cache()
    node._erase_cache()


# --- objectives ----------------------------------------------------------------------


def reduce_loss(
    loss_module: LossModule, loss: Tensor, *args: Any, **kwargs: Any
) -> Tensor:
    """Reduces a loss according to the module's ``reduction`` and masks."""
    reduced: Tensor = loss_module._reduce_loss(loss, *args, **kwargs)
    return reduced


def priority_weight(loss_module: LossModule, td: TensorDictBase) -> Tensor | None:
    """Returns the importance weights of a batch, ``None`` if it has none."""
    weight: Tensor | None = loss_module._maybe_get_priority_weight(td)
    return weight


def loss_masks(loss_module: LossModule) -> list[NestedKey]:
    """Returns the keys of the masks that a loss module applies."""
    return list(loss_module._loss_mask_keys())


def vmap_loss(*args: Any, **kwargs: Any) -> Any:
    """TorchRL's :func:`torch.vmap` over functional networks."""
    return _vmap_func(*args, **kwargs)


# --- tensors -------------------------------------------------------------------------


def packed_linear(
    weight: Tensor, bias: Tensor, relu: bool
) -> Callable[[Tensor], Tensor]:
    """Returns oneDNN's linear layer, ``[*B, I]`` to ``[*B, O]``, in float32 on a CPU.

    The weight is copied to the fastest layout. There are no gradients.
    """
    # On strided inputs the operator is hundreds of times slower on some processors.
    packed = torch.ops.mkldnn._reorder_linear_weight(weight.detach())
    after = "relu" if relu else "none"

    def apply(value: Tensor) -> Tensor:
        out: Tensor = torch.ops.mkldnn._linear_pointwise(
            value.contiguous(), packed, bias, after, [], ""
        )
        return out

    return apply


def compile_cuda(source: str, names: list[str]) -> dict[str, Any]:
    """Compiles kernels for the current CUDA device, by NVRTC.

    Args:
        source (str): the source in CUDA C++.
        names (list of str): its kernels, declared ``extern "C"``.

    Returns:
        dict: the driver's handle of each kernel.

    Raises:
        OSError: there is no compiler.
        RuntimeError: it refuses the source.
    """
    from torch.cuda._utils import _cuda_load_module, _nvrtc_compile

    binary, _ = _nvrtc_compile(source, names[0])
    loaded: Any = _cuda_load_module(binary, names)
    return {name: loaded[name].func for name in names}


def cuda_stream(index: int) -> int:
    """Returns the current stream of a CUDA device, in a fraction of the time."""
    stream: int = torch._C._cuda_getCurrentRawStream(index)
    return stream


def transforms_are_active() -> bool:
    """Returns whether the call is inside of :func:`torch.vmap` or :mod:`torch.func`."""
    found: bool = torch._C._are_functorch_transforms_active()
    return found


def tensor_version(tensor: Tensor) -> tuple[int, int] | None:
    """Returns a value that changes with every write to a tensor in this process.

    Writes to ``tensor.data`` are not counted.

    Args:
        tensor (torch.Tensor): the tensor.

    Returns:
        tuple of int, optional: its address and the number of writes; ``None`` if they
        are not counted (inference tensors) or if other processes may write to it.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._torchrl import tensor_version
        >>> tensor = torch.zeros(2)
        >>> before = tensor_version(tensor)
        >>> _ = tensor.add_(1)
        >>> tensor_version(tensor) == before
        False
    """
    on_cpu = tensor.device.type == "cpu"
    if tensor.is_inference() or (on_cpu and tensor.is_shared()):
        return None
    return tensor.data_ptr(), int(tensor._version)
