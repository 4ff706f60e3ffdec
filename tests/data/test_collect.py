"""Collection of toy episodes: workers, resuming, unreadable files."""

from __future__ import annotations

import textwrap
import traceback
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.killing import run_killed
from tests.mutations import mutate_file
from torchrl_caiac._files import UnreadableFileError, whole_file
from torchrl_caiac.data.collect import collect_episodes, load_episode, record_episode

TOY = """
    import os
    import numpy as np

    class Source:
        closed = 0

        def __call__(self, spec, seed):
            rng = np.random.default_rng(seed)
            if rng.random() < spec.get("fail", 0.0):
                return None
            if spec.get("crash") and os.path.exists(spec["crash"]):
                raise OSError("no more sand")
            if spec.get("die"):
                os._exit(3)
            n = spec["steps"]
            return {
                "observations": {"sand": rng.normal(size=(n + 1, 2)),
                                 "deep": {"er": np.arange(n + 1)}},
                "actions": rng.uniform(size=(n, 1)),
            }

        def close(self):
            Source.closed += 1

    def factory():
        return Source()
"""


@pytest.fixture()
def toy(tmp_path, monkeypatch):
    """A module that worker processes can import."""
    (tmp_path / "toy_source.py").write_text(textwrap.dedent(TOY))
    monkeypatch.syspath_prepend(tmp_path)
    import toy_source

    yield toy_source
    import sys

    del sys.modules["toy_source"]


def contents(report):
    return [load_episode(file) for file in report.files]


def assert_same(left, right):
    for (arrays, meta), (others, known) in zip(left, right, strict=True):
        assert meta == known
        np.testing.assert_array_equal(arrays["actions"], others["actions"])
        np.testing.assert_array_equal(
            arrays["observations"]["sand"], others["observations"]["sand"]
        )


def test_any_number_of_workers_makes_the_same_episodes(toy, tmp_path):
    specs = [{"steps": 2 + i % 3, "fail": 0.5} for i in range(8)]
    one = collect_episodes(
        toy.factory, specs, tmp_path / "one", seed=3, workers=1, progress=False
    )
    two = collect_episodes(
        toy.factory, specs, tmp_path / "two", seed=3, workers=2, progress=False
    )
    assert_same(contents(one), contents(two))
    for left, right in zip(one.files, two.files, strict=True):
        assert left.read_bytes() == right.read_bytes()
    assert one.failures == two.failures
    assert sum(one.failures) > 0
    assert 0 < one.success_rate < 1
    assert [len(a["actions"]) for a, _ in contents(one)] == [s["steps"] for s in specs]
    assert contents(one)[0][0]["observations"]["deep"]["er"].tolist() == [0, 1, 2]
    assert toy.Source.closed == 1
    other = collect_episodes(
        toy.factory, specs, tmp_path / "other", seed=4, workers=1, progress=False
    )
    assert (
        contents(one)[0][0]["actions"].shape == contents(other)[0][0]["actions"].shape
    )
    assert not np.array_equal(
        contents(one)[0][0]["actions"], contents(other)[0][0]["actions"]
    )


def test_a_second_call_resumes(toy, tmp_path):
    trap = tmp_path / "trap"
    trap.touch()
    specs = [{"steps": 3} for _ in range(5)]
    specs[3]["crash"] = str(trap)
    folder = tmp_path / "work"
    with pytest.raises(OSError, match="no more sand"):
        collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    done = sorted(folder.glob("episode_*.npz"))
    assert len(done) == 3
    before = [file.stat().st_mtime_ns for file in done]
    (folder / ".partial-left").write_bytes(b"half")
    trap.unlink()
    report = collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    assert (report.collected, report.reused) == (2, 3)
    assert [file.stat().st_mtime_ns for file in done] == before
    straight = collect_episodes(
        toy.factory, specs, tmp_path / "straight", workers=1, progress=False
    )
    assert_same(contents(report), contents(straight))
    again = collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    assert (again.collected, again.reused) == (0, 5)


def test_errors_of_workers_are_raised(toy, tmp_path):
    trap = tmp_path / "trap"
    trap.touch()
    specs = [{"steps": 1}, {"steps": 1, "crash": str(trap)}]
    with pytest.raises(OSError, match="no more sand") as caught:
        collect_episodes(toy.factory, specs, tmp_path / "a", workers=2, progress=False)
    assert "toy_source.py" in "".join(traceback.format_exception(caught.value))
    specs = [{"steps": 1, "die": True}, {"steps": 1, "die": True}]
    with pytest.raises(RuntimeError, match="a process ended in the middle of a job"):
        collect_episodes(toy.factory, specs, tmp_path / "b", workers=2, progress=False)
    specs = [{"steps": 1, "fail": 1.0}]
    with pytest.raises(RuntimeError, match="failed in all 4 attempts"):
        collect_episodes(
            toy.factory,
            specs,
            tmp_path / "c",
            workers=1,
            max_attempts=4,
            progress=False,
        )
    assert not list((tmp_path / "c").glob("*.npz"))
    assert not list((tmp_path / "c").glob(".partial-*"))


def test_foreign_folders_and_broken_files(toy, tmp_path):
    specs = [{"steps": 2}, {"steps": 2}]
    folder = tmp_path / "work"
    report = collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    for changed in (
        {"specs": specs, "seed": 1},
        {"specs": [*specs, {"steps": 1}], "seed": 0},
    ):
        with pytest.raises(ValueError, match="has another collection"):
            collect_episodes(
                toy.factory,
                changed["specs"],
                folder,
                seed=changed["seed"],
                workers=1,
                progress=False,
            )
    content = report.files[1].read_bytes()
    for broken in (content[: len(content) // 2], b"", b"not an archive at all"):
        report.files[1].write_bytes(broken)
        with pytest.raises(ValueError, match=r"episode_000001\.npz.*delete it"):
            collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
        with pytest.raises(ValueError, match="delete it"):
            load_episode(report.files[1])
    report.files[1].unlink()
    repaired = collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    assert repaired.files[1].read_bytes()[:2] == b"PK"
    (folder / "collection.json").write_text("{")
    with pytest.raises(ValueError, match=r"collection\.json"):
        collect_episodes(toy.factory, specs, folder, workers=1, progress=False)
    (folder / "collection.json").unlink()
    with pytest.raises(ValueError, match=r"no collection\.json"):
        collect_episodes(toy.factory, specs, folder, workers=1, progress=False)


def test_bad_arguments_and_bad_arrays(toy, tmp_path):
    with pytest.raises(ValueError, match="workers is 0"):
        collect_episodes(toy.factory, [], tmp_path, workers=0)
    with pytest.raises(ValueError, match="max_attempts is 0"):
        collect_episodes(toy.factory, [], tmp_path, max_attempts=0)
    for name, arrays in {
        "slash": {"a/b": np.zeros(1)},
        "meta": {"meta": np.zeros(1)},
        "objects": {"a": np.array([{}, None])},
    }.items():
        with pytest.raises(ValueError, match=r"an episode's key|Python objects"):
            collect_episodes(
                lambda arrays=arrays: lambda spec, seed: arrays,
                [{}],
                tmp_path / name,
                workers=1,
                progress=False,
            )


class Counter:
    """Counts its steps in an array that it hands out itself, as MuJoCo does."""

    def __init__(self, terminate_at=None):
        self.value = np.zeros(1)
        self.terminate_at = terminate_at

    def step(self, action):
        self.value += 1
        over = self.value[0] == self.terminate_at
        return {"n": self.value}, 0.5, over, False, {"n": int(self.value[0])}


@pytest.mark.parametrize(
    ("terminate_at", "stop", "length", "terminated"),
    [(None, None, 6, False), (4, None, 4, True), (None, 3, 3, False)],
)
def test_record_episode(terminate_at, stop, length, terminated):
    env = Counter(terminate_at)
    episode = record_episode(
        env,
        lambda observation: np.array([observation["n"][0], 7.0]),
        {"n": env.value},
        max_steps=6,
        stop=None if stop is None else lambda info: info["n"] >= stop,
        state=lambda: {"value": env.value},
    )
    assert episode["observations"]["n"][:, 0].tolist() == list(range(length + 1))
    assert episode["infos"]["value"][:, 0].tolist() == list(range(length + 1))
    assert episode["actions"].tolist() == [[n, 7.0] for n in range(length)]
    assert episode["rewards"].tolist() == [0.5] * length
    ends = [False] * (length - 1) + [True]
    assert episode["terminations"].tolist() == (
        ends if terminated else [False] * length
    )
    assert episode["truncations"].tolist() == ([False] * length if terminated else ends)


def test_record_episode_needs_steps():
    with pytest.raises(ValueError, match="max_steps is 0"):
        record_episode(Counter(), lambda o: o, {}, max_steps=0)


@settings(max_examples=200)
@given(st.randoms(use_true_random=False))
def test_a_damaged_episode_is_read_or_refused_by_name(tmp_path_factory, rng):
    folder = tmp_path_factory.mktemp("damaged")
    report = collect_episodes(
        lambda: lambda spec, seed: {"a": {"b": np.zeros(spec["n"])}},
        [{"n": 3}],
        folder,
        workers=1,
        progress=False,
    )
    (file,) = report.files
    mutate_file(file, rng)
    try:
        load_episode(file)
    except (UnreadableFileError, FileNotFoundError) as error:
        assert str(file) in str(error)


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"a": np.zeros(1)}, "'meta' is missing"),
        ({"meta": np.zeros(1)}, "not a text"),
        ({"meta": np.array("[]")}, r"'meta' is \[\]"),
        ({"meta": np.array('{"spec": 1, "seed": 1, "attempts": 1}')}, "'spec' is 1"),
        ({"meta": np.array('{"spec": {}, "seed": 1.5, "attempts": 1}')}, "'seed' is"),
        ({"meta": np.array('{"spec": {}, "seed": 1, "attempts": 0}')}, "'attempts' is"),
    ],
)
def test_what_is_not_an_episode(arrays, match, tmp_path):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(UnreadableFileError, match=match):
        load_episode(tmp_path / "a.npz")


def test_an_entry_below_an_array_is_refused(tmp_path):
    meta = np.array('{"spec": {}, "seed": 1, "attempts": 1}')
    for names in (["a", "a/b"], ["a/b", "a"]):
        np.savez(tmp_path / "a.npz", meta=meta, **dict.fromkeys(names, np.zeros(1)))
        with pytest.raises(UnreadableFileError, match=r"a\.npz .*'a'"):
            load_episode(tmp_path / "a.npz")


def test_a_finished_collection_in_a_read_only_folder(toy, tmp_path, read_only):
    call = partial(
        collect_episodes, toy.factory, [{"steps": 3}], workers=1, progress=False
    )
    call(tmp_path / "work")
    run_killed(half_a_file, tmp_path / "work" / "episode_000000.npz")
    read_only(tmp_path / "work")
    report = call(tmp_path / "work")
    assert (report.collected, report.reused) == (0, 1)


def test_what_a_killed_collection_left_is_removed(toy, tmp_path):
    run_killed(half_a_file, tmp_path / "work" / "episode_000007.npz")
    collect_episodes(
        toy.factory, [{"steps": 3}], tmp_path / "work", workers=1, progress=False
    )
    assert not list((tmp_path / "work").glob(".partial-*"))


def half_a_file(path):
    with whole_file(path) as partial_file:
        partial_file.write_text("half")
        yield
