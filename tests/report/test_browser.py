"""Looks at reports in Chromium: nothing overflows, and there are no errors."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.report.test_svg import HOSTILE
from tests.report.test_write_report import report
from tests.report.walks import scored_dataset, transitions
from torchrl_caiac import EntityLayout

pytestmark = pytest.mark.browser

PROBE = """
<script>
const scale = (m) => Math.sqrt(Math.abs(m.a * m.d - m.b * m.c));  // also if turned
addEventListener("load", () => {
  const root = document.documentElement;
  const wide = [...document.querySelectorAll("main *")].filter((element) => {
    const box = element.getBoundingClientRect();
    return box.width && (box.right > root.clientWidth + 1 || box.left < -1);
  }).filter((element) => !element.closest("thead") &&  // it is for screen readers
    (!element.closest("svg") || element.tagName === "svg"));
  // Text of figures that is cut off at the edge of its figure.
  const cut = [...document.querySelectorAll("svg text")].filter((text) => {
    const box = text.getBoundingClientRect();
    const own = text.closest("svg").getBoundingClientRect();
    return box.left < own.left - 2 || box.right > own.right + 2 ||
      box.top < own.top - 2 || box.bottom > own.bottom + 2;
  });
  const sizes = [...document.querySelectorAll("svg text")].map((text) =>
    parseFloat(getComputedStyle(text).fontSize) * scale(text.getScreenCTM()));
  const probe = {
    width: innerWidth, client: root.clientWidth, scroll: root.scrollWidth,
    wide: wide.map((element) => element.outerHTML.slice(0, 90)),
    cut: cut.map((text) => text.textContent),
    smallest: Math.min(...sizes),
    page: getComputedStyle(document.body).backgroundColor,
    ink: getComputedStyle(document.body).color,
  };
  parent.postMessage(JSON.stringify(probe), "*");
});
</script>
"""


# Windows are at least 500 pixels wide, frames are not.
FRAME = """
<!DOCTYPE html>
<script>
addEventListener("message", (event) => { document.body.dataset.probe = event.data; });
</script>
<body>
<iframe src="probe.html" style="border: 0; width: {width}px; height: 900px"></iframe>
"""


def browser() -> str:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = os.environ.get("CHROMIUM") or next(
        filter(None, map(shutil.which, names)), ""
    )
    if not found:
        pytest.fail(
            "no browser was found, and reports have to be seen in one: install one "
            "(on Debian and Ubuntu: apt-get install chromium), or name its program in "
            "the environment variable CHROMIUM"
        )
    return found


def visit(file: Path, scheme: str = "light") -> tuple[str, str]:
    """The page as the browser has it, and what it logs."""
    command = [
        browser(),
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--hide-scrollbars",
        "--enable-logging=stderr",
        f"--user-data-dir={file.parent / 'profile'}",
        "--window-size=1500,1000",
        f"--blink-settings=preferredColorScheme={['dark', 'light'].index(scheme)}",
        "--virtual-time-budget=2000",
        "--dump-dom",
        file.as_uri(),
    ]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout, run.stderr


def look(text: str, folder: Path, width: int, scheme: str = "light") -> dict[str, Any]:
    """What a script in the page sees, which the page itself does not allow."""
    policy = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
    assert policy.search(text)
    (folder / "probe.html").write_text(
        policy.sub("", text).replace("</body>", f"{PROBE}</body>"), encoding="utf-8"
    )
    file = folder / "frame.html"
    file.write_text(FRAME.replace("{width}", str(width)))
    page, log = visit(file, scheme)
    assert "CONSOLE" not in log, log
    return json.loads(html.unescape(re.findall(r'data-probe="([^"]+)"', page)[0]))


def luminance(colour: str) -> float:
    channels = np.array([int(c) for c in re.findall(r"\d+", colour)[:3]]) / 255
    linear = np.where(
        channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
    )
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.fixture(scope="module")
def long_names(tmp_path_factory) -> str:
    """A report with names and texts that want to be wide."""
    names = [*HOSTILE, *(f"a_rather_long_name_of_part_{i}" for i in range(3))]
    names = [name for name in names if name.strip()]
    columns = {name: [3 * i, 3 * i + 1, 3 * i + 2] for i, name in enumerate(names)}
    layout = EntityLayout(columns, positions=columns, fixed=names[:1])
    scored = scored_dataset(
        transitions(6, 30, 3 * len(names)),
        layout,
        reasons=dict.fromkeys(names, "w" * 200),
        source={"path": "/a/very/long/path" * 12, "digest": "0123456789abcdef" * 8},
    )
    return report(scored, tmp_path_factory.mktemp("long"), trajectories=2, examples=2)


@pytest.mark.parametrize("width", [1400, 390])
def test_nothing_overflows(long_names, tmp_path, width: int) -> None:
    seen = look(long_names, tmp_path, width)
    assert seen["width"] == width
    assert seen["scroll"] <= seen["client"], seen
    assert seen["wide"] == [] and seen["cut"] == []
    assert seen["smallest"] >= 8  # pixels


def test_dark_and_without_errors(walks, tmp_path) -> None:
    text = report(walks, tmp_path, trajectories=2, examples=2, pairs=2)
    light, dark = (look(text, tmp_path, 390, scheme) for scheme in ("light", "dark"))
    for seen in (light, dark):
        assert seen["scroll"] <= seen["client"]
        low, high = sorted(luminance(seen[name]) for name in ("page", "ink"))
        assert (high + 0.05) / (low + 0.05) > 7  # the contrast that WCAG AAA asks for
    assert luminance(light["page"]) > 0.8 and luminance(dark["page"]) < 0.1
    # The page as it is, with its policy: nothing is refused, and nothing fails.
    page, log = visit(tmp_path / "report.html")
    assert "CONSOLE" not in log, log
    assert "New combinations of places" in page


def test_a_script_would_not_run(walks, tmp_path) -> None:
    text = report(walks, tmp_path)
    script = "<script>document.body.id = 'attacked'</script></body>"
    for policy, runs in (("Content-Security-Policy", False), ("off", True)):
        file = tmp_path / "attacked.html"
        changed = text.replace("Content-Security-Policy", policy)
        file.write_text(changed.replace("</body>", script), encoding="utf-8")
        page, log = visit(file)
        assert ('id="attacked"' in page) == runs
        assert ("Content Security Policy" in log) == (not runs)
