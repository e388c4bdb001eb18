"""Recording for the Rerun viewer during a run.

Everything is in the map frame, in metres, on the clock of the log.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import ScanweaveError, needs
from slam.measurements import ColorImage, Float32Array, FloatArray, Pose, spatial

_UNKNOWN, _FREE, _OCCUPIED = 205, 254, 0  # nav2's grey values
_JPEG_QUALITY = 80
_BLUE, _GREEN, _RED, _GREY = (37, 99, 184), (31, 138, 76), (194, 53, 43), (102, 114, 129)


class Viewer:
    """Writes a Rerun recording, which needs no display; `recording` makes one."""

    def __init__(self, stream: Any) -> None:
        import rerun

        self._rr, self._stream = rerun, stream
        self._static = True
        stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def at(self, stamp_s: float) -> None:
        """What follows is of this moment; before the first call it is of all time."""
        self._static = False
        self._stream.set_time("log", timestamp=stamp_s)

    def pose(self, T_map_base: Pose) -> None:
        """Where the robot is."""
        matrix = spatial(T_map_base).matrix()
        self._log("map/robot", self._rr.Transform3D(translation=matrix[:3, 3], mat3x3=matrix[:3, :3]))

    def scan(self, points_map: FloatArray) -> None:
        """(N, 2) or (N, 3) points of a scan."""
        self._log("map/scan", self._rr.Points3D(_lifted(points_map), colors=_RED, radii=0.02))

    def image(self, sensor: str, color: ColorImage, depth_m: Float32Array) -> None:
        """What a camera sees."""
        self._log(f"cameras/{sensor}/color", self._rr.Image(color).compress(jpeg_quality=_JPEG_QUALITY))
        depth_mm = np.clip(1000.0 * depth_m, 0, 65535).astype(np.uint16)
        self._log(f"cameras/{sensor}/depth", self._rr.DepthImage(depth_mm, meter=1000.0))

    def polyline(self, name: str, positions_m: FloatArray) -> None:
        """(N, 2) or (N, 3) positions of a trajectory."""
        color = _GREY if name == "truth" else _BLUE
        self._log(f"map/ways/{name}", self._rr.LineStrips3D([_lifted(positions_m)], colors=color))

    def edges(self, name: str, ends_m: FloatArray, *, holds: bool) -> None:
        """(E, 2, 2) or (E, 2, 3) both ends of edges of the graph, or of loops; none clears them."""
        ends = np.asarray(ends_m, dtype=np.float64)
        strips = _lifted(ends.reshape(-1, ends.shape[-1])).reshape(-1, 2, 3)
        color = _GREEN if holds else _RED
        self._log(f"map/{name}", self._rr.LineStrips3D(strips, colors=color, radii=0.01))

    def grid(self, name: str, states: NDArray[np.int8], resolution_m: float, T_map_grid: gtsam.Pose2) -> None:
        """(rows, cols) of 100 occupied, 0 free, -1 unknown, row 0 at the lowest y."""
        grey = np.full(states.shape, _UNKNOWN, dtype=np.uint8)
        grey[states == 0] = _FREE
        grey[states == 100] = _OCCUPIED
        rows, cols = states.shape
        form = self._rr.components.ImageFormat(
            width=cols, height=rows, color_model="L", channel_datatype="U8"
        )
        half = 0.5 * T_map_grid.theta()
        cells = self._rr.GridMap(
            data=grey[::-1].tobytes(),  # an image begins at its top
            format=form,
            cell_size=resolution_m,
            translation=[T_map_grid.x(), T_map_grid.y(), 0.0],
            quaternion=[0.0, 0.0, np.sin(half), np.cos(half)],
        )
        self._log(f"map/grids/{name}", cells)

    def figure(self, name: str, value: float) -> None:
        """A number over time."""
        self._log(f"figures/{name}", self._rr.Scalars(value))

    def note(self, text: str) -> None:
        """A line for people."""
        self._log("notes", self._rr.TextLog(text))

    def _log(self, path: str, what: Any) -> None:
        """Write an entity, for this moment or for all time."""
        self._stream.log(path.split("/"), what, static=self._static)  # parts are escaped, whatever they hold


@contextmanager
def recording(path: Path | None) -> Iterator[Viewer | None]:
    """A viewer that writes a recording to ``path``, which appears whole or not at all; None without a path.

    Raises
    ------
    ScanweaveError
        If Rerun is not installed, or the file cannot be written.
    """
    if path is None:
        yield None
        return
    with needs("a recording needs rerun", "viewer"):
        import rerun
    if path.suffix != ".rrd":
        raise ScanweaveError(f"cannot write {path}: the name of a recording ends in .rrd")
    if not path.absolute().parent.is_dir():
        raise ScanweaveError(f"cannot write {path}: there is no folder {path.absolute().parent}")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.rrd")
    stream = rerun.RecordingStream("scanweave")
    try:
        with _reported(path):
            stream.save(temporary)
        yield Viewer(stream)
        with _reported(path):
            stream.flush()
            stream.disconnect()
            temporary.replace(path)
    finally:
        stream.disconnect()
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn what Rerun and the disk report into one line."""
    try:
        yield
    except (RuntimeError, OSError) as error:
        why = getattr(error, "strerror", error)
        raise ScanweaveError(f"cannot write {path}: {why}; check the folder and its free space") from error


def _lifted(points: FloatArray) -> FloatArray:
    """(N, 3) points of (N, 2) or (N, 3) ones."""
    rows = np.asarray(points, dtype=np.float64)
    return np.column_stack([rows, np.zeros(len(rows))]) if rows.shape[1] == 2 else rows
