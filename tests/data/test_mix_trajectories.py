"""Mixtures: whole trajectories, shares, nested fractions, nothing half-written."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import NonTensorData, TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import (
    action_bounds,
    from_arrays,
    from_replay_buffer,
    load_transitions,
    mix_trajectories,
    offline_buffer,
)
from torchrl_caiac.data.digests import data_digest, data_source
from torchrl_caiac.data.write_transitions import write_transitions
from torchrl_caiac.influence import MotionInfluence, score_buffer


def source(lengths, *, first_id=0, id_shape=(), seed=0):
    """Trajectories with ids that are neither 0, 1, ... nor in order."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(lengths)
    ids = first_id + 7 * torch.arange(len(lengths)).flip(0)
    ends = torch.zeros(total, dtype=torch.bool)
    ends[torch.tensor(lengths).cumsum(0) - 1] = True
    return TensorDict(
        {
            "observation": {"arm": torch.randn(total, 3, generator=generator)},
            "action": torch.randn(total, 2, generator=generator).double(),
            "episode": ids.repeat_interleave(torch.tensor(lengths)).view(
                total, *id_shape
            ),
            "next": {"done": ends.unsqueeze(-1)},
        },
        [total],
    )


def origins(rows):
    """Source and original id of every trajectory, in the order of the rows."""
    seen = zip(
        rows["source"].tolist(), rows["source_episode"].flatten().tolist(), strict=True
    )
    return list(dict.fromkeys(seen))


def assert_whole(rows, sources, key="episode"):
    """Every trajectory of the mixture is one of its source's, row for row."""
    begin = 0
    found = origins(rows)
    for number, (where, original) in enumerate(found):
        there = sources[where]
        theirs = there[there[key].flatten() == original]
        mine = rows[begin : begin + len(theirs)]
        assert mine[key].flatten().tolist() == [number] * len(theirs)
        assert mine["source"].tolist() == [where] * len(theirs)
        assert (mine["source_episode"] == theirs[key]).all()
        kept = mine.exclude("source", "source_episode", key)
        assert (kept == theirs.exclude(key)).all()
        begin += len(theirs)
    assert begin == len(rows)
    assert len(set(found)) == len(found)
    return found


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("id_shape", [(), (1,)])
def test_expert_and_random(kind, id_shape, tmp_path):
    sources = [
        source([3, 1, 4, 2, 5, 2], id_shape=id_shape),
        source([1 + i % 3 for i in range(20)], id_shape=id_shape, seed=1),
    ]
    if kind == "memmap":
        sources = [s.memmap(tmp_path / str(i)) for i, s in enumerate(sources)]
    before = [s.clone() for s in sources]
    rows = mix_trajectories(sources, shares=(0.3, 0.7))
    found = assert_whole(rows, sources)
    assert [where for where, _ in found].count(0) == 6
    assert len(found) == 20
    assert rows["episode"].shape == (len(rows), *id_shape)
    assert rows["source"].shape == (len(rows),)
    assert rows["source"].dtype == rows["episode"].dtype == torch.int64
    assert rows["action"].dtype == torch.float64
    assert all((a == b).all() for a, b in zip(sources, before, strict=True))
    # Sources drawn at random, not one after the other.
    assert len({where for where, _ in found[:10]}) == 2


def test_into_a_folder(tmp_path):
    sources = [source([2, 3, 4]), source([1] * 7, seed=1).memmap(tmp_path / "random")]
    mixed = mix_trajectories(sources, shares=(0.5, 0.5), seed=3)
    stored = mix_trajectories(
        sources, shares=(0.5, 0.5), seed=3, path=tmp_path / "deep" / "mixed"
    )
    assert stored.is_memmap()
    assert (stored == mixed).all()
    assert (load_transitions(tmp_path / "deep" / "mixed") == mixed).all()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        mix_trajectories(sources, path=tmp_path / "deep" / "mixed")
    other = mix_trajectories(sources, path=tmp_path / "deep" / "mixed", overwrite=True)
    assert_whole(other, sources)
    assert [entry.name for entry in (tmp_path / "deep").iterdir()] == ["mixed"]
    batch = offline_buffer(other, batch_size=4).sample()
    assert batch["source"].shape == (4,)


def test_an_error_leaves_what_was_there(tmp_path, monkeypatch):
    sources = [source([2, 3, 4])]
    before = mix_trajectories(sources, path=tmp_path / "mixed").clone()

    def full(*args):
        raise OSError("disk full")

    # The package's attribute of that name is the function.
    module = importlib.import_module("torchrl_caiac.data.mix_trajectories")
    monkeypatch.setattr(module, "_fill", full)
    with pytest.raises(OSError, match="disk full"):
        mix_trajectories(sources, path=tmp_path / "mixed", seed=1, overwrite=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["mixed"]
    assert (load_transitions(tmp_path / "mixed") == before).all()


counts = st.lists(st.integers(1, 30), min_size=1, max_size=4)


@given(
    counts,
    st.data(),
    st.integers(0, 3),
    st.floats(0.05, 1.0),
    st.floats(0.05, 1.0),
    st.booleans(),
)
def test_fractions_are_nested_and_keep_the_shares(
    counts, data, seed, one, other, given_shares
):
    sources = [
        source([1 + (i + j) % 3 for j in range(count)], seed=i)
        for i, count in enumerate(counts)
    ]
    weights = counts
    if given_shares:
        weights = data.draw(
            st.lists(st.integers(1, 9), min_size=len(counts), max_size=len(counts))
        )
    shares = [weight / sum(weights) for weight in weights]
    whole = mix_trajectories(
        sources, shares=shares if given_shares else None, seed=seed
    )
    found = assert_whole(whole, sources)
    total = len(found)
    # The most of which no source's share is more than it has, but for rounding.
    most = min(count / share for count, share in zip(counts, shares, strict=True))
    assert most - len(counts) <= total <= most + 1e-6
    if not given_shares:
        assert total == sum(counts)
    small, large = sorted((one, other))
    parts = {}
    for fraction in (small, large):
        if round(fraction * total) == 0:
            with pytest.raises(ValueError, match="less than one trajectory"):
                mix_trajectories(
                    sources,
                    shares=shares if given_shares else None,
                    fraction=fraction,
                    seed=seed,
                )
            continue
        parts[fraction] = part = mix_trajectories(
            sources,
            shares=shares if given_shares else None,
            fraction=fraction,
            seed=seed,
        )
        taken = assert_whole(part, sources)
        assert len(taken) == round(fraction * total)
        assert (whole[: len(part)] == part).all()
        for number, share in enumerate(shares):
            drawn = [where for where, _ in taken].count(number)
            # Two sources round to the nearest; more can be off by a little more.
            off = 0.5 if len(shares) <= 2 else len(shares) / 2
            assert abs(drawn - share * len(taken)) <= off + 1e-6
    if len(parts) == 2:
        assert set(origins(parts[small])) <= set(origins(parts[large]))


def test_the_paper_s_sizes():
    """600 expert and 1,400 random episodes; 100, 20 and 10 % of them."""
    sources = [source([1] * 600), source([1] * 1400, seed=1)]
    for fraction, expert in ((1.0, 600), (0.2, 120), (0.1, 60)):
        rows = mix_trajectories(sources, shares=(0.3, 0.7), fraction=fraction)
        assert rows["source"].bincount().tolist() == [expert, expert * 7 // 3]
    rows = mix_trajectories(sources, shares=(0.5, 0.5))
    assert rows["source"].bincount().tolist() == [600, 600]
    rows = mix_trajectories(sources, shares=(0.1, 0.9), trajectories=1000)
    assert rows["source"].bincount().tolist() == [100, 900]
    part = mix_trajectories(sources, shares=(0.1, 0.9), trajectories=1000, fraction=0.1)
    assert (part == rows[: len(part)]).all()
    with pytest.raises(ValueError, match=r"1500, expected 1 to 1200.*\[600, 1400\]"):
        mix_trajectories(sources, shares=(0.5, 0.5), trajectories=1500)


def test_seeds():
    sources = [source([1] * 40), source([1] * 40, seed=1)]
    one, again, other = (mix_trajectories(sources, seed=seed) for seed in (0, 0, 1))
    assert (one == again).all()
    assert origins(one) != origins(other)
    assert set(origins(one)) == set(origins(other))
    # The sources have streams of their own.
    first, second = (
        [original for where, original in origins(one) if where == number]
        for number in (0, 1)
    )
    assert first != second


def test_nested_keys():
    sources = [source([2, 1]), source([3, 1, 1], seed=1)]
    sources = [s.rename_key_("episode", ("meta", "traj")) for s in sources]
    rows = mix_trajectories(
        sources,
        trajectory_key=("meta", "traj"),
        source_key=("from", "source"),
        source_trajectory_key=("from", "traj"),
    )
    assert rows["meta", "traj"].unique().tolist() == [0, 1, 2, 3, 4]
    assert rows["from", "source"].bincount().tolist() == [3, 5]
    assert set(rows["from", "traj"].tolist()) == {0, 7, 14}
    assert ("from", "traj") not in sources[0].keys(include_nested=True)


def test_mixtures_of_mixtures():
    """What was mixed can be mixed again, under other names."""
    rows = mix_trajectories([source([2, 1]), source([3, 1, 1], seed=1)])
    with pytest.raises(ValueError, match="already has 'source'"):
        mix_trajectories([rows, rows])
    again = mix_trajectories(
        [rows, rows], source_key="copy", source_trajectory_key="copy_episode"
    )
    assert len(again) == 2 * len(rows)
    assert again["episode"].unique().tolist() == list(range(10))


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"shares": [1.0]}, "1 shares .* for 2 sources"),
        ({"shares": [0.3, 0.6]}, "sum 0.9; expected positive numbers with sum 1"),
        ({"shares": [1.0, 0.0]}, "leave out sources without a share"),
        ({"shares": [1.5, -0.5]}, "expected positive"),
        ({"shares": [float("nan"), 0.5]}, "expected positive"),
        ({"fraction": 0.0}, "fraction is 0.0"),
        ({"fraction": 1.1}, "fraction is 1.1"),
        ({"fraction": float("nan")}, "fraction is nan"),
        ({"fraction": 0.01}, "fraction 0.01 of 5 trajectories is less than one"),
        ({"trajectories": 0}, "trajectories is 0, expected 1 to 5"),
        ({"trajectories": 6}, r"trajectories is 6, expected 1 to 5.*\[2, 3\]"),
    ],
)
def test_bad_arguments(arguments, match, tmp_path):
    sources = [source([2, 3]), source([1, 1, 2], seed=1)]
    with pytest.raises(ValueError, match=match):
        mix_trajectories(sources, path=tmp_path / "mixed", **arguments)
    assert not list(tmp_path.iterdir())


def test_bad_sources():
    good = source([2, 3])
    for sources in ([], good):
        with pytest.raises(ValueError, match="at least one tensordict"):
            mix_trajectories(sources)
    scored = source([2, 3]).set(("caiac", "score"), torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"source 1 has .*'caiac', 'score'.*exclude"):
        mix_trajectories([good, scored])
    with pytest.raises(ValueError, match=r"source 0 and source 1 differ.*action"):
        mix_trajectories([good, source([2]).set("action", torch.zeros(2, 3))])
    with pytest.raises(ValueError, match=r"differ.*float32"):
        mix_trajectories([good, source([2]).apply(torch.Tensor.float)])
    with pytest.raises(ValueError, match=r"source 1 has batch size \[5, 1\]"):
        mix_trajectories([good, good.unsqueeze(-1)])
    with pytest.raises(ValueError, match=r"batch size \[0\]"):
        mix_trajectories([good, good[:0]])
    with pytest.raises(KeyError, match=r"source 0 lacks the trajectory ids.*'traj"):
        mix_trajectories([good, good], trajectory_key="traj")
    with pytest.raises(ValueError, match=r"source 0: 'action' has shape \[5, 2\]"):
        mix_trajectories([good], trajectory_key="action")
    named = source([2]).set("name", NonTensorData("expert", [2]))
    with pytest.raises(ValueError, match=r"'name' of source 0 is a NonTensorData"):
        mix_trajectories([named])


def test_ids_that_come_again_after_an_end_are_other_trajectories():
    twice = torch.cat([source([2, 3]), source([2, 3])])
    rows = mix_trajectories([twice])
    assert rows["episode"].unique().numel() == 4
    ends = rows["next", "done"].flatten()
    assert (rows["episode"].diff() != 0).tolist() == ends[:-1].tolist()
    alone = mix_trajectories([twice], done_key=None)
    assert alone["episode"].unique().numel() == 2


def test_rows_of_parallel_environments_become_consecutive():
    whole = source([4, 3])
    order = torch.tensor([0, 4, 1, 5, 2, 6, 3])
    assert_whole(mix_trajectories([whole[order]]), [whole])


class TestFolders:
    def test_a_full_disk_is_an_error_and_leaves_nothing(self, small_disk):
        big = source([60_000, 60_000])
        with pytest.raises(OSError, match=r"the disk is full: .*\.memmap needs \d+"):
            mix_trajectories([big], path=small_disk / "mixed")
        assert not list(small_disk.iterdir())

    def test_digests_are_written(self, tmp_path):
        stored = write_transitions(source([3, 2]), tmp_path / "source")
        mix_trajectories([stored, source([4])], path=tmp_path / "mixed")
        load_transitions(tmp_path / "mixed", verify=True)
        digest = data_digest(tmp_path / "source")
        assert data_source(tmp_path / "mixed") == {"mixed": [digest, None]}

    @pytest.mark.parametrize(
        ("bounds", "kept"),
        [
            ([([-1, -1], [1, 1])] * 2, True),
            ([([-1, -1], [1, 1]), ([-1, -1], [1, 2])], False),
            ([([-1, -1], [1, 1]), None], False),
            ([None, None], False),
        ],
    )
    def test_action_bounds_are_kept_where_all_agree(self, bounds, kept, tmp_path):
        sources = [
            write_transitions(source([3]), tmp_path / f"{number}", action_bounds=pair)
            for number, pair in enumerate(bounds)
        ]
        mixed = mix_trajectories(sources, path=tmp_path / "mixed")
        found = action_bounds(mixed)
        assert (found is not None) is kept
        if kept:
            assert found[0].tolist() == [-1, -1] and found[1].tolist() == [1, 1]


@pytest.mark.parametrize("name", ["source_key", "source_trajectory_key"])
def test_new_keys_that_would_be_lost_are_refused(name, tmp_path):
    path = tmp_path / "data"
    old = mix_trajectories([source([2, 3])], path=path).clone()
    with pytest.raises(ValueError, match=r"of the mixture has one of the names.*shape"):
        mix_trajectories(
            [source([4])], path=path, overwrite=True, **{name: ("x", "shape")}
        )
    assert (load_transitions(path, verify=True) == old).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["data"]


class TestSourcesOfDifferentLoaders:
    def sources(self, tmp_path):
        rng = np.random.default_rng(0)
        states = {"arm": rng.normal(size=(8, 2)), "cups": {"red": np.ones((8, 1))}}
        first = from_arrays(
            states,
            rng.normal(size=(6, 2)),
            tmp_path / "arrays",
            episode_lengths=[2, 4],
            info={"clock": np.arange(6)},
            action_bounds=([-9, -9], [9, 9]),
            progress=False,
        )
        second = from_replay_buffer(
            first.exclude("info"),
            tmp_path / "buffer",
            progress=False,
            action_bounds=([-9, -9], [9, 9]),
        )
        return first, second

    def test_what_differs_is_named_and_left_out(self, tmp_path):
        first, second = self.sources(tmp_path)
        with pytest.raises(ValueError) as raised:
            mix_trajectories([first, second])
        assert "exclude=[('info', 'clock'), ('info', 'episode')]" in str(raised.value)
        mixed = mix_trajectories(
            [first, second], exclude=["info"], path=tmp_path / "mixed"
        )
        assert len(mixed) == 12
        assert "info" not in mixed
        assert action_bounds(mixed) is not None
        own = mixed[mixed["source"] == 0]
        order = own["source_episode"].argsort(stable=True)
        for key in (
            ("observation", "cups", "red"),
            ("next", "observation", "arm"),
            "action",
        ):
            assert torch.equal(own[key][order], first[key])

    def test_an_excluded_key_that_nobody_has(self, tmp_path):
        first, _ = self.sources(tmp_path)
        with pytest.raises(KeyError, match=r"no source has .*'absent'"):
            mix_trajectories([first, first], exclude=["absent"])

    def test_other_keys_and_types_of_ids(self, tmp_path):
        first, _ = self.sources(tmp_path)
        second = first.clone()
        second["run"] = second["episode"].int()[:, None] + 5
        del second["episode"]
        with pytest.raises(KeyError, match="source 1 lacks the trajectory ids"):
            mix_trajectories([first, second])
        with pytest.raises(ValueError, match="list of 1 keys for 2 sources"):
            mix_trajectories([first, second], trajectory_key=["episode"])
        mixed = mix_trajectories([first, second], trajectory_key=["episode", "run"])
        assert "run" not in mixed
        for number, ids in enumerate([first["episode"], second["run"]]):
            own = mixed[mixed["source"] == number]
            assert own["source_episode"].dtype == torch.int64
            expected = ids.reshape(-1).long()
            assert own["source_episode"].sort()[0].tolist() == expected.tolist()
        assert mixed["episode"].unique_consecutive().tolist() == [0, 1, 2, 3]


def test_scores_of_other_estimators_are_refused():
    class Scaled:
        layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])

        def __init__(self, scale):
            self.scale = scale

        def __call__(self, td):
            return self.scale * td["observation"].abs()

    def scored(scale, seed, lengths=(20, 30)):
        data = source(lengths, seed=seed)
        data["observation"] = data["observation", "arm"][:, :2].clone()
        data["next", "observation"] = data["observation"] + 1
        rb = offline_buffer(data, batch_size=8)
        score_buffer(rb, Scaled(scale), check=False, progress=False)
        return rb.storage[:]

    one, same, other = scored(1.0, 0), scored(1.0, 1), scored(100.0, 2)
    mixed = mix_trajectories([one, same], shares=[0.5, 0.5])
    assert ("caiac", "score") in mixed.keys(True, True)
    with pytest.raises(ValueError, match=r"0 and source 1 .*exclude=\[\('caiac'"):
        mix_trajectories([one, other], shares=[0.5, 0.5])
    mix_trajectories([one, other], shares=[0.5, 0.5], exclude=["caiac"])
    with pytest.raises(ValueError, match="source 0 and source 1"):
        mix_trajectories([scored(1.0, 3, [2]), scored(100.0, 4, [2])])


@pytest.mark.parametrize("key", ["state", "nested"])
def test_scores_of_other_estimators_are_told_by_any_state(key):
    names = {"robot": [0, 1], "cup": [2, 3]}  # not in the order of their names
    if key == "state":
        layout = EntityLayout(names, observation_key="state", fixed=["robot"])
    else:
        keys = {name: ("observation", name) for name in names}
        layout = EntityLayout.from_keys(keys, fixed=["robot"])

    def scored(tolerance, seed, waits=0):
        torch.manual_seed(seed)
        state = torch.rand(200, 4)
        state[:waits] = seed
        after = state + 0.1 * (torch.rand(200, 1) < 0.3)
        data = source([100, 100], seed=seed).select("episode", "action")
        for place, value in (((), state), (("next",), after)):
            if key == "state":
                data[(*place, "state")] = value
            else:
                for name, columns in names.items():
                    data[(*place, "observation", name)] = value[:, columns].clone()
        rb = offline_buffer(data, batch_size=8)
        estimator = MotionInfluence(layout, tolerance)
        score_buffer(rb, estimator, check=False, progress=False)
        return rb.storage[:]

    one, same, other = scored(0.05, 0, 120), scored(0.05, 1, 120), scored(0.5, 2)
    mix_trajectories([one, same])
    with pytest.raises(ValueError, match=r"exclude=\[\('caiac', 'score'\), "):
        mix_trajectories([one, other])
