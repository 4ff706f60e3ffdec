"""Transitions written as Minari datasets, and read back."""

from __future__ import annotations

import logging
import os

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac.data import (
    action_bounds,
    episode_transitions,
    load_lerobot,
    load_minari,
    load_ogbench,
    to_minari,
    write_transitions,
)


def transitions(lengths=(3, 5), *, kind="flat", seed=0, rewards=True):
    """Trajectories as a loader returns them."""
    random, parts = np.random.default_rng(seed), []
    for number, length in enumerate(lengths):
        states = random.normal(size=(length + 1, 4))
        if kind == "nested":
            images = random.integers(0, 255, (length + 1, 32, 32, 3), dtype=np.uint8)
            flags = random.integers(0, 2, (length + 1, 2)).astype(bool)
            states = {"arm": states, "cup": {"image": images, "flags": flags}}
        if kind == "goals":
            goals = {"achieved_goal": states[:, :2], "desired_goal": states[:, 2:]}
            states = {"observation": states, **goals}
        rows = episode_transitions(
            states,
            random.uniform(-1, 1, (length, 2)),
            rewards=random.normal(size=length) if rewards else None,
            terminated=(np.arange(length) == length - 1) & (number % 2 == 0),
            info={
                "qpos": random.normal(size=(length, 3)),
                "a": {"b": np.arange(length)},
            },
            where=f"episode {number}",
        )
        rows["episode"] = torch.full((length,), number)
        parts.append(rows)
    return torch.cat(parts)


def back(dataset, path, **options):
    return load_minari(dataset, path, progress=False, **options)


def write(data, root, **options):
    return to_minari(data, "push/play-v0", root=root, progress=False, **options)


@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    kind=st.sampled_from(["flat", "nested", "goals"]),
    seed=st.integers(0, 100),
)
@settings(max_examples=10, deadline=None)
def test_the_same_transitions_come_back(tmp_path_factory, lengths, kind, seed):
    root = tmp_path_factory.mktemp("minari")
    data = transitions(lengths, kind=kind, seed=seed)
    again = back(write(data, root), root / "rows", infos=["qpos", "a"])
    assert set(again.keys(True, True)) == set(data.keys(True, True))
    for key, leaf in data.items(True, True):
        assert again[key].dtype == leaf.dtype
        assert torch.equal(again[key], leaf), key


def test_bounds_of_actions_come_back(tmp_path):
    bounds = ([-1.0, -2.0], [1.0, 3.0])
    stored = write_transitions(transitions(), tmp_path / "a", action_bounds=bounds)
    back(write(stored, tmp_path / "m"), tmp_path / "b")
    low, high = action_bounds(tmp_path / "b")
    assert (low.tolist(), high.tolist()) == bounds
    wider = ([-5.0, -5.0], [5.0, 5.0])
    dataset = write(stored, tmp_path / "m", action_bounds=wider, overwrite=True)
    back(dataset, tmp_path / "c")
    assert action_bounds(tmp_path / "c")[1].tolist() == wider[1]
    back(write(transitions(), tmp_path / "n"), tmp_path / "d")
    assert action_bounds(tmp_path / "d") is None


def test_interleaved_trajectories_are_put_in_order(tmp_path):
    data = transitions((4, 4))
    mixed = data[torch.tensor([0, 4, 1, 5, 2, 6, 3, 7])]
    again = back(write(mixed, tmp_path), tmp_path / "rows", infos=["qpos", "a"])
    assert (again == data).all()


def test_data_of_other_formats_become_minari_datasets(tmp_path, caplog):
    states = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    ends = np.array([0, 0, 1, 0, 0, 0, 1], bool)
    np.savez(
        tmp_path / "a-v0.npz",
        observations=states,
        actions=states[:, :2],
        terminals=ends,
        qpos=states,
    )
    data = load_ogbench(tmp_path / "a-v0.npz", tmp_path / "a", progress=False)
    again = back(write(data, tmp_path / "m"), tmp_path / "b", infos=["qpos"])
    assert "no ('next', 'reward'), so push/play-v0 gets rewards of 0" in caplog.text
    assert not again["next", "reward"].any()
    assert (again.exclude(("next", "reward")) == data).all()
    lerobot = os.path.join(os.path.dirname(__file__), "lerobot/v3.0")
    data = load_lerobot(lerobot, tmp_path / "c", progress=False)
    extra = ["task", ("next", "success")]
    dataset = write(data, tmp_path / "m", exclude=extra, overwrite=True)
    assert (back(dataset, tmp_path / "d") == data.exclude(*extra)).all()


def with_entries(**entries):
    data = transitions()
    for key, value in entries.items():
        data[tuple(key.split("__"))] = value
    return data


def broken():
    data = transitions()
    data["next", "observation"][4] += 1
    return data


def unfinished():
    data = transitions()
    data["next", "truncated"][2] = data["next", "terminated"][2] = False
    return data


ONES = torch.ones(8, 1)


@pytest.mark.parametrize(
    ("data", "options", "error", "message"),
    [
        (broken(), {}, ValueError, "'observation' of row 4 is not that of row 5"),
        (unfinished(), {}, ValueError, "trajectory 0 does not end at its last row 2"),
        (
            with_entries(caiac__score=ONES, task=ONES),
            {},
            ValueError,
            r"no place for \[\('caiac', 'score'\), 'task'\]: .*exclude=",
        ),
        (
            with_entries(next__success=ONES),
            {},
            ValueError,
            "'next', 'success'.*exclude",
        ),
        (
            transitions().exclude(("next", "observation")),
            {},
            ValueError,
            "no 'observation' that is also under 'next'",
        ),
        (
            transitions().exclude(("next", "truncated")),
            {},
            ValueError,
            r"lack \[\('next', 'truncated'\)\], they have",
        ),
        (transitions(), {"exclude": ["cup"]}, KeyError, r"cup.*correct exclude="),
        (transitions(), {"action_bounds": ([0], [1])}, ValueError, r"shape \[1\], but"),
        (
            with_entries(action=ONES.half()),
            {},
            ValueError,
            "'action',. has torch.float16",
        ),
        (
            with_entries(next__reward=torch.ones(8, 2)),
            {},
            ValueError,
            r"one number a row",
        ),
        (TensorDict({"action": ONES}, [8]), {}, ValueError, "lacks .'episode'."),
    ],
)
def test_what_minari_cannot_hold_is_refused_and_nothing_stays(
    tmp_path, data, options, error, message
):
    with pytest.raises(error, match=message):
        write(data, tmp_path / "minari", **options)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_an_existing_dataset_is_replaced_on_request_only(tmp_path):
    write(transitions(), tmp_path)
    with pytest.raises(FileExistsError, match=r"'push/play-v0' exists at .*overwrite"):
        write(transitions(), tmp_path)
    with pytest.raises(ValueError, match=r"'observation' of row 4"):
        write(broken(), tmp_path, overwrite=True)
    assert write(transitions((2,)), tmp_path, overwrite=True).total_steps == 2


def test_scores_are_left_out_by_name(tmp_path, caplog):
    data = with_entries(caiac__score=ONES)
    with caplog.at_level(logging.WARNING):
        dataset = write(data, tmp_path, exclude=["caiac"])
    assert dataset.total_steps == 8
    assert "reward" not in caplog.text
