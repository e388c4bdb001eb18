"""The page in a real browser: it loads, shows its pictures, sorts, and asks nobody for anything."""

from __future__ import annotations

from typing import Any

import pytest
from browser import visit
from tiny_comparison import Tiny

COLUMN = "[...document.querySelectorAll('table.sortable')].at({table}).tBodies[0].rows"
TEXTS = f"[...{COLUMN}].map(row => row.cells[{{column}}].textContent)"
CLICK = "[...document.querySelectorAll('table.sortable')].at({table}).tHead.rows[0].cells[{column}].click()"


@pytest.mark.browser
def test_the_page_works_in_chromium(tiny: Tiny) -> None:
    with visit(tiny.out / "report.html") as page:

        def column(table: int, number: int) -> Any:
            return page.value(TEXTS.format(table=table, column=number))

        def click(table: int, number: int) -> Any:
            page.value(CLICK.format(table=table, column=number))
            return column(table, number)

        heads = page.value(
            "[...document.querySelector('table.sortable').tHead.rows[0].cells].map(x => x.textContent)"
        )
        ate = heads.index("ATE RMSE, m")
        seen = {
            "title": page.value("document.title"),
            "heading": page.value("document.querySelector('h1').textContent"),
            "pictures": page.value("[...document.images].map(i => i.complete ? i.naturalWidth : 0)"),
            "names": column(0, 0),
            "up": click(0, ate),
            "down": click(0, ate),
            "named": click(0, 0),
            "warned": page.value("document.querySelector('.warnings').textContent"),
        }
    seen |= {"requests": page.requests, "complaints": page.complaints}
    assert seen["title"] == "Scanweave: Tiny <world>"
    assert seen["heading"].endswith("Tiny <world>")
    assert len(seen["pictures"]) >= 6 and min(seen["pictures"]) > 100
    assert seen["names"] == ["full", "wheels only", "theirs", "absent"]

    def number(text: str) -> float:
        return float(text.split(" ")[0])

    # What has no value stays last, whichever way the column is sorted.
    assert seen["up"][-1] == seen["down"][-1] == "–"
    rising = [number(text) for text in seen["up"][:-1]]
    assert rising == sorted(rising) and len(set(rising)) == 3
    assert [number(text) for text in seen["down"][:-1]] == rising[::-1]
    assert seen["named"] == sorted(seen["named"])
    assert "absent-flat.tum" in seen["warned"]
    assert seen["requests"] == [(tiny.out / "report.html").resolve().as_uri()]
    assert seen["complaints"] == []


def test_the_page_names_nothing_outside(tiny: Tiny) -> None:
    # Holds where no browser is at hand, too.
    text = (tiny.out / "report.html").read_text(encoding="utf-8")
    for word in ("http:", "https:", 'src="/', "url(", "@import", "<link"):
        assert word not in text
    assert "Tiny &lt;world&gt;" in text and "<world>" not in text
    assert text.count("data:image/png;base64,") >= 6
