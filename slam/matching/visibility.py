"""What a scan has looked through, and what would have stood in its way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.kernel import kernel
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
        bearings = np.sort(np.arctan2(beams[:, 1], beams[:, 0]))
        spacing_rad = np.median(np.diff(bearings)) if len(beams) > 1 else 1.0
        nearest_m = np.full(max(int(np.pi / max(spacing_rad, TINY)), 1), np.inf)
        np.minimum.at(nearest_m, _bearings(points, len(nearest_m)), np.hypot(points[:, 0], points[:, 1]))
        return cls(pose, np.where(np.isfinite(nearest_m), nearest_m, np.nan))

    def less_far(self, points: AnyFloatArray, margins_m: FloatArray, sign: int) -> BoolArray:
        """(M,) whether points (M, 2), base frame, are nearer than the image; farther where the sign is minus.

        By a margin (M,), and so are those beside them by as much, or by a bearing.
        """
        less = np.zeros(len(points), np.bool_)
        _less_far(np.asarray(points, np.float64), np.zeros(3), self.nearest_m, margins_m, sign, less)
        return less


def seen_through(points: AnyFloatArray, images: Sequence[RangeImage], margins_m: FloatArray) -> BoolArray:
    """(M,) whether a scan saw through where points (M, 2) of the map lie, and a margin (M,) around."""
    seen, points = np.zeros(len(points), np.bool_), np.asarray(points, np.float64)
    for image in images:
        _less_far(points, between(image.pose, np.zeros(3)), image.nearest_m, margins_m, 1, seen)
    return seen


@kernel
def _less_far(points, pose, nearest_m, margins_m, sign, less):  # type: ignore[no-untyped-def]
    """See `RangeImage.less_far`, of points (M, 2) moved by a pose (3,); what is marked is passed over."""
    count = nearest_m.size
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    for i in range(less.size):
        if less[i]:
            continue
        x = cos * points[i, 0] - sin * points[i, 1] + pose[0]
        y = sin * points[i, 0] + cos * points[i, 1] + pose[1]
        range_m = math.sqrt(x * x + y * y)
        margin_m = margins_m[i]
        bearing = math.floor(math.atan2(y, x) / (2.0 * math.pi) * count) % count
        if not sign * (nearest_m[bearing] - range_m) > margin_m:
            continue
        aside = math.ceil(math.asin(margin_m / max(range_m, margin_m)) * count / (2.0 * math.pi))
        left = sign * (nearest_m[(bearing - aside) % count] - range_m) > margin_m
        less[i] = left and sign * (nearest_m[(bearing + aside) % count] - range_m) > margin_m


def _bearings(points: AnyFloatArray, count: int) -> NDArray[np.int64]:
    """(M,) number of the bearing of each point (M, 2), of so many."""
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    return np.floor(turns * count).astype(np.int64) % count
