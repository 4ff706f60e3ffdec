"""Looks at every page of the built site in Chromium.

``python docs/check_site.py docs/_build/html`` serves the site on this machine and opens
its pages at the widths of a desk and of a phone, in light and dark. It fails if a page
scrolls sideways, logs an error, loads something from another machine, has text that is
hard to read or code without a button to copy it; or if the search does not find what it
should. ``make docs`` runs it where a browser is installed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
WIDTHS = (1400, 390)
WORDS = ("install", "lookahead", "donor", "nats", "UnreadableFileError")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHATTER = r"\[PST\]: |Got invalid theme mode: \."  # of the theme
LIMIT = 1200  # seconds


class Site(SimpleHTTPRequestHandler):
    """Serves the site, the script that visits it, and takes what the script saw."""

    seen: dict[str, Any]
    done: threading.Event
    visits: dict[str, Any]

    def do_GET(self) -> None:
        if self.path == "/__check__":
            page = (HERE / "check_site.html").read_text(encoding="utf-8")
            text = page.replace("{{visits}}", json.dumps(self.visits)).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)
        else:
            super().do_GET()

    def do_POST(self) -> None:
        length = int(self.headers["Content-Length"])
        self.seen.update(json.loads(self.rfile.read(length)))
        self.send_response(204)
        self.end_headers()
        self.done.set()

    def log_message(self, *args: Any) -> None:
        """Logs nothing: what is missing is an error of the page that asks for it."""


def public_names() -> list[str]:
    """Returns the names that the reference has to have."""
    text = (HERE / "reference" / "index.rst").read_text(encoding="utf-8")
    modules = re.findall(r"^   (torchrl_caiac[\w.]*)$", text, flags=re.MULTILINE)
    names = {n for module in modules for n in importlib.import_module(module).__all__}
    return sorted(names)


def look(site: Path) -> list[str]:
    """Returns what is wrong with the pages of the site."""
    pages = sorted(
        str(page.relative_to(site))
        for page in site.rglob("*.html")
        if not page.is_relative_to(site / "_static")
    )
    handler = type(
        "Handler",
        (Site,),
        {
            "seen": {},
            "done": threading.Event(),
            "visits": {
                "pages": pages,
                "widths": WIDTHS,
                "words": WORDS,
                "names": public_names(),
            },
        },
    )
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    # Children of the browser may write for a moment after it has ended.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            os.environ.get("CHROMIUM")
            or next(filter(None, map(shutil.which, BROWSERS))),
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--hide-scrollbars",
            "--enable-logging=stderr",
            f"--user-data-dir={profile}",
            "--window-size=1500,1000",
            f"http://127.0.0.1:{server.server_port}/__check__",
        ]
        log = Path(profile) / "log"
        with log.open("w") as stream:
            browser = subprocess.Popen(command, stderr=stream, stdout=stream)
            finished = handler.done.wait(LIMIT)
            browser.terminate()
            browser.wait()
        console = [
            line
            for line in re.findall(r"CONSOLE.*", log.read_text(errors="replace"))
            if not re.search(CHATTER, line)
        ]
    server.shutdown()
    if not finished:
        return [f"the browser did not finish in {LIMIT} s", *console]
    return [*handler.seen["wrong"], *(f"console: {line}" for line in console)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("site", type=Path, help="the folder that Sphinx has built")
    wrong = look(parser.parse_args().site.resolve())
    print("\n".join(wrong) or "every page is in order")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
