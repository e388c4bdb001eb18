"""Commands that change a finished map without its log: scanweave edit, merge, remap, view."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import SetOption, command, folder_of, say, tell
from slam.cli.saved import MapArgument

if TYPE_CHECKING:
    from slam.outputs.finished_map import Map

OutOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", parser=folder_of, help="folder for the new map; default: replace the map"),
]


@command("edit house/ edits.yaml")
def edit(
    map_: MapArgument,
    edits: Annotated[
        Path | None, typer.Argument(metavar="EDITS", help="edits.yaml; docs/edits.md describes it")
    ] = None,
    out: OutOption = None,
    undo: Annotated[bool, typer.Option("--undo", help="undo the last edits")] = False,
    list_: Annotated[bool, typer.Option("--list", help="list the edits of the map")] = False,
    sessions: Annotated[
        int | None, typer.Option(metavar="N", help="keep the first N sessions and remove the later ones")
    ] = None,
) -> None:
    """Apply edits to a map: forbid, force or add loops, erase regions, add zones, rotate, name places."""
    if (edits is not None) + undo + list_ + (sessions is not None) != 1:
        raise typer.BadParameter("give a file of edits, --undo, --sessions or --list")
    started = time.perf_counter()
    from slam.outputs.finished_map import load_map

    saved = load_map(map_)
    if list_:
        for number, text in enumerate(saved.edits, start=1):
            tell(f"# {number}\n{text.rstrip()}")
        if not saved.edits:
            tell(f"{saved.path} has no edits")
        return
    folder = out or _own_folder(saved)
    if sessions is not None:
        from slam.app.rolling_back import roll_back

        edited_map = roll_back(saved, sessions, out=folder)
    else:
        edited_map = saved.undone(out=folder) if undo else saved.edited(edits or "", out=folder)
    _report(saved, edited_map, started)


@command("merge ground-floor/ upstairs/ -o house/")
def merge(
    maps: Annotated[
        list[Path], typer.Argument(metavar="MAP...", help="maps; the first defines frame and settings")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", parser=folder_of, help="folder for the joined map")],
    force: Annotated[bool, typer.Option("--force", help="replace a map in the folder")] = False,
) -> None:
    """Join saved maps into one, in any order; report each map that does not connect, and why."""
    started = time.perf_counter()
    from slam.app.merging import merge as merged

    result = merged(maps, out, overwrite=force)
    for path, reason in result.refused.items():
        tell(f"warning: {path} does not connect: {reason}", sys.stderr)
    joined = len(maps) - len(result.refused)
    say(
        f"{joined} of {len(maps)} maps in one, {len(result.map.sessions)} sessions, "
        f"{len(result.map.keyframe_poses)} keyframes; {time.perf_counter() - started:.1f} s"
    )
    say("wrote " + ", ".join(str(path) for path in result.written))


@command("remap house/ -s grid.resolution_m=0.02 -o fine/")
def remap(map_: MapArgument, set_: SetOption = None, out: OutOption = None) -> None:
    """Rebuild a map with other settings (cell size, layers, accepted loops), without its log."""
    started = time.perf_counter()
    from slam.outputs.finished_map import load_map

    saved = load_map(map_)
    _report(saved, saved.remap(set_ or [], out=out or _own_folder(saved)), started)


@command("view house/")
def view(
    map_: MapArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 picks a free one")] = 0,
) -> None:
    """Open a map in a browser on this machine, and save the edits made there."""
    from slam.app.viewing import serve

    serve(map_, port, lambda address: tell(f"{address}\nThe map is served there until you press Ctrl-C."))


def _own_folder(saved: Map) -> Path:
    """Where a map lies, if another may take its place there."""
    from slam.errors import MapFileError
    from slam.storage.map_file import MAP_NAME

    if saved.path.name != MAP_NAME:
        raise MapFileError(f"{saved.path} is not named {MAP_NAME}; give --out for the new map")
    return saved.path.parent


def _report(before: Map, after: Map, started: float) -> None:
    """What became of a map."""
    import numpy as np

    from slam.evaluation.saved_page import write_saved_page
    from slam.matching.planar import between

    # Seen from the first keyframe: a map that was turned has not changed.
    old_and_new = (before.keyframe_poses, after.keyframe_poses)
    ends = [[between(poses[0], pose)[:2] for pose in poses] for poses in old_and_new]
    moved_m = float(np.hypot(*(np.array(ends[1]) - ends[0][: len(ends[1])]).T).max())
    loops = sum(loop.accepted for loop in after.loops)
    say(
        f"edits: {len(after.edits)}; {loops} of {len(after.loops)} loops accepted; keyframes moved by up to "
        f"{moved_m:.3f} m; {time.perf_counter() - started:.1f} s"
    )
    for loop in after.loops[len(before.loops) :]:
        if not loop.accepted:
            tell(f"warning: an added loop {loop.reason}; 'loops: force' keeps it", sys.stderr)
    say(f"wrote {after.path}, {write_saved_page(after)}")
