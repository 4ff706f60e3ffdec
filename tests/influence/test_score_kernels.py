"""Scores of one pass come from one kernel, whatever other processes would measure."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.influence.scoring import LAYOUT, episodes
from torchrl_caiac._kernels import onednn_has_float32
from torchrl_caiac.data import UnreadableFileError, load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer, score_file
from torchrl_caiac.modules import linear_kernel
from torchrl_caiac.modules.linear import linear

pytestmark = pytest.mark.usefixtures("float32")
BATCH = 64


@pytest.fixture
def float32(monkeypatch) -> None:
    """Lets the test run on a processor with AMX, too, on which oneDNN rounds."""
    if not onednn_has_float32():
        monkeypatch.setattr("torchrl_caiac._kernels.onednn_has_float32", lambda: True)
        monkeypatch.setattr(
            "torchrl_caiac.modules.linear.onednn_has_float32", lambda: True
        )


class Layer:
    """An estimator that multiplies; it ends a process after some calls."""

    def __init__(self, calls: int = -1) -> None:
        self.layout = LAYOUT
        self.weight = torch.randn(256, 256, generator=torch.Generator().manual_seed(0))
        self.calls = calls

    def __repr__(self) -> str:
        return "Layer()"

    def __call__(self, td):
        if not self.calls:
            raise KeyboardInterrupt
        self.calls -= 1
        state = td["observation"].repeat(1, 86)[:, :256]
        return linear(state, self.weight, self.weight[0])[:, :3].contiguous()


def score(folder: Path, calls: int = -1, **options) -> bytes:
    rb = offline_buffer(load_transitions(folder))
    try:
        score_buffer(rb, Layer(calls), BATCH, check=False, progress=False, **options)
    except KeyboardInterrupt:
        return b""
    return (folder / "caiac" / "score.memmap").read_bytes()


@pytest.fixture
def folders(tmp_path):
    """Makes folders of the same transitions."""
    rows = episodes([150, 170, 130])

    def make(name: str) -> Path:
        rows.memmap(tmp_path / name)
        return tmp_path / name

    return make


@pytest.fixture
def of(folders, new_process):
    """The scores of processes in which one kernel is the fastest."""
    found = {}
    for kernel in ("plain", "onednn"):
        new_process(kernel)
        found[kernel] = score(folders(kernel))
    assert found["plain"] != found["onednn"]
    return found


@pytest.mark.parametrize("first", ["plain", "onednn"])
@pytest.mark.parametrize("shards", [(None, None), ((0, 2), (1, 2)), ((0, 2), None)])
@pytest.mark.parametrize("calls", [1, 3])
def test_a_process_that_goes_on_uses_the_same(
    folders, new_process, of, first, shards, calls
):
    folder = folders("shared")
    new_process(first)
    assert not score(folder, calls, shard=shards[0])
    new_process("onednn" if first == "plain" else "plain")
    assert score(folder, shard=shards[1]) == of[first]


def test_all_scores_are_of_the_same_kernel_as_the_first(folders, new_process, of):
    """A last block of fewer rows, and the states after the last rows, are alike."""
    new_process("onednn")
    folder = folders("again")
    assert score(folder, overwrite=True) == of["onednn"]
    new_process("plain")
    assert score(folder, overwrite=True) == of["plain"]


def test_a_fixed_kernel_is_kept(folders, new_process, of):
    new_process("plain")
    folder = folders("fixed")
    with linear_kernel("onednn"):
        assert not score(folder, 3)
    with (
        linear_kernel("plain"),
        pytest.raises(ValueError, match="linear_kernel 'onednn', and 'plain' is set"),
    ):
        score(folder)
    score(folder)
    other = folders("whole")
    with linear_kernel("onednn"):
        whole = score(other)
    assert score(folder) == whole
    with linear_kernel("plain"):
        assert score(folder, overwrite=True) == of["plain"]


def test_a_record_of_unknown_kernels_is_refused(folders):
    folder = folders("damaged")
    score(folder)
    file = score_file(folder)
    text = file.read_text()
    file.write_text(text.replace('"auto"', '"another"'))
    with pytest.raises(UnreadableFileError, match="'another'"):
        score(folder)
