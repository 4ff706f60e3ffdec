"""Files and folders are whole or not there, and killed processes leave nothing."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from tests.killing import run_killed, running
from torchrl_caiac._files import (
    remove_leftovers,
    remove_leftovers_in,
    whole_file,
    whole_folder,
)


class TestWholeFile:
    def test_takes_its_place_at_the_end(self, tmp_path):
        path = tmp_path / "new" / "folder" / "figure.png"
        with whole_file(path) as partial:
            assert partial.suffix == ".png"
            partial.write_text("first")
            assert not path.exists()
        assert path.read_text() == "first"
        with whole_file(str(path)) as partial:
            partial.write_text("second")
            assert path.read_text() == "first"
        assert path.read_text() == "second"
        assert list(path.parent.iterdir()) == [path]

    def test_errors_leave_the_old_file(self, tmp_path):
        path = tmp_path / "table.txt"
        path.write_text("old")
        with pytest.raises(KeyboardInterrupt), whole_file(path) as partial:
            partial.write_text("ne")
            raise KeyboardInterrupt
        with pytest.raises(FileNotFoundError), whole_file(path):
            pass  # nothing is written
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("next_write", [True, False])
    def test_what_a_killed_process_left_is_removed(self, next_write, tmp_path):
        path = tmp_path / "table.txt"
        for name in ("table.txt", "other.txt", "a-table.txt"):
            run_killed(half_a_file, tmp_path / name)
        assert len(list(tmp_path.iterdir())) == 3
        if next_write:
            with whole_file(path) as partial:
                partial.touch()
        else:
            remove_leftovers(path)
        left = sorted(p.name.split("-", 3)[-1] for p in tmp_path.iterdir())
        written = ["table.txt"] if next_write else []
        assert left == sorted(["other.txt", "a-table.txt", *written])
        remove_leftovers_in(tmp_path)
        assert [p.name for p in tmp_path.iterdir()] == written

    def test_what_another_process_writes_stays(self, tmp_path):
        with running(half_a_file, tmp_path / "table.txt"):
            (theirs,) = tmp_path.iterdir()
            with whole_file(tmp_path / "table.txt") as partial:
                partial.write_text("ours")
            assert theirs.read_text() == "half"
        remove_leftovers_in(tmp_path)
        assert [p.name for p in tmp_path.iterdir()] == ["table.txt"]

    def test_what_another_machine_writes_stays(self, tmp_path, monkeypatch):
        run_killed(half_a_file, tmp_path / "table.txt")
        monkeypatch.setattr("platform.node", lambda: "elsewhere")
        remove_leftovers_in(tmp_path)
        assert len(list(tmp_path.iterdir())) == 1

    def test_two_writers_in_one_process_do_not_meet(self, tmp_path):
        path = tmp_path / "table.txt"
        with whole_file(path) as one, whole_file(path) as other:
            one.write_text("one")
            other.write_text("other")
        assert path.read_text() == "one"
        assert list(tmp_path.iterdir()) == [path]

    def test_all_spellings_of_a_path_are_the_same(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "link").symlink_to(tmp_path)
        spellings = [Path("table.txt"), tmp_path / "table.txt", Path("link/table.txt")]
        for one in spellings:
            for other in spellings:
                with whole_file(one) as partial:
                    partial.write_text("one")
                    with whole_file(other) as second:
                        second.write_text("other")
                    remove_leftovers(other)
                    remove_leftovers_in(other.parent)
                    assert partial.read_text() == "one"
                assert (tmp_path / "table.txt").read_text() == "one"

    def test_the_working_directory_may_change(self, tmp_path, monkeypatch):
        (tmp_path / "other").mkdir()
        monkeypatch.chdir(tmp_path)
        with whole_file("table.txt") as partial, whole_folder("data") as folder:
            partial.touch()
            folder.mkdir()
            monkeypatch.chdir(tmp_path / "other")
        assert {p.name for p in tmp_path.iterdir()} == {"table.txt", "data", "other"}
        assert not list((tmp_path / "other").iterdir())

    def test_threads_do_not_meet(self, tmp_path):
        start, seen = threading.Barrier(8), []

        def write():
            start.wait()
            for _ in range(50):
                with whole_file(tmp_path / "table.txt") as partial:
                    partial.touch(exist_ok=False)  # raises if another thread has it
            seen.append(True)

        threads = [threading.Thread(target=write) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(seen) == 8
        assert [p.name for p in tmp_path.iterdir()] == ["table.txt"]

    def test_a_read_only_folder_is_left_as_it_is(self, tmp_path, read_only):
        run_killed(half_a_file, tmp_path / "x" / "table.txt")
        read_only(tmp_path / "x")
        remove_leftovers(tmp_path / "x" / "table.txt")
        remove_leftovers(tmp_path / "missing" / "table.txt")
        assert len(list((tmp_path / "x").iterdir())) == 1


class TestWholeFolder:
    def test_what_raises_leaves_the_old_folder(self, tmp_path):
        path = tmp_path / "a" / "data"
        for text in ("old", "new"):
            with whole_folder(path) as partial:
                partial.mkdir()
                (partial / "x").write_text(text)
        with pytest.raises(RuntimeError), whole_folder(path) as partial:
            partial.mkdir()
            (partial / "x").write_text("half")
            raise RuntimeError
        with pytest.raises(FileNotFoundError), whole_folder(path):
            pass  # nothing was made: what is there stays
        assert (path / "x").read_text() == "new"
        assert list(path.parent.iterdir()) == [path]

    def test_what_a_killed_process_left_is_removed(self, tmp_path):
        run_killed(half_a_folder, tmp_path / "data")
        assert len(list(tmp_path.iterdir())) == 1
        with whole_folder(tmp_path / "data") as partial:
            partial.mkdir()
        assert [p.name for p in tmp_path.iterdir()] == ["data"]

    def test_a_kill_between_the_two_moves_loses_nothing(self, tmp_path, monkeypatch):
        path = tmp_path / "data"
        path.mkdir()
        (path / "x").write_text("old")
        replace = os.replace

        def once(source, target):
            replace(source, target)
            os.kill(os.getpid(), 9)

        monkeypatch.setattr(os, "replace", once)
        run_killed(half_a_folder, path, leave=True)
        monkeypatch.undo()
        assert not path.exists()
        remove_leftovers(path)
        assert (path / "x").read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]


def half_a_file(path: Path) -> None:
    with whole_file(path) as partial:
        partial.write_text("half")
        yield


def half_a_folder(path: Path, leave: bool = False) -> None:
    with whole_folder(path) as partial:
        partial.mkdir()
        (partial / "x").write_text("half")
        if not leave:
            yield
    yield


def test_an_interrupt_between_the_moves_keeps_the_old_folder(tmp_path, monkeypatch):
    path = tmp_path / "data"
    path.mkdir()
    (path / "old").touch()
    replace, moves = os.replace, []

    def interrupted(source, target):
        moves.append(target)
        if len(moves) == 2:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt), whole_folder(path) as partial:
        partial.mkdir()
    assert [x.name for x in path.iterdir()] == ["old"]
    assert [x.name for x in tmp_path.iterdir()] == ["data"]
