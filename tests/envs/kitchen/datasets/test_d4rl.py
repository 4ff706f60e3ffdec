from __future__ import annotations

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.envs.kitchen import kitchen_transitions, load_d4rl_kitchen


def make_arrays(length=7, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "observations": rng.normal(size=(length, 60)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (length, 9)).astype(np.float32),
        "rewards": rng.integers(0, 5, length).astype(np.float32),
        "terminals": np.zeros(length, bool),
        "timeouts": np.zeros(length, bool),
    }


def write_file(path, arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
        # The original files contain more, which is not read.
        file["infos/goal"] = np.full(3, np.nan)
    return path


@settings(max_examples=60, deadline=None)
@given(ends=st.lists(st.sampled_from("-xtb"), min_size=1, max_size=12))
def test_files_of_d4rl(ends, tmp_path_factory):
    arrays = make_arrays(len(ends))
    arrays["terminals"][:] = [end in "xb" for end in ends]
    arrays["timeouts"][:] = [end in "tb" for end in ends]
    path = write_file(tmp_path_factory.mktemp("d4rl") / "kitchen.hdf5", arrays)
    # Row by row: episodes of at least two rows, without their last one.
    expected, first = [], 0
    for row, end in enumerate(ends):
        if end != "-" or row + 1 == len(ends):
            if row > first:
                expected.append(list(range(first, row)))
            first = row + 1
    if not expected:
        with pytest.raises(ValueError, match="no rows that are followed"):
            load_d4rl_kitchen(path)
        return
    rows = load_d4rl_kitchen(path)
    taken = [row for episode in expected for row in episode]
    state = arrays["observations"][:, :30]
    np.testing.assert_array_equal(rows["observation"], state[taken])
    after = [row + 1 for row in taken]
    np.testing.assert_array_equal(rows["next", "observation"], state[after])
    np.testing.assert_array_equal(rows["action"], arrays["actions"][taken])
    np.testing.assert_array_equal(
        rows["next", "reward"][:, 0], arrays["rewards"][taken]
    )
    assert rows["episode"].tolist() == [
        number for number, episode in enumerate(expected) for _ in episode
    ]
    done = [row == episode[-1] for episode in expected for row in episode]
    assert rows["next", "done"].flatten().tolist() == done
    assert rows["next", "truncated"].flatten().tolist() == done
    assert not rows["next", "terminated"].any()
    assert (rows["task"] == -1).all()


def test_files_of_d4rl_have_the_structure_of_minaris(foreign, tmp_path):
    arrays = make_arrays()
    arrays["timeouts"][3] = True
    path = write_file(tmp_path / "kitchen.hdf5", arrays)
    rows = load_d4rl_kitchen(path)
    theirs = kitchen_transitions(
        "D4RL/kitchen/mixed-v2", root=foreign[0], progress=False
    )
    assert {
        key: (leaf.dtype, leaf.shape[1:]) for key, leaf in rows.items(True, True)
    } == {key: (leaf.dtype, leaf.shape[1:]) for key, leaf in theirs.items(True, True)}
    stored = load_d4rl_kitchen(path, tmp_path / "rows")
    assert stored.is_memmap()
    assert (stored == rows).all()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        load_d4rl_kitchen(path, tmp_path / "rows")
    load_d4rl_kitchen(path, tmp_path / "rows", overwrite=True)


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        (
            "observations",
            np.zeros((7, 59)),
            ValueError,
            r"\(7, 59\), expected",
        ),
        ("actions", np.zeros((7, 8)), ValueError, r"'actions'.*\(7, 8\)"),
        ("rewards", np.zeros(6), ValueError, r"'rewards'.*\(6,\), expected \(7,\)"),
        ("timeouts", np.zeros((7, 1)), ValueError, r"'timeouts'.*\(7, 1\)"),
        ("actions", np.full((7, 9), np.nan), ValueError, "first in row 0"),
        ("timeouts", None, KeyError, r"lacks \['timeouts'\]"),
    ],
)
def test_wrong_files_of_d4rl(name, value, error, message, tmp_path):
    arrays = make_arrays()
    if value is None:
        del arrays[name]
    else:
        arrays[name] = value
    path = write_file(tmp_path / "kitchen.hdf5", arrays)
    with pytest.raises(error, match=message):
        load_d4rl_kitchen(path, tmp_path / "rows")
    assert not (tmp_path / "rows").exists()


def test_files_that_are_none_of_d4rl(tmp_path):
    path = tmp_path / "kitchen.hdf5"
    with pytest.raises(FileNotFoundError, match="no file at"):
        load_d4rl_kitchen(path)
    whole = write_file(path, make_arrays(200)).read_bytes()
    for content in (b"", b"no HDF5", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="not an HDF5 file or is truncated"):
            load_d4rl_kitchen(path)
