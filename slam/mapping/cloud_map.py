"""Point cloud of the whole map from the clouds of its keyframes, tile by tile, coloured by height."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import IO, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, TINY
from fusion.height_band import thin_to_voxels
from slam.mapping.dense_map import ColoredCloud, Colors, refuse_lost
from slam.matching.local_cloud import moved
from slam.matching.plane_voxels import surface_normals
from slam.measurements import AnyFloatArray, BoolArray, Float32Array, FloatArray
from slam.vision.prefetch import prefetched

_Span: TypeAlias = tuple[int, int, int]  # offset of rows in a file, their number and columns

# Side of a tile in voxels; side of a neighbourhood cell: larger than the error of a lidar.
_TILE_VOXELS, _NORMAL_VOXELS = 256.0, 1.5
# Blue, green, yellow, red from the lowest to the highest usual height.
_RAMP = np.array([[40, 60, 160], [40, 160, 120], [230, 210, 60], [200, 60, 40]], dtype=np.float64)
_USUAL_PERCENT = (1.0, 99.0)


class CloudTiles:
    """The points of a map's clouds, one per voxel, in tiles on disk: the clouds are read once.

    Parameters
    ----------
    clouds
        (N, 3) points of each keyframe, base frame, or (N, 4) with their intensities.
    poses
        ``T_map_base`` of each.
    file
        Empty file for the stored points.

    Raises
    ------
    ScanweaveError
        If a pose is not finite.
    """

    def __init__(
        self, clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], voxel_m: float, file: IO[bytes]
    ) -> None:
        self._voxel_m, self._file = voxel_m, file
        self._path = np.array([pose.translation() for pose in poses]).reshape(-1, 3)
        self._seen, pieces = list[_Span](), [np.zeros((0, 5), np.int64)]
        refuse_lost(poses)
        numbered = enumerate(zip(clouds, poses, strict=True))
        self._columns = 4
        for placed, tiles in prefetched(numbered, lambda args: _by_tile(args[0], *args[1], voxel_m), 1):
            self._seen.append(self._keep(placed))
            begin, _, columns = self._seen[-1]
            self._columns = max(self._columns, columns)
            begins = begin + placed.strides[0] * (np.cumsum(tiles[:, 2]) - tiles[:, 2])
            pieces.append(np.column_stack([tiles[:, :2], begins, tiles[:, 2], np.full(len(tiles), columns)]))
        self._tiles, heights = list[_Span](), [np.zeros(0, np.float32)]
        parts = np.concatenate(pieces)
        parts = parts[np.lexsort((parts[:, 2], parts[:, 1], parts[:, 0]))]
        ends = np.flatnonzero(np.diff(parts[:, :2], axis=0).any(axis=1)) + 1
        for tile in np.split(parts[:, 2:], ends) if len(parts) else []:
            rows = self._thinned(tile.tolist())
            heights.append(rows[::FEWEST, 2].astype(np.float32))
            self._tiles.append(self._keep(rows))
        self._height_range = _usual(np.concatenate(heights))

    def points(self) -> Iterator[FloatArray]:
        """Yield (N, 3) points of one tile after the other, map frame."""
        return self._points(self._tiles)

    def seen(self) -> Iterator[FloatArray]:
        """Yield (N, 3) points of one keyframe after the other, map frame."""
        return self._points(self._seen)

    def cloud(self, chosen: Callable[[FloatArray], BoolArray] | None = None) -> Iterator[ColoredCloud]:
        """Return the chosen points, or all, with normals towards the keyframe that saw them."""

        def colored(rows: FloatArray) -> ColoredCloud:
            rows = rows if chosen is None else rows[chosen(rows[:, :3])]
            points = rows[:, :3]
            normals = surface_normals(points, _NORMAL_VOXELS * self._voxel_m)
            is_back = np.einsum("ij,ij->i", normals, self._path[rows[:, 3].astype(np.int64)] - points) < 0.0
            normals[is_back] *= -1.0
            colors = ramp(points[:, 2], self._height_range)
            intensities = rows[:, 4].astype(np.float32) if self._columns > 4 else None
            return ColoredCloud(points.astype(np.float32), colors, normals.astype(np.float32), intensities)

        return prefetched((self._rows(tile) for tile in self._tiles), colored, most_waiting=1)

    def _keep(self, rows: AnyFloatArray) -> _Span:
        """Write rows (points, keyframe number, and intensity, if any); return their location."""
        span = self._file.seek(0, os.SEEK_END), len(rows), rows.shape[1]
        self._file.write(rows.astype(np.float32, copy=False).data)
        return span

    def _points(self, spans: Iterable[_Span]) -> Iterator[FloatArray]:
        """Yield (N, 3) of the written points, one block after the other."""
        return (np.ascontiguousarray(self._rows(span)[:, :3]) for span in spans)

    def _rows(self, span: _Span) -> FloatArray:
        """Return written rows; an intensity that only others have is NaN."""
        begin, count, columns = span
        rows = np.empty((count, self._columns))
        self._file.seek(begin)
        rows[:, :columns] = np.fromfile(self._file, np.float32, columns * count).reshape(-1, columns)
        rows[:, columns:] = np.nan
        return rows

    def _thinned(self, spans: Sequence[_Span]) -> FloatArray:
        """Return the rows of a tile, the first of each voxel; few more are ever in memory."""
        kept, waiting, most = np.zeros((0, self._columns)), list[FloatArray](), 0
        for span in spans:
            waiting.append(self._rows(span))
            most += span[1]
            if most > max(_TILE_VOXELS**2, len(kept)):
                kept, waiting, most = thin_to_voxels(np.concatenate([kept, *waiting]), self._voxel_m), [], 0
        return thin_to_voxels(np.concatenate([kept, *waiting]), self._voxel_m)


def _by_tile(
    number: int, points: FloatArray, T_map_base: gtsam.Pose3, voxel_m: float
) -> tuple[Float32Array, NDArray[np.int64]]:
    """Return rows of `CloudTiles` for points (N, 3 or 4), base frame, one per voxel, tile by tile.

    Also (T, 3) the index of each tile, and its number of rows.
    """
    points = thin_to_voxels(np.column_stack([moved(points, T_map_base), points[:, 3:]]), voxel_m)
    rows = np.empty((len(points), 1 + points.shape[1]), np.float32)
    if not len(points):
        return rows, np.zeros((0, 3), np.int64)
    x, y = (np.floor(points[:, axis] / (_TILE_VOXELS * voxel_m)).astype(np.int64) for axis in (0, 1))
    columns = int(np.ptp(y)) + 1
    # Small numbers sort ten times as fast.
    numbers = (x - x.min()) * columns + (y - y.min())
    numbers = numbers.astype(np.min_scalar_type(int(numbers.max())))
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    begins = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    first, counts = order[begins], np.diff(begins, append=len(order))
    rows[:, :3], rows[:, 3], rows[:, 4:] = points[:, :3], number, points[:, 3:]
    return rows.take(order, axis=0), np.column_stack([x[first], y[first], counts])


def _usual(heights: AnyFloatArray) -> tuple[float, float]:
    """Return the lowest and the highest usual value."""
    if not len(heights):
        return 0.0, 0.0
    low, high = np.percentile(heights, _USUAL_PERCENT)
    return float(low), float(high)


def ramp(values: AnyFloatArray, usual: tuple[float, float] | None = None) -> Colors:
    """Return (N, 3) RGB of values (N,), from blue to red between the usual ones."""
    low, high = _usual(values) if usual is None else usual
    share = np.clip((values - low) / max(high - low, TINY), 0.0, 1.0) * (len(_RAMP) - 1)
    channels = [np.interp(share, np.arange(len(_RAMP)), _RAMP[:, channel]) for channel in range(3)]
    return np.column_stack(channels).astype(np.uint8)
