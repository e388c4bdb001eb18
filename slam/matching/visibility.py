"""What a scan has looked through, and what would have stood in its way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
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
        bearings = np.sort(np.arctan2(beams[:, 1], beams[:, 0]))
        spacing_rad = np.median(np.diff(bearings)) if len(beams) > 1 else 1.0
        nearest_m = np.full(max(int(np.pi / max(spacing_rad, TINY)), 1), np.inf)
        np.minimum.at(nearest_m, _bearings(points, len(nearest_m)), np.hypot(points[:, 0], points[:, 1]))
        return cls(pose, np.where(np.isfinite(nearest_m), nearest_m, np.nan))

    def less_far(self, points: AnyFloatArray, margins_m: FloatArray, sign: int) -> BoolArray:
        """(M,) whether points (M, 2), base frame, are nearer than the image; farther where the sign is minus.

        By a margin (M,), and so are those beside them by as much, or by a bearing.
        """
        range_m, count = np.hypot(points[:, 0], points[:, 1]), len(self.nearest_m)
        bearings = _bearings(points, count)
        less = np.asarray(sign * (self.nearest_m[bearings] - range_m) > margins_m)
        (few,) = np.nonzero(less)  # most are what the image shows, and need no look beside
        range_m, margins_m = range_m[few], margins_m[few]
        aside_rad = np.arcsin(margins_m / np.maximum(range_m, margins_m))
        aside = np.ceil(aside_rad * count / (2.0 * np.pi)).astype(np.int64)
        beside = self.nearest_m[(bearings[few] + np.array([[-1], [1]]) * aside) % count]
        less[few] = (sign * (beside - range_m) > margins_m).all(axis=0)
        return less


def seen_through(points: AnyFloatArray, images: Sequence[RangeImage], margins_m: FloatArray) -> BoolArray:
    """(M,) whether a scan saw through where points (M, 2) of the map lie, and a margin (M,) around."""
    seen = np.zeros(len(points), np.bool_)
    for image in images:
        here = transform_points(points, between(image.pose, np.zeros(3)))
        seen |= image.less_far(here, margins_m, 1)
    return seen


def _bearings(points: AnyFloatArray, count: int) -> NDArray[np.int64]:
    """(M,) number of the bearing of each point (M, 2), of so many."""
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    return np.floor(turns * count).astype(np.int64) % count
