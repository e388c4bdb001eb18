"""Curves of ranges at equal angles: lidar sweeps, and depth images converted to the same form.

Bearings increase counter-clockwise, seen from above, in a level frame: x forward, y left, z up. A range is
the distance in the plane. Inside this package an invalid range is ``nan``. In the input, each range that is
not finite, not above zero, or beyond the sensor's maximum is invalid (Xu2024 does not define this).
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.checks import instance, numbers
from fusion.estimation import TINY
from fusion.kernel import ZERO, kernel
from fusion.showing import drawn, one_line, shaded, with_pictures

Float32Array: TypeAlias = NDArray[np.float32]
FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int32]

SAMPLE_STEP_RAD = math.radians(1.0)  # Xu2024, 3.2.1: 180 samples of 180 degrees, 240 of 240
HEIGHT_STEP_M = 0.02  # between distinct heights
NEAREST_M = 0.25  # no depth camera measures nearer
CAMERA_REACH_M = 6.0  # a structured-light camera's readings beyond are mostly noise
STEEPEST = 2.0  # slope: beyond, a camera looks at the floor before the robot's feet
SLACK_M = 0.04  # maximum difference of readings of one surface at any range
EDGE_M = 0.15  # neighbouring samples farther apart belong to two surfaces
NEAR_SAMPLES = 2  # samples this close count as the same position
BESIDE = 4  # samples on either side that form a surface


@dataclass(frozen=True)
class LidarCurve:
    """One sweep of a planar lidar.

    Attributes
    ----------
    ranges_m
        (N,) in beam order; ``inf``, ``nan``, values up to zero and above ``range_max_m`` are invalid.
    start_angle_rad, step_rad
        Bearing of beam 0, and angle between beams; a negative step is a clockwise sweep.
    range_max_m
        Maximum range of the lidar.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> fusion.LidarCurve(np.linspace(1.0, 4.0, 181), start_angle_rad=-np.pi / 2, step_rad=np.pi / 180)
    LidarCurve(ranges_m=float64[181] 1..4, start_angle_rad=-1.5708, step_rad=0.0174533, range_max_m=inf)
    """

    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float
    range_max_m: float = math.inf

    __repr__ = one_line

    def _repr_html_(self) -> str:
        points = Curve(self.valid_ranges_m(), self.start_angle_rad, self.step_rad).points()
        return with_pictures(self, drawn(black=points, red=np.zeros((1, 2))))

    def __post_init__(self) -> None:
        object.__setattr__(self, "ranges_m", numbers(self.ranges_m, (None,), "ranges_m", finite=False))
        numbers([self.start_angle_rad, self.step_rad], (2,), "start_angle_rad, step_rad")
        if not numbers(self.range_max_m, (), "range_max_m", finite=False) > 0.0:
            raise ValueError(f"range_max_m is {self.range_max_m}; give a maximum above 0")
        if self.step_rad == 0.0 or not len(self.ranges_m):
            raise ValueError(f"{self}: give one beam or more, and the angle between two")

    def bearings_rad(self) -> FloatArray:
        """(N,) bearing of each beam.

        Examples
        --------
        >>> import fusion, numpy as np
        >>> clockwise = fusion.LidarCurve(np.ones(3), start_angle_rad=0.5, step_rad=-0.5)
        >>> clockwise.bearings_rad().tolist()
        [0.5, 0.0, -0.5]
        """
        return self.start_angle_rad + self.step_rad * np.arange(len(self.ranges_m), dtype=np.float64)

    def valid_ranges_m(self) -> Float32Array:
        """(N,) with ``nan`` for every invalid reading.

        Examples
        --------
        >>> import fusion, numpy as np
        >>> scan = fusion.LidarCurve(np.array([1.5, np.inf, 0.0, 12.0]), 0.0, 0.1, range_max_m=10.0)
        >>> scan.valid_ranges_m().tolist()
        [1.5, nan, nan, nan]
        """
        return masked(self.ranges_m, self.range_max_m)


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a pinhole camera in pixels; the centre of pixel (0, 0) is at (0, 0).

    Examples
    --------
    >>> import fusion, math
    >>> camera = fusion.Intrinsics(fx=120.0, fy=120.0, cx=79.5, cy=59.5)  # 160 by 120 pixels
    >>> round(math.degrees(2 * math.atan(80 / camera.fx)))  # field of view in degrees
    67
    """

    fx: float
    fy: float
    cx: float
    cy: float


# Columns are the optical x (right), y (down) and z (forward) in a level frame.
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class DepthImage:
    """A depth image of one camera.

    Attributes
    ----------
    depth_m
        (H, W) along the optical axis; values that are zero, not finite or above ``range_max_m`` are invalid.
    intrinsics
        Intrinsics of its camera, without distortion.
    R_level_camera
        (3, 3) rotation from the optical frame to a level frame, for a camera that does not look straight
        ahead: a tilt, a rotation by 90 degrees about the axis, or the yaw between several cameras. Its yaw
        need not be exact: registration estimates the yaw to the lidar.
    range_max_m
        Larger depths are invalid.

    Examples
    --------
    A camera that looks 20 degrees down; columns are its right, down and forward axes in the level frame.

    >>> import fusion, numpy as np
    >>> tilt = np.radians(20)
    >>> R = np.array([[0, -np.sin(tilt), np.cos(tilt)], [-1, 0, 0], [0, -np.cos(tilt), -np.sin(tilt)]])
    >>> camera = fusion.Intrinsics(fx=120, fy=120, cx=79.5, cy=59.5)
    >>> image = fusion.DepthImage(np.full((120, 160), 2.0, np.float32), camera, R)
    >>> (image.R_level_camera @ [0.0, 0.0, 1.0]).round(2).tolist()  # forward, and down
    [0.94, 0.0, -0.34]
    """

    depth_m: Float32Array
    intrinsics: Intrinsics
    R_level_camera: FloatArray = field(default_factory=FORWARD.copy)
    range_max_m: float = CAMERA_REACH_M

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, shaded(np.where(self.depth_m > 0.0, self.depth_m, np.nan)))

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth_m", numbers(self.depth_m, (None, None), "depth_m", finite=False))
        lens = instance(self.intrinsics, Intrinsics, "intrinsics")
        numbers([lens.fx, lens.fy, lens.cx, lens.cy], (4,), f"{lens}: fx, fy, cx, cy")
        R = numbers(self.R_level_camera, (3, 3), "R_level_camera")
        object.__setattr__(self, "R_level_camera", R)
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0:
            raise ValueError("R_level_camera is not a (3, 3) rotation")
        numbers(self.range_max_m, (), "range_max_m", finite=False)
        if not min(lens.fx, lens.fy, self.range_max_m) > 0.0:
            raise ValueError(f"{lens}, range_max_m={self.range_max_m}: give values above 0")
        if min(self.depth_m.shape) < 2:
            raise ValueError(f"depth_m has shape {self.depth_m.shape}; give (H, W) with both above 1")


@dataclass(frozen=True)
class Curve:
    """A curve of ranges at equal angles.

    Attributes
    ----------
    ranges_m
        (N,) ``nan`` if there is no range.
    start_angle_rad, step_rad
        Bearing of the first sample, and angle between samples, counter-clockwise.
    """

    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float

    def bearings_rad(self) -> FloatArray:
        """(N,) bearing of each sample."""
        return self.start_angle_rad + self.step_rad * np.arange(self.ranges_m.size, dtype=np.float64)

    def points(self) -> FloatArray:
        """(N, 2) x forward, y left; ``nan`` if there is no range."""
        bearings = self.bearings_rad()
        return self.ranges_m[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])


def masked(ranges_m: NDArray[np.floating[Any]], range_max_m: float) -> Float32Array:
    """Return a copy with ``nan`` for ranges that are not finite, not above zero, or above the maximum.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.curves import masked
    >>> masked(np.array([0.5, -1.0, np.inf, 7.0]), range_max_m=6.0).tolist()
    [0.5, nan, nan, nan]
    """
    ranges = np.array(ranges_m, dtype=np.float32)
    with np.errstate(invalid="ignore"):
        ranges[~((ranges > 0.0) & (ranges <= range_max_m) & np.isfinite(ranges))] = np.nan
    return ranges


def resample(scan: LidarCurve, step_rad: float = SAMPLE_STEP_RAD) -> Curve:
    """Resample a lidar sweep to another angular step: the median of the beams around each sample.

    Parameters
    ----------
    step_rad
        Step of the result, above zero. If it is finer than the lidar's, samples repeat the nearest beam.

    Returns
    -------
    A curve, counter-clockwise from the lowest bearing of the sweep.

    Raises
    ------
    ValueError
        If the step is not above zero, or the sweep covers more than one revolution.
    """
    if not step_rad > 0.0:
        raise ValueError(f"step_rad is {step_rad}; give an angle above 0")
    ranges = scan.valid_ranges_m()
    start, own = scan.start_angle_rad, scan.step_rad
    if own < 0.0:
        ranges, start, own = ranges[::-1].copy(), start + own * (len(ranges) - 1), -own
    aperture = own * (len(ranges) - 1)
    if aperture > 2.0 * math.pi + own:
        raise ValueError(f"the sweep has {math.degrees(aperture):.0f} degrees; more than one turn")
    count = math.floor(aperture / step_rad + TINY) + 1
    medians, samples_a_beam = np.full(count, np.nan, np.float32), own / step_rad
    window = np.empty(math.ceil(1.0 / samples_a_beam) + 3, np.float32)
    _fill_medians(ranges, samples_a_beam, window, medians)
    return Curve(medians, start, step_rad)


@kernel
def _fill_medians(ranges, samples_a_beam, window, medians):  # type: ignore[no-untyped-def]
    """Compute medians of the valid beams within half a sample; if there are none, use the nearest beam.

    ``window`` is a buffer for the beams of a sample.
    """
    for sample in range(medians.size):
        low = max(0, math.ceil((sample - 0.5) / samples_a_beam))
        high = min(ranges.size - 1, math.ceil((sample + 0.5) / samples_a_beam) - 1)
        if high < low:
            low = high = min(ranges.size - 1, math.floor(sample / samples_a_beam + 0.5))
        count = ZERO
        for beam in range(low, high + 1):
            if not math.isnan(ranges[beam]):
                # Insertion sort, because numba takes a second to compile a library sort.
                place = count
                while place > 0 and window[place - 1] > ranges[beam]:
                    window[place] = window[place - 1]
                    place -= 1
                window[place] = ranges[beam]
                count += 1
        if 2 * count >= high - low + 1 and count > 0:
            # The lower of two middle values, because a mean of two surfaces would be neither.
            medians[sample] = window[(count - 1) // 2]
