"""Registration of a depth image to a lidar curve, in bearing and height: Xu2024 Eq. (1).

The candidates are slices at constant height (in the paper, image rows), and a likelihood ratio selects
one (see `fusion.likelihood`; in the paper, similarities). ``tools/xu2024_rows.py`` has both for
comparison. The grade is by PCC (similarity of two curves, Xu2024 Eq. (2)), as published, but "high" also
requires that no other offset explains the pair nearly as well: a wall matches itself anywhere along it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from fusion.alignment import align
from fusion.checks import instance, numbers
from fusion.curves import HEIGHT_STEP_M, NEAR_SAMPLES, Curve, Float32Array, FloatArray, LidarCurve, resample
from fusion.estimation import FEWEST, TINY
from fusion.likelihood import log_ratio_map
from fusion.panorama import CurveStack, Depths, as_images, height_slices, join
from fusion.showing import drawn, one_line, shaded, with_pictures

HEIGHTS_M = HEIGHT_STEP_M * np.arange(-60.0, 21.0)  # of the lidar's plane above the camera
CONFIDENT = 0.9  # probability share within them, for a high grade
_SOFTNESS = 0.1  # neighbouring samples see one surface, so their evidence counts a tenth

LOW_MAX, MIDDLE_MAX = 0.3, 0.6  # Xu2024, Table 1
LEAST_OVERLAP = 0.3


@dataclass(frozen=True)
class Registration:
    """The registration of a depth image to a lidar curve.

    Attributes
    ----------
    u
        Sample of the (resampled) lidar curve at which the window of the image begins.
    v
        Index of the selected height.
    height_m
        Height of the lidar's plane above the camera.
    yaw_rad
        Bearing in the lidar's frame minus bearing in the level frame of the image.
    score
        Score of the measure that selected (u, v).
    pcc
        PCC of the pair at (u, v), from which the grade follows.
    grade
        Grade of the pair: LOW, MIDDLE or HIGH.
    confidence
        Share of the probability within `NEAR_SAMPLES` of u, 0..1.
    score_map
        (V, U) scores of the measure; larger is more similar.
    curve, stacks
        The lidar curve and the candidates of each camera that were compared.
    """

    u: int
    v: int
    height_m: float
    yaw_rad: float
    score: float
    pcc: float
    grade: Grade
    confidence: float
    score_map: Float32Array
    curve: Curve
    stacks: tuple[CurveStack, ...]

    __repr__ = one_line

    def _repr_html_(self) -> str:
        """Draw the lidar curve, and in red the curves of the cameras as registered."""
        curve = join(self.stacks).curve(self.v)
        turned = Curve(curve.ranges_m, curve.start_angle_rad + self.yaw_rad, curve.step_rad)
        drawing = drawn(black=self.curve.points(), red=turned.points())
        return with_pictures(self, drawing, shaded(self.score_map[::-1]))

    @property
    def first_yaw_step(self) -> int:
        """Index of column 0 of the score map in the grid of yaws that all pairs of a rig share."""
        return -round(join(self.stacks).start_angle_rad / self.curve.step_rad)


def register(scan: LidarCurve, depth: Depths, *, heights_m: FloatArray = HEIGHTS_M) -> Registration:
    """Find (u, v) of one pair, without extrinsics or an initial guess.

    Parameters
    ----------
    scan
        The lidar sweep; its field of view must be at least that of the image.
    depth
        One image, or the images of several cameras, which form a panorama.
    heights_m
        (V,) heights above the camera to try.

    Raises
    ------
    ValueError
        If an argument is of a wrong type, there is no image or height, or the window is wider than the sweep.

    Examples
    --------
    A camera looks 0.9 rad to the left of the lidar's zero; this yaw is not given.

    >>> import fusion, numpy as np
    >>> def ranges_m(bearings):  # to the walls of a room of 6 m by 4 m, from a position in it
    ...     rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ...     return ((np.array([3.0, 2.0]) - np.sign(rays) * [0.5, 0.3]) / np.abs(rays)).min(axis=1)
    >>> beams, slopes = np.linspace(-np.pi, np.pi, 721, endpoint=False), (79.5 - np.arange(160)) / 120
    >>> camera = fusion.Intrinsics(fx=120, fy=120, cx=79.5, cy=59.5)
    >>> depth_m = ranges_m(np.arctan(slopes) + 0.9) * np.cos(np.arctan(slopes))  # looks 0.9 rad to the left
    >>> depth = fusion.DepthImage(np.tile(depth_m, (120, 1)).astype(np.float32), camera)
    >>> scan = fusion.LidarCurve(ranges_m(beams), -np.pi, 2 * np.pi / 721)
    >>> pair = fusion.register(scan, depth)
    >>> round(pair.yaw_rad, 1), pair.grade.name
    (0.9, 'HIGH')
    """
    instance(scan, LidarCurve, "scan")
    if not len(heights_m := numbers(heights_m, (None,), "heights_m")):
        raise ValueError("heights_m is empty; give the heights above the camera to try")
    stacks = tuple(height_slices(image, heights_m) for image in as_images(depth))
    curve, stack = resample(scan), join(stacks)
    scores = log_ratio_map(stack.ranges_m, curve.ranges_m)
    # Walls are vertical: all heights together select the offset, then the best height is chosen.
    profile = scores.mean(axis=0)
    u = int(np.argmax(profile))
    match = registration_at(curve, stacks, scores, int(np.argmax(scores[:, u])), u, _belief_near(profile, u))
    return replace(match, grade=Grade.MIDDLE) if match.grade == Grade.HIGH and _swings(match) else match


def _swings(match: Registration) -> bool:
    """Return whether the offset changes once the camera may have another position than the lidar."""
    aligned = align([match.curve], [join(match.stacks).curve(match.v)], match.yaw_rad)
    if aligned is None:
        return False  # a single wall does not determine the motion
    T = aligned.T_laser_level
    turn_rad = math.remainder(math.atan2(T[1, 0], T[0, 0]) - match.yaw_rad, 2.0 * math.pi)
    return abs(turn_rad) > NEAR_SAMPLES * match.curve.step_rad


def registration_at(
    curve: Curve, stacks: tuple[CurveStack, ...], scores: Float32Array, v: int, u: int, confidence: float
) -> Registration:
    """Select candidate v and offset u from a score map (V, U), with the grade."""
    stack = join(stacks)
    width = stack.ranges_m.shape[1]
    pcc = pearson(stack.ranges_m[v], curve.ranges_m[u : u + width])
    grade = grade_of(pcc)
    if grade == Grade.HIGH and confidence < CONFIDENT:
        grade = Grade.MIDDLE
    return Registration(
        u=u,
        v=v,
        height_m=float(stack.heights_m[v]),
        yaw_rad=curve.start_angle_rad + u * curve.step_rad - stack.start_angle_rad,
        score=float(scores[v, u]),
        pcc=pcc,
        grade=grade,
        confidence=confidence,
        score_map=scores,
        curve=curve,
        stacks=stacks,
    )


def _belief_near(profile: Float32Array, u: int) -> float:
    """Return the probability share of offsets around u, with log ratios scaled by `_SOFTNESS`."""
    soft = max(2.0, _SOFTNESS * abs(float(profile[u])))
    belief = np.exp((profile - profile[u]) / soft)
    low = max(0, u - NEAR_SAMPLES)
    return float(belief[low : u + NEAR_SAMPLES + 1].sum() / belief.sum())


class Grade(IntEnum):
    """Reliability of a pair, by its PCC (Xu2024, Table 1).

    Examples
    --------
    >>> import fusion
    >>> fusion.Grade.HIGH > fusion.Grade.MIDDLE > fusion.Grade.LOW
    True
    """

    LOW = 0
    MIDDLE = 1
    HIGH = 2


def grade_of(pcc: float) -> Grade:
    """Return the class of a PCC in the paper."""
    if pcc > MIDDLE_MAX:
        return Grade.HIGH
    return Grade.MIDDLE if pcc > LOW_MAX else Grade.LOW


def pearson(one: Float32Array, other: Float32Array) -> float:
    """Return Xu2024 Eq. (2) of two curves (W,), ``nan`` invalid; 0 if one is flat or too few are shared."""
    both = np.isfinite(one) & np.isfinite(other)
    if both.sum() < max(FEWEST, LEAST_OVERLAP * one.size):
        return 0.0
    a, b = one[both].astype(np.float64), other[both].astype(np.float64)
    return float(np.corrcoef(a, b)[0, 1]) if a.std() * b.std() > TINY else 0.0
