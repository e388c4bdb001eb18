"""Simulates a lidar on a car's roof that rotates while the car drives."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import Float32Array, FloatArray
from slam.simulation.ray_caster import RayCaster
from slam.simulation.sensor_models import RingLidarModel
from slam.simulation.street_drive import StreetDrive
from slam.simulation.street_plan import Town
from slam.simulation.street_traffic import Traffic

_GRAZING_COS = 0.015  # no return at flatter angles


@dataclass(frozen=True, slots=True)
class StreetTurn:
    """The points of a revolution, in firing order.

    Attributes
    ----------
    points_lidar
        (N, 3) as measured: each in the lidar frame at its own time.
    undistorted_lidar
        (N, 3) the same points in the frame at the middle of the revolution.
    after_s
        (N,) seconds after the start of the revolution.
    ring, brightness, label
        (N,) number of the ring from below, 0 to 1, `slam.simulation.street_traffic.MovingBoxes.label`.
    """

    points_lidar: Float32Array
    undistorted_lidar: Float32Array
    after_s: FloatArray
    ring: NDArray[np.uint16]
    brightness: Float32Array
    label: NDArray[np.uint32]


class StreetLidar:
    """A lidar that rotates clockwise and starts a revolution at the rear, like the Velodyne in KITTI."""

    def __init__(
        self,
        town: Town,
        drive: StreetDrive,
        traffic: Traffic,
        model: RingLidarModel,
        T_base_lidar: gtsam.Pose3,
    ) -> None:
        self._mesh, self._drive, self._traffic, self._model = town.mesh, drive, traffic, model
        self._T_base_lidar = T_base_lidar
        self._caster = RayCaster(town.mesh.vertices, town.mesh.triangles)
        columns = np.arange(model.azimuths, dtype=np.float64)
        bearing = np.pi - 2.0 * np.pi * (columns + 0.5) / model.azimuths
        self._column_s: FloatArray = (columns + 0.5) / (model.azimuths * model.rate_hz)
        up = np.array(model.elevations_rad)
        level = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(len(bearing))], axis=1)
        self._beams = np.cos(up)[:, None] * level[:, None] + np.sin(up)[:, None] * [0.0, 0.0, 1.0]

    def poses_at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) and positions (N, 3) of the lidar in the map."""
        rotations, positions = self._drive.poses_at(times_s)
        mounted = rotations @ self._T_base_lidar.rotation().matrix()
        return mounted, positions + rotations @ self._T_base_lidar.translation()

    def turn(self, begin_s: float, rng: np.random.Generator) -> StreetTurn:
        """One revolution that starts at a time of the drive."""
        model, rings = self._model, len(self._model.elevations_rad)
        middle_s = begin_s + 0.5 / model.rate_hz
        rotations, positions = self.poses_at(begin_s + self._column_s)
        directions = (self._beams @ rotations.transpose(0, 2, 1)).reshape(-1, 3)
        rays = np.hstack([np.repeat(positions, rings, axis=0), directions]).astype(np.float32)
        range_m, triangle, normal = self._caster.cast(rays)
        hit = triangle >= 0
        length = np.linalg.norm(normal, axis=1)
        cosine = np.abs(np.einsum("ij,ij->i", normal, rays[:, 3:])) / np.where(hit, length, 1.0)
        label = np.where(hit, self._mesh.label[triangle], 0).astype(np.uint32)
        bright = np.where(hit, self._mesh.brightness[triangle], 0.0)
        after_s = np.repeat(self._column_s, rings)
        boxes = self._traffic.near(positions[len(positions) // 2], middle_s)
        box, face = boxes.meet(rays, after_s - 0.5 / model.rate_hz, range_m)
        met = box >= 0
        label[met], bright[met], cosine[met] = boxes.label[box[met]], boxes.brightness[box[met]], face[met]
        noisy = range_m + rng.normal(0.0, model.sigma_m, len(range_m))
        noisy = np.round(noisy / model.resolution_m) * model.resolution_m
        kept = (noisy > model.range_min_m) & (noisy < model.range_max_m) & (cosine > _GRAZING_COS)
        kept &= rng.random(len(noisy)) >= model.faults.random_hole_share
        points = (self._beams.reshape(-1, 3) * np.where(kept, noisy, 0.0)[:, None])[kept]
        column = np.repeat(np.arange(model.azimuths), rings)[kept]
        at_map = np.einsum("nij,nj->ni", rotations[column], points) + positions[column]
        (rotation,), (position,) = self.poses_at(np.array([middle_s]))
        return StreetTurn(
            points.astype(np.float32),
            ((at_map - position) @ rotation).astype(np.float32),
            after_s[kept],
            np.tile(np.arange(rings, dtype=np.uint16), model.azimuths)[kept],
            (bright * cosine)[kept].astype(np.float32),
            label[kept],
        )
