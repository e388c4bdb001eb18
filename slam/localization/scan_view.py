"""A scan in the form that localisation uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.matching.local_map import OrientedPoints
from slam.matching.scan_points import ScanPoints, points_by
from slam.measurements import AnyFloatArray, BoolArray, FloatArray, LaserScan

Numbers: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class ScanView:
    """A prepared scan.

    Attributes
    ----------
    points
        All returns, base frame.
    oriented
        Returns on a line, with normals.
    laser
        (2,) origin of the beams, base frame.
    """

    stamp_s: float
    points: ScanPoints
    oriented: OrientedPoints
    laser: FloatArray

    @classmethod
    def of(cls, scan: LaserScan, config: Config) -> ScanView:
        """Prepare a scan."""
        points = points_by(config.scan, scan)
        laser = np.array([scan.T_base_laser.x(), scan.T_base_laser.y()])
        return cls(scan.stamp_s, points, OrientedPoints.from_scan(points), laser)

    def only(self, keep: BoolArray) -> ScanView:
        """Return the scan with only some of its returns, (M,)."""
        points = ScanPoints(self.points.points_base[keep], self.points.normals_base[keep])
        return ScanView(self.stamp_s, points, OrientedPoints.from_scan(points), self.laser)


def first_in_cells(points: AnyFloatArray, cell_m: float) -> tuple[Numbers, NDArray[np.int64]]:
    """Return indices of the first point (of (M, 2)) in each cell, ascending, and (n, 2) the cells."""
    cells = np.floor(points / cell_m).astype(np.int64)
    _, first = np.unique(cell_keys(cells), return_index=True)
    first = np.sort(first)
    return first, cells[first]


def cell_keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for each of (n, 2) cells."""
    keys: NDArray[np.int64] = (cells[:, 0] << 32) + cells[:, 1]
    return keys
