"""scanweave diff."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import JsonOption, command, folder_of, say, tell
from slam.cli.saved import MapArgument


@command()
def diff(
    before: MapArgument,
    after: Annotated[
        Path | None, typer.Argument(metavar="[MAP]", help="the later map; none with --sessions")
    ] = None,
    sessions: Annotated[
        tuple[int, int] | None,
        typer.Option("--sessions", help="two sessions of one map, by their numbers, instead of a second map"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", parser=folder_of, help="folder for diff.json, diff.geojson and diff.png"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Tell what went, appeared or moved between two maps of a place, with a probability each."""
    from slam.app.differing import diff_maps
    from slam.outputs.finished_map import open_map
    from slam.sessions.difference_files import difference_plain, difference_text

    first, second = open_map(before), None if after is None else open_map(after)
    found = diff_maps(first, second, sessions=sessions, out=out)
    told = found.things, found.passing, found.comparison
    names = [str(before), str(before if after is None else after)]
    tell(json.dumps(difference_plain(*told, names), indent=2) if as_json else difference_text(*told))
    if found.written and not as_json:
        say("wrote " + ", ".join(str(path) for path in found.written))
