"""Whom to believe of a step between two keyframes: the lidar's match or the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from slam.matching.planar import between
from slam.measurements import FloatArray

# Squared sigmas of three degrees of freedom, 99.9 %.
_CONTRADICTION = 16.0
# Wheels take a side where it is nearer to them by so many squared sigmas.
_TAKES_SIDES = 1.0


class Step(NamedTuple):
    """Motion (3,) from one keyframe to the next, its covariance (3, 3), and the camera that measured it."""

    motion: FloatArray
    covariance: FloatArray
    camera: str = ""


def vote(match: Step | None, wheels: Step | None, cameras: Sequence[Step]) -> tuple[bool, list[Step]]:
    """Whether a match is doubtful, and the cameras that stay.

    A camera that contradicts the match speaks against it, one that does not speaks for it; the wheels speak
    for the side that they are nearer to. Outvoted cameras are left out, an outvoted match is doubtful; so is
    one where votes are even, and then the cameras stay: the loops decide.
    """
    if match is None:
        return False, list(cameras)
    contradicts = [_squares(match, camera) > _CONTRADICTION for camera in cameras]
    against = [camera for camera, opposed in zip(cameras, contradicts, strict=True) if opposed]
    if not against:
        return False, list(cameras)
    for_match = 1 + len(cameras) - len(against)
    for_cameras = len(against)
    if wheels is not None:
        to_match = _squares(wheels, match)
        to_cameras = min(_squares(wheels, camera) for camera in against)
        for_match += to_match + _TAKES_SIDES < to_cameras
        for_cameras += to_cameras + _TAKES_SIDES < to_match
    if for_match > for_cameras:
        return False, [camera for camera, opposed in zip(cameras, contradicts, strict=True) if not opposed]
    return True, list(cameras)


def agree(steps: Sequence[Step], squares: float = _CONTRADICTION) -> bool:
    """Whether no two of some steps are farther apart than so many squared sigmas: contradict each other."""
    return all(_squares(*pair) <= squares for pair in combinations(steps, 2))


def _squares(one: Step, other: Step) -> float:
    """Squared distance of two motions in their common standard deviations."""
    offset = between(one.motion, other.motion)
    return float(offset @ np.linalg.solve(one.covariance + other.covariance, offset))
