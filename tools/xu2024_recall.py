"""Recall of good pairs and of noise pairs against eps: Xu2024 Fig. 6."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from xu2024_pairs import TruePair
from xu2024_score import Tally, is_burr, is_hole, pixels_of_beams

import fusion
from fusion.panorama import native_slice
from fusion.reprojection import reproject, smooth
from slam.simulation.faults import Fault

EPS_OVER_E = np.round(
    np.concatenate([np.linspace(0.4, 1.0, 7), np.linspace(1.1, 1.4, 4), [2**0.5, 1.6, 2.0]]), 4
)


VARIANTS = ("smooth", "raw", "zeros")
_SMOOTH_BEAMS, _LIDAR_SLACK = 4, 0.04


def score_recall(pair: TruePair, rig: fusion.RigEstimate, tally: Tally) -> None:
    """Count, for every eps, the pairs of readings classified correctly.

    A pair of readings is a beam whose true point a camera has in view, and that camera's slice at the
    beam's bearing. It is good where both masks are clean, noise where either has a hole or a burr.
    """
    own = pair.scan.valid_ranges_m()
    steady = smooth(own, pair.scan.step_rad, _SMOOTH_BEAMS, _LIDAR_SLACK)
    for image, alignment in zip(pair.images, rig.alignments, strict=True):
        if alignment is None:
            continue
        piece = native_slice(image.depth, rig.height_m)
        beams = (pair.scan.start_angle_rad, pair.scan.step_rad, own.size)
        other = reproject(
            piece.ranges_m, piece.start_angle_rad, piece.step_rad, alignment.T_laser_level, beams, 0.01
        )
        inside, row, col = pixels_of_beams(pair, image)
        fault = image.fault[row, col]
        burr = inside & (is_burr(pair.fault) | is_burr(fault))
        truth = {
            "good": inside & (pair.fault == Fault.NONE) & (fault == Fault.NONE),
            "burr": burr,
            "noise": burr | (inside & (is_hole(pair.fault) | is_hole(fault))),
        }
        _count(steady, other, inside, truth, tally, "smooth")
        _count(own, other, inside, truth, tally, "raw")
        _count(own, other, inside, truth, tally, "zeros")


def _count(
    own: NDArray[np.float32],
    other: NDArray[np.float32],
    inside: NDArray[np.bool_],
    truth: dict[str, NDArray[np.bool_]],
    tally: Tally,
    variant: str,
) -> None:
    """One variant: the lidar's curve smoothed along its surfaces, as it is, or with holes as zeros in E."""
    both = np.isfinite(own) & np.isfinite(other)
    if not both.any():
        return
    if variant == "zeros":
        mean = float(np.abs(np.nan_to_num(own) - np.nan_to_num(other))[inside | both].mean())
    else:
        mean = float(np.abs(own[both] - other[both]).mean())
    apart = np.where(both, np.abs(np.where(both, own, 0.0) - np.where(both, other, 0.0)), np.inf)
    for ratio in EPS_OVER_E:
        agree = apart <= ratio * mean
        for kind, chosen in truth.items():
            tally.add(f"{variant}_{kind}_{ratio}", (agree if kind == "good" else ~agree)[chosen])


def curves(tally: Tally, name: str) -> dict[str, list[float]]:
    """The three recalls over eps."""
    return {
        "eps_over_E": EPS_OVER_E.tolist(),
        **{
            kind: [tally.share(f"{name}_{kind}_{r}") for r in EPS_OVER_E]
            for kind in ("good", "noise", "burr")
        },
    }
