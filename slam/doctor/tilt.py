"""Finds a tilt of a 3D lidar that the log does not contain."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.finding import Finding, mounting_entry
from slam.doctor.floor import ANGLE_RAD, LEVER_M
from slam.doctor.imu import ImuSamples, up_by_imu
from slam.doctor.paired_motions import JOINED, joined, runs_of, turns_of
from slam.doctor.planar_hand_eye import PlanarHandEye
from slam.matching.upright import upright_of
from slam.measurements import FloatArray


def stood_up(
    name: str, samples: CloudSamples, imus: Iterable[ImuSamples] = (), by_wheels: PlanarHandEye | None = None
) -> list[Finding]:
    """Return a tilt of a 3D lidar that the log does not contain; its samples get the right mounting.

    A robot on a floor rotates about the vertical. If that axis is tilted in the base frame, and perpendicular
    to it is a floor as far below as the log says, or wheels or an IMU rotate about the vertical of the base
    at the same time, the rotation in the log is wrong.
    """
    stated, steps = samples.T_base_lidar, [step for stretch in samples.steps for step in stretch]
    ups = [up for up in (up_by_imu(imu, steps) for imu in imus) if up is not None]
    upright = _upright(samples, ups, by_wheels)
    if upright is None:
        return []
    samples.T_base_lidar = gtsam.Pose3(upright, stated.translation())
    off_deg = math.degrees(float(np.linalg.norm(gtsam.Rot3.Logmap(stated.rotation().between(upright)))))
    text = f"it is tilted by {off_deg:.1f} degrees more than the log says, by the axis of its rotations"
    mounting = mounting_entry(upright, np.asarray(stated.translation()).tolist())
    effect, remedy = "the path of the robot is wrong", {"lidars_3d": {name: {"T_base_lidar": mounting}}}
    return [Finding(name, "mounting", text, effect, (remedy,), sure=True, value=off_deg)]


def _upright(
    samples: CloudSamples, ups: Sequence[FloatArray], by_wheels: PlanarHandEye | None
) -> gtsam.Rot3 | None:
    """``R_base_lidar`` of a tilted lidar; None if the log is right, or the evidence is not sufficient.

    ``ups`` (3,) are the vertical of the base in the lidar's frame by IMUs. Without wheels, the correction is
    the smallest rotation, of a lidar on its head after a rotation about its forward axis.
    """
    stated, stated_up = samples.T_base_lidar.rotation(), samples.stated_up
    turns = turns_of(joined(runs_of(samples.steps), JOINED))
    if len(turns) < FEWEST or samples.T_base_lidar.z() < LEVER_M or samples.stands:
        return None
    _, sizes, axes = np.linalg.svd(turns, full_matrices=False)
    axis, least_rad = axes[0], 0.5 * ANGLE_RAD
    off_rad = least_rad + math.sqrt(gate() / len(turns)) * sizes[1] / max(sizes[0], SETTLED)
    found = [one for one in map(samples.floor, (stated_up, axis, -axis)) if one is not None]
    if not found:
        least_rad = off_rad  # a floor is more exact than the axis
        found = [*ups, *([] if by_wheels is None else [by_wheels.up])]
        # Without a floor, a lidar on its head and rotations of the wrong sign look alike.
        found = [one for one in found if one @ stated_up > -math.cos(2.0 * ANGLE_RAD)]
    found = [one for one in found if abs(one @ axis) > math.cos(off_rad)]
    up = max(found, key=lambda one: float(one @ stated_up), default=stated_up)
    tilt_rad = math.acos(float(np.clip(up @ stated_up, -1.0, 1.0)))
    if tilt_rad < least_rad:
        return None
    turned = stated.compose(gtsam.Rot3.Roll(math.pi)) if up @ stated_up < -0.5 else stated
    upright = upright_of(-np.asarray(turned.rotate(up))).compose(turned)
    if by_wheels is not None and by_wheels.up @ up > math.cos(off_rad):
        ahead = np.asarray(upright.rotate(by_wheels.ahead))
        yaw_rad = -math.atan2(ahead[1], ahead[0])
        if abs(yaw_rad) > ANGLE_RAD + gate() ** 0.5 * by_wheels.sigmas[2]:
            upright = gtsam.Rot3.Yaw(yaw_rad).compose(upright)
    return upright
