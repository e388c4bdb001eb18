"""Kernels for estimating a registration: fit the motions of all frame pairs, check all matches."""

from __future__ import annotations

from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import FloatArray

IntArray: TypeAlias = NDArray[np.int64]

# Fixes a motion that its matches do not determine.
_DAMPING = 1e-6


def settle_motions(
    points_a: FloatArray,
    points_b: FloatArray,
    pixels_a: FloatArray,
    pixels_b: FloatArray,
    starts: IntArray,
    poses: FloatArray,
    camera: FloatArray,
    scale_px: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """Minimise the reprojection errors of each pair in both directions: Gauss-Newton with Geman-McClure.

    Parameters
    ----------
    points_a, points_b
        (N, 3) of all matches in the colour frames a and b; a point with z = 0 is ignored.
    pixels_a, pixels_b
        (N, 2) their pixels.
    starts
        (P + 1,) the matches of pair p are starts[p] to starts[p + 1].
    poses
        (P, 3, 4) first guess of ``T_b_a``.
    camera
        (4,) fx, fy, cx, cy of the colour camera.
    scale_px
        Error at which a match has half its loss.

    Returns
    -------
    poses
        (P, 3, 4) settled.
    errors
        (N, 2) squared reprojection errors in pixels, a seen in b and b seen in a; NaN without a point.
    """
    points, pixels = np.stack([points_a, points_b]), np.stack([pixels_b, pixels_a])
    settled, diagonal = poses.copy(), np.arange(6)
    rows, errors = np.zeros((len(points_a), 4, 7)), np.empty((len(points_a), 2))
    for left in range(iterations, -1, -1):
        turns, shifts = settled[:, :, :3], settled[:, :, 3:]
        back = turns.transpose(0, 2, 1)
        there = np.stack([settled, np.concatenate([back, -back @ shifts], axis=2)])
        # In b, the derivatives by a point of b have the opposite sign.
        into_b = np.stack([np.broadcast_to(np.eye(3), turns.shape), -turns])
        _linearize(points, pixels, starts, there, into_b, camera, scale_px * scale_px, rows, errors)
        if not left:
            break
        blocks = [rows[first:end].reshape(-1, 7) for first, end in pairwise(starts)]
        sums = np.array([block[:, :6].T @ block for block in blocks])
        hessians, gradients = sums[:, :, :6], sums[:, :, 6:]
        hessians[:, diagonal, diagonal] += _DAMPING * (1.0 + hessians[:, diagonal, diagonal])
        steps = np.asarray(np.linalg.solve(hessians, gradients)[:, :, 0], np.float64)
        settled = _moved(settled, -steps)
    return settled, errors


@kernel(error_model="numpy")
def _linearize(  # type: ignore[no-untyped-def]
    points, pixels, starts, poses, into_b, camera, squared_scale, rows, errors
):
    """Write the weighted derivatives and errors, ``rows`` (N, 4, 7): x and y, of a point of a and of b.

    The points (2, N, 3) of a and b are transformed by ``poses`` (2, P, 3, 4) into the other camera, with
    ``pixels`` (2, N, 2); the motion is perturbed in b: ``exp(v, w) T_b_a``.
    """
    for pair in range(starts.size - 1):
        for i in range(starts[pair], starts[pair + 1]):
            for side in range(2):
                px, py, pz = points[side, i, 0], points[side, i, 1], points[side, i, 2]
                T = poses[side, pair]
                x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
                y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
                z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
                if pz <= 0.0 or z <= 0.0:
                    rows[i, 2 * side : 2 * side + 2] = 0.0
                    errors[i, side] = np.nan
                    continue
                du = camera[0] * x / z + camera[2] - pixels[side, i, 0]
                dv = camera[1] * y / z + camera[3] - pixels[side, i, 1]
                errors[i, side] = du * du + dv * dv
                # Geman and McClure.
                share = squared_scale / (squared_scale + errors[i, side])
                miss, along = du, x
                # The perturbation moves the point in b.
                if side == 0:
                    px, py, pz = x, y, z
                for axis in range(2):
                    slope = share * camera[axis] / z
                    depth = -slope * along / z
                    a = into_b[side, pair, 0, axis] * slope + into_b[side, pair, 0, 2] * depth
                    b = into_b[side, pair, 1, axis] * slope + into_b[side, pair, 1, 2] * depth
                    c = into_b[side, pair, 2, axis] * slope + into_b[side, pair, 2, 2] * depth
                    row = rows[i, 2 * side + axis]
                    row[0], row[1], row[2] = a, b, c
                    row[3] = py * c - pz * b
                    row[4] = pz * a - px * c
                    row[5] = px * b - py * a
                    row[6] = share * miss
                    miss, along = dv, y


def _moved(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """Return (P, 3, 4) poses rotated by steps[:, 3:] and then shifted by steps[:, :3]."""
    from scipy.spatial.transform import Rotation

    moved = Rotation.from_rotvec(steps[:, 3:]).as_matrix() @ poses
    moved[:, :, 3] += steps[:, :3]
    return np.asarray(moved)
