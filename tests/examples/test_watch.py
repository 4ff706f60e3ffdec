from __future__ import annotations

import functools
import importlib
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_caiac.envs import KitchenEnv


@pytest.fixture(scope="module")
def watch(steps):
    return importlib.import_module("watch")


@pytest.fixture(scope="module")
def recording(steps):
    return importlib.import_module("environments.playing").Recording


class Waving:
    """Acts on the observation, so that equal starts give equal episodes."""

    def __call__(self, tensordict):
        width = {30: 9, 34: 4}[tensordict["observation"].shape[-1]]
        tensordict["action"] = tensordict["observation"][:, :width].sin()
        return tensordict


def numbered(states):
    """Draws each state as its own shade."""
    frames = np.zeros((len(states), 240, 320, 3), dtype=np.uint8)
    return frames + states[:, :1, None, None].astype(np.uint8)


def test_both_sides_run_at_the_same_time(watch, recording, tmp_path):
    long = recording("kettle", np.arange(201.0)[:, None], numbered, False, 0.08)
    short = recording("kettle", np.arange(11.0)[:, None], numbered, True, 0.08)
    images = watch.film([long, short], ["one", "two"])
    assert len(images) * 0.08 <= 8
    assert {image.size for image in images} == {(640, 280)}
    shades = [np.asarray(image)[-1, [0, -1], 0].tolist() for image in images]
    assert shades[0] == [0, 0]
    assert shades[-1] == [200, 10]
    assert all(right == min(left, 10) for left, right in shades)
    # The labels change when an episode is over.
    strips = [np.asarray(image)[:40, 320:] for image in images]
    assert (strips[-1] == strips[-2]).all()
    assert (strips[0] != strips[-1]).any()
    path = tmp_path / "watch.gif"
    watch.write_gif(path, images)
    with Image.open(path) as gif:
        assert gif.size == (640, 280)
        gif.seek(gif.n_frames - 1)
        assert abs(int(np.asarray(gif.convert("RGB"))[-1, 0, 0]) - 200) < 8
    assert path.stat().st_size < 3_000_000


def test_a_gif_that_is_too_large_has_fewer_colours(watch, monkeypatch, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), np.uint8)
    images = [Image.fromarray(frame) for frame in noise]
    watch.write_gif(tmp_path / "whole.gif", images)
    size = (tmp_path / "whole.gif").stat().st_size
    monkeypatch.setattr(watch, "_MAX_BYTES", size - 1)
    watch.write_gif(tmp_path / "small.gif", images)
    assert (tmp_path / "small.gif").stat().st_size < size
    monkeypatch.setattr(watch, "_MAX_BYTES", 100)
    with pytest.raises(ValueError, match="more than 100"):
        watch.write_gif(tmp_path / "none.gif", images)


def test_a_missing_ffmpeg_is_told(watch, monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    path = tmp_path / "watch.mp4"
    assert "no ffmpeg" in watch.write_mp4(path, [Image.new("RGB", (4, 4))])
    assert not path.exists()


@pytest.mark.parametrize("name", ["kitchen_all_tasks", "fetch_push"])
def test_recordings_are_a_test_episode(name, steps, compose, tmp_path, monkeypatch):
    short = functools.partial(KitchenEnv, max_episode_steps=30)
    monkeypatch.setattr("environments.kitchen.KitchenEnv", short)
    cfg = compose(f"env={name}")
    cfg.env.evaluate.episodes = 2
    environment = steps.parts.make_environment(cfg)
    episodes = environment.play(Waving(), 3, tmp_path)
    torch.manual_seed(5)
    recording = environment.record(Waving(), 3)
    assert recording.success == episodes[0][environment.success_key]
    if name == "fetch_push":
        assert len(recording.states) == cfg.env.collect.steps + 1
    else:
        assert len(recording.states) == episodes[0]["steps"] + 1
    second = environment.record(Waving(), 3, episode=1)
    assert second.success == episodes[1][environment.success_key]
    assert (second.states[0] != recording.states[0]).any()
    with pytest.raises(ValueError, match="episode is 2, expected 0 to 1"):
        environment.record(Waving(), 3, episode=2)
    frames = recording.render(recording.states[[0, -1]])
    assert frames.shape == (2, 240, 320, 3)
    assert (frames[0] != frames[1]).any()
    with pytest.raises(ValueError, match="task is 'toaster'"):
        environment.record(Waving(), 3, "toaster")


def test_the_sides_differ_in_the_method_alone(watch, tmp_path):
    arguments = ["study=demo", f"root={tmp_path}"]
    options, task, episode = watch.read_watch_arguments(arguments)
    assert (task, episode) == ("microwave", 0)
    left, right = watch.pair(options)
    assert (left.method, right.method) == ("none", "caiac")
    assert left._replace(method="", digest="", cfg=None) == right._replace(
        method="", digest="", cfg=None
    )
    with pytest.raises(FileNotFoundError, match=r"none, seed 0 are not in .*study\.py"):
        watch.record(left, task)
    options, task, episode = watch.read_watch_arguments(
        ["study=demo", "methods=[caiac,none]", "seeds=1", "task=kettle", "episode=3"]
    )
    assert [(r.method, r.seed) for r in watch.pair(options)] == [
        ("caiac", 1),
        ("none", 1),
    ]
    assert (task, episode) == ("kettle", 3)
    options, *_ = watch.read_watch_arguments(["study=demo", "methods=[none,coda]"])
    with pytest.raises(ValueError, match="no two such runs"):
        watch.pair(options)
    for arguments, message in (
        (["methods=[none,caiac]"], "study=NAME is missing"),
        (["study=demo", "methods=[none]"], "expected two"),
        (["study=demo", "episode=-1"], "episode is '-1', expected a number from 0"),
        (["study=demo", "episode="], "episode is '', expected a number"),
    ):
        with pytest.raises(ValueError, match=message):
            watch.read_watch_arguments(arguments)
