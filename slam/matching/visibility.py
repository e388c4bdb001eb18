"""What a scan has looked through, and what would have stood in its way."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.kernel import NONE, kernel
from slam.matching.planar import between, transform_points
from slam.measurements import AnyFloatArray, BoolArray, FloatArray


class RangeImage(NamedTuple):
    """The nearest that lies in each direction.

    Attributes
    ----------
    pose
        (3,) of the base in the map, from where it is seen.
    nearest_m
        (B,) distance from there by bearing; not a number where nothing is.
    """

    pose: FloatArray
    nearest_m: FloatArray

    @classmethod
    def of(cls, points: AnyFloatArray, pose: FloatArray, beams: AnyFloatArray) -> RangeImage:
        """Of points (M, 2), base frame, for a base at a pose (3,); two of the ``beams`` (N, 2) a bearing."""
        nearest_m = np.full(_bearing_count(beams), np.inf)
        _take_nearest(points, nearest_m)
        nearest_m[nearest_m == np.inf] = np.nan
        return cls(pose, nearest_m)

    def less_far(self, points: AnyFloatArray, margins_m: FloatArray, sign: int) -> BoolArray:
        """(M,) whether points (M, 2), base frame, are nearer than the image; farther where the sign is minus.

        By a margin (M,), and so are those beside them by as much, or by a bearing.
        """
        less = np.zeros(len(points), np.bool_)
        own = np.zeros((1, 3)), np.array([0, len(self.nearest_m)]), self.nearest_m
        _less_far(np.asarray(points, np.float64), *own, margins_m, sign, less)
        return less


class RangeImages(NamedTuple):
    """Several range images, looked at together.

    Attributes
    ----------
    poses
        (I, 3) of them.
    first
        (I + 1,) where the bearings of each begin, and the end.
    nearest_m
        Of all.
    """

    poses: FloatArray
    first: NDArray[np.int64]
    nearest_m: FloatArray

    @classmethod
    def of(cls, images: Iterable[RangeImage]) -> RangeImages:
        """In their order."""
        images = list(images)
        counts = [len(image.nearest_m) for image in images]
        return cls(
            np.array([image.pose for image in images]).reshape(-1, 3),
            np.cumsum([0, *counts]),
            np.concatenate([np.zeros(0), *[image.nearest_m for image in images]]),
        )


def seen_through(points: AnyFloatArray, images: RangeImages, margins_m: FloatArray) -> BoolArray:
    """(M,) whether a scan saw through where points (M, 2) of the map lie, and a margin (M,) around."""
    seen = np.zeros(len(points), np.bool_)
    _less_far(np.asarray(points, np.float64), *images, margins_m, 1, seen)
    return seen


def standing_before(
    points: AnyFloatArray,
    images: RangeImages,
    reach_m: float,
    pose: FloatArray,
    scan: AnyFloatArray,
    margins_m: FloatArray,
) -> RangeImage:
    """What stands nearest of points (M, 2) of a map, seen from a pose (3,), where it may be in a scan's way.

    No image may have seen through what stands there, and ``reach_m`` around. A point that lies farther than
    the scan's (N, 2), base frame, by their margins (N,), says nothing of it: so most need not be looked at.
    """
    here = transform_points(points, between(pose, np.zeros(3)))
    nearest_m = np.full(_bearing_count(scan), np.nan)
    bearings, ranges_m = np.empty(len(points), np.int64), np.empty(len(points))
    _before(here, scan, margins_m, np.zeros(len(nearest_m)), bearings, ranges_m)
    left = np.flatnonzero(bearings >= 0)
    while len(left):
        numbers = np.full(len(nearest_m), -1)
        _nearest(left, bearings, ranges_m, numbers)
        asked = numbers[numbers >= 0]
        seen = seen_through(points[asked], images, np.full(len(asked), reach_m))
        stands = asked[~seen]
        nearest_m[bearings[stands]] = ranges_m[stands]
        # Behind what was seen through the next one may stand.
        bearings[asked[seen]] = -1
        left = left[(bearings[left] >= 0) & np.isnan(nearest_m[bearings[left]])]
    return RangeImage(pose, nearest_m)


def _bearing_count(beams: AnyFloatArray) -> int:
    """Bearings of an image, two of the beams (N, 2) each."""
    if len(beams) < 2:
        return int(np.pi)
    spacings_rad = np.diff(np.sort(np.arctan2(beams[:, 1], beams[:, 0])))
    spacings_rad.sort()
    # The median, at a twentieth of what numpy takes for it.
    spacing_rad = 0.5 * (spacings_rad[(len(spacings_rad) - 1) // 2] + spacings_rad[len(spacings_rad) // 2])
    return max(int(np.pi / max(spacing_rad, TINY)), 1)


@kernel
def _take_nearest(points, nearest_m):  # type: ignore[no-untyped-def]
    """Write the distance of the nearest of points (M, 2) by bearing."""
    for i in range(points.shape[0]):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * nearest_m.size) % nearest_m.size
        nearest_m[bearing] = min(nearest_m[bearing], math.sqrt(x * x + y * y))


@kernel
def _before(points, scan, margins_m, reach_m, bearings, ranges_m):  # type: ignore[no-untyped-def]
    """Write the bearing and the distance of points (M, 2); -1 for what cannot be in the scan's way.

    ``reach_m`` (B,) are zeros, for how far it has to be free by bearing.
    """
    count = reach_m.size
    for i in range(scan.shape[0]):
        x = np.float64(scan[i, 0])
        y = np.float64(scan[i, 1])
        range_m = math.sqrt(x * x + y * y)
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count)
        aside = math.ceil(math.asin(margins_m[i] / max(range_m, margins_m[i])) * count / (2.0 * math.pi))
        for near in range(bearing - aside, bearing + aside + 1):
            reach_m[near % count] = max(reach_m[near % count], range_m - margins_m[i])
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        ranges_m[i] = math.sqrt(x * x + y * y)
        bearings[i] = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count) % count
        if ranges_m[i] >= reach_m[bearings[i]] + TINY:
            bearings[i] = NONE


@kernel
def _nearest(left, bearings, ranges_m, numbers):  # type: ignore[no-untyped-def]
    """Write which of the points with these numbers is nearest, by bearing."""
    for i in left:
        other = numbers[bearings[i]]
        if other < 0 or ranges_m[i] < ranges_m[other]:
            numbers[bearings[i]] = i


@kernel
def _less_far(points, poses, first, nearest_m, margins_m, sign, less):  # type: ignore[no-untyped-def]
    """See `RangeImage.less_far`, of points (M, 2) and `RangeImages`; what is marked is passed over."""
    for image in range(poses.shape[0]):
        begun = first[image]
        count = first[image + 1] - begun
        cos = math.cos(poses[image, 2])
        sin = math.sin(poses[image, 2])
        for i in range(less.size):
            if less[i]:
                continue
            dx = points[i, 0] - poses[image, 0]
            dy = points[i, 1] - poses[image, 1]
            x = cos * dx + sin * dy
            y = cos * dy - sin * dx
            range_m = math.sqrt(x * x + y * y)
            margin_m = margins_m[i]
            bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count) % count
            if not sign * (nearest_m[begun + bearing] - range_m) > margin_m:
                continue
            aside = math.ceil(math.asin(margin_m / max(range_m, margin_m)) * count / (2.0 * math.pi))
            left = sign * (nearest_m[begun + (bearing - aside) % count] - range_m) > margin_m
            less[i] = left and sign * (nearest_m[begun + (bearing + aside) % count] - range_m) > margin_m
