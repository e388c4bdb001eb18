"""Serve the page of a map on this machine only, and apply the edits made there.

The server listens on the loopback interface. Anyone with its address, which contains a random token, can view
and edit the map. Other pages of the same browser do not know the address, and a host name that is redirected
here (DNS rebinding) is rejected by the Host header.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from slam.config.edits import dump_edits, edits_of
from slam.errors import MapFileError, ScanweaveError, needs
from slam.evaluation.saved_page import saved_page, write_saved_page
from slam.foreign import MOST_TEXT, from_json, plain
from slam.outputs.finished_map import Map, load_map
from slam.storage.files import write_bytes
from slam.storage.map_file import MAP_NAME

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

_LOOPBACK = "127.0.0.1"
_NEEDS = "'scanweave view' needs starlette and uvicorn"
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class MapView:
    """A map that is looked at and edited, one edit at a time.

    Parameters
    ----------
    path
        Its folder, or its ``map.db``.

    Raises
    ------
    MapFileError
        If there is none, or its file has another name than ``map.db``.
    """

    def __init__(self, path: Path | str) -> None:
        self._map = load_map(path)
        if self._map.path.name != MAP_NAME:
            raise MapFileError(f"{self._map.path} is not named {MAP_NAME}: no edits can take its place")
        self._lock = Lock()
        self._page: tuple[str, str] | None = None

    @property
    def map(self) -> Map:
        """As it is now."""
        return self._map

    def page(self) -> str:
        """The page of the map as it is now."""
        with self._lock:
            if self._page is None or self._page[0] != self._map.digest:
                self._page = self._map.digest, "".join(saved_page(self._map, connect="'self'"))
            return self._page[1]

    def edit(self, tree: object) -> str:
        """Apply edits that the page has collected, and keep them in ``edits.yaml`` beside the map.

        Returns
        -------
        What became of it, in a line.

        Raises
        ------
        ScanweaveError
            If they do not fit; the map is as it was.
        """
        edits = edits_of(tree, "the edits")
        folder = self._map.path.parent
        with self._lock:
            self._take(self._map.edited(edits, out=folder))
            number = len(self._map.edits)
            name = "edits.yaml" if number == 1 else f"edits-{number}.yaml"
            write_bytes(folder / name, dump_edits(edits).encode())
        return f"saved as {name}"

    def undo(self) -> str:
        """Take the last edits back; as `edit`."""
        with self._lock:
            self._take(self._map.undone(out=self._map.path.parent))
        return f"undone; edits left: {len(self._map.edits)}"

    def _take(self, saved: Map) -> None:
        """Show another map from now on."""
        self._map.close()
        self._map = saved
        write_saved_page(saved)


def application(view: MapView, token: str, port: int) -> Starlette:
    """The program behind the address ``http://127.0.0.1:PORT/TOKEN/``.

    Raises
    ------
    LibraryError
        Without the extra ``view``.
    """
    with needs(_NEEDS, "view"):
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse
        from starlette.routing import Route
    hosts = {f"{name}:{port}" for name in (_LOOPBACK, "localhost")}

    def refused(request: Request, *, writes: bool) -> Response | None:
        """The error response to a request that is not allowed."""
        if request.headers.get("host") not in hosts:
            return PlainTextResponse("wrong host", 421, _HEADERS)
        if not secrets.compare_digest(str(request.path_params.get("token", "")).encode(), token.encode()):
            return PlainTextResponse("not found", 404, _HEADERS)
        if writes and request.headers.get("origin") not in {f"http://{host}" for host in hosts}:
            return PlainTextResponse("wrong origin", 403, _HEADERS)
        if writes and request.headers.get("content-type") != "application/json":
            return PlainTextResponse("edits are JSON", 415, _HEADERS)
        return None

    async def look(request: Request) -> Response:
        """The page."""
        no = refused(request, writes=False)
        return no or HTMLResponse(await run_in_threadpool(view.page), 200, _HEADERS)

    async def change(request: Request, act: Callable[[object], str]) -> Response:
        """Edit the map with what was posted."""
        if no := refused(request, writes=True):
            return no
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > MOST_TEXT:
                return JSONResponse({"error": f"more than {MOST_TEXT} bytes of edits"}, 413, _HEADERS)
        try:
            done = await run_in_threadpool(act, from_json(body))
        except (ScanweaveError, ValueError) as error:
            return JSONResponse({"error": plain(error, longest=500)}, 400, _HEADERS)
        return JSONResponse({"done": done}, 200, _HEADERS)

    async def edit(request: Request) -> Response:
        """Apply edits."""
        return await change(request, view.edit)

    async def undo(request: Request) -> Response:
        """Take the last back."""
        return await change(request, lambda _: view.undo())

    routes = [
        Route("/{token}/", look, methods=["GET"]),
        Route("/{token}/edits", edit, methods=["POST"]),
        Route("/{token}/undo", undo, methods=["POST"]),
    ]
    return Starlette(routes=routes)


def serve(path: Path | str, port: int, tell: Callable[[str], None]) -> None:
    """Serve the page of a map until it is interrupted.

    Parameters
    ----------
    port
        0 takes one that is free.
    tell
        Called with the address.

    Raises
    ------
    ScanweaveError
        Without the extra ``view``, where there is no such map, or the port is in use.
    """
    with needs(_NEEDS, "view"):
        import uvicorn

    class _Server(uvicorn.Server):
        """A server that reports its address when it answers; an interrupt ends it."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            tell(f"http://{_LOOPBACK}:{bound}/{token}/")

    view, token = MapView(path), secrets.token_urlsafe()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((_LOOPBACK, port))
        except OSError as error:
            raise ScanweaveError(f"port {port}: {error.strerror}; give another --port") from error
        bound = int(listening.getsockname()[1])
        options: dict[str, Any] = {"access_log": False, "server_header": False, "log_level": "warning"}
        server = _Server(uvicorn.Config(application(view, token, bound), lifespan="off", **options))
        try:
            server.run(sockets=[listening])
        except KeyboardInterrupt:
            return  # as it should end
