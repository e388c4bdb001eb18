"""`scanweave view`: who may look, who may edit, what becomes of it, and that Ctrl-C ends it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from edit_maps import content
from view_server import Served, served

import slam
from slam.app.viewing import application
from slam.errors import LibraryError

__all__ = ["served"]  # a fixture

REPO = Path(__file__).parents[2]


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
    assert served.post("undo", {}) == (200, {"done": "undone; edits left: 1"})
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


def test_without_the_extra_one_line_shows_it(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    with pytest.raises(LibraryError, match=r"pip install 'scanweave\[view\]'"):
        application(served.view, "secret", 1)
