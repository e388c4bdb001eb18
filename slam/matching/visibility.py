"""What a scan has looked through, and what would have stood in its way."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.kernel import NONE, kernel
from slam.matching.planar import between
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
        own = np.array([[0.0, 0.0, 1.0, 0.0]]), np.array([0, len(self.nearest_m)]), self.nearest_m
        _less_far(np.asarray(points, np.float64), *own, margins_m, sign, less)
        return less


class RangeImages(NamedTuple):
    """Several range images, looked at together.

    Attributes
    ----------
    views
        (I, 4) x, y, cosine and sine of the yaw of each.
    first
        (I + 1,) where the bearings of each begin, and the end.
    nearest_m
        Of all.
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
    farthest_m, ranges_m = np.zeros(_bearing_count(scan)), np.empty(len(points))
    newest, before = np.empty(len(farthest_m), np.int64), np.empty(len(points), np.int64)
    room = farthest_m, ranges_m, newest, before
    _stands_before(points, between(pose, np.zeros(3)), *images, reach_m, scan, margins_m, *room)
    return RangeImage(pose, farthest_m)


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
def _stands_before(  # type: ignore[no-untyped-def]
    points, moved, views, first, images_m, reach_m, scan, margins_m, nearest_m, ranges_m, newest, before
):
    """Write the distance of the nearest of points (M, 2), ``moved`` by a pose (3,), that stands in the way.

    ``nearest_m`` (B,) are zeros: first how far it has to be free by bearing. Points of a bearing hang
    together: the ``newest`` (B,), and the one ``before`` each (M,).
    """
    count = nearest_m.size
    for i in range(scan.shape[0]):
        x = np.float64(scan[i, 0])
        y = np.float64(scan[i, 1])
        range_m = math.sqrt(x * x + y * y)
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count)
        aside = math.ceil(math.asin(margins_m[i] / max(range_m, margins_m[i])) * count / (2.0 * math.pi))
        for near in range(bearing - aside, bearing + aside + 1):
            nearest_m[near % count] = max(nearest_m[near % count], range_m - margins_m[i])
    for bearing in range(count):
        newest[bearing] = NONE
    cos, sin = math.cos(moved[2]), math.sin(moved[2])
    for i in range(points.shape[0]):
        x = cos * points[i, 0] - sin * points[i, 1] + moved[0]
        y = sin * points[i, 0] + cos * points[i, 1] + moved[1]
        ranges_m[i] = math.sqrt(x * x + y * y)
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count) % count
        if ranges_m[i] < nearest_m[bearing] + TINY:
            before[i] = newest[bearing]
            newest[bearing] = i
    for bearing in range(count):
        seen = True
        while seen:
            # Behind what was seen through the next one may stand.
            seen = False
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
                    seen = seen or _beyond(x, y, views, first, images_m, image, reach_m, 1)
                if seen:
                    ranges_m[nearest] = math.inf


@kernel
def _less_far(points, views, first, images_m, margins_m, sign, less):  # type: ignore[no-untyped-def]
    """See `RangeImage.less_far`, of points (M, 2) and `RangeImages`; what is marked is passed over."""
    for image in range(views.shape[0]):
        for i in range(less.size):
            x, y = points[i, 0], points[i, 1]
            less[i] = less[i] or _beyond(x, y, views, first, images_m, image, margins_m[i], sign)


@kernel(inline="always")
def _beyond(x, y, views, first, images_m, image, margin_m, sign):  # type: ignore[no-untyped-def]
    """Whether a range image is beyond a point and those beside it, or nearer where the sign is minus."""
    begun = first[image]
    count = first[image + 1] - begun
    dx = x - views[image, 0]
    dy = y - views[image, 1]
    ahead = views[image, 2] * dx + views[image, 3] * dy
    left = views[image, 2] * dy - views[image, 3] * dx
    range_m = math.sqrt(ahead * ahead + left * left)
    bearing = math.floor(math.atan2(left, ahead) / (2.0 * math.pi) * count) % count
    if not sign * (images_m[begun + bearing] - range_m) > margin_m:
        return False
    aside = math.ceil(math.asin(margin_m / max(range_m, margin_m)) * count / (2.0 * math.pi))
    return (
        sign * (images_m[begun + (bearing - aside) % count] - range_m) > margin_m
        and sign * (images_m[begun + (bearing + aside) % count] - range_m) > margin_m
    )
