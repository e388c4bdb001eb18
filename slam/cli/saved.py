"""Commands on a finished map: scanweave info, check, export."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import JsonOption, command, folder_of, say, tell
from slam.errors import ScanweaveError

MapArgument = Annotated[
    Path, typer.Argument(metavar="MAP", help="a folder that 'scanweave map' has made, or its map.db")
]


class Format(StrEnum):
    """What a map can be exported as."""

    NAV2 = "nav2"
    TUM = "tum"
    G2O = "g2o"
    PLY = "ply"
    BT = "bt"


@command()
def info(map_: MapArgument, as_json: JsonOption = False) -> None:
    """Tell what is in a map: sensors, keyframes, loops, grid, settings, versions."""
    from slam.evaluation.map_info import map_info, render_info

    found = map_info(map_)
    tell(json.dumps(found, indent=2) if as_json else render_info(found))


@command()
def check(map_: MapArgument) -> None:
    """Read everything in a map and compare it with its checksums."""
    from slam.outputs.finished_map import open_map

    saved = open_map(map_)
    saved.check()
    frames, clouds = saved.contents.frames or (), saved.contents.clouds or ()
    with_clouds = f"{len(clouds)} clouds, " if clouds else ""
    tell(
        f"{saved.path} is whole: {len(saved.keyframe_poses)} keyframes, {with_clouds}{len(frames)} images, "
        f"{len(saved.factors)} factors, {len(saved.trajectory)} poses, digest {saved.digest}"
    )


@command()
def export(
    map_: MapArgument,
    format_: Annotated[
        Format, typer.Option("--format", "-f", help="nav2 grid, TUM trajectory, g2o graph, PLY, OctoMap")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", parser=folder_of, help="the file, or a folder for files of the usual names"
        ),
    ],
) -> None:
    """Write a map in the format of another program: the same bytes as 'scanweave map' has written."""
    from slam.outputs.finished_map import open_map

    saved = open_map(map_)
    written = saved.export(format_.value, out)
    if not written:
        raise ScanweaveError(f"nothing was exported of {saved.path}: its images show no surface")
    say("wrote " + ", ".join(str(path) for path in written))
