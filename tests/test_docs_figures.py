"""Tables of figures say when they were measured, and none is old without saying so."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tools.benchmark import cost_cells, table
from tools.date_figures import faults, mark_tables, pages
from tools.tables import place, tables, write_between

REPO = Path(__file__).parents[1]
TABLE = "| | m |\n|---|---|\n| fr079 | 0.03 |\n"


def git(repo: Path, *arguments: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    stated = subprocess.run(["git", *who, *arguments], cwd=repo, check=True, capture_output=True, text=True)
    return stated.stdout.strip()


def commit(repo: Path, text: str) -> str:
    """Commit a page of figures; the short name of the commit."""
    (repo / "docs" / "figures").mkdir(parents=True, exist_ok=True)
    (repo / "docs" / "figures.md").write_text(text)
    git(repo, "add", "-A")
    git(repo, "commit", "-qm", "figures", "--allow-empty")
    return git(repo, "log", "-1", "--format=%h")


@pytest.fixture
def repo(tmp_path: Path) -> Path:
    git(tmp_path, "init", "-q")
    return tmp_path


@pytest.mark.parametrize("page", pages(REPO), ids=lambda page: page.name)
def test_every_table_says_when_it_was_measured(page: Path) -> None:
    if not (REPO / ".git").exists():
        pytest.skip("no history here: that tables are of this version was NOT tested")
    assert faults(REPO, page) == []


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_measured_numbers_of_entry_pages_are_on_a_page_of_figures(page: str) -> None:
    measured = r"(?<![\w.`])\d+(?:\.\d+)?(?= (?:m|cm|mm|%|CPU|MB|GB|campuses|degrees)\b)"
    text = re.sub(r"`[^`\n]*`", "", (REPO / page).read_text("utf-8"))
    figures = "".join(file.read_text("utf-8") for file in [*pages(REPO), REPO / "docs" / "limits.md"])
    sizes = {"530"}  # of packages of others
    for number in {*re.findall(measured, text)} - sizes:
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?!\.?\d)", figures), f"{page}: {number}"


def test_a_table_without_a_mark_is_seen_and_gets_one(repo: Path) -> None:
    first = commit(repo, f"text\n\n{TABLE}")
    page = repo / "docs" / "figures.md"
    assert "does not say when" in faults(repo, page)[0]
    commit(repo, f"text\n\n{TABLE}| intel | 0.04 |\n")
    mark_tables(repo, page)
    assert f"<!-- measured: {first} " in page.read_text()
    assert faults(repo, page) == []
    assert page.read_text().count("measured") == 1


def test_a_commit_that_is_none_is_seen(repo: Path) -> None:
    commit(repo, f"<!-- measured: 0123456 2026-11-22 -->\n{TABLE}")
    assert "which is no commit" in faults(repo, repo / "docs" / "figures.md")[0]


def test_a_table_of_two_releases_ago_must_say_so(repo: Path) -> None:
    first, page = commit(repo, ""), repo / "docs" / "figures.md"
    marked = f"<!-- measured: {first} 2026-11-22 -->\n{TABLE}"
    for number in (1, 2):
        commit(repo, marked)
        git(repo, "tag", f"v{number}")
        if number == 1:
            assert faults(repo, page) == []
    assert "before the last release but one" in faults(repo, page)[0]
    page.write_text(marked.replace(" -->", ", earlier version -->"))
    assert faults(repo, page) == []


def test_each_table_that_a_tool_writes_has_one_place() -> None:
    docs = sorted((REPO / "docs").rglob("*.md"))
    text = "".join(page.read_text("utf-8") for page in docs)
    named = {name for names in re.findall(r"tools/tables\.py ([a-z -]+)", text) for name in names.split()}
    placed = re.findall(r"^<!-- ([\w-]+) -->$", text, re.MULTILINE)
    assert named == {*placed} and len(placed) == len(named) > 5
    for name in named:
        assert place(docs, name).is_file()


def test_the_benchmark_makes_the_table_of_its_page() -> None:
    head = table([]).splitlines()[0]
    assert head in (REPO / "docs" / "figures" / "lidar2d.md").read_text("utf-8")
    assert len(cost_cells({})) == head.count("|") - 1 - 4


def test_tables_are_found_and_written_between_their_marks(tmp_path: Path) -> None:
    assert tables(["told\n", "| a |\n", "|---|\n", "\n", "| b |\n"]) == ["| a |\n|---|", "| b |"]
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    page.write_text("above\n<!-- a -->\nold\n<!-- /a -->\nbelow\n<!-- b -->\n<!-- /b -->\n")
    other.write_text("<!-- b -->\n<!-- /b -->\n")
    write_between(place([page, other], "a"), "a", r"| \1 |")
    assert page.read_text() == "above\n<!-- a -->\n| \\1 |\n<!-- /a -->\nbelow\n<!-- b -->\n<!-- /b -->\n"
    write_between(page, "b", "new")
    assert "<!-- b -->\nnew\n<!-- /b -->\n" in page.read_text()
    for name in ("b", "c"):
        with pytest.raises(SystemExit, match="not on one"):
            place([page, other], name)
