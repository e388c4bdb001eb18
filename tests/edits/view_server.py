"""A small map behind `scanweave view`, in this process."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import uvicorn

import slam
from slam.app.viewing import MapView, application
from slam.simulation.synthetic_log import write_synthetic_log


@dataclass
class Served:
    """A map behind a port of this machine."""

    view: MapView
    folder: Path
    port: int

    def ask(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, str]:
        """Status and text of the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        finally:
            connection.close()

    def post(self, where: str, tree: object, **headers: str) -> tuple[int, dict[str, str]]:
        """What the page would post."""
        own = {"Origin": f"http://127.0.0.1:{self.port}", "Content-Type": "application/json", **headers}
        status, text = self.ask("POST", f"/secret/{where}", json.dumps(tree).encode(), **own)
        return status, json.loads(text) if text.startswith("{") else {"said": text}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("viewed")
    slam.map_log(write_synthetic_log(folder / "log", duration_s=34.0).log_path, out=folder / "map").close()
    view = MapView(folder / "map")
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        port = listening.getsockname()[1]
        config = uvicorn.Config(application(view, "secret", port), lifespan="off", log_level="error")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        yield Served(view, folder / "map", port)
        server.should_exit = True
        thread.join()
