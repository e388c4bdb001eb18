"""Space that the beams of a scan passed through, and obstacles that would have blocked them."""

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

        By a margin (M,), and so are their neighbours, by the same margin, or by a bearing.
        """
        own = np.array([[0.0, 0.0, 1.0, 0.0]]), np.array([0, len(self.nearest_m)]), self.nearest_m
        return RangeImages(*own).less_far(points, margins_m, sign)


class RangeImages(NamedTuple):
    """Several range images, looked at together.

    Attributes
    ----------
    views
        (I, 4) x, y, cosine and sine of the yaw of each.
    first
        (I + 1,) where the bearings of each begin, and the end.
    """

    views: FloatArray
    first: NDArray[np.int64]
    nearest_m: FloatArray

    @classmethod
    def of(cls, images: Iterable[RangeImage]) -> RangeImages:
        """In their order."""
        images = list(images)
        x, y, yaw = np.array([image.pose for image in images]).reshape(-1, 3).T
        return cls(
            np.column_stack([x, y, np.cos(yaw), np.sin(yaw)]),
            np.cumsum([0, *[len(image.nearest_m) for image in images]]),
            np.concatenate([np.zeros(0), *[image.nearest_m for image in images]]),
        )

    def less_far(self, points: AnyFloatArray, margins_m: FloatArray, sign: int) -> BoolArray:
        """As `RangeImage.less_far` by one of the images at least, of points (M, 2) of the map."""
        less, (x, y) = np.zeros(len(points), np.bool_), np.array(points.T, np.float64, order="C")
        at_x, at_y, cos, sin = self.views.T[:, :, None]
        dx, dy = x - at_x, y - at_y
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        # A kernel takes twenty times as long for arc tangents as numpy.
        coordinates = ahead, left, np.arctan2(left, ahead)
        _less_far(*coordinates, self.first, self.nearest_m, margins_m, sign, less)
        return less


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
    farthest_m = np.zeros(_bearing_count(scan))
    x, y = transform_points(points, between(pose, np.zeros(3))).T.copy()
    coordinates, ranges_m = (x, y, np.arctan2(y, x)), np.empty(len(points))
    newest, before = np.empty(len(farthest_m), np.int64), np.empty(len(points), np.int64)
    room = farthest_m, ranges_m, newest, before
    _stands_before(points, *coordinates, *images, reach_m, scan, margins_m, *room)
    return RangeImage(pose, farthest_m)


def _bearing_count(beams: AnyFloatArray) -> int:
    """Bearings of an image, two of the beams (N, 2) each."""
    if len(beams) < 2:
        return int(np.pi)
    bearings_rad = np.sort(np.arctan2(beams[:, 1], beams[:, 0]))
    return max(int(np.pi / max(np.median(np.diff(bearings_rad)), TINY)), 2)


@kernel(inline="always")
def _in_turn(bearing, count):  # type: ignore[no-untyped-def]
    """Number of a bearing of so many, at most a turn away; a remainder takes ten times as long."""
    return bearing + count if bearing < 0 else bearing if bearing < count else bearing - count


@kernel
def _take_nearest(points, nearest_m):  # type: ignore[no-untyped-def]
    """Write the distance of the nearest of points (M, 2) by bearing."""
    for i in range(points.shape[0]):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        bearing = _in_turn(math.floor(math.atan2(y, x) / (2.0 * math.pi) * nearest_m.size), nearest_m.size)
        nearest_m[bearing] = min(nearest_m[bearing], math.sqrt(x * x + y * y))


@kernel
def _stands_before(  # type: ignore[no-untyped-def]
    points,
    xs,
    ys,
    angles_rad,
    views,
    first,
    images_m,
    reach_m,
    scan,
    margins_m,
    nearest_m,
    ranges_m,
    newest,
    before,
):
    """Write the distance of the nearest of points (M, 2) that occludes, seen at xs, ys and angles.

    ``nearest_m`` (B,) are zeros: first how far it has to be free by bearing. Points of a bearing are a
    linked list: the ``newest`` (B,), and the one ``before`` each (M,).
    """
    count = nearest_m.size
    for i in range(scan.shape[0]):
        x = np.float64(scan[i, 0])
        y = np.float64(scan[i, 1])
        range_m = math.sqrt(x * x + y * y)
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count)
        aside = math.ceil(math.asin(margins_m[i] / max(range_m, margins_m[i])) * count / (2.0 * math.pi))
        for near in range(bearing - aside, bearing + aside + 1):
            at = _in_turn(near, count)
            nearest_m[at] = max(nearest_m[at], range_m - margins_m[i])
    for bearing in range(count):
        newest[bearing] = NONE
    for i in range(points.shape[0]):
        ranges_m[i] = math.sqrt(xs[i] * xs[i] + ys[i] * ys[i])
        bearing = _in_turn(math.floor(angles_rad[i] / (2.0 * math.pi) * count), count)
        if ranges_m[i] < nearest_m[bearing] + TINY:
            before[i] = newest[bearing]
            newest[bearing] = i
    for bearing in range(count):
        stands = True
        while stands:
            # Behind what was seen through the next one may stand.
            stands = False
            nearest_m[bearing] = math.nan
            nearest = NONE
            i = newest[bearing]
            while i >= 0:
                if ranges_m[i] < math.inf and not ranges_m[i] >= nearest_m[bearing]:
                    nearest = i
                    nearest_m[bearing] = ranges_m[i]
                i = before[i]
            if nearest >= 0:
                x, y = points[nearest, 0], points[nearest, 1]
                for image in range(views.shape[0]):
                    if stands:
                        break
                    dx = x - views[image, 0]
                    dy = y - views[image, 1]
                    ahead = views[image, 2] * dx + views[image, 3] * dy
                    left = views[image, 2] * dy - views[image, 3] * dx
                    angle_rad = math.atan2(left, ahead)
                    stands = _beyond(ahead, left, angle_rad, first, images_m, image, reach_m, 1)
                if stands:
                    ranges_m[nearest] = math.inf


@kernel
def _less_far(ahead, left, angles_rad, first, images_m, margins_m, sign, less):  # type: ignore[no-untyped-def]
    """See `RangeImages.less_far`, of points as images see them, (I, M); what is marked is passed over."""
    for image in range(ahead.shape[0]):
        for i in range(less.size):
            if not less[i]:
                x, y, angle_rad = ahead[image, i], left[image, i], angles_rad[image, i]
                less[i] = _beyond(x, y, angle_rad, first, images_m, image, margins_m[i], sign)


@kernel(inline="always")
def _beyond(ahead, left, angle_rad, first, images_m, image, margin_m, sign):  # type: ignore[no-untyped-def]
    """Whether a range image is beyond a point and those beside it, or nearer where the sign is minus."""
    begun = first[image]
    count = first[image + 1] - begun
    range_m = math.sqrt(ahead * ahead + left * left)
    bearing = math.floor(angle_rad / (2.0 * math.pi) * count)
    if not sign * (images_m[begun + _in_turn(bearing, count)] - range_m) > margin_m:
        return False
    aside = math.ceil(math.asin(margin_m / max(range_m, margin_m)) * count / (2.0 * math.pi))
    return (
        sign * (images_m[begun + _in_turn(bearing - aside, count)] - range_m) > margin_m
        and sign * (images_m[begun + _in_turn(bearing + aside, count)] - range_m) > margin_m
    )
