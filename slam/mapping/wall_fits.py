"""Fit lines to the points on the walls of a room, and find how they depend on the poses of the scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, ROUNDS, TINY, gate, median_to_sigma
from slam.mapping.room_outline import Face
from slam.mapping.wall_segments import SAME_DIRECTION_RAD, WallPoints
from slam.measurements import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Contrast:
    """A number that would be zero without errors.

    Attributes
    ----------
    value
        What it is.
    jacobian
        (3 n,) of it by GTSAM's tangents of the n poses.
    """

    value: float
    jacobian: FloatArray


@dataclass(frozen=True, slots=True)
class WallFit:
    """A line: ``offset + slope * (along - middle)`` before a face.

    Attributes
    ----------
    face
        The face whose points it fits.
    middle_m
        Along the face, from its point: the mean of the points.
    offset_m, slope
        Of the line there, into the room.
    jacobian
        (2, 3 n) of offset and slope by GTSAM's tangents of the n poses.
    noise
        (2,) variances of both apart from the poses: the scatter between points of different scans.
    along_m
        (k,) where its points lie.
    drift
        Half of how far the later scans saw it before where the earlier ones did.
    """

    face: Face
    middle_m: float
    offset_m: float
    slope: float
    jacobian: FloatArray
    noise: FloatArray
    along_m: FloatArray
    drift: Contrast

    def reach(self, along_m: float) -> FloatArray:
        """(2,) by which offset and slope move the line at a place along it."""
        return np.array([1.0, along_m - self.middle_m])

    def places(self, *points_m: FloatArray) -> list[float]:
        """Where along it (2,) points lie."""
        return self.face.along(np.array(points_m)).tolist()

    def seen_m(self, begin_m: float, end_m: float, cell_m: float) -> FloatArray:
        """(n, 2) stretches from its begin on which points lie, no farther apart than four cells."""
        length_m = abs(end_m - begin_m)
        at = np.sort((self.along_m - begin_m) * np.sign(end_m - begin_m))
        at = at[(at > 0.0) & (at < length_m)]
        if not len(at):
            return np.zeros((0, 2))
        breaks = np.flatnonzero(np.diff(at) > 4 * cell_m)
        spans = np.column_stack([at[np.append(0, breaks + 1)], at[np.append(breaks, len(at) - 1)]])
        spans = spans[spans[:, 1] - spans[:, 0] > cell_m]
        # A corner hides what is nearest to it.
        if len(spans):
            spans[0, 0] = 0.0 if spans[0, 0] < 4 * cell_m else spans[0, 0]
            spans[-1, 1] = length_m if spans[-1, 1] > length_m - 4 * cell_m else spans[-1, 1]
        return spans

    def line(self) -> Face:
        """The face moved and turned onto it."""
        along = self.face.tangent
        at = self.face.point_m + self.middle_m * along + self.offset_m * self.face.normal
        turned = self.face.normal - self.slope * along
        return replace(self.face, point_m=at, normal=turned / np.hypot(*turned))


def fit_wall(
    face: Face, ends_m: tuple[float, float], points: WallPoints, poses: FloatArray, cell_m: float
) -> WallFit | None:
    """The line through the points near a face; None if there are too few.

    Parameters
    ----------
    ends_m
        Along the face, the lower first.
    points
        That were seen from inside the room.
    poses
        (n, 3) of the keyframes.
    cell_m
        Points twice so far off are none of the wall.
    """
    at, offsets = face.along(points.points_map), face.off(points.points_map)
    on = (points.normals_map @ face.normal > np.cos(SAME_DIRECTION_RAD)) & (np.abs(offsets) < 2.0 * cell_m)
    on &= (at > ends_m[0]) & (at < ends_m[1])
    if np.count_nonzero(on) < FEWEST:
        return None
    at, offsets, owners = at[on], offsets[on], points.keyframes[on]
    keep = _mode(at, offsets, cell_m)
    for _ in range(ROUNDS):
        if np.count_nonzero(keep) < FEWEST:
            return None
        middle = float(at[keep].mean())
        design = np.column_stack([np.ones(len(at)), at - middle])
        rest = offsets - design @ (np.linalg.pinv(design[keep]) @ offsets[keep])
        scale = median_to_sigma() * float(np.median(np.abs(rest[keep])))
        last, keep = keep, np.abs(rest) <= np.sqrt(gate()) * min(scale, cell_m / 5)
        if (keep == last).all():
            break
    at, offsets, rest, owners = at[keep], offsets[keep], rest[keep], owners[keep]
    middle = float(at.mean())
    design = np.column_stack([np.ones(len(at)), at - middle])
    gain = np.linalg.pinv(design)
    offset, slope = gain @ offsets
    by = points.points_map[on][keep], owners, face.normal, poses
    jacobian = _by_poses(gain, *by)
    # What offset and slope cannot explain of the earlier half of the scans against the later.
    halves = np.where(owners > np.median(owners), 1.0, -1.0)
    halves -= design @ (gain @ halves)
    halves /= max(halves @ halves, TINY)
    drift = Contrast(float(halves @ offsets), _by_poses(halves[None], *by)[0])
    return WallFit(face, middle, float(offset), float(slope), jacobian, _noise(gain, rest, owners), at, drift)


def _mode(along: FloatArray, offsets: FloatArray, cell_m: float) -> BoolArray:
    """(N,) points near the line that the longest part of a wall lies on, whatever stands before the rest.

    It runs as the face does: one that may turn leads from a wall to the glass in it. Two cells along it
    have one vote, however many points they have: their median.
    """
    bins = np.floor((along - along.min()) / (2.0 * cell_m)).astype(int)
    order = np.lexsort((offsets, bins))
    starts = np.flatnonzero(np.diff(bins[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    rows = order[starts + counts // 2]
    votes = offsets[rows]
    fits = (np.abs(votes - votes[:, None]) < cell_m / 5).sum(axis=1)
    best = int(np.argmax(fits))
    # Panes of glass and closed doors lie behind the wall's face.
    inner = (votes - votes[best] > 3 * cell_m / 5) & (fits >= 4)
    if inner.any():
        best = int(np.argmax(np.where(inner, fits, 0)))
    return np.asarray(np.abs(offsets - votes[best]) < 2 * cell_m / 5)


def _by_poses(
    gain: FloatArray, points_map: FloatArray, owners: NDArray[np.int64], normal: FloatArray, poses: FloatArray
) -> FloatArray:
    """(2, 3 n) of what is linear in the points by the poses that they were seen from."""
    x, y, yaw = poses[owners].T
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward = cos * normal[0] + sin * normal[1]
    leftward = cos * normal[1] - sin * normal[0]
    turn = (points_map[:, 0] - x) * normal[1] - (points_map[:, 1] - y) * normal[0]
    jacobian = np.zeros((len(gain), 3 * len(poses)))
    for row, weights in enumerate(gain):
        for place, moved in enumerate((forward, leftward, turn)):
            jacobian[row, place::3] = np.bincount(owners, weights * moved, minlength=len(poses))
    return jacobian


def _noise(gain: FloatArray, residuals: FloatArray, owners: NDArray[np.int64]) -> FloatArray:
    """(2,) variances where the errors of one scan go together (Liang & Zeger 1986, one cluster a scan)."""
    scans = np.unique(owners, return_inverse=True)[1]
    sums = np.array([np.bincount(scans, weights * residuals) for weights in gain])
    count = sums.shape[1]
    one_by_one = (residuals**2).mean() * (gain**2).sum(axis=1)
    return np.asarray((sums**2).sum(axis=1) * count / max(count - 2, 1) + one_by_one)


def straightened(fits: Sequence[WallFit], covariance: FloatArray) -> tuple[list[WallFit], FloatArray]:
    """Turn the walls of a room towards its axes, as far as their points leave that open.

    The spread of the walls about the axes is measured on the better half of them.

    Parameters
    ----------
    covariance
        (2 m, 2 m) of offset and slope of m walls, one after the other.

    Returns
    -------
    The walls, and the covariance of these.
    """
    if len(fits) < 3:
        return list(fits), covariance
    slopes, variances = np.array([fit.slope for fit in fits]), np.diag(covariance)[1::2]
    precise = variances <= np.median(variances)
    common = float(np.average(slopes, weights=1.0 / variances))
    spread = (median_to_sigma() * float(np.median(np.abs(slopes[precise] - common)))) ** 2
    keep = np.ones(2 * len(fits))
    aligned = (slopes - common) ** 2 < gate() * (variances + spread)
    keep[1::2][aligned] = (spread / (spread + variances))[aligned]
    turned = [
        replace(fit, slope=common + share * (fit.slope - common))
        for fit, share in zip(fits, keep[1::2], strict=True)
    ]
    uncertain = np.zeros(2 * len(fits))
    uncertain[1::2] = (1.0 - keep[1::2]) ** 2 * spread
    return turned, np.asarray(keep[:, None] * covariance * keep + np.diag(uncertain))
