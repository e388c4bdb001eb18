"""Commands on a finished map: scanweave info, check, export, floorplan, diff."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import JsonOption, command, folder_of, say, tell
from slam.errors import ScanweaveError
from slam.later import load_later

MapArgument = Annotated[
    Path, typer.Argument(metavar="MAP", help="output folder of 'scanweave map', or its map.db")
]


class Format(StrEnum):
    """What a map can be exported as."""

    NAV2 = "nav2"
    TUM = "tum"
    G2O = "g2o"
    PLY = "ply"
    BT = "bt"
    COLMAP = "colmap"
    NERFSTUDIO = "nerfstudio"
    GLB = "glb"
    E57 = "e57"
    KITTI = "kitti"
    GPX = "gpx"
    SENSORS = "sensors"
    MCAP = "mcap"
    LAS = "las"
    PCD = "pcd"
    PLY_TILES = "ply-tiles"
    LAS_TILES = "las-tiles"
    PCD_TILES = "pcd-tiles"
    SVG = "svg"
    DXF = "dxf"
    GEOJSON = "geojson"
    NAV2_ZONES = "nav2-zones"


@command("info house/")
def info(map_: MapArgument, as_json: JsonOption = False) -> None:
    """Show what a map contains: sensors, keyframes, loops, grid, settings, versions."""
    load_later("gtsam")
    from slam.evaluation.map_info import map_info, render_info

    facts = map_info(map_)
    tell(json.dumps(facts, indent=2) if as_json else render_info(facts))


@command("check house/")
def check(map_: MapArgument) -> None:
    """Verify a map: read all of it and compare it with its checksums."""
    from slam.outputs.finished_map import load_map

    saved = load_map(map_)
    saved.check()
    frames, clouds = saved.contents.frames or (), saved.contents.clouds or ()
    with_clouds = f"{len(clouds)} clouds, " if clouds else ""
    tell(
        f"{saved.path} is whole: {len(saved.keyframe_poses)} keyframes, {with_clouds}{len(frames)} images, "
        f"{len(saved.factors)} factors, {len(saved.trajectory)} poses, digest {saved.digest}"
    )


@command("export house/ --format nav2 -o nav2/")
def export(
    map_: MapArgument,
    format_: Annotated[
        Format, typer.Option("--format", "-f", help="output format; docs/outputs.md describes each")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", parser=folder_of, help="output file, or a folder for files with the usual names"
        ),
    ],
) -> None:
    """Export a map to the format of another program."""
    from slam.outputs.finished_map import load_map

    saved = load_map(map_)
    written = saved.export(format_.value, out)
    if not written:
        raise ScanweaveError(f"nothing was exported of {saved.path}: its images show no surface")
    say("wrote " + ", ".join(str(path) for path in written))


@command("floorplan house/ -o plan.svg")
def floorplan(
    map_: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="the drawing: .svg, .dxf or .geojson")] = Path(
        "floorplan.svg"
    ),
    as_json: JsonOption = False,
) -> None:
    """Draw a floor plan: rooms, doors, lengths and areas, each with its 95 % interval."""
    from slam.outputs.finished_map import load_map
    from slam.storage.plan_files import plan_geojson

    formats = {".svg": Format.SVG, ".dxf": Format.DXF, ".geojson": Format.GEOJSON}
    if out.suffix not in formats:
        raise typer.BadParameter(f"--out is {out}; give a file that ends in {', '.join(formats)}")
    saved = load_map(map_)
    plan = saved.floor_plan()
    saved.export(formats[out.suffix].value, out)
    tell(json.dumps(plan_geojson(plan), indent=2) if as_json else plan.text())
    say(f"wrote {out}")


@command("diff monday/ friday/ -o diff/")
def diff(
    before: MapArgument,
    after: Annotated[
        Path | None, typer.Argument(metavar="[MAP]", help="the later map; omit it with --sessions")
    ] = None,
    sessions: Annotated[
        tuple[int, int] | None,
        typer.Option("--sessions", help="numbers of two sessions of one map, instead of a second map"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", parser=folder_of, help="folder for diff.json, diff.geojson and diff.png"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List what disappeared, appeared or moved between two maps of a place, with probabilities."""
    from slam.app.differing import diff_maps
    from slam.outputs.finished_map import load_map
    from slam.sessions.difference_files import difference_plain, difference_text

    first, second = load_map(before), None if after is None else load_map(after)
    difference = diff_maps(first, second, sessions=sessions, out=out)
    result = difference.things, difference.passing, difference.comparison
    names = [str(before), str(before if after is None else after)]
    tell(json.dumps(difference_plain(*result, names), indent=2) if as_json else difference_text(*result))
    if difference.written and not as_json:
        say("wrote " + ", ".join(str(path) for path in difference.written))
