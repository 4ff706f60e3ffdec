"""The screenshots of reports in docs/report.md.

They are of a report of OGBench's ``cube-double``, whose data are made here::

    python -c "from torchrl_caiac.envs.ogbench import create_ogbench_play as create; \\
        create('cube-double.npz', 'cube-double', episodes=100)"
    caiac score cube-double.npz --layout ogbench/cube-double --out scored
    python docs/make_report_images.py scored docs/images

A Chromium is needed: ``apt-get install chromium``, or its program in ``CHROMIUM``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from torchrl_caiac.report import write_report
from torchrl_caiac.scored import open_scored

#: File, sections shown (all if empty), width, height, scale, and colour scheme.
SHOTS = (
    ("report_top.png", (), 1400, 1500, 1, "light"),
    ("report_coverage.png", ("coverage", "examples"), 1300, 1560, 1, "light"),
    ("report_phone.png", ("influence",), 390, 780, 2, "dark"),
)
MOST_BYTES = 200_000


def browser() -> str:
    """The program of a Chromium."""
    names = ("chromium", "chromium-browser", "google-chrome")
    found = os.environ.get("CHROMIUM") or next(
        filter(None, map(shutil.which, names)), ""
    )
    if not found:
        sys.exit("no Chromium was found: install one, or name it in CHROMIUM")
    return found


def screenshot(
    text: str,
    folder: Path,
    sections: tuple[str, ...],
    width: int,
    height: int,
    scale: int,
    scheme: str,
) -> Image.Image:
    """A picture of a page, or of some of its sections, in the browser's window."""
    if sections:
        others = "".join(f':not([aria-labelledby="{name}"])' for name in sections)
        hidden = f"header, .tiles, section{others} {{ display: none }}"
        text = text.replace("</head>", f"<style>{hidden}</style></head>")
    page, picture = folder / "page.html", folder / "screenshot.png"
    page.write_text(text, encoding="utf-8")
    command = [
        browser(),
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        f"--user-data-dir={folder / 'profile'}",
        f"--window-size={width},{height}",
        f"--force-device-scale-factor={scale}",
        f"--blink-settings=preferredColorScheme={['dark', 'light'].index(scheme)}",
        f"--screenshot={picture}",
        page.as_uri(),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    with Image.open(picture) as image:
        return image.convert("RGB")


def main() -> None:
    """Writes the screenshots."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scored", help="a folder that `caiac score` wrote")
    parser.add_argument("folder", type=Path, help="where to write the pictures")
    arguments = parser.parse_args()
    scored = open_scored(arguments.scored)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        page = write_report(scored, folder / "report.html", title="Cube double play")
        for name, *view in SHOTS:
            image = screenshot(page.read_text(encoding="utf-8"), folder, *view)
            file = arguments.folder / name
            # Also colours of few pixels, such as those of the cubes, are kept.
            image.quantize(
                256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
            ).save(file, optimize=True)
            size = file.stat().st_size
            print(f"{file}: {image.width} x {image.height}, {size} bytes")
            if size > MOST_BYTES:
                sys.exit(f"{file} has more than {MOST_BYTES} bytes: show less")


if __name__ == "__main__":
    main()
