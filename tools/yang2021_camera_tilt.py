"""Estimates unknown height and tilt of a camera from its images: the only fit of the ground.

Only for this calibration. A camera is fixed on its robot, so in its own frame the floor is the same plane in
every image, while walls move: a plane that fits many images at once is the floor. Afterwards, Yang2021's
height band does not need a visible floor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.curves import FORWARD, STEEPEST, FloatArray
from fusion.estimation import ROUNDS, median_to_sigma

_POINTS_A_FRAME = 1500
_DRAWS = 600


@dataclass(frozen=True)
class CameraTilt:
    """Where the floor is in the camera's frame.

    Attributes
    ----------
    height_m
        Of the optical centre above the floor.
    pitch_rad
        Positive where the camera looks down.
    roll_rad
        Positive where the image's right edge is lower.
    spread_m
        Robust standard deviation of the floor's points about the plane.
    frame_share
        Share of the frames in which the floor was seen, 0..1.
    share_below
        Share of all points that lie clearly under the plane; a floor has next to none.
    """

    height_m: float
    pitch_rad: float
    roll_rad: float
    spread_m: float
    frame_share: float
    share_below: float

    def R_level_camera(self) -> FloatArray:
        """(3, 3) from the optical frame to x forward, y left, z up, heading as the camera does."""
        c, s = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        pitch = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        c, s = math.cos(self.roll_rad), math.sin(self.roll_rad)
        roll = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        return np.asarray(pitch @ roll @ FORWARD)


def camera_tilt(
    clouds: Sequence[FloatArray], rng: np.random.Generator, tolerance_m: float = 0.02
) -> CameraTilt | None:
    """Find the plane that most images share and that nothing lies under; None where there is none.

    Parameters
    ----------
    clouds
        (N, 3) points of each image in the optical frame: z forward, x right, y down; from different places.
    tolerance_m
        A point so near belongs to the plane, at 1 m; farther points get more, as their noise grows.

    Examples
    --------
    A camera 0.7 m above a floor, tilted down by 0.2 rad.

    >>> import fusion, numpy as np
    >>> rng = np.random.default_rng(0)
    >>> true = fusion.CameraTilt(0.7, 0.2, 0.0, 0.0, 1.0, 0.0)
    >>> def seen():  # (500, 3) points of the floor from 1 to 3 m before the camera, optical frame
    ...     floor = np.column_stack([rng.uniform([1, -1], [3, 1], (500, 2)), np.full(500, -0.7)])
    ...     return floor @ true.R_level_camera()
    >>> found = fusion.camera_tilt([seen() for image in range(5)], rng)
    >>> round(found.height_m, 3), round(found.pitch_rad, 3)
    (0.7, 0.2)
    """
    drawn = [cloud[rng.permutation(len(cloud))[:_POINTS_A_FRAME]] for cloud in clouds if len(cloud) >= 3]
    if not drawn:
        return None
    points = np.concatenate(drawn)
    owner = np.repeat(np.arange(len(drawn)), [len(cloud) for cloud in drawn])
    slack = tolerance_m * np.maximum(1.0, np.linalg.norm(points, axis=1) ** 2 / 4.0)
    best, best_score = None, 0.0
    for cloud in (drawn[index] for index in rng.integers(len(drawn), size=_DRAWS)):
        plane = _plane_through(cloud[rng.choice(len(cloud), 3, replace=False)])
        if plane is not None and (score := _score(points, slack, plane)) > best_score:
            best, best_score = plane, score
    if best is None:
        return None
    for _ in range(ROUNDS):
        near = np.abs(points @ best[:3] + best[3]) < slack
        if np.count_nonzero(near) < 3:
            return None
        best = _fit(points[near], 1.0 / slack[near])
    return _tilt(points, owner, slack, best)


def _plane_through(three: FloatArray) -> FloatArray | None:
    """(4,) normal towards the camera and its height over the plane; None where the plane is too steep."""
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-6:
        return None
    normal = normal / length
    height = -float(normal @ three[0])
    if height < 0.0:
        normal, height = -normal, -height
    # Up is against the image's y: the floor lies under the camera, however it is tilted.
    if -normal[1] < math.cos(math.atan(STEEPEST)) or height < 0.05:
        return None
    return np.append(normal, height)


def _score(points: FloatArray, slack: FloatArray, plane: FloatArray) -> float:
    """Points on the plane, less three times those under it: a table's top has a floor below."""
    over = points @ plane[:3] + plane[3]
    return float(np.count_nonzero(np.abs(over) < slack) - 3.0 * np.count_nonzero(over < -2.0 * slack))


def _fit(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(4,) weighted least squares, the normal towards the camera."""
    middle = np.average(points, axis=0, weights=weights)
    scaled = (points - middle) * weights[:, None]
    normal = np.linalg.svd(scaled.T @ scaled)[0][:, 2]
    height = -float(normal @ middle)
    return np.append(normal, height) if height > 0.0 else np.append(-normal, -height)


def _tilt(points: FloatArray, owner: NDArray[np.intp], slack: FloatArray, plane: FloatArray) -> CameraTilt:
    """Angles of a plane, and how far it can be trusted."""
    up, height = plane[:3], float(plane[3])
    over = points @ up + height
    near = np.abs(over) < slack
    seen = np.bincount(owner[near], minlength=int(owner.max()) + 1)
    total = np.bincount(owner)
    return CameraTilt(
        height_m=height,
        pitch_rad=math.asin(float(np.clip(-up[2], -1.0, 1.0))),
        roll_rad=math.atan2(-float(up[0]), -float(up[1])),
        spread_m=float(median_to_sigma() * np.median(np.abs(over[near]))),
        frame_share=float(np.mean(seen > 0.02 * total)),
        share_below=float(np.mean(over < -2.0 * slack)),
    )
