"""Tables of a comparison's page that sort by a click on their heads."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TypeAlias

# Text, and the number to sort by; None sorts by the text.
Cell: TypeAlias = tuple[str, float | None]

STYLE = """
main { max-width: 1240px; }
table.sortable { font-size: 13px; white-space: nowrap; }
table.sortable th { cursor: pointer; user-select: none; white-space: normal; vertical-align: bottom; }
table.sortable th[aria-sort] { color: var(--accent); }
table.sortable th[aria-sort=ascending]::after { content: " \\2191"; }
table.sortable th[aria-sort=descending]::after { content: " \\2193"; }
.wide { overflow-x: auto; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(400px, 1fr)); gap: 12px; }
"""

# A number in data-v decides, else the text; what has neither (a dash) stays last either way.
SCRIPT = """
document.querySelectorAll("table.sortable th").forEach(head => head.addEventListener("click", () => {
  const table = head.closest("table"), body = table.tBodies[0], column = head.cellIndex;
  const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  table.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down === 1 ? "ascending" : "descending");
  const value = row => row.cells[column].dataset.v, text = row => row.cells[column].textContent;
  Array.from(body.rows).sort((a, b) => {
    const x = value(a), y = value(b);
    if (x === undefined && y === undefined) return down * text(a).localeCompare(text(b));
    if (x === "" || y === "") return (x === "") - (y === "");
    return down * (Number(x) - Number(y));
  }).forEach(row => body.append(row));
}));
"""


def sortable(head: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """A table with numbers to sort by, or nothing without rows."""
    body = "\n".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    if not body:
        return ""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return (
        f'<div class="wide"><table class="sortable"><thead><tr>{titles}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>\n"
    )


def text_cell(text: str) -> Cell:
    """A cell that sorts by its text."""
    return text, None


def _cell(cell: Cell) -> str:
    """One cell; not a number is an empty value, which stays last."""
    text, value = cell
    if value is None:
        return f"<td>{escape(text)}</td>"
    return (
        f'<td data-v="{value:.12g}">{escape(text)}</td>'
        if value == value
        else f'<td data-v="">{escape(text)}</td>'
    )
