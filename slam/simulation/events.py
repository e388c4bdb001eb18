"""Events of a simulated drive: readings with their ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import BoolArray, Float32Array, LaserScan, RgbdFrame, WheelOdometry


@dataclass(frozen=True, slots=True)
class ScanEvent:
    """A scan of the lidar.

    Attributes
    ----------
    true_stamp_s
        True time of the scan; its own stamp is by the sensor's clock.
    T_map_base
        Pose of the robot at that time.
    scan
        The sensor's reading.
    true_ranges_m
        (N,) distance of the first surface on each beam, ``inf`` if there is none.
    fault
        (N,) fault of each beam, 0 for none; see the sensor models.
    """

    true_stamp_s: float
    T_map_base: gtsam.Pose2
    scan: LaserScan
    true_ranges_m: Float32Array
    fault: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class CloudEvent:
    """A revolution of the 3D lidar: its returns only.

    Attributes
    ----------
    true_stamp_s, T_map_base
        As in `ScanEvent`.
    stamp_s, sensor
        Stamp by the sensor's clock, and its name.
    points_laser
        (N, 3) in the frame of the lidar.
    ring
        (N,) index of the ring, 0 the lowest.
    true_ranges_m, fault
        (N,) as in `ScanEvent`.
    """

    true_stamp_s: float
    T_map_base: gtsam.Pose2
    stamp_s: float
    sensor: str
    points_laser: Float32Array
    ring: NDArray[np.uint8]
    true_ranges_m: Float32Array
    fault: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ImageEvent:
    """A colour and a depth image of one camera.

    Attributes
    ----------
    true_stamp_s, T_map_base
        As in `ScanEvent`.
    frame
        The camera's reading.
    true_depth_m
        (height, width) depth of the first surface at each pixel.
    fault
        (height, width) fault of each depth pixel, 0 for none.
    """

    true_stamp_s: float
    T_map_base: gtsam.Pose2
    frame: RgbdFrame
    true_depth_m: Float32Array
    fault: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class OdometryEvent:
    """A reading of the wheels.

    Attributes
    ----------
    true_stamp_s, reading
        As in `ScanEvent`.
    twist
        Speed in m/s and angular rate in rad/s since the previous reading, by the wheels.
    slipping
        (2,) whether the left and the right wheel slipped since then.
    """

    true_stamp_s: float
    reading: WheelOdometry
    twist: tuple[float, float]
    slipping: BoolArray


@dataclass(frozen=True, slots=True)
class TruthEvent:
    """True pose of the robot, at a regular rate."""

    true_stamp_s: float
    T_map_base: gtsam.Pose2


DriveEvent: TypeAlias = ScanEvent | CloudEvent | ImageEvent | OdometryEvent | TruthEvent
