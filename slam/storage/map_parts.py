"""Parts of ``map.db`` that can be read separately: the trajectory, the grids, scans of keyframes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from slam.errors import MapFileError
from slam.estimates import Trajectory, one_after_another
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import LaserScan
from slam.spool import Spool
from slam.storage.map_file import MapFile
from slam.storage.map_soundness import of, require, sound_grid, sound_trajectory
from slam.storage.map_tables import GRIDS, TRAJECTORY
from slam.storage.packing import pack_small, unpack, unpack_small

Unpack = Callable[[bytes], Any]

_MOST_GRIDS = 4


def read_trajectory(file: MapFile, small: Unpack) -> Trajectory:
    """Read only the trajectory; `MapFileError` if a row is damaged."""
    stretches = list(
        file.parsed(TRAJECTORY, lambda row: sound_trajectory(of(Trajectory, small(row[1])), row[0]))
    )
    if not stretches:
        raise MapFileError(f"{file.path} holds no trajectory; make the map anew")
    return one_after_another(stretches)


def read_grids(file: MapFile, small: Unpack, *, placed: bool = True) -> dict[str, OccupancyGrid]:
    """Read only the grids, with or without their poses; `MapFileError` if a row is damaged."""
    if file.count(GRIDS) > _MOST_GRIDS:
        raise MapFileError(f"{file.path} holds {file.count(GRIDS)} grids; make the map anew")
    return dict(file.parsed(GRIDS, lambda row: _grid(row, small, placed)))


def _grid(row: tuple[Any, ...], small: Unpack, placed: bool) -> tuple[str, OccupancyGrid]:
    """Parse a row of the grids, with its name."""
    name, rows, cols, resolution_m, corner, cells = row
    steps = of(np.ndarray, small(cells))
    require(steps.shape == (rows, cols), "its cells have another size")
    T_map_grid: Any = of(gtsam.Pose2, unpack(corner)) if placed else None
    if steps.dtype == np.float32:  # log-odds, in maps of the first schemas
        require((np.abs(steps) < np.inf).all(), "its cells are not finite")
        return name, sound_grid(OccupancyGrid.of_log_odds(steps, resolution_m, T_map_grid))
    require(steps.dtype == np.int16, "its cells are no steps of log-odds")
    return name, sound_grid(OccupancyGrid(steps, resolution_m, T_map_grid))


class KeptScans(Sequence[LaserScan | None]):
    """Scans with one in memory at a time, shared by parallel iterations.

    Parameters
    ----------
    read
        Reads the scan of an index.
    """

    def __init__(self, count: int, read: Callable[[int], Any]) -> None:
        self._count, self._read = count, read
        self._newest: tuple[int, Any] = -1, None

    @classmethod
    def on_disk(cls, scans: Iterable[Any]) -> KeptScans:
        """Store scans, or tuples of them, in a temporary file as they are created."""
        spool = Spool()
        for scan in scans:
            spool.append(pack_small(scan))
        return cls(len(spool), lambda key: unpack_small(spool[key]))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Any) -> Any:
        numbers = range(self._count)[key]
        if isinstance(numbers, range):
            return [self[number] for number in numbers]
        newest = self._newest
        if newest[0] != numbers:
            self._newest = newest = numbers, self._read(numbers)
        return newest[1]
