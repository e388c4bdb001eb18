"""Candidate places for a scan in a map of clouds: by appearance, and by the 2D plan.

Scan contexts know only places near the mapped path. A room that looks the same from its other half must not
be found only there, so the plan is used as well. It gives no height; the keyframes do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.height_band import HeightBand, thin_to_voxels
from slam.config import Config
from slam.localization.global_search import at_once, search_map
from slam.localization.known_clouds import TILE
from slam.localization.scan_view import first_in_cells
from slam.localization.whole_map_field import WholeMapField
from slam.mapping.band_scan import band_scan, ground_of
from slam.matching.scan_context import SECTORS, ContextBank, scan_context
from slam.matching.scan_points import extract_points
from slam.measurements import FloatArray, spatial
from slam.storage.map_contents import MapContents

# Guesses in one tile with headings within this angle converge to the same alignment.
_SAME_RAD = 0.5


class CloudPlaces:
    """The scan contexts of all keyframes of a map, and its plan.

    Parameters
    ----------
    field
        Likelihood field of the plan; None if the map has none.
    known
        A map of a 3D lidar.
    """

    def __init__(
        self, field: WholeMapField | None, known: MapContents, voxel_m: float, config: Config
    ) -> None:
        assert known.clouds is not None
        self._field, self._config = field, config
        self._T_base_lidar = known.T_base_lidar
        self._poses = [spatial(pose) for pose in known.node_poses]
        self.apart_m = 0.5 * TILE * voxel_m
        self._voxel_m = voxel_m
        self._bank = ContextBank(
            [scan_context(thin_to_voxels(points, voxel_m), voxel_m) for points in known.clouds]
        )
        self._positions = np.array([pose.translation() for pose in self._poses])
        thickness_m = config.cloud_odometry.thickness_m
        ground = None if field is None else ground_of(known.clouds, known.T_base_lidar, voxel_m, thickness_m)
        self._ground_m = None if ground is None else ground.height_m

    def propose(self, points: FloatArray) -> list[gtsam.Pose3]:
        """Return ``T_map_base`` of places similar to a thinned scan (N, 3), base frame, by the plan first."""
        return self._apart([*self._by_plan(points), *self._by_appearance(points)])

    def _by_appearance(self, points: FloatArray) -> list[gtsam.Pose3]:
        """Return places by appearance, the most similar first.

        A context depends on the viewpoint, and the robot may be beside the mapped path: so contexts beside
        the robot are compared, too.
        """
        steps_m = np.array([-self.apart_m, 0.0, self.apart_m])
        beside_m = np.array([(x, y, 0.0) for x in steps_m for y in steps_m])
        unlike = np.array(
            [self._bank.dissimilarity(scan_context(points - offset, self._voxel_m)) for offset in beside_m]
        )
        turns, least = unlike.argmin(axis=2), unlike.min(axis=2)
        chosen: list[gtsam.Pose3] = []
        for flat in np.argsort(least, axis=None, kind="stable").tolist():
            if len(chosen) == self._config.cloud_localization.places:
                break
            side, key = divmod(flat, len(self._poses))
            turn = gtsam.Rot3.Yaw(2.0 * math.pi * float(turns[side, key]) / SECTORS)
            # The keyframe's lidar is at the offset.
            pose = self._poses[key].compose(gtsam.Pose3(turn, -turn.rotate(beside_m[side])))
            chosen = self._apart([*chosen, pose])
        return chosen

    def _by_plan(self, points: FloatArray) -> list[gtsam.Pose3]:
        """Return places by the plan, the best first, each at the height of the nearest keyframe."""
        flat = self._flat(points)
        if self._field is None or not len(flat):
            return []
        most = self._config.cloud_localization.places
        places = at_once(search_map(self._field, flat, self._config.localization, most))
        lifted = []
        for x, y, yaw in (place.pose.tolist() for place in places):
            nearest = int(np.hypot(*(self._positions[:, :2] - [x, y]).T).argmin())
            lifted.append(gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.array([x, y, self._positions[nearest, 2]])))
        return lifted

    def _flat(self, points: FloatArray) -> FloatArray:
        """Return (M, 2) the virtual 2D scan of a cloud, one point per cell."""
        layers, limits = self._config.layers, self._config.scan
        if self._ground_m is None:
            return np.zeros((0, 2))
        band = HeightBand(0.0, layers.robot_height_m, layers.climb_m)
        # A thinned scan has one point per cell.
        config = self._config.cloud_map.model_copy(update={"least_points": 1})
        scan = band_scan(points, 0.0, self._T_base_lidar, band, self._ground_m, config)
        flat = extract_points(scan, limits.range_min_m, limits.range_max_m, limits.neighbours).points_base
        cell_m = self._config.localization.novel_cell_m
        return np.asarray(flat[first_in_cells(flat, cell_m)[0]], np.float64)

    def _apart(self, guesses: Sequence[gtsam.Pose3]) -> list[gtsam.Pose3]:
        """Return poses whose alignment does not converge to that of an earlier one."""
        kept: list[gtsam.Pose3] = []
        for guess in guesses:
            steps = [guess.between(other) for other in kept]
            if not any(
                np.linalg.norm(step.translation()) < self.apart_m and abs(step.rotation().yaw()) < _SAME_RAD
                for step in steps
            ):
                kept.append(guess)
        return kept
