"""The page in a real browser: it loads, shows its pictures, sorts, and asks nobody for anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from browser import Page, visit
from tiny_comparison import Tiny

COLUMN = "[...document.querySelectorAll('table.sortable')].at({table}).tBodies[0].rows"
TEXTS = f"[...{COLUMN}].map(row => row.cells[{{column}}].textContent)"
CLICK = "[...document.querySelectorAll('table.sortable')].at({table}).tHead.rows[0].cells[{column}].click()"


@pytest.mark.browser
def test_the_page_works_in_chromium(tiny: Tiny, tmp_path: Path) -> None:
    async def look(page: Page) -> dict[str, Any]:
        async def column(table: int, number: int) -> Any:
            return await page.value(TEXTS.format(table=table, column=number))

        async def click(table: int, number: int) -> Any:
            await page.value(CLICK.format(table=table, column=number))
            return await column(table, number)

        heads = await page.value(
            "[...document.querySelector('table.sortable').tHead.rows[0].cells].map(x => x.textContent)"
        )
        ate = heads.index("ATE RMSE, m")
        return {
            "title": await page.value("document.title"),
            "heading": await page.value("document.querySelector('h1').textContent"),
            "pictures": await page.value("[...document.images].map(i => i.complete ? i.naturalWidth : 0)"),
            "names": await column(0, 0),
            "up": await click(0, ate),
            "down": await click(0, ate),
            "named": await click(0, 0),
            "warned": await page.value("document.querySelector('.warnings').textContent"),
            "requests": page.requests(),
            "complaints": page.complaints(),
        }

    seen = visit(tiny.out / "report.html", look, tmp_path / "profile")
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
