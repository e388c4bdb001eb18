"""Differences between two maps of a place, or between two sessions of one map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from fusion.showing import one_line, with_pictures
from slam.errors import ScanweaveError, path_of
from slam.localization.known_map import has_walls
from slam.outputs.finished_map import Map, load_map
from slam.sessions.changes import Comparison, Visit, compare, spread_between
from slam.sessions.connection import connect
from slam.sessions.difference_files import difference_picture, write_difference
from slam.sessions.moved_things import ChangedThing, changed_things
from slam.storage.map_contents import MapContents


@dataclass(frozen=True, slots=True)
class Difference:
    """The differences between two maps or sessions.

    Attributes
    ----------
    things
        Objects that disappeared, appeared or moved, in the frame of the first map. The most likely change
        comes first; each has a probability above one half.
    passing
        Number of objects that were seen only at times: people, glass.
    comparison
        Everything that may have changed, and what both visits saw.
    written
        The files that were written.
    """

    things: Sequence[ChangedThing]
    passing: int
    comparison: Comparison
    written: tuple[Path, ...] = ()

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, difference_picture(self.things, self.comparison))


def diff_maps(
    before: Map | Path | str,
    after: Map | Path | str | None = None,
    *,
    sessions: tuple[int, int] | None = None,
    out: Path | str | None = None,
) -> Difference:
    """Find objects that disappeared, appeared or moved between two maps of a place, or sessions of one map.

    Two maps are first aligned in one frame, as `slam.join` does; neither map is changed.

    Parameters
    ----------
    before, after
        The maps or their paths; they must be of a robot on a floor with a lidar. ``after`` is None if
        ``sessions`` names two sessions of ``before``.
    sessions
        Numbers of two sessions of ``before``, from 1.
    out
        Folder for ``diff.json``, ``diff.geojson`` and ``diff.png``; None writes nothing.

    Raises
    ------
    ScanweaveError
        If a map has no scans or is not of a robot on a floor, the maps cannot be aligned, a session does not
        exist, or a file cannot be written.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> monday = slam.map_log(write_synthetic_log("monday", seed=1, duration_s=10.0).log_path)
    >>> tuesday = slam.map_log(write_synthetic_log("tuesday", seed=2, duration_s=10.0).log_path)
    >>> slam.diff_maps(monday, tuesday).things
    []
    """
    before = before if isinstance(before, Map) else load_map(before)
    after = after if isinstance(after, Map | None) else load_map(after)
    for saved in (before, after):
        if saved is not None:
            _refuse_unfit(saved)
    if (after is None) == (sessions is None):
        raise ScanweaveError("give two maps, or two sessions of one map")
    if after is None:
        assert sessions is not None
        contents, parts = before.contents, _keyframes_of(before, sessions)
    elif before.digest == after.digest:
        contents, parts = before.contents, [np.arange(len(before.keyframe_poses))] * 2
    else:
        contents, parts = _in_one_frame(before, after)
    visits = [
        Visit([contents.measured_scans[k] for k in part], contents.keyframe_poses[part]) for part in parts
    ]
    compared = compare(visits[0], visits[1], spread_between(contents, *parts), before.config)
    believed = [change for change in compared.changes if change.probability > 0.5]
    things = changed_things(believed, compared.resolution_m)
    passing = sum(change.standing < 0.5 for change in compared.changes)
    difference = Difference(things, passing, compared)
    if out is None:
        return difference
    names = [before.path, after.path] if after else [before.path] * 2
    written = write_difference(path_of(out, "out"), things, passing, compared, [str(name) for name in names])
    return Difference(things, passing, compared, tuple(written))


def _refuse_unfit(saved: Map) -> None:
    """Raise an error if a map has no scans of a robot on a floor."""
    if saved.contents.clouds or not saved.planar:
        sensor = "a 3D lidar" if saved.contents.clouds else "a camera in space"
        raise ScanweaveError(f"{saved.path} is of {sensor}; only maps of a robot on a floor are compared")
    if not has_walls(saved.contents):
        raise ScanweaveError(f"{saved.path} holds no lidar scan; maps are compared by their scans")


def _keyframes_of(saved: Map, sessions: tuple[int, int]) -> list[np.ndarray]:
    """Return the keyframes of two sessions."""
    count = len(saved.sessions)
    numbers = [number for number in sessions if number in range(1, count + 1)]
    if len(numbers) != 2 or numbers[0] == numbers[1] or len(sessions) != 2:
        named = " and ".join(map(str, sessions))
        raise ScanweaveError(f"{saved.path} has sessions 1 to {count}; name two of them, not {named}")
    ends = list(accumulate(session.keyframes for session in saved.sessions))
    return [np.arange(ends[n - 1] - saved.sessions[n - 1].keyframes, ends[n - 1]) for n in sessions]


def _in_one_frame(before: Map, after: Map) -> tuple[MapContents, list[np.ndarray]]:
    """Return both maps as one, and the keyframes of each."""
    connection = connect(before, after)
    if connection.joined is None:
        raise ScanweaveError(f"{after.path} does not connect to {before.path}: {connection.reason}")
    contents, first = connection.joined.contents, len(before.keyframe_poses)
    return contents, [np.arange(first), np.arange(first, len(contents.node_poses))]
