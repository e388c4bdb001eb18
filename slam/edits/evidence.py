"""Find what scans, images and clouds saw inside polygons of the map, and remove it from the scans.

Only the end points of beams, pixels or points are removed; what their rays passed through stays known. So the
rest of the map does not change in a single cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.height_band import pixel_rays
from slam.config import Config
from slam.mapping.polygons import inside
from slam.matching.planar import compose, transform_points
from slam.measurements import BoolArray, FloatArray, LaserScan, Pose, row_from_pose2, spatial
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import CLOUD, FRAME, MEASURED, REPAIRED, Evidence, mask_of


@dataclass(frozen=True, slots=True)
class Cut:
    """A region whose readings are removed.

    Attributes
    ----------
    polygon
        (n, 2) corners in the map.
    outside
        True removes everything outside, down to the floor; False removes objects inside.
    """

    polygon: FloatArray
    outside: bool = False

    def takes(self, points: FloatArray) -> BoolArray:
        """Return (N,) whether points (N, 2) are removed."""
        within = inside(points, self.polygon)
        return ~within if self.outside else within


def taken(
    contents: MapContents, cuts: Sequence[Cut], config: Config, first: int = 0
) -> dict[Evidence, bytes]:
    """Return which evidence is in one of some cuts: packed bits by kind and number.

    Parameters
    ----------
    first
        First keyframe to check.
    """
    evidence: dict[Evidence, bytes] = {}
    if not cuts:
        return evidence
    for kind, scans in ((MEASURED, contents.measured_scans), (REPAIRED, contents.keyframe_scans)):
        for node, scan in enumerate(scans):
            if node >= first and scan is not None:
                beams = _beams(scan, contents.keyframe_poses[node], cuts, config)
                if beams.any():
                    evidence[kind, node] = np.packbits(beams).tobytes()
    for (kind, number), points, z_m in _in_space(contents, first):
        floor = (
            np.zeros(len(points), np.bool_) if z_m is None else points[:, 2] <= z_m + config.layers.climb_m
        )
        cut_points = np.zeros(len(points), np.bool_)
        for cut in cuts:
            cut_points |= cut.takes(points[:, :2]) & ~(floor & (not cut.outside))
        if cut_points.any():
            evidence[kind, number] = np.packbits(cut_points & np.isfinite(points[:, 0])).tobytes()
    return evidence


def _beams(scan: LaserScan, pose: FloatArray, cuts: Sequence[Cut], config: Config) -> BoolArray:
    """Return (N,) which beams of a scan hit something that is removed."""
    ranges = scan.ranges_m.astype(np.float64)
    limit_m = min(config.scan.range_max_m, scan.range_max_m)
    hits = np.flatnonzero((ranges > 0.0) & (ranges <= limit_m) & np.isfinite(ranges))
    bearings = scan.bearings_rad()[hits]
    ends = ranges[hits, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    ends = transform_points(ends, compose(pose, row_from_pose2(scan.T_base_laser)))
    is_cut = np.zeros(len(ranges), np.bool_)
    for cut in cuts:
        is_cut[hits] |= cut.takes(ends)
    return is_cut


def _in_space(contents: MapContents, first: int) -> Iterator[tuple[Evidence, FloatArray, float | None]]:
    """Yield kind and number of images and clouds, their points (N, 3) in the map, the floor height there.

    A pixel without a reading is NaN.
    """
    if contents.frames is not None:
        for index, T_map_camera in enumerate(contents.frame_poses()):
            head = contents.frames.head(index)
            if head.node < first:
                continue
            depth_m = contents.frames.frame(index).depth_m.astype(np.float64)
            rays = pixel_rays(depth_m.shape, head.intrinsics)
            depth_m[~(np.isfinite(depth_m) & (depth_m > 0.0))] = np.nan
            points = np.dstack([rays * depth_m[..., None], depth_m]).reshape(-1, 3)
            base = None
            if head.T_base_camera is not None:
                base = T_map_camera.compose(head.T_base_camera.inverse())
            yield (FRAME, index), _placed(points, T_map_camera), _floor_m(contents, base)
    if contents.clouds is not None:
        for node in range(max(first, 0), len(contents.clouds)):
            points = contents.clouds.points(node, everything=True)
            pose = contents.node_poses[node]
            yield (CLOUD, node), _placed(points, pose), _floor_m(contents, pose)


def _placed(points: FloatArray, pose: Pose) -> FloatArray:
    """Return points (N, 3) of a frame in the map."""
    matrix = np.asarray(spatial(pose).matrix())
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def _floor_m(contents: MapContents, T_map_base: Pose | None) -> float | None:
    """Return the height of the floor around the robot; None if unknown."""
    if contents.planar:
        return 0.0
    if contents.ground_m is None or T_map_base is None:
        return None
    return float(spatial(T_map_base).z()) + contents.ground_m


def scans_without(scans: Sequence[LaserScan | None], erased: Mapping[int, bytes]) -> list[LaserScan | None]:
    """Return scans with readings removed: these get negative ranges."""
    remaining = list(scans)
    for node, bits in erased.items():
        scan = scans[node]
        if scan is not None:
            is_cut = mask_of(bits, scan.ranges_m.size)
            remaining[node] = replace(scan, ranges_m=np.where(is_cut, -scan.ranges_m, scan.ranges_m))
    return remaining
