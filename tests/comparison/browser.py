"""A headless Chromium, spoken to over its DevTools protocol: what a page does, says and asks for."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_START_S = 60.0


def chromium() -> str:
    """Path of the browser; the test is skipped, loudly, where there is none."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip("no Chromium here (apt-get install chromium): the page was NOT tested in a browser")


class Page:
    """A page that is loaded, and all that it said and asked for."""

    def __init__(self, call: Callable[..., Any], events: list[dict[str, Any]]) -> None:
        self._call, self.events = call, events

    async def value(self, expression: str) -> Any:
        """What a JavaScript expression gives."""
        answer = await self._call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def requests(self) -> list[str]:
        """Every address asked for, but for data inside the page."""
        asked = [
            e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"
        ]
        return [address for address in asked if not address.startswith("data:")]

    def complaints(self) -> list[str]:
        """Errors of scripts, and what the console holds."""
        kinds = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}
        return [json.dumps(event["params"]) for event in self.events if event["method"] in kinds]


def visit(page: Path, look: Callable[[Page], Any], profile: Path) -> Any:
    """Load a file in Chromium and look at it."""
    process = subprocess.Popen(
        [
            *(chromium(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
            *("--disable-background-networking", "--no-first-run", "--remote-debugging-port=0"),
            *(f"--user-data-dir={profile}", "about:blank"),
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stderr is not None
        told = ""
        for line in process.stderr:
            told += line
            if match := re.search(r"DevTools listening on (ws://\S+)", line):
                return asyncio.run(asyncio.wait_for(_visited(match[1], page, look), _START_S))
        if "error while loading shared libraries" in told:  # the same as none
            pytest.skip(f"the page was NOT tested in a browser: {told.splitlines()[-1]}")
        raise AssertionError(f"Chromium did not start:\n{told}")
    finally:
        process.terminate()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


async def _visited(address: str, page: Path, look: Callable[[Page], Any]) -> Any:
    """Open a tab, load the page, and let ``look`` look."""
    from tornado.websocket import websocket_connect

    socket = await websocket_connect(address, max_message_size=1 << 28)
    events: list[dict[str, Any]] = []
    answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
    loaded = asyncio.Event()
    numbers = itertools.count(1)
    session: dict[str, str] = {}

    async def read() -> None:
        while (text := await socket.read_message()) is not None:
            message = json.loads(text)
            if "id" in message:
                answers.pop(message["id"]).set_result(message)
            else:
                events.append(message)
                if message["method"] == "Page.loadEventFired":
                    loaded.set()

    async def call(method: str, **params: Any) -> Any:
        number = next(numbers)
        future = answers[number] = asyncio.get_running_loop().create_future()
        await socket.write_message(json.dumps({"id": number, "method": method, "params": params, **session}))
        answer = await future
        assert "error" not in answer, answer
        return answer["result"]

    reader = asyncio.create_task(read())
    try:
        target = await call("Target.createTarget", url="about:blank")
        attached = await call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        session["sessionId"] = attached["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            await call(f"{domain}.enable")
        events.clear()
        await call("Page.navigate", url=page.resolve().as_uri())
        await loaded.wait()
        return await look(Page(call, events))
    finally:
        reader.cancel()
        with suppress(asyncio.CancelledError):
            await reader
        socket.close()
