"""Pieces of report.html: sections, tables, folds, pictures. Every text is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape


def section(title: str, content: str) -> str:
    """A titled part of the page; the content is HTML."""
    return f"<section><h2>{escape(title)}</h2>\n{content}</section>\n"


def paragraph(text: str) -> str:
    """A text of its own."""
    return f"<p>{escape(text)}</p>\n"


def folded(label: str, content: str) -> str:
    """Content that opens on a click, without a script."""
    return f"<details><summary>{escape(label)}</summary>\n{content}</details>\n"


def image(png: bytes, description: str, css_class: str = "map") -> str:
    """A picture inside the page itself."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img class="{css_class}" alt="{escape(description)}" src="data:image/png;base64,{data}">\n'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], css_class: str = "") -> str:
    """A table of texts, or nothing without rows."""
    # The end tags of rows and cells may be left out in HTML; with thousands of rows that is a third.
    body = "\n".join("<tr><td>" + "<td>".join(map(escape, row)) for row in rows)
    if not body:
        return ""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f'<table class="{css_class}"><thead><tr>{titles}</tr></thead>\n<tbody>\n{body}\n</tbody></table>\n'
