"""The cloud of the whole map from the clouds of its keyframes, tile by tile, coloured by height."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import BinaryIO

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from fusion.height_band import thin_to_voxels
from slam.errors import ScanweaveError
from slam.mapping.dense_map import ColoredCloud, Colors
from slam.matching.local_cloud import moved
from slam.matching.plane_voxels import surface_normals
from slam.measurements import FloatArray

# Side of a tile in voxels; of a cell of neighbours: wider than what a lidar is off by.
_TILE_VOXELS, _NORMAL_VOXELS = 512.0, 1.5
# Blue, green, yellow, red from the lowest to the highest usual height.
_RAMP = np.array([[40, 60, 160], [40, 160, 120], [230, 210, 60], [200, 60, 40]], dtype=np.float64)
_USUAL_PERCENT = (1.0, 99.0)


def map_cloud(
    clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], voxel_m: float
) -> Iterator[ColoredCloud]:
    """One point a voxel, with normals towards the keyframe that saw it, a tile of the map after the other.

    Parameters
    ----------
    clouds
        (N, 3) points of each keyframe, base frame.
    poses
        ``T_map_base`` of each.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite.
    """
    path = np.array([pose.translation() for pose in poses]).reshape(-1, 3)
    side_m = _TILE_VOXELS * voxel_m
    with tempfile.TemporaryFile(prefix="scanweave-cloud-") as spool:
        pieces: defaultdict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
        heights = [np.zeros(0)]
        for rows in _placed(clouds, poses, voxel_m):
            heights.append(rows[::FEWEST, 2].copy())
            tiles = np.floor(rows[:, :2] / side_m).astype(np.int64)
            order = np.lexsort(tiles.T)
            rows, tiles = rows[order], tiles[order]
            changes = np.flatnonzero(np.any(np.diff(tiles, axis=0), axis=1)) + 1
            for part, tile in zip(np.split(rows, changes), tiles[[0, *changes]], strict=True):
                pieces[int(tile[0]), int(tile[1])].append((spool.tell(), len(part)))
                spool.write(part.astype(np.float32).tobytes())
        usual = _usual(np.concatenate(heights))
        for _, parts in sorted(pieces.items()):
            rows = _read(spool, parts, voxel_m)
            points = rows[:, :3]
            normals = surface_normals(points, _NORMAL_VOXELS * voxel_m)
            away = np.einsum("ij,ij->i", normals, path[rows[:, 3].astype(np.int64)] - points) < 0.0
            normals[away] *= -1.0
            yield ColoredCloud(
                points.astype(np.float32), by_height(points, usual), normals.astype(np.float32)
            )


def _placed(
    clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], voxel_m: float
) -> Iterator[FloatArray]:
    """Points (N, 4) of each keyframe that has any, map frame, and its number."""
    for number, (points, pose) in enumerate(zip(clouds, poses, strict=True)):
        if not np.isfinite(pose.matrix()).all():
            raise ScanweaveError(f"pose {number} of {len(poses)} keyframes is not finite; see the report")
        if len(points):
            rows = np.column_stack([moved(points, pose), np.full(len(points), float(number))])
            yield thin_to_voxels(rows, voxel_m)


def _read(spool: BinaryIO, pieces: Sequence[tuple[int, int]], voxel_m: float) -> FloatArray:
    """Rows (M, 4) of a tile, the first of each voxel; many more are never held."""
    kept, waiting, most = np.zeros((0, 4)), list[NDArray[np.float32]](), 0
    for begin, count in pieces:
        spool.seek(begin)
        waiting.append(np.frombuffer(spool.read(4 * 4 * count), np.float32).reshape(-1, 4))
        most += count
        if most > max(_TILE_VOXELS**2, len(kept)):
            kept, waiting, most = thin_to_voxels(np.concatenate([kept, *waiting]), voxel_m), [], 0
    return thin_to_voxels(np.concatenate([kept, *waiting]), voxel_m)


def _usual(heights: FloatArray) -> tuple[float, float]:
    """The lowest and the highest usual height."""
    if not len(heights):
        return 0.0, 0.0
    low, high = np.percentile(heights, _USUAL_PERCENT)
    return float(low), float(high)


def by_height(points: FloatArray, usual: tuple[float, float] | None = None) -> Colors:
    """(N, 3) RGB of the heights, between the usual ones; by default the usual of these points."""
    low, high = _usual(points[:, 2]) if usual is None else usual
    share = np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0) * (len(_RAMP) - 1)
    channels = [np.interp(share, np.arange(len(_RAMP)), _RAMP[:, channel]) for channel in range(3)]
    return np.column_stack(channels).astype(np.uint8)
