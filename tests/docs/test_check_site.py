"""The look at the site in a browser finds what it should find."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "docs" / "check_site.py"
PAGES = {
    "good": "<p>text",
    "wide": "<div style='width: 900px'>wide</div><p>text",
    "loud": "<p>text<script>console.error('a script failed')</script>",
    "remote": "<p>text<img src='http://localhost:9/picture.png'>",
    "broken": "<p>text<img src='missing.png'>",
    "uncopied": "<p>text<div class=highlight><pre>code</pre></div>",
    "pale": "<style>[data-theme=dark] p { color: #777 }</style><p>text",
}


@pytest.mark.browser
def test_bad_pages_are_found(tmp_path: Path, monkeypatch) -> None:
    spec = importlib.util.spec_from_file_location("check_site", SCRIPT)
    check_site = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check_site)
    monkeypatch.setattr(check_site, "WORDS", ())
    monkeypatch.setattr(check_site, "public_names", list)
    for name, text in PAGES.items():
        (tmp_path / f"{name}.html").write_text(
            "<!DOCTYPE html><meta name='viewport' content='width=device-width'>"
            "<link rel='icon' href='data:,'>"
            "<style>body { background: #fff; color: #111 } "
            "[data-theme=dark] body { background: #111; color: #eee }</style>"
            f"<body><article>{text}</article>"
        )
    wrong = "\n".join(check_site.look(tmp_path))
    assert "wide.html at 390: 9" in wrong
    assert "wide.html at 1400" not in wrong
    assert "a script failed" in wrong
    assert "remote.html loads http://localhost:9/picture.png" in wrong
    assert "broken.html: no http" in wrong
    assert "uncopied.html: code has no button" in wrong
    assert "pale.html, dark: contrast" in wrong
    assert "pale.html, light" not in wrong
    assert "good.html" not in wrong
    assert "the check failed" in wrong  # as this site has no search
