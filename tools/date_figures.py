"""Say by which commit each table of figures was measured, and tell those that are too old to stand so.

    python tools/date_figures.py            marks tables without a mark, by git's account of their oldest row
    python tools/date_figures.py --check    prints what is wrong, and ends with 1 if anything is

A mark is the line before a table, ``<!-- measured: COMMIT DATE -->``: no row is of an earlier commit. A table
that is older than the release before the latest says so: ``<!-- measured: COMMIT DATE, earlier version -->``.
Releases are the tags that begin with v.
"""

from __future__ import annotations

import re
import subprocess
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator
from pathlib import Path

REPO = Path(__file__).parents[1]
MARK = re.compile(r"<!-- measured: ([0-9a-f]{7,40}) (\d{4}-\d\d-\d\d)(, earlier version)? -->")
RULE = re.compile(r"^ *\|(?:[ :]*-+[ :]*\|)+ *$")


def main() -> None:
    """Mark, or check."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    if parser.parse_args().check:
        wrong = [fault for page in pages(REPO) for fault in faults(REPO, page)]
        raise SystemExit("\n".join(wrong) if wrong else 0)
    for page in pages(REPO):
        mark_tables(REPO, page)


def pages(repo: Path) -> list[Path]:
    """Where tables of figures are."""
    return [repo / "docs" / "figures.md", *sorted((repo / "docs" / "figures").glob("*.md"))]


def tables(lines: list[str]) -> Iterator[tuple[int, int, re.Match[str] | None]]:
    """First row after the head, end and mark of each table of figures; a list of links to pages is none."""
    for number, line in enumerate(lines):
        if RULE.match(line):
            end = next((k for k in range(number, len(lines)) if "|" not in lines[k]), len(lines))
            if not all("](figures/" in row or "](#" in row for row in lines[number + 1 : end]):
                yield number + 1, end, MARK.match(lines[number - 2].strip())


def faults(repo: Path, page: Path) -> list[str]:
    """What is wrong with the marks of a page, one line each."""
    found = []
    lines = page.read_text("utf-8").splitlines()
    for first, _, mark in tables(lines):
        where = f"{page.relative_to(repo)}:{first}: the table {lines[first - 2][:60]!r}"
        if mark is None:
            found.append(f"{where} does not say when it was measured: python tools/date_figures.py")
        elif _git(repo, "cat-file", "-t", mark[1]) != "commit":
            found.append(f"{where} is of {mark[1]}, which is no commit")
        elif outdated(repo, mark[1]) and not mark[3]:
            found.append(f"{where} is of {mark[1]}, before the last release but one: measure anew, or say so")
    return found


def outdated(repo: Path, commit: str) -> bool:
    """Whether a commit is older than the release before the latest."""
    releases = (_git(repo, "tag", "--list", "v*", "--sort=-creatordate") or "").split()
    if len(releases) < 2:
        return False
    completed = subprocess.run(
        ["git", "merge-base", "--is-ancestor", releases[1], commit], cwd=repo, capture_output=True
    )
    return completed.returncode != 0


def mark_tables(repo: Path, page: Path) -> None:
    """Write the missing marks of a page, which is committed as it is."""
    text = page.read_text("utf-8")
    lines = text.splitlines()
    missing = [(first, end) for first, end, mark in tables(lines) if mark is None]
    if not missing:
        return
    blame = _git(repo, "blame", "-w", "-C", "-C", "--line-porcelain", "HEAD", "--", str(page)) or ""
    commits = re.findall(r"^([0-9a-f]{40}) \d+ \d+", blame, re.MULTILINE)
    times = [int(time) for time in re.findall(r"^committer-time (\d+)$", blame, re.MULTILINE)]
    for first, end in reversed(missing):
        oldest = min(range(first, end), key=times.__getitem__)
        day = _git(repo, "show", "-s", "--format=%cs", commits[oldest])
        indent = re.match(" *", lines[first])[0]  # type: ignore[index]
        lines[first - 2 : first - 2] = [f"{indent}<!-- measured: {commits[oldest][:7]} {day} -->"]
    page.write_text("\n".join(lines) + "\n", "utf-8")


def _git(repo: Path, *arguments: str) -> str | None:
    """What git says; None where it fails."""
    completed = subprocess.run(["git", *arguments], cwd=repo, capture_output=True, text=True)
    return completed.stdout.strip() if completed.returncode == 0 else None


if __name__ == "__main__":
    main()
