"""Suggested thresholds of whole datasets."""

from __future__ import annotations

import json
import sys
import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer, suggest_thresholds

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1], "lid": [2]},
    fixed=["arm"],
    positions={"cup": [1], "lid": [2]},
    variance_floor=0.01,
)


def world(count: int = 1000, seed: int = 0) -> TensorDict:
    """A cup that is pushed in a fifth of the rows, and a lid that rests."""
    generator = torch.Generator().manual_seed(seed)
    number = torch.arange(count)
    pushed = number % 20 >= 16
    noise = 0.3 * torch.randn(count, 2, generator=generator)
    state = torch.rand(count, 3, generator=generator)
    after = state.clone()
    after[pushed, 1] += 0.2
    logs = torch.stack([torch.where(pushed, -0.5, -2.5), torch.full((count,), -1.0)], 1)
    score = torch.cat([torch.ones(count, 1), 10 ** (logs + noise)], 1)
    return TensorDict(
        {
            "observation": state,
            "next": {
                "observation": after,
                "done": (number % 100 == 99).unsqueeze(-1),
            },
            "episode": number // 100,
            "pushed": pushed,
            "caiac": {"score": score},
        },
        [count],
    )


def test_what_is_suggested() -> None:
    data = world()
    found = suggest_thresholds(data, LAYOUT)
    assert found.confidence == {
        "cup": "two clear modes",
        "lid": "one mode: never influenced",
    }
    score = data["caiac", "score"]
    above = score[:, 1] > found.thresholds["cup"]
    assert (above == data["pushed"]).double().mean() > 0.99
    assert found.thresholds["lid"] > score[:, 2].max()
    assert found.free["cup"] == pytest.approx((~above).double().mean().item())
    assert found.free["lid"] == 1.0 and found.rows == 1000
    out = CAIACTransform(LAYOUT, found.thresholds, 1.0)(data)
    assert torch.equal(out["caiac", "swapped"][:, 1], ~above)


def test_without_positions_modes_that_are_near_are_unclear_and_never_swapped() -> None:
    data = world()
    layout = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])
    data["caiac", "score"][:, 1] = data["caiac", "score"][:, 2]
    found = suggest_thresholds(data, layout)
    assert set(found.confidence.values()) == {"unclear"}
    assert all("positions are unknown" in reason for reason in found.reasons.values())
    assert found.free == {"cup": 0.0, "lid": 0.0}
    assert found.splits["cup"] > 0  # which is not taken
    swapped = CAIACTransform(layout, found.thresholds, 1.0)(data)["caiac", "swapped"]
    assert not swapped.any()


def test_zeros_without_positions_are_unclear_unless_the_entity_rests() -> None:
    data = world()
    data["caiac", "score"][:] = 0.0
    data["next", "observation"][:, 2] += 0.005  # the noise of the lid
    columns = {"arm": [0], "cup": [1], "lid": [2]}
    unknown = EntityLayout(columns, fixed=["arm"])
    found = suggest_thresholds(data, unknown)
    assert found.confidence == {"cup": "unclear", "lid": "unclear"}
    assert "its state changes" in found.reasons["cup"] and found.free["cup"] == 0
    found = suggest_thresholds(
        data, EntityLayout(columns, fixed=["arm"], variance_floor=0.01)
    )
    assert found.confidence == {
        "cup": "unclear",
        "lid": "one mode: never influenced",
    }
    found = suggest_thresholds(data.exclude("next"), unknown)
    assert set(found.confidence.values()) == {"unclear"}
    assert "are missing" in found.reasons["lid"]


def test_never_is_below_negative_scores_too() -> None:
    data = world()
    layout = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])
    data["caiac", "score"] -= 0.2
    found = suggest_thresholds(data, layout)
    assert found.free == {"cup": 0.0, "lid": 0.0}


def test_the_lookahead_of_score_buffer_is_known() -> None:
    data = world().exclude("caiac")

    class Near:
        """High where the cup is about to be pushed."""

        layout = LAYOUT

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return torch.stack(
                [
                    torch.ones(len(td)),
                    torch.where(td["observation"][:, 0] > 0.5, 1.0, 1e-3),
                    torch.full((len(td),), 1e-3),
                ],
                -1,
            )

    # pushed where the arm is in its upper half
    data["observation"][:, 0] = torch.where(data["pushed"], 0.9, 0.1)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), batch_size=1)
    rb.extend(data)
    with pytest.warns(UserWarning, match="'lid' .* would be swapped in every row"):
        score_buffer(rb, Near(), lookahead=15, check=False, progress=False)
    found = suggest_thresholds(rb, LAYOUT)
    assert found.confidence["cup"] == "two clear modes"
    assert "with probability 1.000" in found.reasons["cup"]
    # Rows that rest before a push are influenced within 15 states.
    blind = suggest_thresholds(rb, LAYOUT, lookahead=0)
    assert "with probability 1.000" not in blind.reasons["cup"]
    rb.append_transform(CAIACTransform(LAYOUT))
    assert suggest_thresholds(rb) == found  # by the layout of the transform
    assert suggest_thresholds(rb.storage, LAYOUT) == found


def test_in_a_folder(tmp_path) -> None:
    data = world().set("action", torch.zeros(1000, 2))
    data.memmap(tmp_path / "rows")
    loaded = load_transitions(tmp_path / "rows")
    expected = suggest_thresholds(data, LAYOUT)
    assert suggest_thresholds(loaded, LAYOUT) == expected
    assert suggest_thresholds(offline_buffer(loaded, 1), LAYOUT) == expected


def test_large_data_are_sampled_and_the_same_twice() -> None:
    data = world(60_000)
    one, two = (suggest_thresholds(data, LAYOUT, max_rows=5000) for _ in range(2))
    assert one == two and one.rows == 5000
    every = suggest_thresholds(data, LAYOUT)
    assert one.confidence == every.confidence
    above = data["caiac", "score"][:, 1] > one.thresholds["cup"]
    assert (above == data["pushed"]).double().mean() > 0.99
    # the shares are those of all rows
    assert one.free["cup"] == pytest.approx((~above).double().mean().item())
    assert one.free["lid"] > 0.9999


def test_a_rare_high_score_of_what_never_moves_is_not_free() -> None:
    data = world(60_000)
    data["caiac", "score"][30_123, 2] = 1e6
    found = suggest_thresholds(data, LAYOUT, max_rows=5000)
    assert found.confidence["lid"] == "one mode: never influenced"
    assert found.thresholds["lid"] < 100 and 0.9999 < found.free["lid"] < 1


def test_rows_without_scores_are_left_out() -> None:
    data = world()
    data["caiac", "score"][::2] = float("nan")
    data["caiac", "score"][1::100] = 1e30  # whose next states are not stored
    found = suggest_thresholds(data, LAYOUT)
    assert found.rows == 500
    assert found.confidence["cup"] == "two clear modes"
    assert found.thresholds["lid"] < 1e3


def test_twenty_rows_are_unclear() -> None:
    found = suggest_thresholds(world(20), LAYOUT)
    assert set(found.confidence.values()) == {"unclear"}
    assert "only 20 rows" in found.reasons["cup"]


def test_scores_of_other_states_are_left_out() -> None:
    class Column:
        layout = LAYOUT

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return td["observation"].abs()

    rb = ReplayBuffer(storage=LazyTensorStorage(1000), batch_size=1)
    rb.extend(world().exclude("caiac"))
    score_buffer(rb, Column(), check=False, progress=False, lookahead=0)
    rb.storage[:]["observation"][:300] += 1.0
    assert suggest_thresholds(rb, LAYOUT).rows == 700
    rb.storage[:]["observation"][:] += 1.0
    with pytest.raises(ValueError, match="none of 1000 rows has a score"):
        suggest_thresholds(rb, LAYOUT)


def test_a_second_score_must_agree() -> None:
    data = world()
    data["same"] = data["caiac", "score"] * 3
    data["other"] = data["caiac", "score"].roll(2, 0)  # late by two rows
    data["noise"] = torch.rand(1000, 3)
    alike = suggest_thresholds(data, LAYOUT, second_key="same")
    assert alike.confidence["cup"] == "two clear modes"
    assert "agree about 100.0 %" in alike.reasons["cup"]
    for key in ("other", "noise"):
        found = suggest_thresholds(data, LAYOUT, second_key=key)
        assert found.confidence["cup"] == "unclear" and "second" in found.reasons["cup"]
        assert found.free["cup"] == 0.0


def test_as_text_and_json() -> None:
    found = suggest_thresholds(world(), LAYOUT)
    text = str(found)
    assert "two clear modes" in text and "it never moves in 1000 rows" in text
    again = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert again["thresholds"] == found.thresholds and again["rows"] == 1000
    data = world()
    data["caiac", "score"].fill_(0.3)
    equal = suggest_thresholds(data, LAYOUT)
    assert json.loads(json.dumps(equal.to_dict(), allow_nan=False))["splits"] == {}


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_figure(tmp_path, suffix: str) -> None:
    data = world()
    data["caiac", "score"][:5, 2] = 0.0
    found = suggest_thresholds(data, LAYOUT)
    figure = found.figure()
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["cup: two clear modes", "lid: one mode: never influenced"]
    cup = figure.axes[0]
    lines = [line.get_xdata()[0] for line in cup.lines]
    assert lines == [found.thresholds["cup"]]
    heights = sum(patch.get_height() for patch in cup.patches)
    assert heights == 1000  # every row in one bar
    path = found.plot(tmp_path / f"scores{suffix}")
    start = path.read_bytes()[:100]
    assert start.startswith(b"\x89PNG" if suffix == ".png" else b"<?xml")


def test_the_figure_needs_matplotlib(monkeypatch) -> None:
    found = suggest_thresholds(world(), LAYOUT)
    for name in [name for name in sys.modules if name.startswith("matplotlib")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"torchrl-caiac\[report\]"):
        found.figure()


def test_wrong_input() -> None:
    data = world()
    with pytest.raises(ValueError, match="pass layout"):
        suggest_thresholds(data)
    with pytest.raises(TypeError, match="must be an EntityLayout, got dict"):
        suggest_thresholds(data, {})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="got list"):
        suggest_thresholds([data], LAYOUT)  # type: ignore[arg-type]
    with pytest.raises(KeyError, match="no scores in 'mine'"):
        suggest_thresholds(data, LAYOUT, score_key="mine")
    for shape in ((1000, 4), (1000,), (1000, 4, 3)):
        data["wide"] = torch.zeros(shape)
        with pytest.raises(ValueError, match=r"expected \[T, 3\]"):
            suggest_thresholds(data, LAYOUT, score_key="wide")
    fixed = EntityLayout({"arm": [0, 1, 2]}, fixed=["arm"])
    with pytest.raises(ValueError, match="all entities of the layout are fixed"):
        suggest_thresholds(data, fixed)
    data["caiac", "score"][7, 1] = float("inf")
    with pytest.raises(ValueError, match="infinite"):
        suggest_thresholds(data, LAYOUT)
    data["caiac", "score"].fill_(float("nan"))
    with pytest.raises(ValueError, match="none of 1000 rows"):
        suggest_thresholds(data, LAYOUT)


# --- what score_buffer says ----------------------------------------------------------


def scored(values: list[float], count: int = 200) -> None:
    class Given:
        layout = LAYOUT

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return torch.tensor(values).expand(len(td), 3) * (1 + td["observation"])

    rb = ReplayBuffer(storage=LazyTensorStorage(count), batch_size=1)
    rb.extend(world(count).exclude("caiac"))
    score_buffer(rb, Given(), check=False, progress=False)
    score_buffer(rb, Given(), check=False, progress=False)  # nothing to do or to say


def test_score_buffer_names_entities_on_one_side() -> None:
    with pytest.warns(UserWarning) as warned:
        scored([0.0, 0.3, 0.01])
    (message,) = {str(w.message) for w in warned}
    assert len(warned) == 1
    assert "nothing of 'cup' (its scores are 0.3" in message
    assert "'lid' (its scores are 0.01" in message and "every row" in message
    assert "arm" not in message and "suggest_thresholds" in message


@pytest.mark.parametrize(
    ("values", "count"), [([9.0, 0.04, 0.03], 200), ([9.0] * 3, 99)]
)
def test_score_buffer_says_nothing(values: list[float], count: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scored(values, count)
