"""`scanweave view`: who may look, who may edit, what becomes of it, and that Ctrl-C ends it."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import uvicorn
from edit_maps import content

import slam
from slam.app.viewing import MapView, application
from slam.errors import LibraryError
from slam.simulation.synthetic_log import write_synthetic_log

REPO = Path(__file__).parents[2]


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


def test_only_who_knows_the_token_sees_anything(served: Served) -> None:
    status, page = served.ask("GET", "/secret/")
    assert status == 200 and "connect-src &#39;self&#39;" in page
    for path in (
        "/",
        "/secre/",
        "/secret/map.db",
        "/secret/..%2fmap.db",
        "/secret/../map.db",
        "/secret/edits",
    ):
        assert served.ask("GET", path)[0] in (404, 405), path
    assert served.ask("GET", "/secret/", Host="evil.example:80")[0] == 421
    assert served.ask("GET", "/secret/", Host=f"localhost:{served.port}")[0] == 200


def test_edits_are_taken_from_the_page_alone(served: Served) -> None:
    before = content(served.view.map)
    tree = {"places": [{"name": "dock", "position": [0, 0]}]}
    assert served.post("edits", tree, Origin="http://evil.example")[0] == 403
    assert served.post("edits", tree, **{"Content-Type": "text/plain"})[0] == 415
    assert served.ask("POST", "/wrong/edits", b"{}")[0] == 404
    own = {"Origin": f"http://127.0.0.1:{served.port}", "Content-Type": "application/json"}
    assert served.ask("POST", "/secret/edits", b"[" * 2_000_000, **own)[0] == 413
    for bad, said in (
        (b"[" * 100_000, "nested too deep"),
        (b"no json", "Expecting value"),
        (b'{"places": [{"name": "x", "position": [NaN, 0]}]}', "places"),
        (b'{"erase": [{"poligon": []}]}', "unknown key"),
        (b'{"loops": {"forbid": [[{"reading": 1}, {"reading": 999999}]]}}', "there is no keyframe"),
    ):
        status, text = served.ask("POST", "/secret/edits", bad, **own)
        assert status == 400 and said in json.loads(text)["error"], text
    assert content(served.view.map) == before and not (served.folder / "edits.yaml").exists()


def test_edits_are_saved_beside_the_map_and_can_be_taken_back(served: Served) -> None:
    before = content(served.view.map)
    assert served.post("edits", {"turn": {"degrees": 90}}) == (200, {"done": "saved as edits.yaml"})
    assert (served.folder / "edits.yaml").read_text() == "turn: {degrees: 90.0}\n"
    assert served.post("edits", {"places": [{"name": "<b>", "position": [0, 0]}]})[0] == 200
    assert slam.load_map(served.folder).edits[0] == "turn: {degrees: 90.0}\n"
    assert "<b>" not in served.ask("GET", "/secret/")[1]
    assert served.post("undo", {}) == (200, {"done": "undone; 1 edits are left"})
    assert served.post("undo", {})[0] == 200
    assert content(served.view.map) == before
    assert served.post("undo", {}) == (400, {"error": f"{served.folder / 'map.db'} has no edits to undo"})


def test_it_listens_to_this_machine_alone_and_ends_by_ctrl_c(served: Served) -> None:
    run = "import sys; from slam.cli import main; sys.argv = ['scanweave', 'view', sys.argv[1]]; main()"
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    process = subprocess.Popen(
        [sys.executable, "-c", run, str(served.folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address.startswith("http://127.0.0.1:") and len(address.split("/")[3]) > 40
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0 and not err


def test_without_the_extra_one_line_tells_it(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    with pytest.raises(LibraryError, match=r"pip install 'scanweave\[view\]'"):
        application(served.view, "secret", 1)
