"""Warnings about the constraints of a finished map, and about poses that nothing measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.trajectory.carried import grown_covariances


def apart(pieces: NDArray[np.int64], stamps_s: FloatArray) -> list[str]:
    """Warn if only guesses connect parts of the map; single keyframes do not count as parts.

    Parameters
    ----------
    pieces
        (n,) the piece of each keyframe.
    stamps_s
        (n,) seconds since the start.
    """
    counts = np.bincount(pieces)
    (parts,) = np.nonzero(counts > 1)
    if len(parts) < 2:
        return []
    begins_s = sorted(float(stamps_s[pieces == part][0]) for part in parts)
    share = counts.max() / len(pieces)
    return [
        f"The map is in {len(parts)} pieces whose relative poses are only a guess: the first piece ends "
        f"before {begins_s[1]:.0f} s, the largest has {share:.0%} of the keyframes. Wheel odometry, more "
        "scans or a place that is visited again would connect them"
    ]


def unseen(
    trajectory: Trajectory, placed: NDArray[np.int64], covariances: FloatArray, config: Config
) -> list[str]:
    """Warn if no scan was matched for a while, and poses became more uncertain than a match corrects.

    Parameters
    ----------
    placed
        (S,) numbers of the poses given by a scan match.
    covariances
        (N, d, d) covariances of all poses.
    """
    # A point at this distance from the robot may be so uncertain.
    most_m, lever_m = config.match.search_half_width_m, config.loops.reach_m
    periods = []
    for gap in np.flatnonzero(np.diff(trajectory.stamps_s[placed]) > GAP_S):
        first, last = int(placed[gap]), int(placed[gap + 1])
        grown = np.diagonal(grown_covariances(trajectory, covariances, first, last), axis1=1, axis2=2)
        variances = np.column_stack([grown[:, 0] + grown[:, 1], grown[:, -1]]).clip(0.0)
        off_m2 = variances @ [1.0, lever_m**2]
        at = int(off_m2.argmax())
        if off_m2[at] > most_m**2:
            periods.append((float(off_m2[at]), first, last, *np.sqrt(variances[at]).tolist()))
    if not periods:
        return []
    _, first, last, position_m, turn_rad = max(periods)
    from_s, to_s = trajectory.stamps_s[[first, last]] - trajectory.stamps_s[0]
    others = f" (the worst of {len(periods)} such periods)" if len(periods) > 1 else ""
    return [
        f"No scan or image was matched from {from_s:.1f} to {to_s:.1f} s{others}: relative to before, "
        f"poses are uncertain by up to {position_m:.2f} m and {np.degrees(turn_rad):.1f} degrees (one sigma)"
    ]
