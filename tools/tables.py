"""Write the tables that a tool prints into the pages of docs, with the commit and the day.

    python tools/growth.py fr079.log.gz | python tools/tables.py growth

Each NAME is given one of the Markdown tables that are read, in their order: it goes between ``<!-- NAME -->``
and ``<!-- /NAME -->``, which stand on one page of docs. All that is read is shown, too.
"""

from __future__ import annotations

import re
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

REPO = Path(__file__).parents[1]
PLACE = r"(?<=<!-- {0} -->\n).*?(?=<!-- /{0} -->\n)"


def main() -> None:
    """Read a tool's output to its end, then write."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help="of a place")
    names = parser.parse_args().names
    pages = sorted((REPO / "docs").rglob("*.md"))
    places = [place(pages, name) for name in names]
    found = tables(shown(sys.stdin))
    if len(found) != len(names):
        raise SystemExit(f"{len(found)} tables were read for {len(names)} names; nothing is written")
    changed = ["git", "diff", "--quiet", "HEAD", "--", "slam", "fusion", "configs"]
    if subprocess.run(changed, cwd=REPO).returncode:
        raise SystemExit(
            "slam, fusion or configs differ from the last commit; nothing is written: commit first"
        )
    for page, name, text in zip(places, names, found, strict=True):
        write_between(page, name, f"{mark_of_now()}\n{text}")


def mark_of_now() -> str:
    """The mark of a table that is measured now."""
    told = subprocess.run(["git", "log", "-1", "--format=%h %cs"], cwd=REPO, check=True, capture_output=True)
    return f"<!-- measured: {told.stdout.decode().strip()} -->"


def shown(lines: Iterable[str]) -> Iterable[str]:
    """The same lines, printed as they come."""
    for line in lines:
        print(line, end="", flush=True)
        yield line


def tables(lines: Iterable[str]) -> list[str]:
    """The tables among lines."""
    return ["".join(group).rstrip() for row, group in groupby(lines, lambda line: line[:1] == "|") if row]


def place(among: Iterable[Path], name: str) -> Path:
    """The one page that has the marks of a name."""
    found = [page for page in among if re.search(PLACE.format(name), page.read_text("utf-8"), re.DOTALL)]
    if len(found) != 1:
        raise SystemExit(
            f"<!-- {name} --> and <!-- /{name} --> stand on {len(found)} pages of docs, not on one"
        )
    return found[0]


def write_between(page: Path, name: str, text: str) -> None:
    """Put a text between the marks of a page."""
    old = page.read_text("utf-8")
    page.write_text(re.sub(PLACE.format(name), lambda _: f"{text}\n", old, flags=re.DOTALL), "utf-8")


if __name__ == "__main__":
    main()
