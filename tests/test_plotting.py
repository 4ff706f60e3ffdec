from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from torchrl_caiac.plotting import (
    bootstrap_interval,
    plot_frames,
    plot_influence,
    plot_learning_curves,
    plot_success,
)

NAMES = ["robot", "kettle", "microwave", "slide_cabinet", "light_switch"]


@pytest.fixture
def scores() -> np.ndarray:
    values = np.abs(np.random.default_rng(0).normal(0, 0.01, (60, 5)))
    values[:, 0] = 5.0
    values[20:30, 2] = 1.2
    return values


def legend(figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


class TestInfluence:
    def test_highlights_what_passes_the_threshold(self, scores, tmp_path):
        figure = plot_influence(scores, NAMES, threshold=0.3, exclude=["robot"])
        assert legend(figure) == ["microwave", "3 others", "θ = 0.3"]
        path = tmp_path / "influence.png"
        figure.savefig(path)
        assert path.stat().st_size > 5000

    def test_true_contacts(self, scores):
        contact = np.zeros(scores.shape, dtype=bool)
        contact[22:28, 2] = True
        contact[40:44, 1] = contact[50:52, 1] = True  # contact without a score
        figure = plot_influence(
            scores,
            NAMES,
            ground_truth=contact,
            threshold=0.3,
            exclude=["robot"],
            title="x",
        )
        assert legend(figure)[:2] == ["kettle", "microwave"]
        strip = figure.axes[1]
        assert [t.get_text() for t in strip.get_yticklabels()] == [
            "kettle",
            "microwave",
        ]
        spans = [
            path.get_extents().intervalx.tolist()
            for bars in strip.collections
            for path in bars.get_paths()
        ]
        assert spans == [[39.5, 43.5], [49.5, 51.5], [21.5, 27.5]]

    def test_without_threshold_and_in_seconds(self, scores):
        figure = plot_influence(scores, NAMES, exclude=["robot"], step_seconds=0.08)
        assert legend(figure) == ["microwave", "3 others"]
        assert figure.axes[0].get_xlabel() == "time (s)"
        assert figure.axes[0].lines[0].get_xdata()[-1] == pytest.approx(59 * 0.08)

    def test_gaps_one_row_and_many_entities(self, scores):
        scores[3:6] = np.nan
        plot_influence(scores, NAMES, threshold=0.3)
        plot_influence(scores[:1], NAMES, ground_truth=np.ones((1, 5), bool))
        plot_influence(np.full((4, 5), np.nan), NAMES)
        figure = plot_influence(np.ones((4, 12)), [f"e{i}" for i in range(12)])
        looks = [(x.get_color(), x.get_linestyle()) for x in figure.axes[0].lines]
        assert len(set(looks)) == 12

    def test_input_stays(self, scores):
        before = scores.copy()
        plot_influence(scores, NAMES)
        assert np.array_equal(scores, before)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"names": NAMES[:3]}, r"\[L, 3\]"),
            ({"scores": np.zeros((0, 5))}, "at least one row"),
            ({"ground_truth": np.zeros((60, 5))}, "expected bool"),
            ({"ground_truth": np.zeros((6, 5), bool)}, r"\(60, 5\)"),
            ({"exclude": ["toaster"]}, "toaster"),
            ({"exclude": NAMES}, "no entity"),
        ],
    )
    def test_bad_input(self, scores, changes, message):
        arguments = {"scores": scores, "names": NAMES, **changes}
        with pytest.raises(ValueError, match=message):
            plot_influence(**arguments)


RESULTS = {
    "none": {"kettle": [1.0, 0.9, 1.0], "microwave": [0.0, 0.0, 0.0]},
    "caiac": {"kettle": [1.0, 1.0, 1.0], "microwave": [0.8, 1.0, 0.9]},
}


class TestSuccess:
    def test_bars_are_means(self, tmp_path):
        figure = plot_success(RESULTS, labels={"caiac": "CAIAC"}, title="x")
        axes = figure.axes[0]
        heights = [[bar.get_height() for bar in c] for c in axes.containers[::2]]
        assert np.allclose(heights, [[29 / 30, 0.0], [1.0, 0.9]])
        assert [t.get_text() for t in axes.get_xticklabels()] == ["kettle", "microwave"]
        assert legend(figure) == ["none", "CAIAC"]
        figure.savefig(tmp_path / "success.png")

    def test_intervals(self):
        assert bootstrap_interval([0.5]) == (0.5, 0.5)
        low, high = bootstrap_interval([0.0, 0.5, 1.0, 1.0])
        assert 0 <= low < 0.625 < high <= 1
        narrow = bootstrap_interval([0.0, 0.5, 1.0, 1.0], confidence=0.5)
        assert low < narrow[0] < narrow[1] < high
        assert bootstrap_interval([0.0, 0.5, 1.0, 1.0]) == (low, high)
        # a normal mean's interval, from many runs
        values = np.random.default_rng(0).normal(0, 1, 2000)
        low, high = bootstrap_interval(values)
        half = 1.96 * values.std() / 2000**0.5
        assert low == pytest.approx(values.mean() - half, abs=0.005)
        assert high == pytest.approx(values.mean() + half, abs=0.005)

    def test_bad_input(self):
        with pytest.raises(ValueError, match="empty"):
            plot_success({})
        with pytest.raises(ValueError, match=r"'b' lack the tasks \['kettle'\]"):
            plot_success({"a": {"kettle": [1.0]}, "b": {}})
        with pytest.raises(ValueError, match="at least one value"):
            plot_success({"a": {"kettle": []}})
        with pytest.raises(ValueError, match="finite"):
            bootstrap_interval([0.0, np.nan])
        with pytest.raises(ValueError, match="confidence"):
            bootstrap_interval([0.0], confidence=95)


CURVES = {
    "none": ([2000, 4000, 6000], [[0.0, 0.1, 0.2], [0.1, 0.1, 0.3], [0.2, 0.4, 0.4]]),
    "caiac": ([2000, 6000], [[0.2, 0.8]]),
}


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_the_legend_fits_into_the_figure(count):
    names = [f"method {n}" for n in range(count)]
    labels = {name: f"{name}, with a label that is rather long" for name in names}
    results = {name: {"kettle": [1.0]} for name in names}
    figure = plot_success(results, labels=labels)
    figure.canvas.draw()
    extent = figure.legends[0].get_window_extent()
    assert extent.x0 >= 0 and extent.x1 <= figure.bbox.width
    assert len(figure.legends) == 1 and len(legend(figure)) == count


class TestLearningCurves:
    def test_lines_are_means_with_bands(self, tmp_path):
        figure = plot_learning_curves(
            CURVES, labels={"caiac": "CAIAC"}, confidence=0.8, xlabel="a", ylabel="b"
        )
        axes = figure.axes[0]
        assert legend(figure) == ["none", "CAIAC"]
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("a", "b")
        for line, (steps, runs) in zip(axes.lines, CURVES.values(), strict=True):
            assert line.get_xdata().tolist() == steps
            assert np.allclose(line.get_ydata(), np.mean(runs, 0))
        bands = [c.get_paths()[0].vertices for c in axes.collections]
        runs = np.array(CURVES["none"][1])
        for x, values in zip(CURVES["none"][0], runs.T, strict=True):
            ends = bands[0][bands[0][:, 0] == x, 1]
            expected = bootstrap_interval(values, confidence=0.8)
            assert (ends.min(), ends.max()) == pytest.approx(expected)
        # The band of a single run has no width.
        assert set(bands[1][:, 1].round(9)) == {0.2, 0.8}
        assert -0.05 < axes.get_ylim()[0] <= 0
        figure.savefig(tmp_path / "curves.png")

    def test_negative_returns_are_seen(self):
        figure = plot_learning_curves({"a": ([0, 1], [[-3.0, -1.0]])}, title="returns")
        assert figure.axes[0].get_ylim()[0] < -3
        assert figure.axes[0].get_title(loc="left") == "returns"

    @pytest.mark.parametrize(
        ("curves", "message"),
        [
            ({}, "empty"),
            ({"a": ([1, 2], [0.0, 1.0])}, r"'a' has steps of shape \(2,\).*\[R, P\]"),
            ({"a": ([1, 2], [[0.0, 1.0, 2.0]])}, r"values of shape \(1, 3\)"),
            ({"a": ([[1, 2]], [[0.0, 1.0]])}, r"steps of shape \(1, 2\)"),
            ({"a": ([1, 2], [[0.0, np.nan]])}, "finite"),
            ({"a": ([1, 2], np.zeros((0, 2)))}, "at least one value"),
        ],
    )
    def test_bad_input(self, curves, message):
        with pytest.raises(ValueError, match=message):
            plot_learning_curves(curves)


class TestFrames:
    def test_strip(self, tmp_path):
        frames = np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), np.uint8)
        figure = plot_frames(frames, [f"t = {i}" for i in range(5)], title="x")
        assert len(figure.axes) == 5
        assert np.array_equal(figure.axes[2].images[0].get_array(), frames[2])
        figure.savefig(tmp_path / "frames.png")
        lines = plot_frames(list(frames), columns=2)
        spec = lines.axes[0].get_subplotspec().get_gridspec()
        assert (spec.nrows, spec.ncols) == (3, 2)

    def test_bad_input(self):
        frame = np.zeros((4, 4, 3))
        with pytest.raises(ValueError, match="empty"):
            plot_frames([])
        with pytest.raises(ValueError, match=r"frame 1 has shape \(4, 4\)"):
            plot_frames([frame, frame[..., 0]])
        with pytest.raises(ValueError, match="1 titles for 2 frames"):
            plot_frames([frame, frame], ["a"])
        with pytest.raises(ValueError, match="columns"):
            plot_frames([frame], columns=0)


def test_matplotlib_is_imported_on_use():
    code = (
        "import sys; "
        "from torchrl_caiac.plotting import plot_frames; "
        "assert 'matplotlib' not in sys.modules and 'scipy' not in sys.modules; "
        "import numpy as np; "
        "plot_frames(np.zeros((1, 4, 4, 3))); "
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=240)
