from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.data import (
    TransitionWriter,
    action_bounds,
    episode_transitions,
    load_transitions,
    verify_digests,
)


def episode(length=3, seed=0, ends=True, **given):
    rng = np.random.default_rng(seed)
    observations = {
        "arm": rng.normal(size=(length + 1, 2)),
        "on": np.ones(length + 1) > 0,
    }
    return episode_transitions(
        observations, rng.normal(size=(length, 2)), where="it", ends=ends, **given
    )


def test_the_folder_is_that_of_tensordict(tmp_path):
    episodes = [episode(length, seed) for seed, length in enumerate((3, 1, 6))]
    with TransitionWriter(
        tmp_path / "a", action_bounds=([-9, -9], [9, 9]), source={"file": "x"}
    ) as writer:
        for rows in episodes:
            writer.add(rows)
        assert (writer.episodes, writer.rows) == (3, 10)
        assert not (tmp_path / "a").exists()
        writer.source = {"file": "y"}
    whole = torch.cat(episodes)
    whole["episode"] = torch.tensor([0] * 3 + [1] + [2] * 6)
    whole.memmap(tmp_path / "b")
    data = load_transitions(tmp_path / "a", verify=True)
    assert (data == whole).all()
    assert torch.equal(action_bounds(data)[0], torch.tensor([-9.0, -9.0]))
    assert json.loads((tmp_path / "a" / "digests.json").read_text())["source"] == {
        "file": "y"
    }
    for file in (tmp_path / "b").rglob("*"):
        if file.is_file():
            written = tmp_path / "a" / file.relative_to(tmp_path / "b")
            assert written.read_bytes() == file.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


@pytest.mark.parametrize("rows", [None, 9, 4])
def test_parts_of_an_episode_and_more_or_less_rows_than_expected(rows, tmp_path):
    with TransitionWriter(tmp_path / "a", rows=rows) as writer:
        writer.add(episode(3, ends=False), ends=False)
        writer.add(episode(2))
        writer.add(episode(1))
    assert load_transitions(tmp_path / "a")["episode"].tolist() == [0] * 5 + [1]


def test_what_is_there_stays_until_the_end(tmp_path):
    with TransitionWriter(tmp_path / "a") as writer:
        writer.add(episode())
    with pytest.raises(FileExistsError, match="overwrite=True"):
        TransitionWriter(tmp_path / "a")
    with (
        pytest.raises(RuntimeError, match="stop"),
        TransitionWriter(tmp_path / "a", overwrite=True) as writer,
    ):
        writer.add(episode(7))
        raise RuntimeError("stop")
    assert len(load_transitions(tmp_path / "a")) == 3
    with TransitionWriter(tmp_path / "a", overwrite=True) as writer:
        writer.add(episode(7))
    verify_digests(tmp_path / "a")
    assert len(load_transitions(tmp_path / "a")) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def spoiled(**changes):
    rows = episode()
    for key, value in changes.items():
        rows["next", key] = value
    return rows


FLAGS = torch.zeros(3, 1, dtype=torch.bool)


@pytest.mark.parametrize(
    ("rows", "ends", "match"),
    [
        (episode()[:0], True, r"e 7 has batch size \[0\]"),
        (episode().reshape(1, 3), True, r"batch size \[1, 3\]"),
        (episode().set("episode", torch.zeros(3)), True, r"exclude\('episode'\)"),
        (episode().exclude("action"), True, r"e 7 lacks \['action'\]"),
        (episode().exclude(("next", "done")), True, r"lacks \[\('next', 'done'\)\]"),
        (spoiled(done=FLAGS), True, "is not 'terminated' or 'truncated'"),
        (spoiled(done=FLAGS.float()), True, r"'done'\) of e 7 is torch.float32"),
        (spoiled(done=FLAGS[:, 0]), True, r"torch.bool \[3\], expected"),
        (spoiled(done=FLAGS, truncated=FLAGS), True, "not done.*ends=False"),
        (episode(), False, "last row of e 7 is done.*ends=True"),
        (
            spoiled(reward=torch.full((3, 1), torch.nan)),
            True,
            "'reward'.* of e 7 has NaN",
        ),
        (
            episode(rewards=[1, 2, 3]),
            True,
            r"e 7 and the first one, first, differ.*"
            r"'reward'\) is torch.float32 \[L, 1\] and was missing",
        ),
        (
            episode().set("action", torch.zeros(3, 3)),
            True,
            r"'action' is .*\[L, 3\] and "
            r"was torch.float32 \[L, 2\]",
        ),
        (episode().set("action", torch.zeros(3, 2).int()), True, "torch.int32"),
    ],
)
def test_a_bad_episode_is_refused_and_can_be_skipped(rows, ends, match, tmp_path):
    with TransitionWriter(tmp_path / "a") as writer:
        writer.add(episode(2), where="first")
        with pytest.raises(ValueError, match=match):
            writer.add(rows, where="e 7", ends=ends)
        writer.add(episode(4))
    data = load_transitions(tmp_path / "a")
    assert data["episode"].tolist() == [0, 0, 1, 1, 1, 1]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_keys_with_the_same_name_with_dots_are_refused(tmp_path):
    observations = {"a.b": np.zeros((4, 2)), "a": {"b": np.ones((4, 2))}}
    rows = episode_transitions(observations, np.zeros((3, 1)), where="it")
    match = r"'a\.b'\).*'a', 'b'\).* of it have the same name with dots"
    with (
        pytest.raises(ValueError, match=match),
        TransitionWriter(tmp_path / "a") as writer,
    ):
        writer.add(rows, where="it")
    assert not list(tmp_path.iterdir())
    for name in ("a.b", "a.c"):  # each alone is stored
        one = rows.exclude(("observation", "a"), ("next", "observation", "a"))
        for root in (one, one["next"]):
            root.rename_key_(("observation", "a.b"), ("observation", name))
        with TransitionWriter(tmp_path / name) as writer:
            writer.add(one)
        data = load_transitions(tmp_path / name, verify=True)
        assert data["observation", name].shape == (3, 2)


def test_texts_and_reserved_names_are_refused(tmp_path):
    for key, value in (("text", "cup"), ("shape", torch.zeros(3))):
        with (
            pytest.raises(ValueError, match=f"'{key}' of episode 0"),
            TransitionWriter(tmp_path / "a") as writer,
        ):
            writer.add(episode().set(key, value))
    assert not list(tmp_path.iterdir())


def test_what_has_no_end_is_refused(tmp_path):
    with (
        pytest.raises(ValueError, match="no episode was added"),
        TransitionWriter(tmp_path / "a"),
    ):
        pass
    with (
        pytest.raises(ValueError, match=r"episode 1 .* has no end"),
        TransitionWriter(tmp_path / "a") as writer,
    ):
        writer.add(episode())
        writer.add(episode(ends=False), ends=False)
    assert not list(tmp_path.iterdir())


def test_bounds_are_checked_early(tmp_path):
    with pytest.raises(ValueError, match="finite"):
        TransitionWriter(tmp_path / "a", action_bounds=([0.0], [np.inf]))
    with (
        pytest.raises(ValueError, match=r"action_bounds have shape \[1\]"),
        TransitionWriter(tmp_path / "a", action_bounds=([0.0], [1.0])) as writer,
    ):
        writer.add(episode())
    assert not list(tmp_path.iterdir())


def test_only_in_its_block(tmp_path):
    writer = TransitionWriter(tmp_path / "a")
    with pytest.raises(RuntimeError, match="is not open: add episodes in its with"):
        writer.add(episode())
    with writer:
        writer.add(episode())
    with pytest.raises(RuntimeError, match="is not open"):
        writer.add(episode())


@pytest.mark.parametrize("rows", [None, 1_000_000])
def test_a_full_disk_is_an_error_and_leaves_nothing(rows, small_disk):
    large = episode(100_000)
    with (
        pytest.raises(OSError, match=r"the disk is full: .*\.memmap needs \d+ bytes"),
        TransitionWriter(small_disk / "a", rows=rows) as writer,
    ):
        for _ in range(3):
            writer.add(large)
    assert not list(small_disk.iterdir())


def test_after_a_failed_write_nothing_is_kept(small_disk):
    with (
        pytest.raises(ValueError, match=r"episode 1 .* could not be written"),
        TransitionWriter(small_disk / "a") as writer,
    ):
        writer.add(episode())
        with pytest.raises(OSError, match="disk is full"):
            writer.add(episode(400_000))
        with pytest.raises(RuntimeError, match="failed earlier"):
            writer.add(episode())
    assert not list(small_disk.iterdir())


def test_rows_without_numbers(tmp_path):
    rows = episode()
    rows["nothing"] = torch.zeros(3, 0)
    with TransitionWriter(tmp_path / "a") as writer:
        writer.add(rows)
    assert load_transitions(tmp_path / "a")["nothing"].shape == (3, 0)


def test_tensors_in_any_layout(tmp_path):
    rows = TensorDict(dict(episode().items()), [3])
    rows["action"] = torch.zeros(2, 3).t()
    rows["half"] = torch.ones(1, dtype=torch.bfloat16).expand(3)
    rows["grad"] = torch.ones(3, requires_grad=True)
    with TransitionWriter(tmp_path / "a") as writer:
        writer.add(rows)
    data = load_transitions(tmp_path / "a")
    assert data["half"].dtype == torch.bfloat16
    assert data["half"].all() and data["grad"].all()
