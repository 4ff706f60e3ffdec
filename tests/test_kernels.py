"""Tests of what computes linear layers: measured, kept in a file, or recorded."""

from __future__ import annotations

import json
import threading
import types
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from tests.mutations import mutate_file
from torchrl_caiac import _kernels
from torchrl_caiac._kernels import (
    UsedKernels,
    check_kernels,
    choose,
    keep_kernels,
    known_kernel,
    machine,
    onednn_has_float32,
    only_kernels,
    through_onednn,
)
from torchrl_caiac.modules import linear_kernel


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """The folder of a user who has measured nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(_kernels, "_base", _kernels._State())
    monkeypatch.setattr(_kernels, "_files", {})
    return tmp_path / "torchrl_caiac"


@pytest.fixture
def timed(monkeypatch) -> Callable[..., Callable[[], dict]]:
    """A function that makes candidates that take some seconds of a stopped clock."""
    now = [0.0]
    clock = types.SimpleNamespace(
        thread_time=lambda: now[0], perf_counter=lambda: now[0]
    )
    monkeypatch.setattr(_kernels, "time", clock)

    def make(**seconds: float | list[float]) -> Callable[[], dict]:
        def take(name):
            took = seconds[name]
            if isinstance(took, list):
                took.append(took.pop(0))
                took = took[-1]
            now[0] += took

        return lambda: {name: lambda name=name: take(name) for name in seconds}

    return make


def refuse() -> dict:
    raise AssertionError("it is measured again")


def forget(monkeypatch) -> None:
    """Stands in for a new process."""
    monkeypatch.setattr(_kernels, "_base", _kernels._State())
    monkeypatch.setattr(_kernels, "_files", {})


@pytest.mark.parametrize(
    ("times", "want"),
    [
        ({"plain": 1.0, "onednn": 0.95}, "plain"),  # not by a tenth
        ({"plain": 1.0, "onednn": 0.85}, "onednn"),
        ({"plain": 1.0, "onednn": 2.0}, "plain"),
        ({"onednn": 0.85, "plain": 1.0}, "onednn"),
        ({"float32": 1.0, "bfloat16": 0.8}, "bfloat16"),
        # A call in which another process had the processor, and the first ones.
        ({"plain": [1.0] * 5, "onednn": [9.0, 9.0, 0.5, 9.0, 9.0]}, "onednn"),
        ({"plain": [9.0, 1.0, 1.0], "onednn": [0.1, 2.0, 2.0, 2.0, 2.0, 2.0]}, "plain"),
        ({"plain": 1.0}, "plain"),
    ],
)
def test_the_fastest_is_chosen_by_a_margin(timed, times, want):
    default = "float32" if "float32" in times else "plain"
    assert choose("8x8x8", default, timed(**times)) == want
    assert choose("8x8x8", default, refuse) == want


def test_processors_of_one_name_are_told_apart():
    text = Path("/proc/cpuinfo").read_text()
    own = machine()["processor"]
    assert ("family" in own) == ("cpu family" in text)


def test_another_process_reads_what_one_has_measured(timed, cache, monkeypatch):
    choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
    choose("9x9x9", "plain", timed(plain=1.0, onednn=1.0))
    forget(monkeypatch)
    assert choose("8x8x8", "plain", refuse) == "onednn"
    assert choose("9x9x9", "plain", refuse) == "plain"
    (file,) = cache.glob("*.json")
    content = json.loads(file.read_text())
    assert content["machine"] == machine()
    assert content["choices"] == {"8x8x8": "onednn", "9x9x9": "plain"}


def test_of_two_processes_that_measure_the_first_decides(timed, monkeypatch):
    candidates = timed(plain=1.0, onednn=0.5)

    def meanwhile() -> dict:
        with monkeypatch.context() as patch:
            forget(patch)
            choose("8x8x8", "plain", timed(plain=1.0, onednn=1.0))
        return candidates()

    assert choose("8x8x8", "plain", meanwhile) == "plain"
    assert choose("8x8x8", "plain", refuse) == "plain"


@pytest.mark.parametrize("threads", [1, 2])
def test_choices_are_of_one_number_of_threads(timed, threads):
    choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
    torch.set_num_threads(threads)
    try:
        kernel = choose("8x8x8", "plain", timed(plain=1.0, onednn=1.0))
    finally:
        torch.set_num_threads(1)
    assert kernel == ("onednn" if threads == 1 else "plain")


def other_machine(file: Path) -> None:
    content = json.loads(file.read_text())
    content["machine"]["processor"] = "another"
    file.write_text(json.dumps(content))


def other_kernel(file: Path) -> None:
    file.write_text(file.read_text().replace("onednn", "an_unknown_one"))


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(b"\xff\x00"),
        lambda file: file.write_text("[1]"),
        lambda file: file.write_text('{"choices": {}}'),
        other_machine,
        other_kernel,
    ],
    ids=["empty", "binary", "list", "bare", "machine", "kernel"],
)
def test_a_damaged_or_foreign_file_is_written_anew(
    timed, cache, monkeypatch, caplog, damage
):
    choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
    (file,) = cache.glob("*.json")
    damage(file)
    forget(monkeypatch)
    assert choose("8x8x8", "plain", timed(plain=1.0, onednn=2.0)) == "plain"
    (record,) = caplog.records
    assert str(file) in record.getMessage()
    forget(monkeypatch)
    assert choose("8x8x8", "plain", refuse) == "plain"
    assert len(caplog.records) == 1


def test_any_damage_leaves_a_choice(timed, cache, monkeypatch):
    import random

    choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
    (file,) = cache.glob("*.json")
    content = file.read_bytes()
    for seed in range(100):
        file.write_bytes(content)
        mutate_file(file, random.Random(seed))
        forget(monkeypatch)
        kernel = choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
        assert kernel in ("plain", "onednn")
        if file.is_dir():
            file.rmdir()


def test_a_read_only_home_is_measured_in_each_process(timed, cache, read_only):
    cache.mkdir()
    read_only(cache)
    assert choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5)) == "onednn"
    assert choose("8x8x8", "plain", refuse) == "onednn"
    assert not list(cache.iterdir())


def test_without_a_home_it_is_measured_in_each_process(timed, monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(_kernels.os.path, "expanduser", lambda path: path)
    monkeypatch.chdir(tmp_path)
    assert choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5)) == "onednn"
    assert choose("8x8x8", "plain", refuse) == "onednn"
    assert not list(tmp_path.iterdir())


def test_threads_have_their_own_context(monkeypatch):
    monkeypatch.setattr(_kernels, "onednn_has_float32", lambda: True)
    inside, left = threading.Event(), threading.Event()
    found = []

    def other() -> None:
        with linear_kernel("onednn"):
            inside.set()
            left.wait()
            found.append(known_kernel(1, lambda: "8x8x8", refuse))

    thread = threading.Thread(target=other)
    with linear_kernel("plain"):
        thread.start()
        inside.wait()
        assert known_kernel(1, lambda: "8x8x8", refuse) == "plain"
    left.set()
    thread.join()
    assert found == ["onednn"]
    assert _kernels.kernel_mode() == "auto"


@pytest.mark.parametrize("kernel", ["plain", "onednn", "auto"])
def test_a_fixed_choice(timed, kernel, monkeypatch):
    monkeypatch.setattr(_kernels, "onednn_has_float32", lambda: True)
    found = []

    def look() -> None:
        candidates = timed(plain=1.0, onednn=0.5) if kernel == "auto" else refuse
        found.append(known_kernel(1, lambda: "8x8x8", candidates))

    with pytest.raises(KeyError), linear_kernel(kernel):
        look()
        with linear_kernel("plain"):
            found.append(known_kernel(1, lambda: "8x8x8", refuse))
        look()
        raise KeyError
    want = "onednn" if kernel == "auto" else kernel
    assert found == [want, "plain", want]
    assert _kernels.kernel_mode() == "auto"


def test_an_unknown_kernel_is_refused():
    with pytest.raises(ValueError, match="'mkl'"), linear_kernel("mkl"):
        pass


def test_what_was_used_is_kept(timed, monkeypatch):
    choose("8x8x8", "plain", timed(plain=1.0, onednn=0.5))
    used = UsedKernels()
    assert used.state() == {"kernel": "auto", "chosen": {}}
    known_kernel(1, lambda: "8x8x8", refuse)
    known_kernel(2, lambda: "9x9x9", timed(plain=1.0, onednn=1.0))
    state = used.state()
    assert state["chosen"] == {"8x8x8": "onednn", "9x9x9": "plain"}
    check_kernels(json.loads(json.dumps(state)))
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")  # of another machine
    monkeypatch.setattr(_kernels, "onednn_has_float32", lambda: True)
    forget(monkeypatch)
    other = timed(plain=1.0, onednn=2.0)
    with only_kernels(state):
        assert choose("8x8x8", "plain", refuse) == "onednn"
        assert choose("7x7x7", "plain", refuse) == "plain"  # however fast it is
    assert known_kernel(1, lambda: "8x8x8", other) == "plain"
    keep_kernels(state)
    assert known_kernel(1, lambda: "8x8x8", refuse) == "onednn"


@pytest.mark.parametrize(
    "state",
    [
        None,
        {},
        {"kernel": "auto"},
        {"kernel": "fast", "chosen": {}},
        {"kernel": "auto", "chosen": {"8x8x8": "fast"}},
        {"kernel": "auto", "chosen": ["plain"]},
    ],
)
def test_another_record_is_refused(state):
    with pytest.raises(ValueError, match="kernels of linear layers"):
        check_kernels(state)


def test_a_processor_that_would_round(monkeypatch, caplog):
    """That of a record had no AMX, this one has."""
    monkeypatch.setattr(_kernels, "onednn_has_float32", lambda: False)
    with pytest.raises(ValueError, match="round"), linear_kernel("onednn"):
        pass
    state = {"kernel": "auto", "chosen": {"8x8x8": "onednn", "9x9x9": "plain"}}
    keep_kernels(state)
    assert choose("8x8x8", "plain", refuse) == "plain"
    with only_kernels({"kernel": "onednn", "chosen": {}}):
        assert known_kernel(1, lambda: "8x8x8", refuse) == "plain"
    assert len(caplog.records) == 2


def test_rounding_is_noticed(monkeypatch):
    onednn_has_float32.cache_clear()
    monkeypatch.setattr(
        _kernels, "through_onednn", lambda: torch.autocast("cpu", torch.bfloat16)
    )
    assert not onednn_has_float32()
    onednn_has_float32.cache_clear()

    @contextmanager
    def nothing():
        yield

    monkeypatch.setattr(_kernels, "through_onednn", nothing)
    assert onednn_has_float32() is torch.backends.mkldnn.is_available()
    onednn_has_float32.cache_clear()


def test_the_setting_of_torch_is_restored():
    setting = torch.backends.mkldnn.matmul
    assert setting.fp32_precision == "none"
    inside, left = threading.Event(), threading.Event()

    def other() -> None:
        with through_onednn():
            inside.set()
            left.wait()

    thread = threading.Thread(target=other)
    with through_onednn():
        thread.start()
        inside.wait()
        with pytest.raises(KeyError), through_onednn():
            assert setting.fp32_precision == "bf16"
            raise KeyError
    assert setting.fp32_precision == "bf16"  # the other one goes on
    left.set()
    thread.join()
    assert setting.fp32_precision == "none"
