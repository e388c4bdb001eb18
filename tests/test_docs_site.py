"""The documentation site builds without a warning, opens from its folder, and asks nothing of the network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from browser import visit

import fusion
import slam
from slam.config import leaves, load_config
from tools.architecture import drawing

REPO = Path(__file__).parents[1]
# What a browser loads by itself: scripts, pictures, frames, style sheets, icons.
LOADED = re.compile(r"<(?:script|img|iframe|source|link)\b[^>]*?\b(?:src|href)=\"?((?:https?:)?//[^\"\s>]+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does."""
    folder = tmp_path_factory.mktemp("site")
    stated = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "-d", str(folder)],
        cwd=REPO,
        capture_output=True,
        text=True,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )
    assert stated.returncode == 0, stated.stderr
    return folder


def test_pages_load_nothing_from_outside(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        assert LOADED.findall(page.read_text("utf-8")) == [], page.name


def test_what_is_loaded_from_outside_is_seen() -> None:
    assert LOADED.findall('<script defer src="https://unpkg.com/x"></script>') == ["https://unpkg.com/x"]
    assert LOADED.findall('<a href="https://a.b">there</a> <img src="home.png">') == []


def test_files_say_what_readers_of_the_site_see(site: Path) -> None:
    page = (site / "figures" / "lidar2d.html").read_text("utf-8")
    assert 'class="measured">oldest row: commit ' in page and "<!-- measured" not in page
    assert page.count("<table") >= 4 and "|---|" not in page


def test_all_settings_have_a_row(site: Path) -> None:
    page = (site / "settings.html").read_text("utf-8")
    rows = re.findall(r"<td><code>([\w.]+)</code></td>", page)
    wanted = [name for name, _ in leaves(load_config().model_dump()) if ".calibration." not in name]
    assert sorted({*wanted} - {*rows}) == []


@pytest.mark.browser
def test_the_site_is_searched_from_its_folder(site: Path) -> None:
    with visit(site / "index.html") as page:
        page.page.locator("input[name=query]").press_sequentially("covariance")
        page.until("document.querySelectorAll('.md-search-result__item').length", lambda found: found > 5)
        assert all(request.startswith(("file:", "data:", "blob:")) for request in page.requests)
        assert page.complaints == []


def test_the_reference_has_every_public_name() -> None:
    stated = {
        name: re.findall(
            rf"^::: {name}\.(\w+)$", (REPO / "docs/api" / f"{name}.md").read_text(), re.MULTILINE
        )
        for name in ("slam", "fusion")
    }
    assert sorted(stated["slam"]) == sorted(slam._HOMES)
    assert sorted(stated["fusion"]) == sorted(fusion.__all__)


def test_the_picture_of_the_architecture_is_that_of_the_imports() -> None:
    drawn = (REPO / "docs" / "images" / "architecture.svg").read_text("utf-8")
    assert drawn == drawing(), "draw it anew: PYTHONPATH=. python tools/gallery.py architecture.svg"


def test_the_gallery_draws_every_picture_and_each_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(REPO / "tools"))
    from gallery import PICTURES

    names = {path.name for path in (REPO / "docs" / "images").iterdir()}
    assert names == set(PICTURES)
    pages = [REPO / "README.md", *(REPO / "docs").rglob("*.md")]
    shown = "".join(page.read_text("utf-8") for page in pages)
    assert [name for name in names if f"images/{name}" not in shown] == []
    drawn = PICTURES["repair.png"](None)  # the one that needs no drive
    assert drawn.size == (1300, 360) and len(drawn.getcolors()) > 10
