from __future__ import annotations

import itertools
import logging
import os
import re
import resource
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.killing import run_killed
from torchrl_caiac import EntityLayout
from torchrl_caiac import data as loaders
from torchrl_caiac.data import (
    action_bounds,
    array_parts,
    from_arrays,
    from_stream,
    load_transitions,
    offline_buffer,
)

WIDTH, ACTIONS = 3, 2


def random_episodes(seed, lengths):
    rng = np.random.default_rng(seed)
    return [
        {
            "observations": rng.normal(size=(length + 1, WIDTH)),
            "actions": rng.normal(size=(length, ACTIONS)),
            "rewards": rng.normal(size=length),
            "terminals": (np.arange(length) == length - 1) & (rng.random() < 0.5),
            "info": rng.integers(0, 9, length),
        }
        for length in lengths
    ]


def oracle(episodes, lose_last=False):
    """The transitions as a list of rows, by a loop."""
    rows = []
    for number, episode in enumerate(episodes):
        steps = len(episode["actions"]) - lose_last
        for t in range(steps):
            terminated = bool(episode["terminals"][t])
            last = t == steps - 1
            rows.append(
                {
                    "observation": episode["observations"][t],
                    "action": episode["actions"][t],
                    "episode": number,
                    ("info", "count"): episode["info"][t],
                    ("next", "observation"): episode["observations"][t + 1],
                    ("next", "reward"): episode["rewards"][t : t + 1],
                    ("next", "terminated"): [terminated],
                    ("next", "truncated"): [last and not terminated],
                    ("next", "done"): [last],
                }
            )
    return rows


def assert_rows(data, expected):
    assert len(data) == len(expected)
    keys = set(data.keys(True, True))
    assert keys == set(expected[0])
    for key in keys:
        values = np.array([row[key] for row in expected])
        if values.dtype.kind == "f":
            values = values.astype(np.float32)
        assert np.array_equal(data[key].numpy(), values), key


def flat(episodes, name):
    return np.concatenate([episode[name] for episode in episodes])


def states(episodes, rows):
    return np.concatenate([episode["observations"][rows] for episode in episodes])


def ends_of(episodes, how):
    """What says where the episodes end, in one of the forms."""
    lengths = [len(episode["actions"]) for episode in episodes]
    terminals = flat(episodes, "terminals")
    done = np.zeros(sum(lengths), bool)
    done[np.cumsum(lengths) - 1] = True
    return {
        "lengths": {"episode_lengths": lengths, "terminals": terminals},
        "ids": {
            "episode_ids": np.repeat(np.arange(len(lengths)) * 7 - 3, lengths),
            "terminals": terminals,
        },
        "flags": {"terminals": terminals, "timeouts": done & ~terminals},
        "dones": {"dones": done, "terminals": terminals.astype(float)[:, None]},
        "all": {
            "dones": torch.from_numpy(done),
            "timeouts": done & ~terminals,
            "terminals": terminals,
            "episode_lengths": torch.tensor(lengths),
        },
    }[how]


def as_kind(value, kind):
    """The same arrays in NumPy, in torch, or also with tensordicts as mappings."""
    if kind == "numpy":
        return value
    if isinstance(value, list):
        return [as_kind(item, kind) for item in value]
    if isinstance(value, dict):
        tree = {key: as_kind(item, kind) for key, item in value.items()}
        return TensorDict(tree) if kind == "tensordict" else tree
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def write(form, how, episodes, path, cuts=(), kind="numpy"):
    """Writes episodes in one of the forms of arrays."""

    def from_arrays(*given, path, **named):
        return loaders.from_arrays(
            *(as_kind(value, kind) for value in given),
            path=path,
            **{name: as_kind(value, kind) for name, value in named.items()},
        )

    def from_stream(stream, path, **named):
        items = ({k: as_kind(v, kind) for k, v in item.items()} for item in stream)
        return loaders.from_stream(items, path, **named)

    names = ("actions", "rewards")
    rest = {"progress": False, "action_bounds": ([-9, -9], [9, 9])}
    if form.startswith("list"):
        lists = {name: [e[name] for e in episodes] for name in (*names, "terminals")}
        rows = slice(-1) if form == "list, next" else slice(None)
        observed = [episode["observations"][rows] for episode in episodes]
        if form == "list, next":
            lists["next_observations"] = [e["observations"][1:] for e in episodes]
        info = [{"count": episode["info"]} for episode in episodes]
        return from_arrays(observed, path=path, info=info, **lists, **rest)
    if form == "stream":
        return from_stream(
            ({**e, "info": {"count": e["info"]}} for e in episodes), path, **rest
        )
    arrays = {name: flat(episodes, name) for name in names}
    arrays["info"] = {"count": flat(episodes, "info")}
    arrays |= ends_of(episodes, how)
    if form == "flat, one more":
        return from_arrays(states(episodes, slice(None)), path=path, **arrays, **rest)
    arrays["observations"] = states(episodes, slice(-1))
    if form == "flat, alone":
        return from_arrays(path=path, **arrays, **rest)
    arrays["next_observations"] = states(episodes, slice(1, None))
    if form == "flat, next":
        return from_arrays(path=path, **arrays, **rest)
    bounds = sorted({0, len(arrays["actions"]), *cuts})

    def parts():
        for start, stop in itertools.pairwise(bounds):
            yield {
                name: {"count": value["count"][start:stop]}
                if name == "info"
                else value[start:stop]
                for name, value in arrays.items()
            }

    return from_stream(parts(), path, of="parts", **rest)


FORMS = [
    "list, one more",
    "list, next",
    "flat, one more",
    "flat, next",
    "flat, alone",
    "stream",
    "parts",
]


@settings(max_examples=60, deadline=None)
@given(
    form=st.sampled_from(FORMS),
    how=st.sampled_from(["lengths", "ids", "flags", "dones", "all"]),
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    seed=st.integers(0, 99),
    chunk=st.sampled_from([1, 150, 1 << 20]),
    cuts=st.lists(st.integers(0, 12)),
    kind=st.sampled_from(["numpy", "torch", "tensordict"]),
)
def test_every_form_gives_the_rows_of_a_loop(
    form, how, lengths, seed, chunk, cuts, kind, tmp_path_factory
):
    if form == "flat, alone":
        lengths = [length + 1 for length in lengths]
    if form == "parts" and how not in ("flags", "dones"):
        how = "flags"
    cuts = [cut for cut in cuts if cut < sum(lengths)]
    episodes = random_episodes(seed, lengths)
    path = tmp_path_factory.mktemp("arrays") / "rows"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(array_parts, "_CHUNK", chunk)
        data = write(form, how, episodes, path, cuts, kind)
    assert_rows(data, oracle(episodes, lose_last=form == "flat, alone"))
    assert_rows(load_transitions(path, verify=True), oracle(episodes, form == FORMS[4]))
    assert torch.equal(action_bounds(path)[1], torch.tensor([9.0, 9.0]))
    again = write(form, how, episodes, path, cuts, kind)
    assert (again == data).all()
    assert {item.name for item in path.parent.iterdir()} == {"rows"}


@pytest.mark.parametrize("of", ["parts", "episodes"])
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy, np.ma.asarray])
def test_a_stream_may_reuse_its_arrays(of, kind, tmp_path):
    steps = np.arange(20)[:, None]
    arrays = {
        "observations": {"state": steps + 0.5},
        "actions": steps + 0.25,
        "next_observations": {"state": steps + 1.5},
    }
    if of == "parts":
        arrays["timeouts"] = (steps % 7 == 6) | (steps == 19)

    def stream(reuse):
        empty = {name: np.zeros((5, 1)) for name in ("now", "action", "next", "end")}
        for start in range(0, 20, 5):
            here = empty if reuse else {k: v.copy() for k, v in empty.items()}
            own = slice(start, start + 5)
            here["now"][:] = arrays["observations"]["state"][own]
            here["action"][:] = arrays["actions"][own]
            here["next"][:] = arrays["next_observations"]["state"][own]
            item = {
                "observations": {"state": kind(here["now"])},
                "actions": kind(here["action"]),
                "next_observations": {"state": kind(here["next"])},
            }
            if of == "parts":
                here["end"][:] = arrays["timeouts"][own]
                item["timeouts"] = here["end"]
            yield item

    data = from_stream(stream(True), tmp_path / "a", of=of, progress=False)
    assert np.array_equal(data["action"].numpy(), arrays["actions"])
    assert np.array_equal(
        data["next", "observation", "state"].numpy(),
        arrays["next_observations"]["state"],
    )
    fresh = from_stream(stream(False), tmp_path / "b", of=of, progress=False)
    assert (data == fresh).all()


def test_masked_values_in_the_rest_of_a_part_are_refused(tmp_path):
    def stream(masked):
        for start in (0, 3):
            rows = np.arange(start, start + 3.0)[:, None]
            yield {
                "observations": np.ma.masked_equal(rows, masked),
                "actions": rows,
                "next_observations": rows + 1,
                "timeouts": rows == 5,
            }

    assert len(from_stream(stream(9), tmp_path / "a", of="parts", progress=False)) == 6
    for masked in (2, 4):
        with pytest.raises(ValueError, match=r"'observation' in .* has masked values"):
            from_stream(stream(masked), tmp_path / "b", of="parts", progress=False)


class TestKindsOfArrays:
    def test_tensors_maps_and_hdf5(self, tmp_path):
        rng = np.random.default_rng(0)
        arrays = {
            "observations": rng.normal(size=(20, 3)).astype(np.float32),
            "actions": rng.normal(size=(20, 2)).astype(np.float32),
        }
        saved = tmp_path / "states.npy"
        np.save(saved, arrays["observations"].astype(">f8"))
        file = h5py.File(tmp_path / "a.hdf5", "w")
        file["actions"] = arrays["actions"]
        kinds = [
            arrays,
            {name: torch.from_numpy(value) for name, value in arrays.items()},
            {
                "observations": np.load(saved, mmap_mode="r"),
                "actions": file["actions"],
            },
            {
                "observations": torch.from_numpy(arrays["observations"]).bfloat16(),
                "actions": arrays["actions"],
            },
        ]
        written = [
            from_arrays(
                **kind, path=tmp_path / str(n), episode_lengths=[12, 8], progress=False
            )
            for n, kind in enumerate(kinds)
        ]
        file.close()
        for data in written[:3]:
            assert (data == written[0]).all()
            assert data["observation"].dtype == torch.float32
            expected = np.delete(arrays["observations"], [11, 19], 0)
            assert np.array_equal(data["observation"].numpy(), expected)
        assert torch.allclose(
            written[3]["observation"], written[0]["observation"], rtol=1e-2
        )

    def test_mappings_and_lists_in_mappings(self, tmp_path):
        rng = np.random.default_rng(0)
        parts = {
            "arm": [rng.normal(size=(n + 1, 2)) for n in (3, 4)],
            "cups": {"red": [rng.normal(size=(n + 1, 1)) for n in (3, 4)]},
        }
        actions = [rng.normal(size=(n, 2)) for n in (3, 4)]
        data = from_arrays(parts, actions, tmp_path / "a", progress=False)
        layout = EntityLayout.from_keys(
            {"arm": ("observation", "arm"), "cup": ("observation", "cups", "red")}
        )
        assert layout.read(data, next=True).shape == (7, 3)
        each = [
            {"arm": parts["arm"][n], "cups": {"red": parts["cups"]["red"][n]}}
            for n in range(2)
        ]
        other = from_arrays(each, actions, tmp_path / "b", progress=False)
        assert (data == other).all()
        trees = [
            TensorDict(
                {
                    "arm": torch.from_numpy(episode["arm"]),
                    "cups": {"red": torch.from_numpy(episode["cups"]["red"])},
                },
                [len(episode["arm"])],
            )
            for episode in each
        ]
        other = from_arrays(trees, actions, tmp_path / "c", progress=False)
        assert (data == other).all()
        other = from_arrays(
            torch.cat(trees),
            np.concatenate(actions),
            tmp_path / "d",
            episode_lengths=[3, 4],
            progress=False,
        )
        assert (data == other).all()

    def test_goals(self, tmp_path):
        rng = np.random.default_rng(0)
        observations = rng.normal(size=(7, 3))
        achieved, desired = rng.normal(size=(7, 2)), rng.normal(size=(7, 2))
        actions = rng.normal(size=(6, 2))
        given = {"desired_goals": desired, "episode_lengths": [6], "progress": False}
        data = from_arrays(
            observations, actions, tmp_path / "a", achieved_goals=achieved, **given
        )
        dictionary = {
            "observation": observations,
            "achieved_goal": achieved,
            "desired_goal": desired,
        }
        same = from_arrays(
            dictionary, actions, tmp_path / "b", episode_lengths=[6], progress=False
        )
        assert (data == same).all()
        assert np.array_equal(
            data["next", "achieved_goal"].numpy(), achieved[1:].astype(np.float32)
        )
        given["desired_goals"] = desired[:6]
        follows = from_arrays(
            observations[:6],
            actions,
            tmp_path / "c",
            next_observations=observations[1:],
            achieved_goals=achieved[:6],
            next_achieved_goals=achieved[1:],
            **given,
        )
        assert torch.equal(
            follows["next", "achieved_goal"], data["next", "achieved_goal"]
        )
        # The goal of a transition does not change in it.
        assert torch.equal(follows["next", "desired_goal"], data["desired_goal"])
        for wrong, match in (
            ({"achieved_goals": achieved[:6]}, "both of achieved_goals"),
            ({"next_achieved_goals": achieved[1:]}, "both of achieved_goals"),
        ):
            with pytest.raises(ValueError, match=match):
                from_arrays(
                    observations[:6],
                    actions,
                    tmp_path / "d",
                    next_observations=observations[1:],
                    **wrong,
                    **given,
                )
        with pytest.raises(ValueError, match=r"have \['achieved_goal', .* already"):
            from_arrays(
                dictionary, actions, tmp_path / "d", achieved_goals=achieved, **given
            )
        with pytest.raises(ValueError, match="without next_observations"):
            from_arrays(
                observations,
                actions,
                tmp_path / "d",
                next_achieved_goals=achieved,
                **given,
            )

    def test_infos_of_states_keep_their_types(self, tmp_path):
        clock = np.arange(9.0) / 3
        data = from_arrays(
            np.zeros((9, 2)),
            np.zeros((7, 1)),
            tmp_path / "a",
            info={"clock": clock},
            episode_lengths=[3, 4],
            progress=False,
        )
        assert np.array_equal(data["info", "clock"].numpy(), np.delete(clock, [3, 8]))
        assert data["info", "clock"].dtype == torch.float64

    def test_unsigned_integers_become_signed(self, tmp_path):
        observations = {
            "state": np.zeros((4, 2)),
            "phase": np.arange(4, dtype=np.uint16),
        }
        given = {"episode_lengths": [3], "progress": False}
        data = from_arrays(observations, np.zeros((3, 1)), tmp_path / "a", **given)
        assert data["next", "observation", "phase"].dtype == torch.int32
        assert data["next", "observation", "phase"].tolist() == [1, 2, 3]
        observations["phase"] = np.full(4, 2**63, dtype=np.uint64)
        with pytest.raises(ValueError, match=r"'phase'\) in .* above 2\*\*63"):
            from_arrays(observations, np.zeros((3, 1)), tmp_path / "b", **given)


def test_the_last_action_without_a_next_state_is_left_out(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    given = {"episode_lengths": [3, 4], "progress": False}
    observations, actions = np.arange(7.0)[:, None], np.arange(7.0)[:, None]
    data = from_arrays(observations, actions, tmp_path / "a", **given)
    assert data["action"].squeeze(-1).tolist() == [0, 1, 3, 4, 5]
    assert data["next", "observation"].squeeze(-1).tolist() == [1, 2, 4, 5, 6]
    assert data["next", "truncated"].squeeze(-1).tolist() == [0, 1, 0, 0, 1]
    assert ("next", "reward") not in data.keys(True)
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert "last action of each of 2 episodes is left out, because" in record.message
    caplog.clear()
    ends = np.array([0, 0, 1, 0, 0, 0, 1])
    data = from_arrays(
        observations, actions, tmp_path / "b", terminals=ends, progress=False
    )
    assert not data["next", "terminated"].any()
    assert data["next", "truncated"].sum() == 2
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "2 were terminal" in record.message


def test_a_batch_in_few_lines(tmp_path):
    arrays = {"observations": np.random.rand(300, 5), "actions": np.random.rand(300, 2)}
    data = from_arrays(
        **arrays, path=tmp_path / "a", episode_lengths=[100] * 3, progress=False
    )
    assert offline_buffer(data, 32).sample()["observation"].shape == (32, 5)


OBS, ACT = np.zeros((10, 3)), np.zeros((10, 2))


def flags(*rows):
    found = np.zeros(10, bool)
    found[list(rows)] = True
    return found


class TestEnds:
    @pytest.mark.parametrize(
        ("ends", "match"),
        [
            ({}, r"nothing says where.*episode_lengths=\[10\]"),
            ({"dones": flags(4, 9)}, "dones do not say.*terminals or as timeouts"),
            ({"terminals": flags(4)}, r"do not cover.*last end is at row 4.*10 rows"),
            ({"terminals": flags()}, "do not cover the data: there is no end"),
            (
                {"terminals": flags(9)[:9]},
                r"terminals have shape \[9\], expected \[10\]",
            ),
            ({"terminals": np.full(10, 0.5)}, "terminals are not flags"),
            ({"timeouts": ["a"] * 10}, "timeouts are not flags"),
            (
                {"episode_lengths": [4, 5]},
                "sum to 9, but there are 10 actions: correct",
            ),
            ({"episode_lengths": [5, 7]}, "sum to 12.*they count states, subtract 1"),
            ({"episode_lengths": [4, 0, 6]}, "has 0 at episode 1"),
            ({"episode_lengths": [4.0, 6.0]}, "dtype float64, expected one integer"),
            ({"episode_lengths": 10}, r"shape \[\]"),
            (
                {"episode_ids": [0] * 4 + [1] * 3 + [0] * 3},
                "id 0 .*comes back at row 7",
            ),
            ({"episode_ids": np.zeros(10)}, "dtype float64, expected integers"),
            (
                {"episode_ids": [0] * 4 + [1] * 6, "episode_lengths": [5, 5]},
                "episode_lengths and episode_ids contradict each other at row 3, and "
                "in 2 rows.*by episode_lengths, no episode ends there",
            ),
            (
                {"episode_lengths": [5, 5], "terminals": flags(2, 9)},
                "episode_lengths and terminals contradict each other at row 2",
            ),
            (
                {"dones": flags(4, 9), "terminals": flags(4), "timeouts": flags(7, 9)},
                "dones and terminals or timeouts contradict each other at row 7",
            ),
            (
                {"dones": flags(4), "terminals": flags(4)},
                "dones do not cover the data",
            ),
        ],
    )
    def test_what_is_refused(self, ends, match, tmp_path):
        with pytest.raises(ValueError, match=match):
            from_arrays(OBS, ACT, tmp_path / "a", progress=False, **ends)
        assert not list(tmp_path.iterdir())

    def test_both_kinds_at_once(self, tmp_path):
        data = from_arrays(
            np.zeros((11, 3)),
            ACT,
            tmp_path / "a",
            dones=flags(9),
            timeouts=flags(9),
            terminals=flags(9),
            progress=False,
        )
        assert data["next", "terminated"][-1]
        assert data["next", "truncated"][-1]


class TestRefused:
    @pytest.mark.parametrize(
        ("observations", "actions", "given", "match"),
        [
            (OBS[:9], ACT, {}, r"9 observations for 10 actions, expected 10 .* or 11"),
            (OBS[:, 0], ACT, {}, r"observations of .* has shape \[10\].*\[:, None\]"),
            (OBS, ACT[:, 0], {}, r"actions of .* has shape \[10\].*\[:, None\]"),
            (OBS, ACT[:0], {}, "has no actions"),
            (OBS, 3, {}, "actions of the arrays is a int, expected an array"),
            (OBS, np.float32(3), {}, "is one number"),
            (np.array([OBS, None], object), ACT, {}, r"Python objects.*list\(obs"),
            ({"a": OBS, "b": OBS[:4]}, ACT, {}, r"different numbers of entries.*'b'"),
            ({}, ACT, {}, "observations of the arrays has no entries"),
            ({3: OBS}, ACT, {}, "named 3, a int, expected a str"),
            (OBS, ACT, {"rewards": np.zeros(9)}, "rewards of the arrays has 9 entries"),
            (OBS, ACT, {"rewards": np.zeros((10, 2))}, "one number for each action"),
            (
                OBS,
                ACT,
                {"info": {"a": np.zeros(9)}},
                "info of the arrays has 9 entries",
            ),
            (OBS, ACT, {"next_observations": OBS[:, :2]}, r"\[10, 3\].*\[10, 2\]"),
            (OBS, ACT, {"next_observations": {"a": OBS}}, "'a'"),
            (OBS, ACT, {"next_observations": OBS[:5]}, "has 5 entries, expected 10"),
            (OBS.astype(str), ACT, {}, "'observation' in .* has text"),
            (OBS + np.nan, ACT, {}, "'observation' in .* has NaN"),
            (OBS, ACT * 1j, {}, "'action' in .* has complex128"),
            ({"observation": OBS, "episode": OBS}, ACT, {}, r"named \['episode'\]"),
            (np.ma.masked_equal(OBS, 0), ACT, {}, "'observation' in .* masked"),
            ({"shape": OBS}, ACT, {}, "'shape'.*reserve: rename it"),
            (
                OBS,
                ACT,
                {"action_bounds": ([0], [1])},
                r"action_bounds have shape \[1\]",
            ),
            (OBS, ACT, {"action_bounds": ([0, 2], [1, 1])}, "none of the lowest above"),
        ],
    )
    def test_flat(self, observations, actions, given, match, tmp_path):
        given = {"episode_lengths": [10], "progress": False} | given
        with pytest.raises(ValueError, match=match):
            from_arrays(observations, actions, tmp_path / "a", **given)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("observations", "actions", "given", "match"),
        [
            ([OBS], ACT, {"episode_lengths": [10]}, "observations of .* is a list"),
            (OBS, [ACT], {}, r"\['observations'\] are not: give lists for all"),
            ([OBS, OBS], [ACT], {}, "'observations': 2, 'actions': 1"),
            ([], [], {}, "at least one"),
            (list(OBS), list(ACT), {}, r"observations of episode 0 has shape \[3\]"),
            ([0.5], [0.5], {}, r"actions\[0\] is a float, expected the array"),
            ([OBS], [ACT], {"episode_ids": np.zeros(10, int)}, "leave out episode_ids"),
            ([OBS], [ACT], {"dones": [flags(9)]}, "dones do not say"),
            ([OBS, OBS[:, :2]], [ACT, ACT], {}, "episode 1 .*differ.*'observation'"),
            ([OBS, OBS[:9]], [ACT, ACT[:8]], {}, "episode 0 has one observation for"),
            (
                [OBS, OBS[:1]],
                [ACT, ACT[:1]],
                {},
                "episode 1 has one observation and one",
            ),
            ([OBS], [ACT], {"terminals": [flags(3)]}, "episode 0 is set in row 3"),
            ({"a": [OBS], "b": OBS}, [ACT], {}, "'a': 1, 'b': None"),
            ([OBS, OBS.astype(int)], [ACT, ACT], {}, "float32.*int64|int64.*float32"),
        ],
    )
    def test_lists(self, observations, actions, given, match, tmp_path):
        with pytest.raises(ValueError, match=match):
            from_arrays(observations, actions, tmp_path / "a", progress=False, **given)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("items", "of", "match"),
        [
            ([], "episodes", "no episode was added"),
            ([{"observations": OBS}], "episodes", r"item 0 .* lacks \['actions'\]"),
            ([OBS], "episodes", "item 0 of the stream is a ndarray"),
            (
                [{"observations": OBS, "actions": ACT, "reward": ACT}],
                "episodes",
                r"unknown \['reward'\]",
            ),
            (
                [
                    {"observations": OBS, "actions": ACT},
                    {"observations": OBS, "actions": ACT, "rewards": ACT[:, 0]},
                ],
                "episodes",
                r"item 1 .*first item has \['rewards'\]",
            ),
            ([{"observations": OBS, "actions": ACT}], "parts", "has no 'terminals'"),
            (
                [{"observations": OBS, "actions": ACT, "timeouts": flags(4)}],
                "parts",
                "the last 5 rows of the stream, in part 0, have no end",
            ),
            (
                [
                    {"observations": OBS, "actions": ACT, "timeouts": flags(4)},
                    {"observations": OBS[:, 1:], "actions": ACT, "timeouts": flags(9)},
                ],
                "parts",
                r"part 1 does not continue.*\[5, 3\] is followed by float64 \[10, 2\]",
            ),
            (
                [{"observations": OBS[1:], "actions": ACT, "timeouts": flags(9)}],
                "parts",
                "part 0 .*'observations': 9, 'actions': 10",
            ),
            ([], "rows", "of is 'rows', expected"),
        ],
    )
    def test_streams(self, items, of, match, tmp_path):
        with pytest.raises(ValueError, match=match):
            from_stream(iter(items), tmp_path / "a", of=of, progress=False)
        assert not list(tmp_path.iterdir())


class TestSecondCall:
    def given(self):
        return {"episode_lengths": [4, 6], "progress": False}

    def test_other_data_are_refused(self, tmp_path):
        states = np.random.default_rng(0).normal(size=(10, 3))
        path = tmp_path / "a"
        first = from_arrays(states, ACT, path, **self.given()).clone()
        # Scores that were added do not matter.
        opened = load_transitions(path)
        opened.make_memmap(("caiac", "score"), shape=(8, 2), dtype=torch.float32)
        again = from_arrays(states, ACT, path, **self.given())
        assert (again.select(*first.keys()) == first).all()
        changed = states.copy()
        changed[7, 1] += 1e-3
        for arrays, options, what in (
            ((changed, ACT), {}, r"'observation'.*episode 1 \(rows 4 to 9\)"),
            ((states[:4], ACT[:4]), {"episode_lengths": [4]}, "8 rows, now 3"),
            ((states, ACT), {"episode_lengths": [5, 5]}, "'episode'"),
            ((states, ACT), {"rewards": np.zeros(10)}, "'reward'"),
            ((states, ACT.astype(int)), {}, "'action'"),
            ((states, ACT), {"action_bounds": ([0, 0], [1, 1])}, "action_bounds"),
        ):
            with pytest.raises(FileExistsError, match=rf"{what}.*overwrite=True"):
                from_arrays(*arrays, path, **(self.given() | options))
        replaced = from_arrays(changed, ACT, path, overwrite=True, **self.given())
        assert not torch.equal(replaced["observation"], first["observation"])
        again["observation"][0] = 7  # the data were changed in their folder
        replaced["observation"][0] = 7
        with pytest.raises(FileExistsError, match="other data"):
            from_arrays(changed, ACT, path, **self.given())

    @pytest.mark.parametrize("content", ["nothing", "file", "damaged"])
    def test_what_is_no_transitions_is_refused(self, content, tmp_path):
        path = tmp_path / "a"
        if content == "file":
            path.touch()
        else:
            path.mkdir()
            (path / "mine.txt").touch()
        if content == "damaged":
            from_arrays(OBS, ACT, path, overwrite=True, **self.given())
            (path / "action.memmap").write_bytes(b"1")
        with pytest.raises(FileExistsError, match=r"a exists.*overwrite=True"):
            from_arrays(OBS, ACT, path, **self.given())
        from_arrays(OBS, ACT, path, overwrite=True, **self.given())


class Lazy:
    """An array of more than the memory, which counts what is read at a time."""

    def __init__(self, steps, columns):
        self.shape, self.dtype = (steps, columns), np.dtype(np.float32)
        self.most = self.calls = 0

    def __getitem__(self, rows):
        count = len(range(self.shape[0])[rows])
        self.most, self.calls = max(self.most, count), self.calls + 1
        found = np.zeros((count, self.shape[1]), np.float32)
        found[:, 0] = np.arange(self.shape[0])[rows]
        return found


@pytest.mark.parametrize("lengths", [[4000], [7] * 500 + [500]])
def test_large_arrays_are_read_in_parts(lengths, tmp_path, monkeypatch):
    observations, actions = Lazy(4000, 50), Lazy(4000, 2)
    monkeypatch.setattr(array_parts, "_CHUNK", 300 * 52 * 4)
    data = from_arrays(
        observations, actions, tmp_path / "a", episode_lengths=lengths, progress=False
    )
    assert len(data) == 4000 - len(lengths)
    assert observations.most <= 301
    assert observations.calls < 30  # not one for each short episode
    kept = np.delete(np.arange(4000), np.cumsum(lengths) - 1)
    assert data["observation"][:, 0].tolist() == kept.tolist()
    assert data["next", "observation"][:, 0].tolist() == (kept + 1).tolist()


def test_more_data_than_memory_pass_through(tmp_path, monkeypatch):
    monkeypatch.setattr(array_parts, "_CHUNK", 2 << 20)

    def work():
        status = Path("/proc/self/status").read_text()
        used = int(re.search(r"VmData:\s+(\d+) kB", status)[1]) << 10
        # A third of the data, which have 2 x 144 MB. Mapped files do not count.
        resource.setrlimit(resource.RLIMIT_DATA, (used + (96 << 20),) * 2)
        from_arrays(
            Lazy(3000, 12_000),
            Lazy(3000, 2),
            tmp_path / "a",
            episode_lengths=[3000],
            progress=False,
        )
        (tmp_path / "done").touch()
        yield

    run_killed(work)
    assert (tmp_path / "done").exists()


def test_a_killed_call_leaves_nothing_that_looks_whole(tmp_path):
    def work():
        def episodes():
            yield {"observations": OBS, "actions": ACT}
            os.kill(os.getpid(), signal.SIGKILL)

        from_stream(episodes(), tmp_path / "a", progress=False)
        yield

    run_killed(work)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".partial-")
    with pytest.raises(FileNotFoundError):
        load_transitions(tmp_path / "a")
    from_stream([{"observations": OBS, "actions": ACT}], tmp_path / "a", progress=False)
    assert [item.name for item in tmp_path.iterdir()] == ["a"]


def test_an_error_in_the_stream_leaves_nothing(tmp_path):
    def episodes():
        yield {"observations": OBS, "actions": ACT}
        raise OSError("the file is damaged")

    with pytest.raises(OSError, match="damaged"):
        from_stream(episodes(), tmp_path / "a", progress=False)
    assert not list(tmp_path.iterdir())
