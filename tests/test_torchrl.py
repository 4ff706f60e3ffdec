"""The one module that touches private names of torch, torchrl and tensordict."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from tensordict import TensorClass, TensorDict, lazy_stack
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SliceSampler,
    StorageEnsemble,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.objectives import LossModule

import torchrl_caiac
from torchrl_caiac import _torchrl as fence
from torchrl_caiac._batches import rows_of, with_leaves
from torchrl_caiac._torchrl import sampled_rows, sampling_buffer
from torchrl_caiac.trajectories import flat_rows

PACKAGE = Path(torchrl_caiac.__file__).parent
FOREIGN = {"torch", "torchrl", "tensordict"}
# Methods that TorchRL's documentation tells subclasses to write, and dunder-like names.
HOOKS = {"_AcceptedKeys", "_call", "_inv_call", "_step", "_reset", "_set_seed"}
# Methods of named tuples, which Python documents.
NAMED_TUPLE = {"_asdict", "_replace"}


def private(name):
    return name.startswith("_") and not name.endswith("__")


def own_names(trees):
    """Every private name that the package defines itself."""
    names = HOOKS | NAMED_TUPLE
    for tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                names.add(node.name)
            elif isinstance(node, (ast.Name, ast.Attribute)):
                is_self = isinstance(node, ast.Attribute) and not (
                    isinstance(node.value, ast.Name)
                    and node.value.id in ("self", "cls", "clone")
                )
                if isinstance(node.ctx, ast.Store) and not is_self:
                    names.add(getattr(node, "id", None) or node.attr)
    return names


def touched(tree, own):
    """Private names of others, by attribute, by getattr and by import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            if private(node.attr) and node.attr not in own:
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            names = [*parts, *(alias.name for alias in node.names)]
            if parts[0] in FOREIGN and any(map(private, names)):
                yield ast.unparse(node)
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("getattr", "setattr", "hasattr")
            and isinstance(node.args[1], ast.Constant)
            and private(node.args[1].value)
            and node.args[1].value not in own
        ):
            yield ast.unparse(node)


# Of gymnasium-robotics, OGBench and Python.
ALLOWED = {
    "os._exit",
    # What OGBench's controller and buttons depend on has no public name.
    "self._task._cur_button_states",
    "self._task._pinch_site_id",
    "self.env.unwrapped._workspace_bounds",
    "task._apply_button_states",
    "task._arm_actuator_ids",
    "task._arm_joint_ids",
    "task._cur_button_states",
    "task._gripper_actuator_ids",
    "task._gripper_opening_joint_id",
    "task._n_steps",
    "robot._ctrl_position_limits",
    "robot._ctrl_velocity_limits",
}


def test_no_other_module_touches_a_private_name():
    trees = {
        path: ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))
    }
    own = own_names(trees.values())
    found = {
        f"{path.relative_to(PACKAGE)}: {name}"
        for path, tree in trees.items()
        if path.name != "_torchrl.py"
        for name in touched(tree, own)
        if name not in ALLOWED
    }
    assert not found
    # And the test can fail: the fence itself is full of them.
    fence_tree = trees[PACKAGE / "_torchrl.py"]
    assert len(set(touched(fence_tree, own))) >= 10


# Private methods of base classes that subclasses override on purpose, and what Python
# and TorchRL set on every class.
OVERRIDDEN = {*HOOKS, "_load_from_state_dict", "_make_vmap", "_set_in_keys"}
AUTOMATIC = {
    "_abc_impl",
    "_all_schedulable_buffers",
    "_backward_cls",
    "_schedulable_buffers",
}


def test_no_private_method_of_a_base_class_is_overridden_by_accident():
    found = set()
    for info in pkgutil.walk_packages(torchrl_caiac.__path__, "torchrl_caiac."):
        module = importlib.import_module(info.name)
        for kind in vars(module).values():
            if not inspect.isclass(kind) or kind.__module__ != info.name:
                continue
            for base in kind.__mro__[1:]:
                if base.__module__.split(".")[0] in FOREIGN:
                    common = {name for name in vars(kind) if private(name)}
                    common &= set(vars(base))
                    found |= {
                        f"{kind.__name__}.{name}"
                        for name in common - OVERRIDDEN - AUTOMATIC
                    }
    assert not found


def rows(n):
    return TensorDict({"a": torch.arange(n), "next": {"b": torch.ones(n, 2)}}, [n])


@pytest.fixture
def rb():
    rb = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=2, prefetch=2)
    rb.extend(rows(3))
    return rb


def test_storage_data_is_the_storage_itself(rb):
    data = fence.storage_data(rb.storage)
    assert data.shape == (4,)
    data["a"][0] = 7
    assert rb.storage[0]["a"] == 7
    with pytest.raises(ValueError, match="the donor buffer is empty"):
        fence.storage_data(LazyTensorStorage(4), "the donor buffer")
    with pytest.raises(TypeError, match="is a ListStorage, expected one"):
        fence.storage_data(ListStorage(4))
    tensors = LazyTensorStorage(4)
    tensors.set(range(2), torch.zeros(2))
    with pytest.raises(TypeError, match="contains a Tensor, expected a TensorDict"):
        fence.storage_data(tensors)


def test_every_write_changes_the_revision(rb):
    seen = {fence.storage_revision(rb.storage)}
    rb.extend(rows(1))
    seen.add(fence.storage_revision(rb.storage))
    rb.extend(rows(4))  # the same length, and the same place written last
    seen.add(fence.storage_revision(rb.storage))
    rb.storage.set(0, rows(1)[0])
    seen.add(fence.storage_revision(rb.storage))
    fence.add_revision(rb.storage)
    seen.add(fence.storage_revision(rb.storage))
    assert len(seen) == 5


def test_a_new_leaf_is_written_once_forgotten(rb):
    data = fence.storage_data(rb.storage)
    with data.unlock_():
        data["score"] = torch.zeros(4)
    before = fence.storage_revision(rb.storage)
    fence.forget_leaves(rb.storage)
    assert fence.storage_revision(rb.storage) != before
    rb.extend(rows(1).set("score", torch.ones(1)))
    assert rb.storage[3]["score"] == 1


def test_last_written(tmp_path):
    rb = ReplayBuffer(storage=LazyTensorStorage(5), batch_size=2)
    assert fence.last_written(rb) is None
    for n, newest in ((3, 2), (1, 3), (3, 1)):
        rb.extend(rows(n))
        assert fence.last_written(rb) == fence.last_written(rb.storage) == newest
    rb.dumps(tmp_path)
    loaded = ReplayBuffer(storage=LazyTensorStorage(5), batch_size=2)
    loaded.loads(tmp_path)
    assert fence.last_written(loaded) == 1
    dataset = ReplayBuffer(
        storage=TensorStorage(rows(3)), writer=ImmutableDatasetWriter()
    )
    assert fence.last_written(dataset) is None


def test_a_transform_finds_the_rows_of_its_batch():
    for options in (
        {},
        {"prefetch": 2},
        {"sampler": SliceSampler(slice_len=2, traj_key="episode")},
    ):
        seen = []

        def look(td, seen=seen):
            seen.append((sampled_rows(), td["row"].clone()))
            return td

        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(20), batch_size=6, **options
        )
        episode = torch.arange(20) // 5
        buffer.extend(TensorDict({"row": torch.arange(20), "episode": episode}, [20]))
        buffer.append_transform(look)
        for _ in range(4):
            buffer.sample()
        for found, row in seen:
            assert found is not None and found[0] is buffer
            assert torch.equal(flat_rows(found[1], buffer.storage), row)
            assert torch.equal(found[2]["row"], row)
            assert sampling_buffer() is None
    assert sampled_rows() is None


class Pose(TensorClass):
    x: torch.Tensor


def batch_of(kind, device=None):
    td = TensorDict({"a": torch.zeros(2), "next": {"a": torch.zeros(2)}}, [2], device)
    td.set_non_tensor("name", "kitchen")
    if kind == "names":
        td.names = ["time"]
    elif kind == "lazy stack":
        td = lazy_stack(list(td.unbind(0)))
    elif kind == "parts":
        td["pose"] = Pose(x=torch.zeros(2), batch_size=[2])
        td["stack"] = lazy_stack([TensorDict({"a": torch.zeros(())})] * 2)
        td["lone"] = TensorDict({"a": torch.zeros(2)})
    return td


KINDS = pytest.mark.parametrize("kind", ["plain", "names", "lazy stack", "parts"])


@KINDS
def test_leaf_of_is_get(kind):
    td = batch_of(kind)
    tensors = ["a", ("a",), ("next", "a"), ("pose", "x"), ("stack", "a"), ("lone", "a")]
    for key in [*tensors, "b", ("next", "b"), ("new", "b"), "name", "next", ("a", "b")]:
        try:
            wanted = td.get(key, None)
        except Exception as error:
            with pytest.raises(type(error)):
                fence.leaf_of(td, key)
            continue
        found = fence.leaf_of(td, key)
        assert type(found) is type(wanted)
        if isinstance(wanted, torch.Tensor):
            assert torch.equal(found, wanted)


def test_leaf_of_a_memory_mapped_tensordict(tmp_path):
    data = rows(3).memmap(tmp_path)
    assert fence.leaf_of(data, "a") is data.get("a")


@pytest.mark.parametrize("device", [None, "cpu"])
@KINDS
def test_with_leaves_is_a_copy_with_leaves(kind, device):
    td = batch_of(kind, device)
    td.lock_()
    keys = ["a", ("next", "a"), ("next", "b"), ("new", "b"), ("pose", "x")]
    leaves = {key: torch.ones(2) for key in [*keys, ("stack", "a")]}
    wanted, before = td.copy(), td.clone()
    for key, leaf in leaves.items():
        wanted.set(key, leaf)
    out = with_leaves(td, leaves)
    assert set(out.keys(True, True)) == set(wanted.keys(True, True))
    assert (out == wanted).all() and (td == before).all()
    assert type(out) is type(wanted) and out.names == wanted.names
    assert out["new"].names == wanted["new"].names
    assert out.device == wanted.device and not out.is_locked
    assert all(out.get(key) is leaves[key] for key in keys if kind == "plain")
    with pytest.raises(RuntimeError, match="batch dimension"):
        with_leaves(td, {("next", "a"): torch.ones(3)})


@KINDS
def test_rows_of_are_those_of_an_index(kind):
    td = batch_of(kind)
    picked = torch.tensor([1, 0, 1])
    wanted, found = td[picked], rows_of(td, picked)
    assert set(found.keys(True)) == set(wanted.keys(True))
    assert (found == wanted).all() and found.batch_size == wanted.batch_size
    assert type(found) is type(wanted) and found.names == wanted.names
    assert found["next"].batch_size == wanted["next"].batch_size


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("cached", [0, 1 << 23])
def test_rows_of_all_kinds_of_leaves(mapped, threads, cached, tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_caiac._batches._CACHED", cached)
    td = TensorDict({"wide": torch.rand(50, 3000), "none": torch.zeros(50, 0)}, [50])
    for number, dtype in enumerate(
        [torch.bool, torch.int16, torch.bfloat16, torch.complex64, torch.float64]
    ):
        td[f"{number}"] = torch.randint(2, (50, number + 1, 3)).to(dtype)
    td["flag"] = torch.rand(50) < 0.5
    td["strided"] = torch.rand(7, 50).t()
    td = td.memmap(tmp_path) if mapped else td
    picked = torch.randint(50, (90,))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for some in (td, td.exclude("none"), td.exclude("none", "strided")):
            wanted, found = some[picked], rows_of(some, picked)
            assert set(found.keys()) == set(wanted.keys())
            for key, leaf in wanted.items():
                assert type(found[key]) is torch.Tensor
                assert found[key].dtype == leaf.dtype and torch.equal(found[key], leaf)
            assert rows_of(some, picked[:0]).batch_size == (0,)
            for bad in (-1, 50, 2**40):
                with pytest.raises(IndexError):
                    rows_of(some, torch.tensor([3, bad]))
    finally:
        torch.set_num_threads(before)


def test_prefetched_batches_are_dropped(rb):
    rb.sample()  # samples the next ones ahead
    fence.storage_data(rb.storage)["a"].fill_(9)
    fence.drop_prefetched(rb)
    assert (rb.sample()["a"] == 9).all()


def test_the_state_of_a_buffer_without_its_generator():
    rb = ReplayBuffer(
        storage=LazyTensorStorage(4), generator=torch.Generator().manual_seed(0)
    )
    rb.extend(rows(3))
    copy = ReplayBuffer.__new__(ReplayBuffer)
    copy.__setstate__(fence.without_generator(rb.__getstate__()))
    assert fence.without_generator(copy.__getstate__()) == copy.__getstate__()


def test_writes_of_other_threads_wait():
    rb = ReplayBuffer(storage=LazyTensorStorage(4))
    with ThreadPoolExecutor() as pool:
        with fence.writes_paused(rb), fence.writes_paused(rb.storage):
            written = pool.submit(rb.extend, rows(2))
            with pytest.raises(TimeoutError):
                written.result(timeout=0.05)
            assert len(rb) == 0
        written.result(timeout=10)
    assert len(rb) == 2


def test_writes_of_other_processes_wait():
    rb = ReplayBuffer(storage=LazyMemmapStorage(4), shared=True)
    rb.extend(rows(2))
    context = torch.multiprocessing.get_context("fork")
    with fence.writes_paused(rb, processes=True), fence.writes_paused(rb):
        process = context.Process(target=rb.extend, args=(rows(2),))
        process.start()
        process.join(1)
        assert process.is_alive() and len(rb) == 2
    process.join(30)
    assert process.exitcode == 0 and len(rb) == 4


def test_storages_of_an_ensemble():
    one, other = LazyTensorStorage(4), LazyTensorStorage(4)
    assert fence.member_storages(StorageEnsemble(one, other)) == [one, other]
    assert fence.member_storages(one) == [one]


def test_a_loaded_folder_becomes_memory_mapped(tmp_path):
    rows(3).memmap(tmp_path)
    loaded = TensorDict.load_memmap(tmp_path)
    fence.mark_memmap(loaded)
    assert loaded.is_memmap() and loaded["next"].is_memmap()
    assert fence.memmap_folder(loaded) == str(tmp_path)
    assert fence.memmap_folder(rows(3)) is None


def test_a_leaf_leaves_the_mapping(tmp_path):
    data = rows(3).memmap(tmp_path)
    data.make_memmap(("caiac", "score"), shape=(3, 2), dtype=torch.float32)
    fence.drop_memmap_leaf(data, ("caiac", "score"))
    fence.drop_memmap_leaf(data, "a")
    assert data.get(("caiac", "score"), None) is None and data.get("a", None) is None
    assert data.is_memmap()


@pytest.mark.parametrize("key", ["a", "a.b", "a/b", "a_b", "ä"])
def test_file_name(key, tmp_path):
    TensorDict({key: torch.zeros(1)}, [1]).memmap(tmp_path)
    assert (tmp_path / f"{fence.file_name(key)}.memmap").exists()


def test_memmap_storages_have_their_folder(tmp_path):
    rb = ReplayBuffer(storage=LazyMemmapStorage(4, scratch_dir=tmp_path))
    rb.extend(rows(2))
    data = fence.storage_data(rb.storage)
    assert fence.memmap_folder(data) == str(tmp_path) and data.is_memmap()


class Square(LossModule):
    @dataclass
    class _AcceptedKeys:
        priority_weight: str = "priority_weight"

    def __init__(self):
        super().__init__()
        self.reduction = "sum"


def test_losses_are_reduced_weighted_and_masked():
    loss_module = Square()
    loss = torch.tensor([1.0, 3.0])
    assert fence.reduce_loss(loss_module, loss) == 4
    assert fence.reduce_loss(loss_module, loss, reduction="mean") == 2
    td = TensorDict({}, [2])
    for key in fence.loss_masks(loss_module):
        td[key] = torch.tensor([True, False])
    assert fence.reduce_loss(loss_module, loss, td) == 1
    assert fence.priority_weight(loss_module, td) is None


def test_vmap_over_the_parameters_of_networks():
    networks, x = [torch.nn.Linear(2, 1) for _ in range(3)], torch.randn(5, 2)
    params = TensorDict.from_modules(*networks)
    found = fence.vmap_loss(networks[0], (None, 0))(x, params)
    torch.testing.assert_close(found, torch.stack([net(x) for net in networks]))


@pytest.mark.parametrize("relu", [False, True])
def test_packed_linear_is_a_linear_layer(relu):
    x, weight, bias = torch.randn(3, 5, 8), torch.randn(4, 8), torch.randn(4)
    wanted = torch.nn.functional.linear(x, weight, bias)
    wanted = wanted.relu() if relu else wanted
    torch.testing.assert_close(fence.packed_linear(weight, bias, relu)(x), wanted)


def test_transforms_are_noticed():
    seen = []

    def look(x):
        seen.append(fence.transforms_are_active())
        return x.sum()

    look(torch.ones(2))
    torch.vmap(look)(torch.ones(2, 2))
    torch.func.grad(look)(torch.ones(2))
    assert seen == [False, True, True]


def test_versions_count_writes():
    tensor = torch.zeros(3)
    versions = [fence.tensor_version(tensor)]
    tensor.add_(1)
    versions.append(fence.tensor_version(tensor))
    tensor.detach()[0] = 2  # a view has the count of its base
    versions.append(fence.tensor_version(tensor))
    assert len(set(versions)) == 3
    assert fence.tensor_version(tensor) == versions[-1]
    assert fence.tensor_version(tensor.clone()) != versions[-1]


def test_tensors_without_a_count_have_no_version():
    with torch.inference_mode():
        assert fence.tensor_version(torch.zeros(3)) is None
    assert fence.tensor_version(torch.zeros(3).share_memory_()) is None
