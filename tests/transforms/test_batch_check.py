"""Checks of each batch: scores of other states, and rows that are no window."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    ReplayBufferEnsemble,
    SliceSampler,
    TensorStorage,
)
from torchrl.envs.transforms import DoubleToFloat

from tests.transforms.oracle import (
    FLAT,
    NESTED,
    KnownScores,
    N,
    make_data,
    score,
    small,
    stored,
    write_later,
)
from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.influence import MotionInfluence, score_buffer
from torchrl_caiac.transforms import TransformKeys
from torchrl_caiac.transforms.checks import LateCheck

KEY = ("caiac", "score")
OTHERS = "of other states than their own: call score_buffer"


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has values on the CPU checked like those of an accelerator."""
    monkeypatch.setattr(LateCheck, "needed", staticmethod(lambda device: True))


def scored(layout: EntityLayout = FLAT, **kwargs: Any) -> ReplayBuffer:
    """A buffer whose scores have fingerprints."""
    rb = small(layout, **kwargs)
    score(rb, layout, KEY)
    return rb


def later_rows(count: int) -> TensorDict:
    """Other rows, one trajectory."""
    generator = torch.Generator().manual_seed(1)
    return make_data(FLAT, 40 + torch.arange(count), [count], generator)


# --- scores of other states ----------------------------------------------------------

STATES = {
    "flat": ["observation", ("next", "observation")],
    "nested": [
        (*where, "state", *key)
        for where in ((), ("next",))
        for key in (("arm",), ("cup", "pos"), ("cup", "pose", "rot"), ("box",))
    ],
}


@given(
    which=st.integers(0, 7),
    row=st.integers(0, 7),
    column=st.integers(0, 7),
    change=st.sampled_from(["next number", "sign", "zero", "any"]),
    number=st.floats(width=32, allow_nan=False, allow_infinity=False),
)
@pytest.mark.parametrize("layout", [FLAT, NESTED], ids=["flat", "nested"])
def test_a_score_is_used_only_for_its_own_state(
    layout: EntityLayout, which: int, row: int, column: int, change: str, number: float
) -> None:
    """Any change of a single value of a state or next state is found."""
    td = scored(layout).storage[:8].clone()
    keys = STATES["flat" if layout is FLAT else "nested"]
    value = td[keys[which % len(keys)]][row].reshape(-1)
    place = column % len(value)
    old = value[place].clone()
    new = {
        "next number": torch.nextafter(old, torch.tensor(math.inf)),
        "sign": -old,
        "zero": torch.zeros(()),
        "any": torch.tensor(number),
    }[change]
    value[place] = new
    transform = CAIACTransform(layout)
    if torch.equal(old.view(torch.int32), new.view(torch.int32)):
        transform(td)
    else:
        with pytest.raises(ValueError, match=f"1 of 8 rows have scores.*{OTHERS}"):
            transform(td)


@pytest.mark.parametrize("by_donors", [False, True])
def test_scores_are_not_used_for_other_entities(by_donors: bool) -> None:
    columns = {name: FLAT.columns[name] for name in reversed(FLAT.names)}
    other = EntityLayout(
        columns, goal=FLAT.goal, achieved=FLAT.achieved, fixed=FLAT.fixed
    )
    rb = scored()
    if by_donors:
        transform = CAIACTransform(other, donors=rb, unscored="keep", check=False)
        assert not transform(rb.storage[:])["caiac", "swapped"].any()
    else:
        with pytest.raises(ValueError, match=r"not those of the entities.*in this or"):
            CAIACTransform(other)(rb.storage[:])
    known = dict.fromkeys(stored(rb)["row"].tolist(), torch.zeros(N))
    with pytest.raises(ValueError, match=r"other settings: .*layout was"):
        score_buffer(rb, KnownScores(other, known), lookahead=0, progress=False)


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.float32, torch.float64, torch.int64]
)
@pytest.mark.parametrize("where", [(), ("next",)])
def test_changes_of_several_values_are_found(
    dtype: torch.dtype, where: tuple[str, ...]
) -> None:
    """Such as the signs of a quaternion, which all change together."""
    generator = torch.Generator().manual_seed(0)
    data = make_data(FLAT, torch.arange(1, 21), [20], generator, dtype)
    rb = ReplayBuffer(storage=LazyTensorStorage(20))
    rb.extend(data)
    score(rb, FLAT, KEY)
    for change in ("sign", "double", "add"):
        # Every set of columns, each in a row of its own.
        sets = torch.arange(1, 256).view(-1, 1) >> torch.arange(8) & 1
        td = rb.storage[:][torch.full((255,), 3)].clone()
        value = td[(*where, "observation")]
        new = {"sign": -value, "double": 2 * value, "add": value + 1}[change]
        td[(*where, "observation")] = torch.where(sets.bool(), new, value)
        transform = CAIACTransform(FLAT, unscored="keep")
        transform(td)
        missed = 255 - transform.unscored_count
        assert missed == 0, f"{missed} changes of kind {change} are not found"


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("with_leaves", [False, True])
def test_rows_written_later_raise_until_they_are_scored(
    storage: type[TensorStorage], with_leaves: bool
) -> None:
    rb = scored(storage=storage)
    rb.append_transform(CAIACTransform(FLAT))
    rb[:]
    write_later(rb, later_rows(3), KEY, with_leaves)
    for _ in range(2):
        with pytest.raises(ValueError, match=f"3 of 20 rows have scores.*{OTHERS}"):
            rb[:]
    known = dict.fromkeys(stored(rb)["row"].tolist(), torch.zeros(N))
    score_buffer(rb, KnownScores(FLAT, known), lookahead=0, progress=False)
    with pytest.raises(ValueError, match="other settings"):
        score_buffer(rb, KnownScores(FLAT, known), smoothing=3, progress=False)
    assert rb[:]["caiac", "swapped"][:, 1:].sum() == 20


def test_rows_that_were_never_scored_raise() -> None:
    rb = scored(size=30)
    rb.append_transform(CAIACTransform(FLAT))
    rb.extend(later_rows(4).exclude("caiac"))
    with pytest.raises(ValueError, match=r"NaN \(not scored\) in 4 of 24 rows"):
        rb[:]
    rb.add(later_rows(5).exclude("caiac")[4])
    with pytest.raises(ValueError, match=r"NaN \(not scored\) in 5 of 25 rows"):
        rb[:]


def test_scores_follow_their_rows() -> None:
    """The place of a row, in the storage or in the batch, says nothing."""
    data = scored().storage[:]
    transform = CAIACTransform(FLAT)
    transform(data[torch.randperm(20)])
    other = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=8)
    other.extend(data.flip(0).exclude("next", "observation").update(data.flip(0)))
    other.append_transform(CAIACTransform(FLAT))
    other.sample()
    # But a score at the row of another one is not its own.
    moved = data.clone()
    for key in (KEY, fingerprint_key(KEY)):
        moved[key] = data[key].roll(1, 0)
    with pytest.raises(ValueError, match=f"20 of 20 rows.*{OTHERS}"):
        transform(moved)


def test_scores_without_fingerprints_are_used_as_they_are() -> None:
    rb = small()
    rb.append_transform(CAIACTransform(FLAT))
    rb.extend(later_rows(3))
    rb[:]
    # A change of other entries does not invalidate a score.
    data = scored().storage[:].clone()
    data["action"] += 1
    data["next", "reward"] += 1
    data["desired_goal"] += 1
    CAIACTransform(FLAT)(data)


def test_scores_in_another_key_have_their_own_fingerprints() -> None:
    rb = small()
    known = dict.fromkeys(range(20), torch.zeros(N))
    key = ("my", "own")
    score_buffer(rb, KnownScores(FLAT, known), key=key, progress=False)
    data = rb.storage[:].clone()
    assert fingerprint_key(key) == ("my", "own_fingerprint")
    transform = CAIACTransform(FLAT, score_key=key)
    assert transform(data)["caiac", "swapped"].any()
    data["observation"][2, 1] += 1
    with pytest.raises(ValueError, match=r"1 of 20 rows.*'my', 'own'.*of other states"):
        transform(data)
    CAIACTransform(FLAT)(data)  # those of the default key have none


def test_transforms_that_change_states_come_after() -> None:
    generator = torch.Generator().manual_seed(0)
    data = make_data(FLAT, torch.arange(10), [10], generator, torch.float64)

    def buffer() -> ReplayBuffer:
        rb = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=4)
        rb.extend(data)
        score(rb, FLAT, KEY)
        return rb

    floats = ["observation", ("next", "observation")]
    rb = buffer()
    rb.append_transform(DoubleToFloat(in_keys=floats))
    rb.append_transform(CAIACTransform(FLAT))
    with pytest.raises(ValueError, match=r"4 of 4 rows.*append this one first"):
        rb.sample()
    rb = buffer()
    rb.append_transform(CAIACTransform(FLAT))
    rb.append_transform(DoubleToFloat(in_keys=floats))
    assert rb.sample()["observation"].dtype == torch.float32


@pytest.mark.parametrize("leaf_kind", ["column", "one row", "wide", "half", "int"])
def test_leaves_of_any_form(leaf_kind: str) -> None:
    """States may be views, of any dtype, in batches of any size."""
    count = 1 if leaf_kind == "one row" else 6
    dtype = {"half": torch.float16, "int": torch.int32}.get(leaf_kind, torch.float64)
    wide = torch.arange(count * 5).view(count, 5).to(dtype)
    cup = wide[:, 2] if leaf_kind in ("column", "one row") else wide[:, 1:4]
    layout = EntityLayout.from_keys({"arm": "arm", "cup": "cup"})
    state = {"arm": wide[:, :1], "cup": cup}
    rb = ReplayBuffer(storage=LazyTensorStorage(count), batch_size=count)
    td = TensorDict(
        {**state, "next": {**state, "done": torch.ones(count, 1, dtype=torch.bool)}},
        [count],
    )
    rb.extend(td)

    class Zeros:
        def __init__(self) -> None:
            self.layout = layout

        def __call__(self, states: TensorDict) -> torch.Tensor:
            return torch.zeros(len(states), 2)

    # The check refuses states that never move.
    score_buffer(rb, Zeros(), trajectory_key=None, check=False, progress=False)
    td[KEY], td[fingerprint_key(KEY)] = (
        rb.storage[:][key] for key in (KEY, fingerprint_key(KEY))
    )
    for part in (td, td.clone(), rb.sample(), td[:1]):
        CAIACTransform(layout)(part)
    td["cup"] = td["cup"] + 1
    with pytest.raises(ValueError, match=f"{count} of {count} rows.*{OTHERS}"):
        CAIACTransform(layout)(td)


# --- rows without valid scores that are kept -----------------------------------------


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("window", [1, 2])
def test_kept_rows_neither_swap_nor_donate(
    window: int, is_late: bool, request: pytest.FixtureRequest
) -> None:
    if is_late:
        request.getfixturevalue("late")
    td = scored().storage[:].clone()
    td[KEY][4, 1] = math.nan  # the cup of row 4 has no score
    td["observation"][9, 6] += 0.5  # row 9 has the score of another state
    td["next", "observation"][8, 6] += 0.5  # so row 8 has, too, and 9 follows it
    transform = CAIACTransform(FLAT, 0.05, 1.0, window=window, unscored="keep")
    transform.set_generator(torch.Generator().manual_seed(0))
    bad = {1: {4: [1], 8: [1, 2], 9: [1, 2]}, 2: {2: [1], 4: [1, 2]}}[window]
    for number in range(1, 21):
        out = transform(td)
        assert out["caiac", "counterfactual"].all()
        assert transform.unscored_count == 3 * number
        swapped = out["caiac", "swapped"].view(-1, window, N)[:, 0]
        for b in range(20 // window):
            wanted = [False, 1 not in bad.get(b, []), 2 not in bad.get(b, [])]
            assert swapped[b].tolist() == wanted
        for n, column in ((1, 5), (2, 7)):
            own = td["observation"][:, column].view(-1, window)
            new = out["observation"][:, column].view(-1, window)
            kept = [b for b in bad if n in bad[b]]
            assert torch.equal(new[kept], own[kept])
            for b in set(range(20 // window)) - set(kept):
                assert not (new[b] == own[kept]).all(-1).any()
    assert transform.no_donor_count.tolist() == [0, 0, 0]


def test_without_any_valid_score_nothing_is_swapped() -> None:
    td = scored().storage[:].clone()
    td["observation"] += 1
    transform = CAIACTransform(FLAT, unscored="keep")
    assert transform.unscored_count == 0
    out = transform(td)
    assert out["caiac", "counterfactual"].sum() == 10
    assert not out["caiac", "swapped"].any()
    assert torch.equal(out["observation"], td["observation"])
    assert transform.unscored_count == 20
    assert transform.share_memory_().unscored_count == 20


@pytest.mark.parametrize("infinity", [math.inf, -math.inf])
def test_infinite_scores_are_not_kept(infinity: float) -> None:
    td = scored().storage[:].clone()
    td[KEY][4, 2] = infinity
    with pytest.raises(ValueError, match=r"is infinite for \['box'\]"):
        CAIACTransform(FLAT, unscored="keep")(td)
    td[KEY][3, 1] = math.nan  # which is kept
    with pytest.raises(ValueError, match=r"is infinite for \['box'\]"):
        CAIACTransform(FLAT, unscored="keep")(td)


@pytest.mark.usefixtures("late")
@pytest.mark.parametrize("infinity", [math.inf, -math.inf])
def test_infinite_scores_are_told_late(infinity: float) -> None:
    good = scored().storage[:]
    bad = good.clone()
    bad[KEY][4, 2] = infinity
    bad[KEY][5, 2] = math.nan
    transform = CAIACTransform(FLAT, unscored="keep")
    transform(bad)
    with pytest.raises(ValueError, match=r"\('caiac', 'score'\).* were invalid"):
        transform(good)
    transform(good)


# --- windows -------------------------------------------------------------------------


def flat_rows(lengths: list[int], noise: float = 0.0) -> TensorDict:
    """Trajectories of steps from 0.8 to 1; states may be recorded twice, with noise."""
    generator = torch.Generator().manual_seed(0)
    walks = [
        torch.rand(n + 1, 4, generator=generator).mul(0.2).add(0.8).cumsum(0)
        for n in lengths
    ]
    walks = [walk + 100 * i for i, walk in enumerate(walks)]
    now, after = torch.cat([w[:-1] for w in walks]), torch.cat([w[1:] for w in walks])
    now = now + noise * torch.rand(now.shape, generator=generator)
    done = torch.zeros(len(now), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    ids = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    return TensorDict(
        {
            "observation": now,
            "episode": ids,
            "next": {"observation": after, "done": done},
            KEY: torch.zeros(len(now), 2),
        },
        [len(now)],
    )


WALK = EntityLayout({"arm": [0, 1], "cup": [2, 3]})
FAULTS = "do not follow each other|crosses a trajectory's end"


@given(
    starts=st.lists(st.integers(0, 9), min_size=1, max_size=4),
    window=st.integers(2, 4),
    fault=st.sampled_from(
        ["none", "other row", "repeated row", "reversed", "other trajectory"]
    ),
    place=st.integers(0, 100),
    noise=st.sampled_from([0.0, 0.2]),
    ids=st.sampled_from(["episode", "wide", "collector", "flags alone"]),
    column_major=st.sets(st.sampled_from(["observation", ("next", "observation")])),
)
@pytest.mark.parametrize("nested", [False, True])
def test_windows_are_successive_rows(
    starts: list[int],
    window: int,
    fault: str,
    place: int,
    noise: float,
    ids: str,
    column_major: set[NestedKey],
    nested: bool,
) -> None:
    td = flat_rows([13, 13], noise)
    if nested:
        for where in (td, td["next"]):
            state = where.pop("observation")
            where["arm"] = state[:, 0]
            where["cup"] = TensorDict(
                {"x": state[:, 1:2], "y": state[:, 2:].reshape(26, 2, 1)}, [26]
            )
    if ids == "wide":
        td["episode"] = td["episode"].unsqueeze(-1)
    elif ids != "episode":
        td[("collector", "traj_ids")] = td.pop("episode")
        if ids == "flags alone":
            td = td.exclude("collector")
    windows = [list(range(s, s + window)) for s in starts]
    wrong = windows[place % len(windows)]
    step = 1 + place % (window - 1)
    if fault == "other row":
        wrong[step] = (wrong[step] + 1 + place % 12) % 13
    elif fault == "repeated row":
        wrong[step] = wrong[step - 1]
    elif fault == "reversed":
        wrong.reverse()
    elif fault == "other trajectory":
        wrong[step:] = [row + 13 for row in wrong[step:]]
    batch = td[torch.tensor(windows).flatten()]
    for key in () if nested else column_major:
        batch[key] = batch[key].t().contiguous().t()
    layout = EntityLayout.from_keys({"arm": "arm", "cup": "cup"}) if nested else WALK
    transform = CAIACTransform(layout, window=window)
    if fault == "none":
        assert transform(batch)["caiac", "counterfactual"].any() == (len(starts) > 1)
    else:
        with pytest.raises(ValueError, match=FAULTS):
            transform(batch)


@pytest.mark.usefixtures("late")
@pytest.mark.parametrize(
    ("rows", "is_right"),
    [
        ([0, 1, 2, 3, 4, 5], True),
        ([0, 1, 2, 3, 4, 4], False),
        ([0, 1, 2, 2, 1, 0], False),
        ([5, 6, 7, 11, 12, 13], False),
    ],
)
def test_windows_that_are_told_late(rows: list[int], is_right: bool) -> None:
    td = flat_rows([13, 13])
    transform = CAIACTransform(WALK, window=3)
    transform(td[rows])
    if is_right:
        transform(td[:6])
    else:
        with pytest.raises(ValueError, match=r"\['the windows'\] were invalid"):
            transform(td[:6])
        transform(td[rows])
        with pytest.raises(ValueError, match=FAULTS):
            transform(td[rows])


def test_things_that_rest_are_no_repeated_rows() -> None:
    td = flat_rows([12])
    td["observation"][:] = 1.0
    td["next", "observation"][:] = 1.0
    CAIACTransform(WALK, window=3)(td)


def test_repeated_rows_are_refused_even_if_they_are_slow() -> None:
    td = flat_rows([12])
    steps = torch.tensor([0.01] * 6 + [1.0] * 6).view(12, 1).expand(12, 4)
    after = steps.cumsum(0)
    td["observation"], td["next", "observation"] = after - steps, after
    transform = CAIACTransform(WALK, window=2)
    transform(td[[0, 1, 8, 9]])
    with pytest.raises(ValueError, match="window 1 of 2 rows do not follow each other"):
        transform(td[[8, 9, 2, 2]])


def test_padding_of_a_sampler_is_refused() -> None:
    rb = ReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=SliceSampler(
            slice_len=5, traj_key="episode", strict_length=False, pad_output=True
        ),
        batch_size=20,
    )
    rb.extend(flat_rows([3, 3, 3]))
    rb.append_transform(CAIACTransform(WALK, window=5))
    with pytest.raises(ValueError, match=FAULTS):
        rb.sample()


def test_ids_of_collectors_are_found() -> None:
    td = flat_rows([6, 6])
    td["next", "observation"][5] = td["observation"][6]  # states go on, ids do not
    td["collector", "traj_ids"] = td.pop("episode")
    td = td.exclude(("next", "done"))
    CAIACTransform(WALK, window=3)(td)
    with pytest.raises(ValueError, match="window 0 of 4 rows crosses a trajectory's"):
        CAIACTransform(WALK, window=4)(td[4:8])


def test_end_flags_end_a_window_even_with_ids() -> None:
    td = flat_rows([8])
    td["next", "done"][7] = False
    CAIACTransform(WALK, window=4)(td)
    td["next", "done"][1] = True
    with pytest.raises(ValueError, match=r"window 0 .*TransformKeys\(done=None\)"):
        CAIACTransform(WALK, window=4)(td)
    CAIACTransform(WALK, window=4, keys=TransformKeys(done=None))(td)


@pytest.mark.parametrize(
    "keys",
    [
        TransformKeys(),
        TransformKeys(trajectory=None),
        TransformKeys(done=None),
        TransformKeys(trajectory=None, done=None),
    ],
)
def test_windows_need_ids_or_end_flags(keys: TransformKeys) -> None:
    td = flat_rows([8]).exclude("episode", ("next", "done"))
    message = "the batch lacks trajectory ids and end flags.*TransformKeys"
    with pytest.raises(KeyError, match=message):
        CAIACTransform(WALK, window=2, keys=keys)(td)
    CAIACTransform(WALK, keys=keys)(td)  # single rows need none


def test_windows_of_steps_that_were_left_out() -> None:
    td = flat_rows([8])
    td["steps_to_next_obs"] = torch.ones(8, 1, dtype=torch.int64)
    message = r"'steps_to_next_obs'.*without MultiStepTransform"
    with pytest.raises(ValueError, match=message):
        CAIACTransform(WALK, window=2)(td)
    CAIACTransform(WALK)(td)


def test_without_checks_rows_are_taken_as_windows() -> None:
    td = flat_rows([8])[[0, 0, 5, 2]]
    CAIACTransform(WALK, window=2, check=False)(td)


# --- states and scores that are not finite -------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_observations_that_are_not_finite(value: float) -> None:
    for layout, key in (
        (FLAT, "observation"),
        (FLAT, ("next", "observation")),
        (NESTED, ("state", "cup", "pos")),
        (NESTED, ("next", "state", "cup", "pos")),
    ):
        td = small(layout, batch=4).sample().clone()
        td[key][0, 2] = value
        with pytest.raises(
            ValueError, match=r"is not finite.* 1 values, first in row 0"
        ):
            CAIACTransform(layout, counterfactual_ratio=0.0)(td)
        CAIACTransform(layout, check=False)(td)


def test_large_finite_values_pass() -> None:
    td = small(batch=4).sample().clone()
    td["observation"] = torch.full((4, 8), 3e38)
    assert CAIACTransform(FLAT)(td)["observation"].isfinite().all()


@pytest.mark.usefixtures("late")
@pytest.mark.parametrize("key", ["observation", ("next", "observation")])
def test_a_late_error_names_the_leaf(key: Any) -> None:
    transform = CAIACTransform(FLAT)
    good = small().storage[:8]
    bad = good.clone()
    bad[key][5, 3] = math.inf
    transform(good)
    transform(bad)
    with pytest.raises(ValueError, match=r"observation.* in an earlier batch"):
        transform(good)
    transform(good)  # what was told is over
    transform(good)
    transform(bad)
    with pytest.raises(ValueError, match=r"observation.*first in row 5 of the batch"):
        transform(bad)  # wrong as well, and so the rows are known


@pytest.mark.usefixtures("late")
def test_late_errors_of_scores() -> None:
    transform = CAIACTransform(FLAT)
    good = scored().storage[:8]
    unscored = good.clone()
    unscored[KEY][2] = math.nan
    transform(unscored)
    with pytest.raises(ValueError, match=r"not scored\) in 1 of 8 rows"):
        transform(unscored)
    other = good.clone()
    other["observation"][3, 1] += 1
    transform(good)
    transform(other)
    with pytest.raises(ValueError, match=r"\['fingerprints'\] were invalid in an earl"):
        transform(good)
    transform(good)


@pytest.mark.parametrize("kind", ["flat", "nested"])
@pytest.mark.parametrize("where", ["memory", "memmap"])
def test_scores_of_a_layout_that_was_corrected_are_refused(kind, where, tmp_path):
    columns = {"hand": [0, 1], "cup": [2, 3], "jug": [4, 5]}
    exchanged = {**columns, "cup": columns["jug"], "jug": columns["cup"]}
    fewer = {**columns, "cup": columns["cup"][:1]}  # such as positions alone

    def layout(named):
        if kind == "flat":
            return EntityLayout(named, fixed=["hand"])
        keys = {name: ("observation", f"at{c[0]}") for name, c in named.items()}
        return EntityLayout.from_keys(keys, fixed=["hand"])

    state = torch.rand(64, 6)
    data = TensorDict({"episode": torch.arange(64)}, [64])
    for place, value in (((), state), (("next",), state + 0.1)):
        if kind == "flat":
            data[(*place, "observation")] = value
        else:
            for c in columns.values():
                data[(*place, "observation", f"at{c[0]}")] = value[:, c].clone()
    data["next", "done"] = torch.ones(64, 1, dtype=torch.bool)

    def scored(named):
        rows = data.clone()
        if where == "memmap":
            rows = rows.memmap(tmp_path / str(len(list(tmp_path.iterdir()))))
        rb = offline_buffer(rows, batch_size=16)
        estimator = MotionInfluence(layout(named), 1.0)
        score_buffer(rb, estimator, progress=False, check=False)
        return rb

    for named in (columns, fewer):
        rb = scored(named)
        rb.append_transform(CAIACTransform(layout(columns)))
        rb.sample()
    right = layout(columns)
    told = pytest.raises(ValueError, match="'jug', but the layout here says 'cup'")
    rb = scored(exchanged)
    rb.append_transform(CAIACTransform(right))
    with told:
        rb.sample()
    rb = scored(columns)
    rb.append_transform(CAIACTransform(right, donors=scored(exchanged)))
    with told:
        rb.sample()
    both = ReplayBufferEnsemble(scored(columns), scored(exchanged), batch_size=16)
    both.append_transform(CAIACTransform(right))
    with told:
        both.sample()


COLUMNS = {"hand": [0], "cup": [1], "jug": [2]}
EXCHANGED = {"hand": [0], "cup": [2], "jug": [1]}


def scored_by(named):
    """A buffer of 64 rows, scored by a layout with these columns."""
    torch.manual_seed(0)
    state = torch.rand(64, 3)
    data = {"observation": state, "next": {"observation": state + 0.1}}
    data["next"]["done"] = torch.ones(64, 1, dtype=torch.bool)
    data["episode"] = torch.arange(64)
    rb = ReplayBuffer(storage=LazyTensorStorage(64), batch_size=16)
    rb.extend(TensorDict(data, [64]))
    estimator = MotionInfluence(EntityLayout(named, fixed=["hand"]), 1.0)
    score_buffer(rb, estimator, progress=False, check=False)
    return rb


def test_a_member_without_rows_is_compared_when_it_has_some():
    empty = ReplayBuffer(storage=LazyTensorStorage(64), batch_size=8)
    both = ReplayBufferEnsemble(scored_by(COLUMNS), empty, batch_size=16, p=[1.0, 0.0])
    both.append_transform(CAIACTransform(EntityLayout(COLUMNS, fixed=["hand"])))
    assert both.sample()["caiac", "swapped"].any()
    empty.extend(scored_by(EXCHANGED).storage[:])  # without a record
    estimator = MotionInfluence(EntityLayout(EXCHANGED, fixed=["hand"]), 1.0)
    score_buffer(empty, estimator, progress=False, check=False, overwrite=True)
    with pytest.raises(ValueError, match="'jug', but the layout here says 'cup'"):
        both.sample()


def test_records_of_rows_that_were_replaced_say_nothing():
    rb, right = scored_by(EXCHANGED), scored_by(COLUMNS).storage[:].clone()
    late = scored_by(EXCHANGED)
    late.extend(right[:63])  # one row is left
    late.append_transform(CAIACTransform(EntityLayout(COLUMNS, fixed=["hand"])))
    with pytest.raises(ValueError, match="'jug', but the layout here says 'cup'"):
        late.sample()
    rb.empty()
    rb.extend(right)
    rb.append_transform(CAIACTransform(EntityLayout(COLUMNS, fixed=["hand"])))
    assert rb.sample()["caiac", "swapped"].any()
