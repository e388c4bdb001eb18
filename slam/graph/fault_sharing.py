"""Distribute the error at the end of a path over several of its steps that are wrong together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import ROUNDS, SETTLED
from slam.graph.relative_uncertainty import composed
from slam.matching.planar import adjoint, between, compose
from slam.measurements import FloatArray


def share_faults(
    way: FloatArray,
    parts: NDArray[np.int64],
    wrong: FloatArray,
    end: int,
    claimed: FloatArray,
    covariance: FloatArray,
) -> tuple[float, FloatArray]:
    """Distribute the error by Gauss-Newton with exact rotations.

    Parameters
    ----------
    way
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
    sure = [between(way[a], way[b]) for a, b in zip(stops[::2], stops[1::2], strict=True)]
    told = [between(way[a], way[b]) for a, b in parts.tolist()]
    off = [np.zeros(3) for _ in told]
    information, priors = np.linalg.inv(covariance), np.linalg.inv(wrong)
    for _ in range(ROUNDS):
        rests = _rests(sure, told, off)
        missed = between(rests[0], claimed)
        # Derivative of the step's error with respect to a change of the step, in the frame of its end.
        turns = [adjoint(one * [0.0, 0.0, 1.0]) for one in off]
        slopes = np.hstack([adjoint(between(rest, np.zeros(3))) for rest in rests[1:]])
        hessian, pull = slopes.T @ information @ slopes, slopes.T @ information @ missed
        for k, (one, turn, prior) in enumerate(zip(off, turns, priors, strict=True)):
            hessian[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += turn.T @ prior @ turn
            pull[3 * k : 3 * k + 3] -= turn.T @ prior @ one
        change: FloatArray = np.linalg.solve(hessian, pull).reshape(-1, 3).astype(np.float64)
        off = [compose(one, further) for one, further in zip(off, change, strict=True)]
        if np.abs(change).max() < SETTLED:
            break
    missed = between(_rests(sure, told, off)[0], claimed)
    left = missed @ information @ missed + sum(
        one @ prior @ one for one, prior in zip(off, priors, strict=True)
    )
    led = way.copy()
    for (first, last), step, one in zip(parts.tolist(), told, off, strict=True):
        moved = compose(compose(led[first], compose(step, one)), between(led[last], np.zeros(3)))
        led[last:] = composed(moved[None], led[last:])
    return float(left), led


def _rests(sure: list[FloatArray], told: list[FloatArray], off: list[FloatArray]) -> list[FloatArray]:
    """Return the end relative to the beginning, and to the end of each wrong step."""
    rests = [sure[-1]]
    for way, step, one in zip(sure[-2::-1], told[::-1], off[::-1], strict=True):
        rests.insert(0, compose(way, compose(compose(step, one), rests[0])))
    return rests
