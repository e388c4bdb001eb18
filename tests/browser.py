"""Pages in a headless Chromium, by Playwright: what a page does, says and asks for."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# Clouds are drawn without a graphics card; in a container there is no sandbox.
_ARGUMENTS = [
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


def chromium() -> str:
    """Path of the browser; the test is skipped, loudly, where there is none."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip("no Chromium here (apt-get install chromium): the page was NOT tested in a browser")


@dataclass
class Visit:
    """A page that is loaded, and all that it asked for and complained of so far."""

    page: Any
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def value(self, expression: str) -> Any:
        """What a JavaScript expression gives."""
        return self.page.evaluate(expression)

    def until(self, expression: str, wanted: Callable[[Any], bool] = bool) -> None:
        """Wait until an expression gives what is wanted; the page's policy allows no waiting inside."""
        for _ in range(400):
            if wanted(self.value(expression)):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"{expression} stays {self.value(expression)}")

    def click(self, selector: str) -> None:
        """Click the first of what a selector finds."""
        self.page.locator(selector).first.click()


# The driver, and a browser with and one without WebGL, with what ends them.
_open: dict[object, Any] = {}
_ends = ExitStack()


def opened(webgl: bool = True) -> Any:
    """The browser that the tests of a file share: to start one takes a second, a visit a quarter."""
    executable = chromium()
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: the page was NOT tested")
    if not _open:
        _open["driver"] = _ends.enter_context(playwright.sync_playwright())
    if webgl not in _open:
        arguments = _ARGUMENTS if webgl else [*_ARGUMENTS[:2], "--disable-gpu", "--disable-3d-apis"]
        launched = _open["driver"].chromium.launch(executable_path=executable, args=arguments)
        _open[webgl] = _ends.enter_context(launched)
    return _open[webgl]


def close() -> None:
    """End the browsers, and the loop of events that the driver runs in this thread."""
    _open.clear()
    _ends.close()


@contextmanager
def visit(
    path: Path, width: int = 1300, height: int = 900, webgl: bool = True, **options: Any
) -> Iterator[Visit]:
    """Load a file.

    Parameters
    ----------
    options
        Of the browser's context: ``color_scheme``, ``java_script_enabled``, ``reduced_motion``.
    """
    options = {"viewport": {"width": width, "height": height}, "reduced_motion": "reduce", **options}
    with opened(webgl).new_context(**options) as context:
        page = context.new_page()
        seen = Visit(page)
        page.on("request", lambda asked: seen.requests.append(asked.url))
        page.on("pageerror", lambda error: seen.complaints.append(str(error)))
        page.on("console", lambda said: seen.complaints.append(said.text))
        page.goto(path.resolve().as_uri())
        yield seen
        seen.requests[:] = [one for one in seen.requests if not one.startswith(("data:", "blob:"))]


def ready(seen: Visit) -> Visit:
    """Wait for the plan of a page."""
    seen.page.wait_for_selector("html.ready", timeout=60_000)
    return seen
