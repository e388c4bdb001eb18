"""Align a scan to a coarse surfel map, then to a fine one, and find the scatter of the gradient."""

from __future__ import annotations

import numpy as np

from fusion.estimation import SETTLED
from fusion.kernel import kernel
from slam.matching.point_to_line import Alignment, align_into, alignment_of
from slam.matching.score_spread import spread_of
from slam.matching.surfel_map import SurfelMap
from slam.measurements import AnyFloatArray, FloatArray


def align_coarse_to_fine(
    points: AnyFloatArray,
    normals: AnyFloatArray,
    guess: FloatArray,
    coarse: tuple[SurfelMap, float],
    fine: tuple[SurfelMap, float],
    iterations: int,
    prior: FloatArray,
    lags: int,
    settled: tuple[float, float],
) -> Alignment:
    """As `slam.matching.point_to_line.align`, twice, and `slam.matching.score_spread.score_spread`.

    Both alignments have the prior at the guess, where the first one starts. Each has a map and the width
    of its kernel, metres. The coarse one has ``settled`` if a step is below so many metres and radians: the
    fine one continues from there.
    """
    pose, hessian, spread = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    terms, sums = np.zeros((len(points), 5)), np.empty((len(points) + 1, 3))
    levels = (*coarse[0], coarse[1]), (*fine[0], fine[1])
    room = terms, sums, pose, hessian, spread
    totals = _align(points, normals, guess, *levels, iterations, settled, prior, lags, *room)
    return alignment_of(pose, hessian, totals, len(points), spread)


@kernel
def _align(  # type: ignore[no-untyped-def]
    points, normals, guess, coarse, fine, iterations, settled, prior, lags, terms, sums, pose, hessian, spread
):
    """Write the pose, its Hessian and spread; ``terms`` (M, 5) are zeros, ``sums`` (M + 1, 3) a buffer."""
    pose[0], pose[1], pose[2] = guess[0], guess[1], guess[2]
    exactly = SETTLED, SETTLED
    align_into(points, normals, guess, *coarse, iterations, settled, prior, terms, pose, hessian)
    totals = align_into(points, normals, guess, *fine, iterations, exactly, prior, terms, pose, hessian)
    align_into(points, normals, guess, *fine, 0, exactly, prior, terms, pose, hessian)
    spread_of(terms, lags, sums, spread)
    return totals
