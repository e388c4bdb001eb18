"""Constants of a rig that all pairs of one robot share: the yaw between its sensors, height and offset.

A single weak pair must not decide: the score maps of all pairs are summed, and the transform between the
sensors is estimated from the last pairs together.

Height: the mean likelihood of a height is not usable: different heights are seen in different places (low
ones only from afar), and some places are easier. So heights are compared in pairs over the samples that
both have, and one value per height is fitted to all these differences.
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.alignment import Alignment, align
from fusion.checks import instance, numbers
from fusion.curves import EDGE_M, Curve, Float32Array, FloatArray
from fusion.estimation import TINY
from fusion.kernel import kernel
from fusion.likelihood import ELSEWHERE_PER_M, OFFSETS_M, SAME_SHARE, SIGMA_SHARE, log_ratios_at
from fusion.panorama import CurveStack
from fusion.registration import Registration
from fusion.showing import one_line

LEAST_COVER = 0.1  # of the samples of the best covered height: excludes heights that the camera hardly sees
_AS_GOOD = 0.12  # nats per sample: less is no difference between two heights
_MOST_STEPS = 4


@dataclass(frozen=True)
class RigEstimate:
    """The estimated constants of a rig.

    Attributes
    ----------
    u
        As in `Registration`, for a level frame, without motion of the robot between scan and image.
    yaw_rad
        Bearing in the lidar's frame minus bearing in the level frame of the image.
    height_m
        Height of the lidar's plane above the camera.
    height_range_m
        Lowest and highest height that explain the pairs about as well: they show the same surfaces.
    v
        Index of the selected height.
    pairs
        Number of summed pairs.
    alignments
        For each camera the planar transform, None if its samples do not determine it.
    drift
        Difference in samples between u of all pairs and u of the last ones: shows if a sensor moved.
    """

    u: int
    yaw_rad: float
    height_m: float
    height_range_m: tuple[float, float]
    v: int
    pairs: int
    alignments: tuple[Alignment | None, ...]
    drift: int

    __repr__ = one_line


class Rig:
    """Accumulate the pairs of one robot: the sum of all score maps, and the curves of the last pairs.

    Parameters
    ----------
    kept
        Number of pairs from which height and transform are estimated; limits the memory (60 kB
        for each pair of 180 degrees).

    Examples
    --------
    A robot rotates on the spot; its camera looks 0.3 rad to the left of the lidar's zero.

    >>> import fusion, numpy as np
    >>> def ranges_m(bearings):  # to the walls of a room of 6 m by 4 m, from a position in it
    ...     rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ...     return ((np.array([3.0, 2.0]) - np.sign(rays) * [0.5, 0.3]) / np.abs(rays)).min(axis=1)
    >>> beams, slopes = np.linspace(-np.pi, np.pi, 721, endpoint=False), (79.5 - np.arange(160)) / 120
    >>> camera = fusion.Intrinsics(fx=120, fy=120, cx=79.5, cy=59.5)
    >>> rig = fusion.Rig()
    >>> for heading in (0.6, 1.1, 2.0, 3.5, 4.1):
    ...     scan = fusion.LidarCurve(ranges_m(beams + heading - 0.3), -np.pi, 2 * np.pi / 721)
    ...     depth_m = ranges_m(np.arctan(slopes) + heading) * np.cos(np.arctan(slopes))
    ...     depth = fusion.DepthImage(np.tile(depth_m, (120, 1)).astype(np.float32), camera)
    ...     rig.add(fusion.register(scan, depth))
    >>> known = rig.estimate()
    >>> round(known.yaw_rad, 1), known.pairs, known.drift
    (0.3, 5, 0)
    """

    def __repr__(self) -> str:
        return f"Rig({self._pairs} pairs)"

    def __init__(self, kept: int = 96) -> None:
        if not numbers(kept, (), "kept") >= 1:
            raise ValueError(f"kept is {kept}; give 1 or more")
        self._last: deque[Registration] = deque(maxlen=kept)
        self._sum: Float32Array | None = None
        self._first = 0
        self._pairs = 0

    def add(self, pair: Registration) -> None:
        """Add a pair.

        Raises
        ------
        ValueError
            If it is no registration, or has other candidates than the pairs before.
        """
        instance(pair, Registration, "pair")
        if self._sum is not None and len(pair.score_map) != len(self._sum):
            raise ValueError(
                f"the pair has {len(pair.score_map)} candidates, those before {len(self._sum)};"
                " a rig is registered one way throughout"
            )
        self._sum, self._first = _add(self._sum, self._first, pair.score_map, pair.first_yaw_step)
        self._pairs += 1
        self._last.append(pair)

    def estimate(self) -> RigEstimate | None:
        """Return the constants from all pairs so far; None before the first."""
        if self._sum is None:
            return None
        curve = self._last[-1].curve
        column = int(np.argmax(self._sum.mean(axis=0)))
        steps = column + self._first
        recent, first = None, 0
        for pair in self._last:
            recent, first = _add(recent, first, pair.score_map, pair.first_yaw_step)
        assert recent is not None
        yaw = curve.start_angle_rad + steps * curve.step_rad
        v, offset = self._first_height(yaw)
        heights = self._last[-1].stacks[0].heights_m
        extent = float(heights[v]), float(heights[v])
        alignments = self._alignments(yaw, v, offset)
        if any(alignments):
            v, low, high = self._height(alignments)
            extent = float(heights[low]), float(heights[high])
            alignments = self._alignments(yaw, v, offset)
        return RigEstimate(
            u=steps - self._last[-1].first_yaw_step,
            yaw_rad=yaw,
            height_m=float(heights[v]),
            height_range_m=extent,
            v=v,
            pairs=self._pairs,
            alignments=alignments,
            drift=int(np.argmax(recent.mean(axis=0))) + first - steps,
        )

    def _first_height(self, yaw_rad: float) -> tuple[int, float]:
        """Return the candidate whose samples fit best on average, and the camera offset where they do."""
        assert self._sum is not None
        offsets_m = np.linspace(2.0 * OFFSETS_M[0], 2.0 * OFFSETS_M[-1], 17)  # camera in front of the lidar
        ratio = np.zeros((offsets_m.size, len(self._sum)))
        count = np.zeros(len(self._sum))
        for pair in self._last:
            for stack in pair.stacks:
                gained, counts = log_ratios_at(
                    stack.ranges_m, stack.bearings_rad(), pair.curve, yaw_rad, offsets_m
                )
                ratio += gained
                count += counts
        mean = ratio / np.maximum(count, max(LEAST_COVER * count.max(), 1.0))
        offset, v = np.unravel_index(np.argmax(mean), mean.shape)
        return int(v), float(offsets_m[offset])

    def _height(self, alignments: tuple[Alignment | None, ...]) -> tuple[int, int, int]:
        """Return the best height once the transform between the sensors is known, and equally good ones."""
        contest = HeightContest(len(self._last[-1].score_map))
        for pair in self._last:
            for stack, alignment in zip(pair.stacks, alignments, strict=True):
                if alignment is not None:
                    contest.add(stack, pair.curve, alignment.T_laser_level)
        return contest.winner()

    def _alignments(self, yaw_rad: float, v: int, offset_m: float) -> tuple[Alignment | None, ...]:
        """Return one transform for each camera, from the pairs that are kept."""
        curves = [pair.curve for pair in self._last]
        begin = (offset_m * math.cos(yaw_rad), offset_m * math.sin(yaw_rad))
        return tuple(
            align(curves, [pair.stacks[camera].curve(v) for pair in self._last], yaw_rad, begin)
            for camera in range(len(self._last[-1].stacks))
        )


def _add(total: Float32Array | None, first: int, scores: Float32Array, at: int) -> tuple[Float32Array, int]:
    """Sum two score maps on the common grid of yaws; only yaws in both are kept."""
    if total is None:
        return scores.astype(np.float32), at
    low, high = max(first, at), min(first + total.shape[1], at + scores.shape[1])
    return total[:, low - first : high - first] + scores[:, low - at : high - at], low


class HeightContest:
    """Sums of the score differences between heights, over all pairs."""

    def __init__(self, heights: int) -> None:
        self._gain = np.zeros((heights, heights))
        self._shared = np.zeros((heights, heights))

    def add(self, stack: CurveStack, curve: Curve, T_laser_level: FloatArray) -> None:
        """Add the comparison of the heights of one camera's slices in one pair."""
        ratios = log_ratios(
            stack.ranges_m,
            stack.bearings_rad(),
            T_laser_level,
            curve.ranges_m,
            curve.start_angle_rad,
            curve.step_rad,
        )
        has = np.isfinite(ratios).astype(np.float32)
        value = np.where(has > 0.0, ratios, np.float32(0.0))
        gain = value @ has.T
        self._gain += gain - gain.T
        self._shared += has @ has.T

    def winner(self) -> tuple[int, int, int]:
        """Return the index of the height with the largest value, and the first and last about as good.

        Upright walls are equal at many heights; only surfaces that begin or end between them differ.
        """
        cover = np.diag(self._shared)
        laplacian = np.diag(self._shared.sum(axis=1)) - self._shared
        values = np.linalg.lstsq(laplacian + TINY * np.eye(cover.size), self._gain.sum(axis=1), rcond=None)[0]
        values = np.where(cover > LEAST_COVER * cover.max(), values, -np.inf)
        best = int(np.argmax(values))
        is_good = values >= values[best] - _AS_GOOD
        first = last = best
        while first > 0 and is_good[first - 1] and best - first < _MOST_STEPS:
            first -= 1
        while last + 1 < cover.size and is_good[last + 1] and last - best < _MOST_STEPS:
            last += 1
        return best, first, last


@kernel
def log_ratios(
    candidates: Float32Array,
    bearings: FloatArray,
    T_laser_level: FloatArray,
    lidar: Float32Array,
    start: float,
    step: float,
) -> NDArray[np.float32]:
    """Return (V, W) log likelihood ratios of the slice samples that the lidar sees; else ``nan``."""
    result = np.full(candidates.shape, np.nan, np.float32)
    rotation_x, rotation_y = np.cos(bearings), np.sin(bearings)
    ahead_x = T_laser_level[0, 0] * rotation_x + T_laser_level[0, 1] * rotation_y
    ahead_y = T_laser_level[1, 0] * rotation_x + T_laser_level[1, 1] * rotation_y
    for v in range(candidates.shape[0]):
        for w in range(candidates.shape[1]):
            if np.isnan(candidates[v, w]):
                continue
            x = candidates[v, w] * ahead_x[w] + T_laser_level[0, 2]
            y = candidates[v, w] * ahead_y[w] + T_laser_level[1, 2]
            at = (np.arctan2(y, x) - start) / step
            low = int(np.floor(at))
            if low < 0 or low + 1 >= lidar.size:
                continue
            near, far, share = lidar[low], lidar[low + 1], at - low
            expected = near if share < 0.5 else far
            if abs(near - far) < EDGE_M:
                expected = near + share * (far - near)
            if np.isnan(expected):
                continue
            sigma = SIGMA_SHARE * (0.5 + expected)
            error = (np.hypot(x, y) - expected) / sigma
            same = (
                SAME_SHARE * np.exp(-0.5 * error * error) / (np.sqrt(2.0 * np.pi) * sigma * ELSEWHERE_PER_M)
            )
            result[v, w] = np.log(same + 1.0 - SAME_SHARE)
    return result
