"""Fixtures that all tests share."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import tempfile
import types
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from hypothesis import settings
from tensordict import TensorDict, TensorDictBase

from tests.pretend_cuda import pretend_cuda
from torchrl_caiac import _kernels

FLAT_LENGTHS = (7, 12, 9, 5)
STATE_WIDTH, ACTION_WIDTH, GOAL_WIDTH = 9, 2, 4


def pytest_configure(config: pytest.Config) -> None:
    """Tests share the machine with each other: one thread each, and no deadline."""
    torch.set_num_threads(1)
    # Not the user's choices of kernels; the processes that tests start share them.
    os.environ.setdefault("MPLCONFIGDIR", os.path.expanduser("~/.cache/matplotlib"))
    folder = tempfile.TemporaryDirectory()
    config.add_cleanup(folder.cleanup)
    os.environ["XDG_CACHE_HOME"] = folder.name
    settings.register_profile("shared", deadline=None)
    settings.load_profile("shared")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts tests with Ray last, since others fork, which its threads do not stand."""
    items.sort(key=lambda item: "cluster" in getattr(item, "fixturenames", ()))


@pytest.fixture(scope="session")
def cluster() -> Iterator[None]:
    """Ray on this machine, with two workers that import this working tree."""
    import ray

    os.environ["RAY_ENABLE_UINT_METRICS"] = "0"
    variables = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    ray.init(
        num_cpus=2,
        include_dashboard=False,
        object_store_memory=200 << 20,
        log_to_driver=False,
        configure_logging=False,
        runtime_env={"env_vars": variables},
    )
    yield
    ray.shutdown()


@pytest.fixture(autouse=True)
def cuda(request: pytest.FixtureRequest) -> Iterator[None]:
    """A stand-in for the device of tests marked ``gpu`` where there is none."""
    is_needed = request.node.get_closest_marker("gpu") is not None
    with (
        pretend_cuda() if is_needed and not torch.cuda.is_available() else nullcontext()
    ):
        yield


@pytest.fixture
def small_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on a disk of 4 MB, a stand-in where none can be mounted."""
    folder, size = tmp_path / "small_disk", 4 << 20
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if (
        shutil.which("mount")
        and not subprocess.run(mount, capture_output=True).returncode
    ):
        yield folder
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        return

    def allocate(descriptor: int, offset: int, nbytes: int) -> None:
        if offset + nbytes > size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", allocate)
    free = types.SimpleNamespace(f_bavail=size, f_frsize=1)
    monkeypatch.setattr(os, "fstatvfs", lambda descriptor: free)
    yield folder


@pytest.fixture
def read_only() -> Iterator[Callable[[Path], None]]:
    """A function that makes a folder read-only until the test ends, also for root."""
    mounted: list[Path] = []

    def protect(folder: Path) -> None:
        if os.geteuid():
            for path in (folder, *folder.rglob("*")):
                path.chmod(path.stat().st_mode & ~0o222)
        else:
            subprocess.run(["mount", "--bind", folder, folder], check=True)
            mounted.append(folder)
            remount = ["mount", "-o", "remount,ro,bind", folder]
            subprocess.run(remount, check=True)

    yield protect
    for folder in mounted:
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def new_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], None]:
    """A function after which this process has measured nothing, and finds one faster.

    Its argument is the kernel that is then the fastest for all products.
    """

    def start(fastest: str) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache" / fastest))
        monkeypatch.setattr(_kernels, "_base", _kernels._State())
        monkeypatch.setattr(_kernels, "_files", {})
        monkeypatch.setattr(_kernels, "_fastest", lambda default, candidates: fastest)

    return start


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded source of random numbers."""
    return torch.Generator().manual_seed(0)


def _walks(width: int, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """States and next states ``[T, width]``, lengths as in ``FLAT_LENGTHS``."""
    walks = [
        torch.randn(n + 1, width, generator=generator).cumsum(0) for n in FLAT_LENGTHS
    ]
    return torch.cat([w[:-1] for w in walks]), torch.cat([w[1:] for w in walks])


def _ends() -> torch.Tensor:
    """True in the last row of every trajectory, ``[T, 1]``."""
    ends = torch.zeros(sum(FLAT_LENGTHS), 1, dtype=torch.bool)
    ends[torch.tensor(FLAT_LENGTHS).cumsum(0) - 1] = True
    return ends


def _common(generator: torch.Generator) -> dict[str, object]:
    rows = sum(FLAT_LENGTHS)
    return {
        "action": torch.rand(rows, ACTION_WIDTH, generator=generator) * 2 - 1,
        "episode": torch.repeat_interleave(
            torch.arange(len(FLAT_LENGTHS)), torch.tensor(FLAT_LENGTHS)
        ),
    }


def _flags(generator: torch.Generator) -> dict[str, torch.Tensor]:
    ends = _ends()
    return {
        "reward": torch.rand(len(ends), 1, generator=generator),
        "done": ends,
        "truncated": ends.clone(),
        "terminated": torch.zeros_like(ends),
    }


def _stored(data: TensorDict, kind: str, path: Path) -> TensorDictBase:
    return data.memmap(path / "data") if kind == "memmap" else data


@pytest.fixture(params=["memory", "memmap"])
def storage_kind(request: pytest.FixtureRequest) -> str:
    """Where the data of ``flat_data`` and ``nested_data`` lie."""
    return request.param


@pytest.fixture
def flat_data(
    storage_kind: str, generator: torch.Generator, tmp_path: Path
) -> TensorDictBase:
    """Four short trajectories of random walks, rows ``[33]``, flat observations.

    Next observations are those of the following row, also in the goals, which mirror
    the observation columns 3, 4 and 6, 7.
    """
    now, after = _walks(STATE_WIDTH, generator)
    mirrored = [3, 4, 6, 7]
    data = TensorDict(
        {
            "observation": now,
            "achieved_goal": now[:, mirrored],
            "desired_goal": torch.randn(len(now), GOAL_WIDTH, generator=generator),
            **_common(generator),
            "next": {
                "observation": after,
                "achieved_goal": after[:, mirrored],
                **_flags(generator),
            },
        },
        [len(now)],
    )
    return _stored(data, storage_kind, tmp_path)


@pytest.fixture
def nested_data(
    storage_kind: str, generator: torch.Generator, tmp_path: Path
) -> TensorDictBase:
    """The same kind of trajectories with one leaf or sub-tensordict per entity."""
    now, after = _walks(STATE_WIDTH, generator)

    def tree(state: torch.Tensor) -> dict[str, object]:
        return {
            "arm": state[:, :3].clone(),
            "kettle": {
                "position": state[:, 3:6].clone(),
                "tilt": state[:, 6:9].clone(),
            },
        }

    data = TensorDict(
        {
            "observation": tree(now),
            **_common(generator),
            "next": {"observation": tree(after), **_flags(generator)},
        },
        [len(now)],
    ).auto_batch_size_(1)
    return _stored(data, storage_kind, tmp_path)
