"""The functions in C and CUDA give the numbers of torch, to the bit."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac._fingerprints import fingerprint, matches, state_hash
from torchrl_caiac._sampling import (
    Runs,
    all_finite,
    chosen_windows,
    is_native,
    on_cuda,
    only_torch,
    read_columns,
    swap_rows,
)
from torchrl_caiac._sampling.on_cpu import library
from torchrl_caiac.transforms import HindsightGoal
from torchrl_caiac.transforms.checks import LateCheck, LateValue
from torchrl_caiac.transforms.draws import (
    DonorIndex,
    SwapDraw,
    draw_batch_donors,
    draw_buffer_donors,
    draw_windows,
    uninfluenced,
)
from torchrl_caiac.transforms.goals.hindsight import HindsightDraw
from torchrl_caiac.transforms.swap import SwapPlanner, apply_swap

KINDS = [torch.float32, torch.float64, torch.float16, torch.uint8, torch.int64]


DEVICES = pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
)


def both(function: Any, device: str = "cpu") -> tuple[Any, Any]:
    """What C or CUDA and what torch return."""
    assert is_native(torch.zeros(1, device=device))
    in_c = function()
    with only_torch():
        return in_c, function()


def assert_same_draws(one: SwapDraw, other: SwapDraw) -> None:
    for name in ("donors", "swapped", "no_donor"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def bits(tensor: torch.Tensor) -> bytes:
    return tensor.cpu().contiguous().view(torch.uint8).numpy().tobytes()


@DEVICES
@settings(max_examples=100, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 12), st.integers(1, 4)),
    drawn=st.integers(0, 12),
    window=st.integers(1, 3),
    swap_prob=st.sampled_from([1.0, 0.5, 0.0]),
    has_chosen=st.booleans(),
    share=st.sampled_from([0.0, 0.2, 0.7, 1.0]),
    seed=st.integers(0, 1000),
)
def test_donors_of_a_batch(
    device: str,
    shape: tuple[int, int],
    drawn: int,
    window: int,
    swap_prob: float,
    has_chosen: bool,
    share: float,
    seed: int,
) -> None:
    drawn = min(drawn, shape[0])
    of = torch.Generator().manual_seed(seed)
    free = torch.rand(shape, generator=of) < share
    chosen = torch.rand(drawn, generator=of) < 0.5 if has_chosen else None
    free, chosen = free.to(device), None if chosen is None else chosen.to(device)
    in_c, in_torch = both(
        lambda: draw_batch_donors(
            free,
            drawn,
            window=window,
            swap_prob=swap_prob,
            chosen=chosen,
            generator=torch.Generator().manual_seed(seed),
        ),
        device,
    )
    assert_same_draws(in_c, in_torch)


@DEVICES
@settings(max_examples=100, deadline=None)
@given(
    owners=st.lists(st.integers(-1, 2), min_size=3, max_size=8),
    dtype=st.sampled_from(KINDS),
    windows=st.integers(1, 8),
    window=st.integers(1, 3),
    drawn=st.integers(1, 8),
    other=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_swapped_rows(
    device: str,
    owners: list[int],
    dtype: torch.dtype,
    windows: int,
    window: int,
    drawn: int,
    other: bool,
    seed: int,
) -> None:
    drawn = min(drawn, windows)
    owners = [0, 1, 2, *owners]
    layout = EntityLayout(
        {str(n): [c for c, owner in enumerate(owners) if owner == n] for n in range(3)}
    )
    of = torch.Generator().manual_seed(seed)

    def values(rows: int) -> torch.Tensor:
        found = torch.randint(0, 200, (rows, len(owners)), generator=of)
        return found.to(device, dtype)

    batch = TensorDict(
        {
            "observation": values(windows * window),
            ("next", "observation"): values(windows * window),
        },
        [windows * window],
    )
    free = (torch.rand(windows, 3, generator=of) < 0.7).to(device)
    draw = draw_batch_donors(free, drawn, window=window, generator=of)
    planner = SwapPlanner(layout)
    sources = [values(windows * window) for _ in range(2)] if other else None
    in_c, in_torch = both(
        lambda: apply_swap(
            batch, *planner(batch), draw, window=window, sources=sources
        ),
        device,
    )
    for key in ("observation", ("next", "observation")):
        assert bits(in_c[key]) == bits(in_torch[key])
        assert in_c[key].dtype is dtype
        assert in_c[key].data_ptr() != batch[key].data_ptr()


@DEVICES
@pytest.mark.parametrize("other", [False, True])
@pytest.mark.parametrize(
    ("windows", "window", "dtype"),
    [(1300, 1, torch.float32), (70, 20, torch.float16), (3, 600, torch.uint8)],
)
def test_rows_of_large_batches(
    device: str, windows: int, window: int, dtype: torch.dtype, other: bool
) -> None:
    # Entities of 1 to 300 values, more of them than are compared at a time.
    widths, of = [*range(1, 18), 100, 300], torch.Generator().manual_seed(0)
    ends = torch.tensor(widths).cumsum(0).tolist()
    layout = EntityLayout(
        {
            f"{i}": range(end - width, end)
            for i, (width, end) in enumerate(zip(widths, ends, strict=True))
        }
    )

    def values(rows: int) -> torch.Tensor:
        return torch.randint(0, 200, (rows, ends[-1]), generator=of).to(device, dtype)

    rows, drawn = windows * window, windows - 1
    td = TensorDict({"observation": values(rows)}, [rows])
    td["next", "observation"] = values(rows)
    shape = drawn, len(widths)
    starts = torch.randint(0, rows - window + 1, shape, generator=of)
    swapped = torch.rand(shape, generator=of) < 0.5
    draw = SwapDraw(starts.to(device), swapped.to(device), torch.zeros(19).long())
    planner = SwapPlanner(layout)
    sources = [values(rows) for _ in range(2)] if other else None
    in_c, in_torch = both(
        lambda: apply_swap(td, *planner(td), draw, window=window, sources=sources),
        device,
    )
    for key in ("observation", ("next", "observation")):
        assert bits(in_c[key]) == bits(in_torch[key])


@DEVICES
@settings(max_examples=100, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 8), st.integers(1, 3)),
    sizes=st.lists(st.integers(0, 4), min_size=3, max_size=3),
    is_short=st.booleans(),
    swap_prob=st.sampled_from([1.0, 0.5]),
    has_chosen=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_donors_of_a_buffer(
    device: str,
    shape: tuple[int, int],
    sizes: list[int],
    is_short: bool,
    swap_prob: float,
    has_chosen: bool,
    seed: int,
) -> None:
    of = torch.Generator().manual_seed(seed)
    free = torch.rand(shape, generator=of) < 0.7
    chosen = torch.rand(shape[0], generator=of) < 0.5 if has_chosen else None
    free, chosen = free.to(device), None if chosen is None else chosen.to(device)
    size = torch.tensor(sizes[: shape[1]])
    starts = torch.randint(0, 99, (max(1, int(size.sum())),), generator=of)
    starts = starts.int() if is_short else starts
    index = DonorIndex(*(x.to(device) for x in (starts, size.cumsum(0) - size, size)))
    in_c, in_torch = both(
        lambda: draw_buffer_donors(
            free,
            index,
            swap_prob=swap_prob,
            chosen=chosen,
            generator=torch.Generator().manual_seed(seed),
        ),
        device,
    )
    assert_same_draws(in_c, in_torch)


@DEVICES
@settings(max_examples=100, deadline=None)
@given(
    rows=st.integers(1, 12),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    future=st.sampled_from([0.0, 0.3, 0.5]),
    random=st.sampled_from([0.0, 0.2, 0.5]),
    counterfactual=st.sampled_from([0.0, 0.3, 0.5, 1.0]),
    seed=st.integers(0, 1000),
)
def test_sources_of_hindsight_goals(
    device: str,
    rows: int,
    share: float,
    future: float,
    random: float,
    counterfactual: float,
    seed: int,
) -> None:
    layout = EntityLayout({"b": [0]}, goal={"b": [0]}, achieved={"b": [0]})
    goals = HindsightGoal(
        layout,
        lambda achieved, desired: achieved[..., 0],
        future=future,
        random=random,
        counterfactual=counterfactual,
    )
    flags = torch.rand(rows, 1, generator=torch.Generator().manual_seed(seed)) < share
    flags = flags.to(device)
    in_c, in_torch = both(
        lambda: goals.generate_parameters(
            flags,
            {"desired_goal": torch.zeros(rows, 1)},
            torch.Generator().manual_seed(seed),
        ),
        device,
    )
    assert torch.equal(in_c.source, in_torch.source)


@DEVICES
@given(
    columns=st.lists(st.integers(0, 4), min_size=1, max_size=6),
    dtype=st.sampled_from(KINDS),
    rows=st.none() | st.lists(st.integers(0, 5), max_size=4),
)
def test_columns_of_rows(
    device: str, columns: list[int], dtype: torch.dtype, rows: list[int] | None
) -> None:
    source = torch.arange(30).view(6, 5).to(device, dtype)
    picked = None
    if rows is not None:
        picked = torch.tensor(rows, dtype=torch.int64).to(device)
    found = read_columns(source, columns, picked)
    wanted = source if picked is None else source[picked]
    assert torch.equal(found, wanted[:, columns])


@pytest.mark.parametrize("rows", [None, [3, 2, 2, 0]])
@DEVICES
def test_fingerprints_in_a_column(device: str, rows: list[int] | None) -> None:
    td = TensorDict({"x": torch.arange(8.0).view(4, 2)}, [4]).to(device)
    known = fingerprint(state_hash(td, ["x"]), None, ["a"], 0).unsqueeze(1)
    td["x"][2] = 9.0
    wanted, picked = td["x"][:, 0] != 9.0, None
    if rows is not None:
        picked = torch.tensor(rows, device=device)
        wanted = wanted[picked]
    for one in both(lambda: matches(td, known, ["x"], [], ["a"], picked), device):
        assert torch.equal(one, wanted)


@pytest.mark.parametrize("row", [-1, -2, 3, 1 << 40, (1 << 63) - 1, -(1 << 63)])
def test_rows_out_of_range(row: int) -> None:
    state, rows = torch.zeros(3, 2), torch.tensor([0, row])
    with pytest.raises(IndexError, match=f"row {row} is out of range: there are 3"):
        read_columns(state, [0], rows)
    with pytest.raises(IndexError, match=f"row {row} is out of range"):
        matches(
            TensorDict({"x": state}, [3]), torch.zeros(3).long(), ["x"], [], "a", rows
        )
    with pytest.raises(IndexError, match=f"row {row} is out of range"):
        donors, swapped = rows.view(2, 1), torch.ones(2, 1, dtype=torch.bool)
        swap_rows([state], [state], [Runs.of([0, 0], 4)], donors, swapped, 1)


@DEVICES
@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 9),
    width=st.integers(1, 6),
    changed=st.lists(st.integers(0, 8), max_size=3),
    some=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_rows_that_changed(
    device: str, rows: int, width: int, changed: list[int], some: bool, seed: int
) -> None:
    of = torch.Generator().manual_seed(seed)
    state, after = (1e3 * torch.randn(rows, width, generator=of) for _ in "ab")
    td = TensorDict({"x": state, ("next", "x"): after}, [rows])
    first, then = state_hash(td, ["x"]), state_hash(td, [("next", "x")])
    assert first is not None and then is not None
    known = fingerprint(first, then, ("a", "b"), 5)
    for row in changed:
        if row < rows:
            state[row, 0] = -state[row, 0]
    picked = torch.randint(0, rows, (4,), generator=of) if some else None
    whole = torch.ones(rows, dtype=torch.bool)
    whole[[row for row in changed if row < rows and changed.count(row) % 2]] = False
    whole = whole if picked is None else whole[picked]
    td, known = td.to(device), known.to(device)
    picked = None if picked is None else picked.to(device)
    hashes = both(lambda: state_hash(td, ["x", ("next", "x")]), device)
    assert torch.equal(*hashes)
    in_c, in_torch = both(
        lambda: matches(td, known, ["x"], [("next", "x")], ("a", "b"), picked), device
    )
    assert torch.equal(in_c, in_torch)
    assert torch.equal(in_c.cpu(), whole)


@pytest.mark.gpu
@given(
    windows=st.integers(1, 12), share=st.floats(0, 1), levels=st.sampled_from([2, 99])
)
def test_windows_that_are_chosen(windows: int, share: float, levels: int) -> None:
    of = torch.Generator().manual_seed(windows)
    number = torch.randint(levels, (windows,), generator=of).double()  # also equal ones
    count = round(share * windows)
    found = chosen_windows(number.to("cuda"), count).cpu()
    assert torch.equal(found, number.argsort(stable=True).argsort() < count)
    device = torch.device("cuda")
    assert int(draw_windows(windows, count, device=device).cpu().sum()) == count
    with only_torch():
        assert int(draw_windows(windows, count, device=device).cpu().sum()) == count


@pytest.mark.gpu
@pytest.mark.parametrize("number", [5, 40])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("bad", [None, "inf", "nan"])
def test_values_that_are_looked_at(
    number: int, dtype: torch.dtype, bad: str | None
) -> None:
    def found() -> list[int]:
        late = LateCheck()
        values = torch.zeros(7, dtype=dtype)
        worst = values.clone()
        if bad is not None:
            worst[3] = float(bad)
        values, worst = values.to("cuda"), worst.to("cuda")
        here = worst == worst[3]
        looked: list[LateValue | None] = [LateValue(values)] * number
        looked[0] = None
        looked[1] = LateValue(here, "true", values.bool())
        looked[2] = LateValue(~values.bool(), "false")
        looked[3] = LateValue(worst, "infinite")
        looked[number - 1] = LateValue(worst)
        late.look(looked)
        torch.cuda.synchronize()
        return late.found()

    with only_torch():
        wanted = found()
    assert found() == wanted
    assert wanted == {None: [], "inf": [3, number - 1], "nan": [number - 1]}[bad]


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-45, 3.4e38, -3.4e38])
def test_finite_numbers(value: float) -> None:
    assert all_finite([torch.full((7,), value)])


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [0, 6])
def test_numbers_that_are_not_finite(value: float, place: int) -> None:
    values = torch.zeros(7)
    values[place] = value
    assert not all_finite([torch.zeros(2), values])


def test_tensors_that_need_torch() -> None:
    assert is_native(torch.zeros(3, 2))
    assert not is_native(torch.zeros(3, 2).t())
    assert not is_native(torch.zeros(3, requires_grad=True))
    assert not is_native(torch.nn.Buffer(torch.zeros(3)).to("meta"))
    with only_torch():
        assert not is_native()


def test_runs_of_columns_apart() -> None:
    runs = Runs.of([1, 0, 0, -1, 0, 1], itemsize=8)
    assert runs.entity.tolist() == [1, 0, 0, 1]
    assert runs.start.tolist() == [0, 8, 32, 40]
    assert runs.length.tolist() == [8, 16, 8, 8]


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """An empty folder that compiled files are kept in."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield tmp_path / "torchrl_caiac"
    monkeypatch.undo()
    library.cache_clear()
    assert is_native()


def is_native_anew() -> bool:
    """What a new process finds."""
    library.cache_clear()
    return is_native()


def test_it_is_compiled_once(cache: Path) -> None:
    assert is_native_anew()
    (file,) = cache.iterdir()
    before = file.stat().st_mtime_ns
    assert is_native_anew()
    assert file.stat().st_mtime_ns == before
    assert not file.stat().st_mode & 0o077


@pytest.mark.parametrize("damage", ["bytes", "rights", "folder"])
def test_a_kept_file_that_is_not_loaded(
    cache: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    assert is_native_anew()
    (good,) = cache.iterdir()
    # A process loads the same path only once.
    other = cache.parent / "other"
    monkeypatch.setenv("XDG_CACHE_HOME", str(other))
    file = other / "torchrl_caiac" / good.name
    file.parent.mkdir(parents=True)
    if damage == "bytes":
        file.write_bytes(b"damaged")
        file.chmod(0o700)
    elif damage == "rights":  # others could have written it
        file.write_bytes(b"")
        file.chmod(0o777)
    else:
        file.parent.rmdir()
        file.parent.write_text("no folder")
    assert is_native_anew()
    if damage == "folder":
        assert file.parent.read_text() == "no folder"
    else:
        assert file.read_bytes() == good.read_bytes()
        assert not file.stat().st_mode & 0o077


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"PATH": "/nowhere"}, "there is no C compiler"),
        ({"CC": "/bin/false"}, "non-zero exit status"),
        ({"TORCHRL_CAIAC_NATIVE": "0"}, ""),
    ],
)
def test_without_a_compiler(
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    variables: dict[str, str],
    message: str,
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        assert not is_native_anew()
    assert message in caplog.text
    assert ("apt-get install gcc" in caplog.text) == bool(message)


def test_draws_that_do_not_fit_are_left_to_torch() -> None:
    layout = EntityLayout({"a": [0], "b": [1]})
    state = torch.zeros(3, 2)
    td = TensorDict({"observation": state, ("next", "observation"): state}, [3])
    plan, values = SwapPlanner(layout)(td)

    def swap(rows: int, entities: int, sources: Any = None) -> Any:
        donors = torch.zeros(rows, entities, dtype=torch.int64)
        draw = SwapDraw(donors, donors.bool(), donors[0])
        return apply_swap(td, plan, values, draw, sources=sources)

    assert torch.equal(swap(3, 2)["observation"], state)
    for wrong in ((3, 1), (4, 2)):
        with pytest.raises((RuntimeError, IndexError)):
            swap(*wrong)
    wider = swap(3, 2, [state.double(), state.double()])
    assert torch.equal(wider["observation"], state)


def test_plans_of_an_empty_batch_fit_later_ones() -> None:
    layout = EntityLayout.from_keys({"a": "a", "b": "b"})
    state = torch.arange(12.0).view(2, 3, 2)
    td = TensorDict({"a": state, "b": state, "next": {"a": state, "b": state}}, [2])
    planner = SwapPlanner(layout)
    planner(td[:0])
    draw = SwapDraw(torch.ones(2, 2).long(), torch.ones(2, 2).bool(), torch.zeros(2))
    in_c, in_torch = both(lambda: apply_swap(td, *planner(td), draw))
    for batch in (in_c, in_torch):
        assert torch.equal(batch["a"], state[[1, 1]])


def test_lazy_signs_and_tensors_without_memory_need_torch() -> None:
    number = torch.complex(torch.ones(2, 2), torch.ones(2, 2)).conj()
    assert number.is_contiguous() and not is_native(number)
    assert not is_native(torch._neg_view(torch.ones(2, 2)))
    assert not is_native(torch._efficientzerotensor((2, 2)))
    assert is_native(torch.ones(0, 2))


def test_numbers_of_other_types_and_an_empty_index_need_torch() -> None:
    free = torch.tensor([[1], [1], [0], [1]])
    one, other = both(lambda: draw_batch_donors(free.bool(), 4).swapped)
    assert torch.equal(one, other)
    assert torch.equal(draw_batch_donors(free, 4).swapped.bool(), one)
    short = DonorIndex(
        torch.arange(4), torch.tensor([0, 2]).int(), torch.tensor([2, 2]).int()
    )
    whole = torch.ones(9, 2, dtype=torch.bool)
    donors = draw_buffer_donors(whole, short).donors
    assert (donors[:, 0] < 2).all() and (donors[:, 1] >= 2).all()
    nothing = torch.zeros(0, dtype=torch.int64)
    zero = torch.tensor([0, 0])
    with pytest.raises(IndexError):
        draw_buffer_donors(whole, DonorIndex(nothing, zero, zero))


@pytest.mark.parametrize("window", [1, 2])
def test_leaves_without_columns(window: int) -> None:
    layout = EntityLayout.from_keys({"a": "a", "b": "b"})
    none, state = torch.zeros(4, 0), torch.arange(8.0).view(4, 2)
    parts = {"a": none, "b": state}
    td = TensorDict({**parts, "next": parts}, [4])
    plan, values = SwapPlanner(layout)(td)
    sources = [values[leaf.place] for leaf in plan.leaves]
    one = torch.ones(4 // window, 2)
    draw = SwapDraw(one.long() * 0, one.bool(), torch.zeros(2))
    for batch in both(
        lambda: apply_swap(td, plan, values, draw, window=window, sources=sources)
    ):
        assert torch.equal(batch["b"], state[:window].repeat(4 // window, 1))


@DEVICES
@given(
    rows=st.integers(1, 9),
    columns=st.permutations(range(5)),
    number=st.integers(1, 5),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    has_future=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_goals_of_rows(
    device: str,
    rows: int,
    columns: list[int],
    number: int,
    dtype: torch.dtype,
    has_future: bool,
    seed: int,
) -> None:
    names = ["abcde"[column] for column in columns[:number]]
    layout = EntityLayout(
        {name: [i] for i, name in enumerate("abcde")},
        goal={name: [names.index(name)] if name in names else [] for name in "abcde"},
        achieved={name: [i] if name in names else [] for i, name in enumerate("abcde")},
    )
    goals = HindsightGoal(
        layout, lambda achieved, desired: -(achieved - desired).sum(-1)
    )
    of = torch.Generator().manual_seed(seed)

    def values(width: int) -> torch.Tensor:
        return torch.rand(rows, width, generator=of).to(device, dtype)

    td = TensorDict(
        {
            "desired_goal": values(number),
            "next": {"observation": values(5), "reward": values(1)},
        },
        [rows],
    )
    source = torch.randint(0, (3 if has_future else 2) * rows, (rows,), generator=of)
    future = {"desired_goal": values(number)} if has_future else None
    draw = HindsightDraw(source.to(device), future)
    native, by_torch = both(lambda: goals.apply_parameters(td, draw), device)
    for key in ("desired_goal", ("next", "reward"), ("hindsight", "relabeled")):
        assert bits(native[key]) == bits(by_torch[key])


@DEVICES
@given(
    windows=st.integers(1, 6),
    window=st.integers(1, 4),
    threshold=st.sampled_from([0.0, 0.05, 1e300, math.inf]),
    each=st.booleans(),
    entities=st.sampled_from([3, 16, 37]),
    seed=st.integers(0, 1000),
)
def test_uninfluenced_entities(
    device: str,
    windows: int,
    window: int,
    threshold: float,
    each: bool,
    entities: int,
    seed: int,
) -> None:
    of = torch.Generator().manual_seed(seed)
    scores = torch.rand(windows * window, entities, generator=of)
    scores[scores > 0.7] = 0.05
    scores[scores > 0.6] = math.nan
    limit: float | torch.Tensor = threshold
    if each:
        limit = (
            torch.tensor([threshold, math.nan, 0.3]).repeat(13)[:entities].to(device)
        )
    scores = scores.to(device)
    assert torch.equal(*both(lambda: uninfluenced(scores, limit, window), device))


@pytest.mark.skipif(
    torch.version.cuda is None,
    reason="this build of PyTorch has no NVRTC, so that nothing compiles kernels",
)
@pytest.mark.parametrize("capability", ["75", "90"])
def test_kernels_compile_for_a_device(capability: str) -> None:
    from torch.cuda._utils import _nvrtc_compile

    source = Path(on_cuda.__file__).with_name("sampling.cu").read_text()
    names = re.findall(r"__global__ void (\w+)", source)
    binary, _ = _nvrtc_compile(source, names[0], capability)
    assert len(names) == 11 and all(name.encode() in binary for name in names)
