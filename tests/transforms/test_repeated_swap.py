"""Swaps in batches like an earlier one: the same numbers as step by step."""

from __future__ import annotations

import copy
import math
import pickle
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import NonTensorData, NonTensorStack, TensorDict, TensorDictBase
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    SliceSampler,
    TensorStorage,
)

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac._fingerprints import fingerprint, fingerprint_key, state_hash
from torchrl_caiac._sampling import only_torch
from torchrl_caiac._torchrl import storage_data
from torchrl_caiac.transforms import TransformKeys, WindowGoal
from torchrl_caiac.transforms.donors import BufferDonors
from torchrl_caiac.transforms.repeated_swap import RepeatedSwap

FLAT = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [4]},  # column 3 is nobody's
    goal={"cup": [2, 0], "box": [1]},
    achieved={"cup": [1, 2], "box": [4]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"arm": ("s", "arm"), "cup": ("s", "cup"), "box": ("s", "box")}, fixed=["arm"]
)
SCORE = ("caiac", "score")
DEVICES = pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
)


def batch(
    layout: EntityLayout,
    windows: int,
    window: int,
    *,
    known: bool = True,
    done: bool = True,
    ids: bool = True,
    seed: int = 0,
) -> TensorDict:
    """Windows of trajectories, the scores of half of the entities below 0.5."""
    of = torch.Generator().manual_seed(seed)
    rows = windows * window
    states = torch.rand(windows, window + 1, 5, generator=of)
    td = TensorDict({"action": torch.rand(rows, 2, generator=of)}, [rows])
    for where, part in ((lambda k: k, states[:, :-1]), (layout.next, states[:, 1:])):
        flat = part.reshape(rows, 5)
        if layout is FLAT:
            td[where("observation")] = flat.clone()
            td[where("achieved_goal")] = flat[:, [2, 4, 1]]
        else:
            td[where(("s", "arm"))] = flat[:, :1].clone()
            td[where(("s", "cup"))] = flat[:, 1:3].clone()
            td[where(("s", "box"))] = flat[:, 3:].clone()
    if layout is FLAT:
        td["desired_goal"] = torch.rand(rows, 3, generator=of)
    td["next", "reward"] = torch.rand(rows, 1, generator=of)
    td[SCORE] = torch.rand(windows, 3, generator=of).repeat_interleave(window, 0)
    if ids:
        td["episode"] = torch.arange(windows).repeat_interleave(window)
    if done:
        flags = torch.zeros(windows, window, dtype=torch.bool)
        flags[:, -1] = True
        td["next", "done"] = flags.view(rows, 1)
    if known:
        here = state_hash(td, layout.in_keys)
        after = state_hash(td, [layout.next(key) for key in layout.in_keys])
        assert here is not None
        td[fingerprint_key(SCORE)] = fingerprint(here, after, layout.names, 0)
    return td


def repeated(transform: CAIACTransform, td: TensorDictBase) -> None:
    """Shows the transform so many batches that the next one is a repeated swap."""
    many = torch.cat([td] * -(-110 * transform.window // len(td)))
    for _ in range(24):
        transform(many)
    transform(td)


def taken(function: Any, *args: Any) -> tuple[Any, bool]:
    """A swapped batch, and whether it was a repeated swap."""
    results = []
    call = RepeatedSwap.__call__

    def watched(*args: Any, **kwargs: Any) -> Any:
        results.append(call(*args, **kwargs))
        return results[-1]

    with mock.patch.object(RepeatedSwap, "__call__", watched):
        out = function(*args)
    return out, bool(results) and results[-1] is not None


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    """The same leaves, to the bit, in the same places."""
    keys = set(one.keys(True, True))
    assert keys == set(other.keys(True, True))
    for key in keys:
        here, there = one[key].cpu(), other[key].cpu()
        assert here.dtype == there.dtype and here.shape == there.shape, key
        # NaN is equal to itself.
        assert torch.equal(here.nan_to_num(9.0), there.nan_to_num(9.0)), key


@DEVICES
@settings(max_examples=60, deadline=None)
@given(
    nested=st.booleans(),
    window=st.integers(1, 3),
    windows=st.integers(2, 9),
    ratio=st.sampled_from([0.3, 0.5, 1.0]),
    rows=st.sampled_from(["random", "last"]),
    swap_prob=st.sampled_from([1.0, 0.5]),
    threshold=st.sampled_from([0.5, {"cup": 0.3, "box": 0.7}, 0.0]),
    known=st.booleans(),
    flags=st.sampled_from([(True, True), (True, False), (False, True)]),
    check=st.booleans(),
    from_buffer=st.booleans(),
    seed=st.integers(0, 99),
)
@pytest.mark.filterwarnings("ignore:entities are free")
def test_the_same_as_step_by_step(
    device: str,
    nested: bool,
    window: int,
    windows: int,
    ratio: float,
    rows: Any,
    swap_prob: float,
    threshold: Any,
    known: bool,
    flags: tuple[bool, bool],
    check: bool,
    from_buffer: bool,
    seed: int,
) -> None:
    layout = NESTED if nested else FLAT
    done, ids = flags

    def made(number: int) -> TensorDict:
        td = batch(
            layout, windows, window, known=known, done=done, ids=ids, seed=number
        )
        return td.to(device)

    donors = batch(layout, windows, window, known=known, seed=seed + 100).to(device)
    transform = CAIACTransform(
        layout,
        threshold,
        ratio,
        rows=rows,
        swap_prob=swap_prob,
        window=window,
        donors=TensorStorage(donors, device=device) if from_buffer else None,
        check=check,
        generator=torch.Generator().manual_seed(seed),
    )
    fresh = copy.deepcopy(transform)
    repeated(transform, made(0))
    transform.generator.set_state(fresh.generator.get_state())
    transform.reset_no_donor_count()
    td = made(seed + 1)
    before = td.clone()
    out, is_repeated = taken(transform, td)
    is_there = device == "cpu" or not from_buffer
    assert is_repeated == (is_there and round(ratio * windows) > 0)
    with only_torch():
        wanted, is_repeated = taken(fresh, td)
    assert not is_repeated
    assert_same(out, wanted)
    assert_same(td, before)
    assert torch.equal(transform.no_donor_count.cpu(), fresh.no_donor_count.cpu())
    assert torch.equal(transform.generator.get_state(), fresh.generator.get_state())


def test_settings_that_change() -> None:
    td = batch(FLAT, 100, 1)
    transform = CAIACTransform(FLAT, 0.5, rows="last")
    repeated(transform, td)
    assert taken(transform, td)[1]
    transform.counterfactual_ratio = 0.25
    out, is_repeated = taken(transform, td)
    assert is_repeated and int(out["caiac", "counterfactual"].sum()) == 25
    transform.swap_prob = 0.0
    assert not taken(transform, td)[0]["caiac", "swapped"].any()
    transform.keys = TransformKeys(swapped="other")
    out, is_repeated = taken(transform, td)
    assert not is_repeated and out["other"].shape == (100, 3)
    assert taken(transform, td)[1]
    transform.counterfactual_ratio = 0.0
    out, is_repeated = taken(transform, td)
    assert not is_repeated and not out["caiac", "counterfactual"].any()


# Buffers send their transforms to other processes pickled; nothing is read from a file.
@pytest.mark.parametrize(
    "send", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_copies_swap_too(send: Any) -> None:
    td = batch(FLAT, 100, 1)
    transform = CAIACTransform(FLAT, 0.5)
    repeated(transform, td)
    transform = send(transform)
    for is_later in (False, True):  # a copy reads the structure anew
        out, is_repeated = taken(transform, td)
        assert is_repeated == is_later and out["caiac", "swapped"].any()


def test_texts_stay() -> None:
    td = batch(FLAT, 100, 1)
    td["task"] = NonTensorStack(*map(str, range(100)), batch_size=[100])
    td["next", "info"] = NonTensorData("push", batch_size=[100])
    transform = CAIACTransform(FLAT, 0.5)
    repeated(transform, td)
    out, is_repeated = taken(transform, td)
    assert is_repeated and out["caiac", "swapped"].any()
    assert out[7]["task"] == "7" and out[7]["next", "info"] == "push"


@pytest.mark.parametrize("rows", ["random", "last"])
@pytest.mark.parametrize("ratio", [1.5, -0.5])
def test_more_windows_than_there_are(rows: Any, ratio: float) -> None:
    td = batch(FLAT, 100, 1)
    transform = CAIACTransform(FLAT, 0.5, rows=rows)
    fresh = copy.deepcopy(transform)
    repeated(transform, td)
    for some in (transform, fresh):
        some.counterfactual_ratio = ratio
        with pytest.raises(ValueError, match="counterfactual_ratio to a share"):
            some(td)


def pair(
    td: TensorDict, kind: Any = CAIACTransform, **kwargs: Any
) -> tuple[CAIACTransform, CAIACTransform]:
    """A transform that repeats swaps, and a fresh one that draws the same numbers."""
    transform = kind(FLAT, 0.5, generator=torch.Generator(), **kwargs)
    fresh = copy.deepcopy(transform)
    repeated(transform, td)
    transform.generator.set_state(fresh.generator.get_state())
    return transform, fresh


@pytest.mark.parametrize("row", [0, -1])
def test_donors_that_are_written_to_are_taken_back(row: int) -> None:
    td, storage = batch(FLAT, 100, 2), TensorStorage(batch(FLAT, 30, 2, seed=1))
    transform, fresh = pair(td, window=2, donors=storage)
    fresh(td)  # finds the eligible donors
    for some in (transform, fresh):  # each has its own storage
        states = storage_data(some.donors)["observation"].view(30, 2, 5)
        states[:20, row] += 1.0  # behind the back of the storage
        some.reset_no_donor_count()
        some.generator.manual_seed(1)
    out, is_repeated = taken(transform, td)
    assert is_repeated
    assert_same(out, fresh(td))
    lost = transform.no_donor_count
    assert torch.equal(lost, fresh.no_donor_count) and int(lost.sum()) > 10
    # They are no longer eligible.
    out, is_repeated = taken(transform, td)
    assert is_repeated and torch.equal(transform.no_donor_count, lost)
    assert out["caiac", "swapped"].any()


@pytest.mark.parametrize("block", [nullcontext, only_torch])
def test_fewer_donors_than_rows_of_a_window(block: Any) -> None:
    td, donors = batch(FLAT, 100, 3), TensorStorage(batch(FLAT, 2, 1))
    transform = CAIACTransform(FLAT, 0.5, window=3, donors=donors)
    with block():
        out = transform(td)
    assert torch.equal(out["observation"], td["observation"])
    assert transform.no_donor_count.any() and not out["caiac", "swapped"].any()


@pytest.mark.parametrize("change", ["states", "known", "removed", "added"])
def test_leaves_of_donors_that_are_replaced(change: str) -> None:
    td, data = batch(FLAT, 100, 1), batch(FLAT, 30, 1, seed=1)
    key = fingerprint_key(SCORE)
    known = data.pop(key) if change == "added" else data[key]
    transform, fresh = pair(td, donors=TensorStorage(data))
    fresh(td)  # finds the eligible donors
    for some in (transform, fresh):  # each has its own storage
        rows = storage_data(some.donors)
        if change != "known":
            rows["observation"] = rows["observation"] + 5.0
        if change == "known":
            rows[key] = known + (1 << 40)
        elif change == "added":
            rows[key] = known
        elif change == "removed":
            del rows[key]
        some.reset_no_donor_count()
        some.generator.manual_seed(1)
    out, is_repeated = taken(transform, td)
    assert is_repeated
    assert_same(out, fresh(td))
    assert torch.equal(transform.no_donor_count, fresh.no_donor_count)
    is_lost = change != "removed"
    assert bool(out["caiac", "swapped"].any()) != is_lost
    assert bool(transform.no_donor_count.any()) == is_lost


@pytest.mark.parametrize("case", ["bits", "ring", "goals", "subclass"])
def test_donors_that_are_read_step_by_step(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    td, data, more = batch(FLAT, 100, 2), batch(FLAT, 30, 2, seed=1), {}
    storage = LazyTensorStorage(60)
    storage.set(range(60), data)
    kind = CAIACTransform
    if case == "bits":
        monkeypatch.setattr("torchrl_caiac.transforms.donors._MOST_LISTED", 0)
    elif case == "ring":
        storage = LazyTensorStorage(60)
        rb = ReplayBuffer(storage=storage)
        rb.extend(torch.cat([data, data])[:62])
    elif case == "goals":
        more = {"goals": WindowGoal(FLAT, window=2)}
    else:

        class Donors(BufferDonors):
            """Donors of a subclass, whose methods are called."""

        class Transform(CAIACTransform):
            donors_class = Donors

        kind = Transform
    transform, fresh = pair(td, kind, window=2, donors=storage, **more)
    out, is_repeated = taken(transform, td)
    assert not is_repeated and out["caiac", "swapped"].any()
    assert_same(out, fresh(td))


@pytest.mark.parametrize("lookahead", [None, 1])
def test_donors_of_a_buffer_that_grows(lookahead: int | None, tmp_path: Path) -> None:
    td = batch(FLAT, 100, 2)
    rb = ReplayBuffer(storage=LazyMemmapStorage(80, scratch_dir=tmp_path))
    rb.extend(batch(FLAT, 15, 2, seed=1))
    kwargs = {"window": 2, "donors": rb, "lookahead": lookahead}
    if lookahead is not None:
        source = ReplayBuffer(
            storage=TensorStorage(td),
            sampler=SamplerWithoutReplacement(shuffle=False),
            batch_size=200,
        )
    transform = CAIACTransform(FLAT, 0.5, generator=torch.Generator(), **kwargs)
    if lookahead is not None:
        source.append_transform(transform)

    def swap() -> TensorDictBase:
        return transform(td) if lookahead is None else source.sample()

    for _ in range(24):
        swap()
    rb.extend(batch(FLAT, 15, 2, seed=2))
    for change in ("grown", "unchecked", "refreshed"):
        transform.check = change != "unchecked"
        if change == "refreshed":
            transform.refresh_donors()
        swap()
        transform.generator.manual_seed(3)
        out, is_repeated = taken(swap)
        assert is_repeated
        transform.generator.manual_seed(3)
        with only_torch():
            wanted, is_repeated = taken(swap)
        assert not is_repeated
        assert_same(out, wanted)
    new = rb.storage[30:]["observation"][:, 1]  # the cup
    assert torch.isin(out["observation"][:, 1], new).any()


def test_donors_are_not_read_where_nothing_is_swapped() -> None:
    td, data = batch(FLAT, 100, 1), batch(FLAT, 30, 1, seed=1)
    del data["desired_goal"]
    transform = CAIACTransform(FLAT, 0.5, 0.0, donors=TensorStorage(data))
    for _ in range(24):
        transform(td)
    transform.counterfactual_ratio = 0.5
    with pytest.raises(KeyError, match="donor buffer has no 'desired_goal'"):
        transform(td)


def test_another_default_device() -> None:
    td = batch(FLAT, 100, 1)
    transform, fresh = pair(td)
    with torch.device("meta"):
        out, is_repeated = taken(transform, td)
    assert is_repeated
    assert_same(out, fresh(td))


def test_another_swap_prob_that_is_no_number() -> None:
    td = batch(FLAT, 100, 1)
    transform, fresh = pair(td)
    transform.swap_prob = fresh.swap_prob = math.nan
    assert_same(transform(td), fresh(td))


def changed(td: TensorDict, change: str) -> TensorDict:
    """A batch of another structure or with something unusual."""
    td = td.clone()
    if change == "entry":
        td["more"] = td["action"]
    elif change == "dtype":
        td["observation"] = td["observation"].double()
        td["next", "observation"] = td["next", "observation"].double()
        del td[fingerprint_key(SCORE)]
    elif change == "size":
        td = td[:-2]
    elif change == "strided":
        td["observation"] = torch.stack([td["observation"]] * 2, -1)[..., 0]
    elif change == "lazy":
        td = TensorDict.lazy_stack(list(td.unbind(0)))
    elif change == "shape":
        td = td.view(2, -1)
    elif change == "names":
        td.names = ["time"]
    elif change == "device":
        td["next"] = td["next"].to("cpu")
    elif change == "kind":
        td["action"] = TensorDict({"x": td["action"]}, td.batch_size)
    return td


@pytest.mark.parametrize(
    "change",
    ["entry", "dtype", "size", "strided", "lazy", "shape", "names", "device", "kind"],
)
def test_other_batches_are_swapped_step_by_step(change: str) -> None:
    td = batch(FLAT, 100, 2)
    transform, fresh = pair(td, window=2)
    other = changed(td, change)
    out, is_repeated = taken(transform, other)
    assert not is_repeated
    wanted = fresh(other)
    assert_same(out, wanted)
    assert out.names == wanted.names and out["next"].device == wanted["next"].device
    assert out["action"] is not other["action"] or change != "kind"
    assert taken(transform, td)[1] or taken(transform, td)[1]  # the usual ones again


@pytest.mark.parametrize("window", [1, 2])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("state", "of other states"),
        ("finite", "is not finite"),
        ("score", "NaN"),
        ("ids", "crosses a trajectory's end"),
        ("done", "crosses a trajectory's end"),
        ("gap", "do not follow each other"),
    ],
)
def test_faults_raise_the_errors_of_single_steps(
    window: int, known: bool, fault: str, message: str
) -> None:
    if window == 1 and fault in ("ids", "done", "gap"):
        return  # there is nothing of the kind
    td = batch(FLAT, 100, window, known=known)
    transform = CAIACTransform(FLAT, 2.0, 1.0, window=window)
    repeated(transform, td)
    row = 8 * window
    if fault == "state":
        td["observation"][row, 3] += 0.5
        if not known:
            return  # nothing tells
    elif fault == "finite":
        td["observation"][row, 3] = math.inf  # is never swapped
        if known:  # the state of the scores
            here = state_hash(td, FLAT.in_keys)
            after = state_hash(td, [FLAT.next(key) for key in FLAT.in_keys])
            assert here is not None
            td[fingerprint_key(SCORE)] = fingerprint(here, after, FLAT.names, 0)
    elif fault == "score":
        td[SCORE][row, 1] = math.nan
        if known:
            return  # score_buffer has checked them
    elif fault == "ids":
        td["episode"][row] += 1
    elif fault == "done":
        td["next", "done"][row] = True
    else:
        td["next", "observation"][row] += 0.5
    with pytest.raises(ValueError, match=message):
        transform(td)


@pytest.mark.gpu
def test_a_gpu_is_not_waited_for_and_tells_faults_late() -> None:
    td = batch(FLAT, 100, 2)
    transform = CAIACTransform(FLAT, 0.5, window=2)
    on_gpu = td.to("cuda")
    repeated(transform, on_gpu)
    torch.cuda.synchronize()
    repeated(transform, on_gpu)
    with nothing_waits():
        assert taken(transform, on_gpu)[1]
    bad = td.clone()
    bad["next", "observation"][4] += 0.5
    bad["episode"][5] += 1
    with pytest.raises(ValueError, match=r"invalid in an earlier batch|end"):
        for _ in range(4):
            transform(bad.to("cuda"))
            torch.cuda.synchronize()


@pytest.mark.parametrize(
    ("change", "is_fit"),
    [(lambda x: x.t().contiguous().t(), True), (lambda x: x.byte(), False)],
)
def test_what_a_subclass_may_swap(change: Any, is_fit: bool) -> None:
    class Odd(CAIACTransform):
        def swappable(self, scores: torch.Tensor) -> torch.Tensor:
            return change(super().swappable(scores))

    td = batch(FLAT, 100, 1)
    transform = Odd(FLAT, 0.5)
    repeated(transform, td)
    out, is_repeated = taken(transform, td)
    assert is_repeated == is_fit and out["caiac", "swapped"].any()


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("fault", "message"), [("gap", "do not follow"), ("state", "of other states")]
)
def test_a_single_wrong_batch_on_a_gpu(fault: str, message: str) -> None:
    td = batch(FLAT, 100, 2)
    transform = CAIACTransform(FLAT, 0.5, window=2)
    repeated(transform, td.to("cuda"))
    bad = td.clone()
    if fault == "gap":
        bad["next", "observation"][4] += 0.5
    else:
        bad["observation"][4] += 0.5  # the first row of a window
    out, is_repeated = taken(transform, bad.to("cuda"))
    assert is_repeated and out.device.type == "cuda"
    torch.cuda.synchronize()
    with pytest.raises(ValueError, match=message):
        transform(td.to("cuda"))


@pytest.mark.gpu
def test_noisy_recordings_on_a_gpu_are_compared_by_distance() -> None:
    td = batch(FLAT, 200, 2, known=False)
    transform = CAIACTransform(FLAT, 0.5, window=2)
    repeated(transform, td.to("cuda"))
    td["next", "observation"] += 1e-3 * torch.randn(400, 5)
    on_gpu = td.to("cuda")
    for _ in range(4):
        transform(on_gpu)
        torch.cuda.synchronize()
    out, is_repeated = taken(transform, on_gpu)
    assert not is_repeated and bool(out["caiac", "swapped"].any())


@pytest.mark.parametrize("lookahead", ["next", 2, "goal"])
@pytest.mark.parametrize("window", [1, 2])
def test_lookahead(lookahead: Any, window: int) -> None:
    rows = batch(FLAT, 30, 10)
    rows[SCORE] = torch.rand(300, 3, generator=torch.Generator().manual_seed(3))

    def sampler(transform: CAIACTransform) -> ReplayBuffer:
        goals = WindowGoal(FLAT, window, generator=torch.Generator().manual_seed(5))
        rb = ReplayBuffer(
            storage=LazyTensorStorage(300),
            sampler=SliceSampler(slice_len=window, traj_key="episode"),
            sample_unit=goals,
            batch_size=60,
        )
        rb.extend(rows)
        rb.append_transform(goals)
        rb.append_transform(transform)
        return rb

    def made() -> CAIACTransform:
        return CAIACTransform(
            FLAT,
            0.8,
            window=window,
            lookahead=lookahead,
            generator=torch.Generator().manual_seed(1),
        )

    transform, fresh = made(), made()
    rb, other = sampler(transform), sampler(fresh)
    for _ in range(100):
        rb.sample()
    seen = []
    for buffer in (rb, other):
        torch.manual_seed(7)
        for part in buffer.transform:
            part.generator.manual_seed(2)
        with only_torch() if buffer is other else nullcontext():
            out, is_repeated = taken(buffer.sample)
        assert is_repeated == (buffer is rb)
        seen.append(out)
    assert_same(*seen)
    assert seen[0]["caiac", "swapped"].any()
