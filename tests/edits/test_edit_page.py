"""The page's panel of edits in a real browser: every control once, undo, and saving into the map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from browser import opened
from edit_maps import content
from view_server import Served, served

from slam.config.edits import edits_of
from slam.evaluation.saved_page import saved_page

__all__ = ["served"]  # a fixture

pytestmark = pytest.mark.browser
DRAWN = [(0.4, 0.4), (0.6, 0.4), (0.6, 0.6)]


class Sheet:
    """The page in a browser."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.said: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda message: self.said.append(message.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))

    def open(self, address: str) -> None:
        """Wait until it lives."""
        self.page.goto(address)
        self.settle("html.ready")

    def settle(self, selector: str) -> None:
        """Wait for an element; then show the edits."""
        self.page.wait_for_selector(selector, state="attached", timeout=60_000)
        self.page.get_by_role("tab", name="Edit").click()

    def press(self, name: str) -> None:
        self.page.locator(f"#{name}").click()

    def at(self, across: float, down: float, clicks: int = 1) -> None:
        """Click in the plan, and wait until it is known that no second click comes."""
        box = self.page.locator("#plan").bounding_box()
        place = box["x"] + across * box["width"], box["y"] + down * box["height"]
        self.page.mouse.click(*place, click_count=clicks)
        self.page.wait_for_timeout(450)

    def draw(self, tool: str, name: str = "") -> None:
        """A square in the middle."""
        self.page.locator("#edit-name").fill(name)
        self.press(tool)
        for across, down in DRAWN:
            self.at(across, down)
        self.at(0.4, 0.6, clicks=2)

    def edits(self) -> dict[str, Any]:
        """What would be saved, as it is read."""
        return dict(yaml.safe_load(self.page.evaluate("Scanweave.editsText()")) or {})


@contextmanager
def browser() -> Iterator[Sheet]:
    """A page of 1300 pixels; the test is skipped, loudly, without Chromium."""
    with opened().new_page(viewport={"width": 1300, "height": 900}) as page:
        yield Sheet(page)


def test_every_control_of_the_page_that_came_by_mail(served: Served, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text("".join(saved_page(served.view.map)))
    with browser() as sheet:
        sheet.open(file.as_uri())
        assert sheet.page.locator("#edits-save").count() == 0
        assert sheet.page.locator("#edits-yaml").is_disabled()
        sheet.page.locator("#edit-later").check()
        for tool in ("edit-erase", "edit-keep-out", "edit-slow", "edit-crop"):
            sheet.draw(tool, "<img src=x>" if tool == "edit-keep-out" else "")
        sheet.press("edit-places")
        sheet.at(0.5, 0.5)
        sheet.press("edit-origin")
        sheet.at(0.45, 0.5)
        sheet.press("edit-along-x")
        sheet.at(0.4, 0.5)
        sheet.at(0.6, 0.5)
        found = sheet.edits()
        assert set(found) == {"erase", "keep_out", "slow", "crop", "places", "origin", "turn"}
        assert found["erase"][0]["later"] and len(found["crop"]) == 4 and "along_x" in found["turn"]
        assert found["keep_out"][0]["name"] == "<img src=x>" and found["slow"][0]["percent"] == 50
        sheet.press("edit-turn")
        assert sheet.edits()["turn"] == {"degrees": 90}
        sheet.press("edit-walls")
        found = sheet.edits()
        assert found["turn"] == {"to_walls": True}
        with sheet.page.expect_download() as saved:
            sheet.press("edits-yaml")
        written = Path(saved.value.path()).read_text()
        assert edits_of(yaml.safe_load(written), "the page") == edits_of(found, "the page")
        for left in range(6, -1, -1):
            count = int(sheet.page.locator("#edits-list h3").inner_text().split(":")[1])
            assert count == left + 1
            sheet.page.keyboard.press("Control+z")
        assert sheet.edits() == {}
        add_a_loop(sheet)
        assert len(sheet.edits()["loops"]["add"]) == 1
        sheet.page.locator("#edits-list button").first.click()
        assert sheet.edits() == {}
        assert sheet.asked == [file.as_uri()] and sheet.said == []


def add_a_loop(sheet: Sheet) -> None:
    """Between the first keyframe and the last."""
    sheet.press("edit-add")
    for node in (0, "Scanweave.data.nodes.stamps_s.length - 1"):
        sheet.page.evaluate(f"Scanweave.select.set({{kind: 'node', index: {node}}})")


def test_what_is_saved_is_in_the_map_and_can_be_taken_back(served: Served) -> None:
    before = content(served.view.map)
    address = f"http://127.0.0.1:{served.port}/secret/"
    with browser() as sheet:
        sheet.open(address)
        sheet.draw("edit-keep-out", "stairs")
        sheet.press("edits-save")
        sheet.settle("html.ready #edits-back")
        assert served.view.map.zones()["stairs"].shape == (4, 2)
        assert sheet.edits() == {}
        sheet.page.evaluate("Scanweave.editing.add('turn', {degrees: 1000}, 'too far')")
        sheet.press("edits-save")
        sheet.page.wait_for_selector("#edits-said:not(:empty)")
        assert "turn.degrees = 1000" in sheet.page.locator("#edits-said").inner_text()
        sheet.press("edits-undo")
        sheet.press("edits-back")
        sheet.settle("html.ready:not(:has(#edits-back))")
        assert not served.view.map.edits and content(served.view.map) == before
        assert {url.removeprefix(address) for url in sheet.asked} == {"", "edits", "undo"}
        assert [line for line in sheet.said if "400" not in line] == []
