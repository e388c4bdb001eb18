"""Distribute the error at the end of a path over several of its steps that are wrong together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import ROUNDS, SETTLED
from slam.graph.relative_uncertainty import composed
from slam.matching.planar import adjoint, between, compose
from slam.measurements import FloatArray


def share_faults(
    path: FloatArray,
    parts: NDArray[np.int64],
    wrong: FloatArray,
    end: int,
    claimed: FloatArray,
    covariance: FloatArray,
) -> tuple[float, FloatArray]:
    """Distribute the error by Gauss-Newton with exact rotations.

    Parameters
    ----------
    path
        (n, 3) x, y, yaw of consecutive poses.
    parts
        (k, 2) first and last pose of each step that may be wrong, in order, not nested.
    wrong
        (k, 3, 3) covariance of the error of each, in the frame of its last pose.
    end, claimed, covariance
        A later pose; (3,) its claimed pose in the frame of the first; (3, 3) its covariance apart from these
        steps, in its own frame.

    Returns
    -------
    The remaining squared sigmas, of the steps and of the claim, and the resulting path (n, 3).

    Examples
    --------
    >>> import numpy as np
    >>> from slam.graph.fault_sharing import share_faults
    >>> way = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    >>> claimed, parts = np.array([5.0, 0.0, 0.0]), np.array([[0, 1], [2, 3]])
    >>> left, led = share_faults(way, parts, np.stack([np.eye(3)] * 2), 3, claimed, 1e-4 * np.eye(3))
    >>> round(left, 2), led[:, 0].round(2).tolist()
    (2.0, [0.0, 2.0, 3.0, 5.0])
    """
    stops = [0, *parts.ravel().tolist(), end]
    certain = [between(path[a], path[b]) for a, b in zip(stops[::2], stops[1::2], strict=True)]
    steps = [between(path[a], path[b]) for a, b in parts.tolist()]
    errors = [np.zeros(3) for _ in steps]
    information, priors = np.linalg.inv(covariance), np.linalg.inv(wrong)
    for _ in range(ROUNDS):
        rests = _rests(certain, steps, errors)
        missed = between(rests[0], claimed)
        # Derivative of the step's error with respect to a change of the step, in the frame of its end.
        turns = [adjoint(error * [0.0, 0.0, 1.0]) for error in errors]
        slopes = np.hstack([adjoint(between(rest, np.zeros(3))) for rest in rests[1:]])
        hessian, pull = slopes.T @ information @ slopes, slopes.T @ information @ missed
        for k, (error, turn, prior) in enumerate(zip(errors, turns, priors, strict=True)):
            hessian[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += turn.T @ prior @ turn
            pull[3 * k : 3 * k + 3] -= turn.T @ prior @ error
        change: FloatArray = np.linalg.solve(hessian, pull).reshape(-1, 3).astype(np.float64)
        errors = [compose(error, further) for error, further in zip(errors, change, strict=True)]
        if np.abs(change).max() < SETTLED:
            break
    missed = between(_rests(certain, steps, errors)[0], claimed)
    left = missed @ information @ missed + sum(
        error @ prior @ error for error, prior in zip(errors, priors, strict=True)
    )
    shifted = path.copy()
    for (first, last), step, error in zip(parts.tolist(), steps, errors, strict=True):
        moved = compose(compose(shifted[first], compose(step, error)), between(shifted[last], np.zeros(3)))
        shifted[last:] = composed(moved[None], shifted[last:])
    return float(left), shifted


def _rests(certain: list[FloatArray], steps: list[FloatArray], errors: list[FloatArray]) -> list[FloatArray]:
    """Return the end relative to the beginning, and to the end of each wrong step."""
    rests = [certain[-1]]
    for onward, step, error in zip(certain[-2::-1], steps[::-1], errors[::-1], strict=True):
        rests.insert(0, compose(onward, compose(compose(step, error), rests[0])))
    return rests
