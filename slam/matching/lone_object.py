"""Directions that only one narrow object determines, or only the noise of the normals.

Whoever walks ahead of a robot through a corridor is hit by a fifth of the beams and holds nearly all of the
information along it: matched alone, he keeps the robot where it is. What else is seen has to confirm him.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import FEWEST, TINY
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import schur, weak_direction
from slam.matching.object_evidence import LONGEST_M, objects_of
from slam.matching.planar import compose
from slam.matching.point_to_line import Alignment, terms_at
from slam.measurements import BoolArray, Float32Array, FloatArray


def confirmed(local_map: LocalMap, scan: OrientedPoints, found: Alignment, guess: FloatArray) -> Alignment:
    """Return an alignment that more than one narrow object of a scan (base frame) determines.

    The others confirm a pose if they fit worse a cell before and behind it, along the direction they know
    least. If they do not, they are aligned without the object, from the guess (3,). A direction in which they
    fit everywhere stays at the guess, if they fit there as well, and counts as undetermined.
    """
    share = local_map.config.degenerate_share
    rows, weights = _rows(local_map, scan, found.pose)
    others = ~_lone_object(scan.points, rows, weights)
    rest = scan.only(others)
    if len(rest) < FEWEST or _loss(local_map, rest, found.pose, rows[others], weights[others])[0] >= share:
        return found
    alone, other = local_map.align(rest, guess), local_map.align(rest, found.pose)
    if other.fit > (1.0 + share) * alone.fit:
        alone = other
    weak = weak_direction(alone, share)
    if weak is None:
        loss, weak = _loss(local_map, rest, alone.pose, *_rows(local_map, rest, alone.pose))
        if loss >= share:
            return alone
    held = local_map.align_along(rest, guess, weak)
    if held.fit > (1.0 - share) * alone.fit:
        alone = held
    known = np.eye(3) - np.outer(weak, weak)
    return alone._replace(hessian=known @ alone.hessian @ known)


def _rows(local_map: LocalMap, scan: OrientedPoints, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows (M, 3) of the Jacobian of a scan at a pose (3,), up to their signs, and weights (M,)."""
    terms = terms_at(scan.points, scan.normals, pose, local_map.fine, 0.5 * local_map.config.cell_m)
    lengths = np.hypot(terms[:, 0], terms[:, 1])
    return terms[:, :3] / np.maximum(lengths, TINY * TINY)[:, None], terms[:, 3]


def _least_known(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the unit tangent (3,) of the translation of which rows (M, 3) know least."""
    axis = np.linalg.eigh(schur(rows.T @ (rows * weights[:, None])))[1][:, 0]
    return np.array([axis[0], axis[1], 0.0])


def _lone_object(points: Float32Array, rows: FloatArray, weights: FloatArray) -> BoolArray:
    """Return which points (M, 2) are of the narrow object that holds the least known direction most.

    The legs of a person are one: narrow objects so close together that they may be.
    """
    objects, (x, y) = objects_of(points, math.inf), points.astype(np.float64).T
    first = np.flatnonzero(np.diff(objects, prepend=-1))
    ends = [(np.minimum.reduceat(axis, first), np.maximum.reduceat(axis, first)) for axis in (x, y)]
    (west, east), (south, north) = ends
    narrow = np.hypot(east - west, north - south) < LONGEST_M
    held = np.bincount(objects, (rows @ _least_known(rows, weights)) ** 2 * weights)
    most = int(np.argmax(np.where(narrow, held, -1.0)))
    middle_x, middle_y = 0.5 * (west + east)[most], 0.5 * (south + north)[most]
    near: BoolArray = narrow[objects] & (np.hypot(x - middle_x, y - middle_y) < LONGEST_M)
    return near


def _loss(
    local_map: LocalMap, scan: OrientedPoints, pose: FloatArray, rows: FloatArray, weights: FloatArray
) -> tuple[float, FloatArray]:
    """Return the share of the fit lost a cell away, where it loses less, and the direction (3,)."""
    direction, total = _least_known(rows, weights), max(float(weights.sum()), 1.0)
    aside = local_map.config.cell_m * direction
    fits = [_rows(local_map, scan, compose(pose, step))[1].sum() for step in (aside, -aside)]
    return 1.0 - float(max(fits)) / total, direction
