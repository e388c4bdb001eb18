"""Checks of a saved map: numbers that are invalid or out of range, wrong shapes, invalid rotations.

`MapFile` rejects columns of a wrong type, `slam.storage.packing` rejects invalid poses, and this file rejects
values that no run writes. Every command that opens a map checks all of it, row by row, before using it.
A new table needs one more function in this file, called where its rows are read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import MOST_BEAMS
from slam.datasets.dataset import STAMP_LIMIT_S
from slam.errors import MapFileError
from slam.estimates import MotionEstimate, Trajectory
from slam.graph.loop_candidate import LoopCandidate
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import (
    CameraIntrinsics,
    FloatArray,
    GnssFix,
    ImuReading,
    LaserScan,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
)
from slam.storage.map_sessions import MapSession
from slam.storage.packing import FARTHEST_M, ROUNDING
from slam.vision.color_registration import ColorRegistration
from slam.vision.features import Features
from slam.vision.learned_camera import LearnedCamera

T = TypeVar("T")
Rule = Callable[[Any], bool]

_CELL_M = (1e-4, 1e4)
_LONGEST_NAME = 256


def require(condition: object, fault: str) -> None:
    """Raise a `MapFileError` if a condition does not hold."""
    if not condition:
        raise MapFileError(fault)


def of(kind: type[T], value: Any) -> T:
    """Return a value of a type; a record only if it is valid, see `sound`."""
    require(isinstance(value, kind), f"a {type(value).__name__} where a {kind.__name__} belongs")
    if type(value) in _RULES:
        sound(value)
    return cast(T, value)


def sound(record: Any) -> None:
    """Raise an error for a record with an invalid field.

    Raises
    ------
    MapFileError
        It names the field.
    """
    for name, rule in _RULES[type(record)].items():
        value = getattr(record, name)
        if not rule(value):
            shown = f"{value.dtype}{list(value.shape)}" if isinstance(value, np.ndarray) else repr(value)
            raise MapFileError(f"its {name} cannot be: {shown}")
        if type(value) in _RULES:
            sound(value)


def sound_stamp(stamp_s: Any) -> float:
    """Check a time in seconds."""
    require(_stamp(stamp_s), f"its stamp cannot be: {stamp_s}")
    return float(stamp_s)


def sound_name(name: Any) -> str:
    """Check the name of a sensor, a grid or a kind of edge."""
    require(_name(name) and name, "its name is none")
    return str(name)


def unsound_covariance(covariances: Sequence[Any], dimension: int) -> int | None:
    """Return the index of the first that is no (d, d) covariance: finite, symmetric, positive definite."""
    shape, float64 = (dimension, dimension), np.dtype(np.float64)
    for number, matrix in enumerate(covariances):
        if not isinstance(matrix, np.ndarray) or matrix.shape != shape or matrix.dtype != float64:
            return number
    if not covariances or _are_covariances(np.stack(covariances)):  # all at once is ten times as fast
        return None
    return next(number for number, matrix in enumerate(covariances) if not _are_covariances(matrix))


def sound_trajectory(stretch: Trajectory, poses: int) -> Trajectory:
    """Check so many poses: finite and in range, with quaternions of unit length."""
    require(len(stretch) == poses, "its arrays have other sizes")
    require((np.abs(stretch.stamps_s) < STAMP_LIMIT_S).all(), "a stamp cannot be")
    require((np.abs(stretch.positions_m) < FARTHEST_M).all(), "a position is not finite, or beyond the Earth")
    norms = np.linalg.norm(stretch.quaternions_xyzw, axis=1)
    require((np.abs(norms - 1.0) < ROUNDING).all(), "a quaternion is not of unit length")
    return stretch


def sound_grid(grid: OccupancyGrid) -> OccupancyGrid:
    """Check that a grid has cells of a valid size."""
    require(grid.steps.size, "it has no cells")
    least_m, most_m = _CELL_M
    require(least_m <= grid.resolution_m <= most_m, f"its resolution cannot be: {grid.resolution_m} m")
    return grid


def sound_readings(readings: NDArray[np.int64], sessions: Sequence[MapSession]) -> None:
    """Check that the keyframes of each session are from its own readings, in increasing order."""
    first = 0
    for number, session in enumerate(sessions):
        own = readings[first : first + session.keyframes]
        first += session.keyframes
        fits = own[0] >= 0 and own[-1] < session.poses and (np.diff(own) > 0).all()
        require(fits, f"the readings of session {number} are not those of its log, in their order")


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _positive(value: Any) -> bool:
    return _number(value) and value > 0.0


def _not_negative(value: Any) -> bool:
    return isinstance(value, int | float) and value >= 0.0  # or infinite: a window that was never searched


def _name(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST_NAME


def _index(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _either(*kinds: type | None) -> Rule:
    """Return a check for one of these types."""
    return lambda value: any(value is None if kind is None else isinstance(value, kind) for kind in kinds)


def _array(dtype: str, *shape: int | None) -> Rule:
    """Return a check for a finite array of a type and shape; None means any length."""

    def fits(value: Any) -> bool:
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.ndim != len(shape):
            return False
        same = all(expected in (None, size) for expected, size in zip(shape, value.shape, strict=True))
        return same and bool(np.isfinite(value).all())

    return fits


def _ranges(value: Any) -> bool:
    """Check ranges of beams: NaN is invalid, inf is no return, negative is removed, but not -inf."""
    fits = isinstance(value, np.ndarray) and value.dtype == np.float32 and value.ndim == 1
    return fits and 0 < value.size <= MOST_BEAMS and not bool(np.isneginf(value).any())


def _are_covariances(values: FloatArray) -> bool:
    """Return whether (..., d, d) matrices are finite, symmetric and positive definite."""
    if not np.isfinite(values).all():
        return False
    asymmetry = np.abs(values - values.swapaxes(-1, -2)).max((-1, -2))
    if (asymmetry > ROUNDING * np.abs(values).max((-1, -2))).any():
        return False
    try:
        np.linalg.cholesky(values)
    except np.linalg.LinAlgError:
        return False
    return True


def _pose2(value: Any) -> bool:
    return isinstance(value, gtsam.Pose2) and math.isfinite(value.matrix().sum())


def _pose3(value: Any) -> bool:
    return isinstance(value, gtsam.Pose3) and math.isfinite(value.matrix().sum())


def _pose3_or_none(value: Any) -> bool:
    return value is None or _pose3(value)


def _stamp(value: Any) -> bool:
    return _number(value) and abs(value) < STAMP_LIMIT_S


_RULES: dict[type, dict[str, Rule]] = {
    LaserScan: {
        "stamp_s": _stamp,
        "ranges_m": _ranges,
        "start_angle_rad": _number,
        "step_rad": lambda value: _number(value) and 0.0 <= value <= 2.0 * math.pi,
        "range_max_m": _positive,
        "T_base_laser": _pose2,
        "sensor": _name,
        "beam_s": _number,
    },
    WheelOdometry: {"stamp_s": _stamp, "T_odom_base": _pose2, "sensor": _name},
    RgbdFrame: {
        "stamp_s": _stamp,
        "intrinsics": lambda value: isinstance(value, CameraIntrinsics),
        "T_base_camera": _pose3_or_none,
        "sensor": _name,
    },
    PointCloud: {"stamp_s": _stamp, "T_base_lidar": _pose3, "sensor": _name},
    ImuReading: {"stamp_s": _stamp, "T_base_imu": _pose3_or_none, "sensor": _name},
    GnssFix: {
        "stamp_s": _stamp,
        "latitude_deg": lambda value: _number(value) and abs(value) <= 90.0,
        "longitude_deg": lambda value: _number(value) and abs(value) <= 360.0,
        "altitude_m": _number,
        "sensor": _name,
    },
    MotionEstimate: {
        "T_reference_base": lambda value: isinstance(value, gtsam.Pose2 | gtsam.Pose3),
        "covariance": lambda value: any(unsound_covariance([value], size) is None for size in (3, 6)),
        "inlier_share": _number,
        "fit": _number,
        "residual_m": _not_negative,
        "converged": _either(bool),
        "degenerate": _either(bool),
        "weak_direction": _array("f8", None),
    },
    LoopCandidate: {
        "place": _index,
        "keyframe": _index,
        "half_width_m": _not_negative,
        "half_yaw_rad": _not_negative,
        "score": _number,
        "motion": _either(MotionEstimate, None),
        "accepted": _either(bool),
        "reason": _either(str),
    },
    CameraIntrinsics: {
        **dict.fromkeys(("fx", "fy"), _positive),
        **dict.fromkeys(("cx", "cy"), _number),
        **dict.fromkeys(("width", "height"), _index),
    },
    ColorRegistration: {
        **dict.fromkeys(("intrinsics_color", "intrinsics_depth"), _either(CameraIntrinsics)),
        "T_depth_color": _pose3,
        "accepted": _either(bool),
        "reason": _either(str),
        **dict.fromkeys(("inlier_share_before", "inlier_share_after"), _number),
    },
    LearnedCamera: {
        "registration": _either(ColorRegistration, None),
        "T_base_camera": _pose3_or_none,
        "mounting_learned": _either(bool),
        **dict.fromkeys(("clock_offset_s", "clock_sigma_s"), _number),
    },
    Features: {
        "pixels": _array("f4", None, 2),
        "descriptors": _array("u1", None, 32),
        **dict.fromkeys(("sigma_px", "depth_m"), _array("f4", None)),
    },
}
