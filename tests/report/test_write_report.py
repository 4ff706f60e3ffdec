from __future__ import annotations

import html
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.report.test_svg import HOSTILE
from tests.report.walks import LAYOUT, scored_dataset, transitions
from torchrl_caiac import EntityLayout, check_dataset
from torchrl_caiac.data import offline_buffer, write_transitions
from torchrl_caiac.influence import MotionInfluence, score_buffer, suggest_thresholds
from torchrl_caiac.report import write_report
from torchrl_caiac.report.page import share_text
from torchrl_caiac.scored import ScoredDataset, write_scored

VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Checks that elements are closed, and collects attributes and texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.texts: list[str] = []
        self.headings: list[int] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.attributes += [(tag, name, value) for name, value in attrs]
        if re.fullmatch(r"h\d", tag):
            self.headings.append(int(tag[1]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        self.attributes += [(tag, name, value) for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.texts).split())


def check_page(text: str) -> Page:
    """What holds for every report."""
    page = Page(text)
    assert len(text.encode()) < 5e6
    assert text.startswith('<!DOCTYPE html>\n<html lang="en">')
    # Nothing is loaded, and nothing runs.
    for tag, name, value in page.attributes:
        assert not name.startswith("on"), (tag, name)
        if name in ("src", "href"):
            assert re.match(r"#|data:", value or ""), (tag, value)
    assert not re.search(r"<(script|iframe|object|embed)|@import|https?:", text)
    assert set(re.findall(r"url\(([^)]{0,9})", text)) <= {
        found for found in re.findall(r"url\((#[^)]{0,8})", text)
    }
    # Headings without gaps, one title, no id twice, alternatives for all pictures.
    assert page.headings[0] == 1 and page.headings.count(1) == 1
    assert all(
        b - a <= 1 for a, b in zip(page.headings, page.headings[1:], strict=False)
    )
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    targets = {
        (value or "")[1:]
        for _, name, value in page.attributes
        if name == "href" and (value or "").startswith("#")
    }
    assert targets <= set(ids)
    assert text.count("<svg ") == text.count('role="img" aria-label="')
    assert text.count("<img ") == len(
        [
            1
            for tag, name, value in page.attributes
            if (tag, name) == ("img", "alt") and value
        ]
    )
    return page


def report(scored: ScoredDataset, folder: Path, **options: Any) -> str:
    few = {"samples": 512, "trajectories": 1, "examples": 1, "pairs": 1}
    options = {**few, **options}
    file = write_report(scored, folder / "report.html", **options)
    return file.read_text(encoding="utf-8")


def table(text: str, attribute: str) -> dict[str, list[float]]:
    """The numbers in the rows of a table, by the row's heading."""
    rows = re.findall(rf'<tr role="row" {attribute}="\d+">(.*?)</tr>', text, re.S)
    return {
        re.findall(r"<th[^>]*>([^<]+)</th>", row)[0]: [
            float(value) for value in re.findall(r'<data value="([^"]+)"', row)
        ]
        for row in rows
    }


def numbers(text: str, attribute: str) -> list[list[float]]:
    """The numbers in the rows of a table."""
    return list(table(text, attribute).values())


class TestContents:
    def test_numbers_against_loops(self, walks, tmp_path) -> None:
        text = report(walks, tmp_path, windows=(1, 10))
        page = check_page(text)
        scores = walks.data["caiac", "score"].numpy()
        shown = numbers(text, "data-entity")
        assert len(shown) == 2
        for entity, row in zip((1, 2), shown, strict=True):
            free = scores[:, entity].reshape(20, 40) <= np.float32(0.5)
            windows = [
                free[episode, start : start + 10].all()
                for episode in range(20)
                for start in range(31)
            ]
            expected = [free.mean(), free.mean(), np.mean(windows)]
            assert row == pytest.approx(expected)
        assert "800 transitions" in page.text and "20 trajectories" in page.text
        assert "800 transitions in 20 trajectories of 40 steps each" in page.text
        for pair in numbers(text, "data-pair"):
            assert 0 < pair[0] < pair[1] <= 1
        for said in ("θ = 0.5", "two clear modes: a wide gap", "motion.tolerance"):
            assert said in page.text

    def test_coverage_counts_what_the_transform_makes(self, tmp_path) -> None:
        # Two objects on lines, always at the same place: a diagonal of combinations.
        data = transitions(4, 50, 3)
        place = torch.arange(200.0) % 50
        for td in (data, data["next"]):
            td["observation"][:, 1] = place
            td["observation"][:, 2] = place
        layout = EntityLayout(
            {"arm": [0], "cup": [1], "box": [2]}, fixed=["arm"], positions={"cup": [1]}
        )
        scored = scored_dataset(data, layout)
        data["caiac", "score"][:] = 0.0
        text = report(scored, tmp_path, samples=20_480)
        before, after = table(text, "data-pair")["cup and box"]
        # 20 of 400 cells; the swaps combine all of them.
        assert before == pytest.approx(20 / 400) and after == 1.0
        data["caiac", "score"][:] = 1.0  # influenced throughout: nothing is swapped
        text = report(scored, tmp_path, overwrite=True)
        assert table(text, "data-pair")["cup and box"] == [before, before]
        assert "No sample was changed by a swap" in text
        assert "cup is never swapped: its score is above" in text

    def test_trajectories_have_the_ids_of_the_data(self, tmp_path) -> None:
        data = transitions(2, 40, 11)
        data["episode"] = data["episode"] * 5 + 70
        text = report(scored_dataset(data, LAYOUT), tmp_path)
        found = set(re.findall(r"<h3>Trajectory (\d+)", text))
        assert found == {"70", "75"}
        assert set(re.findall(r"scores along trajectory (\d+)", text)) & found

    def test_columns_are_not_called_positions(self, tmp_path) -> None:
        columns = {"arm": [0, 1, 2], "cup": [3, 4, 5], "box": [7, 8, 9]}
        layout = EntityLayout(columns, fixed=["arm"])
        scored = scored_dataset(transitions(5, 20, 11), layout)
        page = check_page(report(scored, tmp_path))
        assert "names no positions of arm, cup, box. Below" in page.text
        assert "New combinations of columns" in page.text
        assert "of the possible combinations of places" not in page.text
        assert "Their positions" not in page.text
        # The number at the top is that of the pairs whose positions are known.
        layout = EntityLayout(
            columns, fixed=["arm"], positions={"arm": [0, 1, 2], "cup": [3, 4, 5]}
        )
        scored = scored_dataset(transitions(5, 20, 11), layout)
        text = report(scored, tmp_path, overwrite=True)
        page = check_page(text)
        assert "names no positions of box. Below" in page.text
        before, after = table(text, "data-pair")["arm and cup"]
        shares = " → ".join(" ".join(share_text(x).split()) for x in (before, after))
        assert f"{shares} of the possible combinations of places" in page.text

    def test_problems(self, tmp_path) -> None:
        data = transitions(5, 20, 11)
        data["next", "observation"][7] += 3.0  # not what the following row has
        scored = scored_dataset(
            data,
            LAYOUT,
            thresholds={"cup": 2.0, "box": -1.0},
            confidence={"cup": "one mode: never influenced", "box": "unclear"},
            reasons={"cup": "one mode", "box": "the modes overlap"},
            warnings=("the actions are all from one expert",),
        )
        page = check_page(report(scored, tmp_path))
        assert "Error:" in page.text  # the row that does not follow
        assert "Warning: the actions are all from one expert." in page.text
        assert "Warning: No clear threshold was found for box: the modes" in page.text
        assert "Effect: it is never swapped." in page.text
        assert "Note: cup: never influenced, so swaps are" in page.text
        assert page.text.index("Error:") < page.text.index("Warning:")
        assert page.text.index("Warning:") < page.text.index("Note:")

    def test_nothing_is_said_twice(self, tmp_path) -> None:
        data = transitions(10, 40, 11)
        data["action"][:] = 0.5
        (finding,) = check_dataset(data, LAYOUT, variance_floor=0.01).findings
        scored = scored_dataset(
            data, LAYOUT, warnings=(f"{finding.message} (to do: think)", "Other.")
        )
        page = check_page(report(scored, tmp_path))
        assert page.text.count(finding.message) == 1
        assert finding.remedy in page.text and "Warning: Other." in page.text

    def test_no_problems(self, walks, tmp_path) -> None:
        page = check_page(report(walks, tmp_path))
        assert "No problem was found." in page.text
        assert "800 of 800 transitions were checked." in page.text

    def test_code_runs(self, tmp_path) -> None:
        data = write_transitions(transitions(10, 30, 11), tmp_path / "it's" / "data")
        motion = MotionInfluence(LAYOUT, tolerance=0.8)
        score_buffer(offline_buffer(data), motion, progress=False)
        found = suggest_thresholds(data, LAYOUT)
        scored = write_scored(
            tmp_path / "it's", LAYOUT, found, estimator="motion", settings={}
        )
        text = report(scored, tmp_path)
        check_page(text)
        (code,) = re.findall(r"<pre[^>]*><code>(.*?)</code>", text, re.S)
        names: dict[str, Any] = {}
        exec(html.unescape(code), names)
        assert names["batch"]["caiac", "counterfactual"].sum() == 128
        free = names["scored"].is_free
        assert names["batch"]["caiac", "swapped"].any() == free.any()

    def test_title_date_and_unequal_lengths(self, tmp_path) -> None:
        data = TensorDict.cat([transitions(3, n, 11) for n in (5, 12)])
        data["episode"] = torch.arange(6).repeat_interleave(
            torch.tensor([5, 5, 5, 12, 12, 12])
        )
        scored = scored_dataset(data, LAYOUT)
        text = report(scored, tmp_path, title="A & B", date="1 May")
        page = check_page(text)
        assert "<title>A &amp; B</title>" in text and "1 May" in page.text
        assert "of 5 to 12 steps (median 8.5)" in page.text
        assert "no trajectory is as long" in page.text  # windows of 20
        assert "Lengths of the trajectories" in page.text

    def test_coverage_of_actions(self, walks, tmp_path) -> None:
        scored = scored_dataset(
            walks.data.clone(), LAYOUT, coverage={"share": 0.25, "by": {"cup": 0.5}}
        )
        page = check_page(report(scored, tmp_path))
        assert "How much of the action space" in page.text and "by.cup" in page.text


class TestDatasets:
    def test_hostile_names(self, tmp_path) -> None:
        names = [name for name in HOSTILE if name.strip()]
        columns = {name: [i] for i, name in enumerate(names)}
        data = transitions(6, 12, len(names))
        key = '<b onclick="x">'
        data = data.rename_key_("observation", key)
        data["next"].rename_key_("observation", key)
        scored = scored_dataset(
            data,
            EntityLayout(columns, observation_key=key, fixed=names[:1]),
            path=Path("</title><script>"),
            estimator=names[0],
            settings={names[0]: names[1]},
            source={"file": names[2], "more": {names[0]: [names[1]]}},
            reasons=dict.fromkeys(names[1:], names[0]),
            warnings=(names[0],),
        )
        page = check_page(report(scored, tmp_path))
        assert names[0] in page.text and key in page.text
        assert "$\\frac{a}{" in page.text and "&amp;" in page.text

    def test_one_entity(self, tmp_path) -> None:
        data = transitions(10, 5, 2)
        scored = scored_dataset(data, EntityLayout({"cup": [0, 1]}))
        page = check_page(report(scored, tmp_path))
        assert "no combinations to count" in page.text
        assert "not given in the layout" in page.text

    def test_one_trajectory_of_one_row(self, tmp_path) -> None:
        data = transitions(1, 1, 11)
        page = check_page(report(scored_dataset(data, LAYOUT), tmp_path))
        assert "1 transitions in 1 trajectory of 1 step," in page.text

    def test_goals(self, tmp_path) -> None:
        layout = EntityLayout(
            {"arm": [0, 1], "cup": [2, 3, 4]},
            fixed=["arm"],
            goal={"cup": [0, 1, 2]},
            achieved={"cup": [2, 3, 4]},
        )
        data = transitions(10, 5, 5)
        for td in (data, data["next"]):
            td["achieved_goal"] = td["observation"][:, 2:].clone()
            td["desired_goal"] = torch.zeros(50, 3)
        data["next", "reward"] = torch.zeros(50, 1)
        page = check_page(report(scored_dataset(data, layout), tmp_path))
        assert "observation[2:5]" in page.text
        assert "places of cup" in page.text

    def test_nested(self, tmp_path) -> None:
        flat = transitions(10, 5, 6)
        data = flat.select("action", "episode", ("next", "done"))
        for td, source in ((data, flat), (data["next"], flat["next"])):
            td["observation"] = TensorDict(
                {
                    "arm": source["observation"][:, :2],
                    "cup": {
                        "b": source["observation"][:, 2:4].view(-1, 1, 2),
                        "a": source["observation"][:, 4:],
                    },
                },
                [50],
            )
        layout = EntityLayout.from_keys(
            {"arm": ("observation", "arm"), "cup": ("observation", "cup")},
            fixed=["arm"],
        )
        scored = scored_dataset(data, layout)
        seen: list[TensorDict] = []

        def render(states: TensorDict) -> Any:
            seen.append(states)
            return np.zeros((len(states), 6, 8, 3), np.uint8)

        text = report(scored, tmp_path, render=render, examples=2)
        assert "observation/cup" in check_page(text).text
        # Recorded states, then counterfactual ones: only what is swapped differs.
        (states,) = seen
        assert list(states.keys(True, True)) == list(states.keys(True, True))
        stored = data["observation"]
        recorded, made = states["observation"][:2], states["observation"][2:]
        assert (recorded["arm"] == made["arm"]).all()
        for key in ("a", "b"):
            for part in (recorded, made):
                values = part["cup", key].flatten(1)
                known = stored["cup", key].flatten(1)
                assert (values[:, None] == known).all(-1).any(-1).all()
            assert not (recorded["cup", key] == made["cup", key]).all()

    def test_many_entities(self, tmp_path) -> None:
        layout = EntityLayout({f"part_{i:02}": [i] for i in range(16)})
        data = transitions(10, 20, 16)
        text = report(scored_dataset(data, layout), tmp_path)
        page = check_page(text)
        assert "All 120 pairs as a table" in page.text
        assert "never or rarely influenced are not shown" in page.text

    def test_memory_mapped_data_stay(self, tmp_path) -> None:
        data = transitions(5, 8, 11)
        scored = scored_dataset(data, LAYOUT)
        data.memmap_(tmp_path / "data")
        files = {
            p: p.read_bytes() for p in (tmp_path / "data").rglob("*") if p.is_file()
        }
        report(scored, tmp_path)
        assert files == {
            p: p.read_bytes() for p in (tmp_path / "data").rglob("*") if p.is_file()
        }


class TestFile:
    def test_same_bytes(self, walks, tmp_path) -> None:
        first = report(walks, tmp_path)
        torch.manual_seed(99)
        assert report(walks, tmp_path, overwrite=True) == first
        assert report(walks, tmp_path, overwrite=True, seed=1) != first

    def test_existing_file_stays(self, walks, tmp_path) -> None:
        file = tmp_path / "report.html"
        file.write_text("mine")
        with pytest.raises(FileExistsError, match="overwrite=True"):
            write_report(walks, file)
        with pytest.raises(FileExistsError, match="is a folder: name a file"):
            write_report(walks, tmp_path, overwrite=True)
        broken = scored_dataset(transitions(2, 5, 11), LAYOUT)
        broken.data["caiac", "score"][3] = torch.nan
        with pytest.raises(ValueError, match=r"1 of 10 rows of .* no finite score"):
            write_report(broken, file, overwrite=True)
        assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
        assert file.read_text() == "mine"

    @pytest.mark.parametrize(
        "options, message",
        [
            ({"trajectories": -1}, "trajectories is -1, expected at least 0"),
            ({"windows": (10, 0)}, r"windows\[1\] is 0, expected at least 1"),
            ({"samples": 0}, "samples is 0, expected at least 1"),
            ({"counterfactual_ratio": 0.0}, "counterfactual_ratio is 0.0"),
            ({"counterfactual_ratio": float("nan")}, "counterfactual_ratio is nan"),
            ({"render": "always"}, "render is 'always', expected"),
        ],
    )
    def test_arguments(self, walks, tmp_path, options: Any, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            write_report(walks, tmp_path / "report.html", **options)
        assert not list(tmp_path.iterdir())

    def test_nothing_to_show(self, walks, tmp_path) -> None:
        text = report(walks, tmp_path, trajectories=0, pairs=0, examples=0)
        check_page(text)

    def test_unusable_datasets(self, tmp_path) -> None:
        data = transitions(2, 5, 11)
        fixed = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm", "cup"])
        with pytest.raises(ValueError, match="all entities of the layout are fixed"):
            report(scored_dataset(data.clone(), fixed), tmp_path)
        scored = scored_dataset(data.clone(), LAYOUT, thresholds={"cup": 0.5})
        with pytest.raises(ValueError, match=r"thresholds lack \['box'\]"):
            report(scored, tmp_path)
        scored = scored_dataset(data.clone(), LAYOUT)
        scored.data["caiac", "score"] = torch.zeros(10, 2)
        with pytest.raises(ValueError, match=r"shape \[10, 2\], expected \[10, 3\]"):
            report(scored, tmp_path)

    def test_missing_package(self, walks, tmp_path, monkeypatch) -> None:
        monkeypatch.setitem(__import__("sys").modules, "jinja2", None)
        with pytest.raises(ImportError, match=r"pip install 'torchrl-caiac\[report\]'"):
            report(walks, tmp_path)
