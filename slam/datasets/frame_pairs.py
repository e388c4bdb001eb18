"""Pairs depth images with colour images by time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.datasets.account import Account
from slam.datasets.dataset import RecordFault
from slam.datasets.stamped_files import StampedFile
from slam.measurements import FloatArray

TOLERANCE_S = 0.02  # the TUM benchmark's
NO_DEPTH = "colour image without a depth image in time"
NO_COLOR = "depth image without a colour image in time"

_NEIGHBOURS = 2  # candidates on either side of a stamp; more would share it
_ENOUGH = 0.5  # fraction of the shorter list that must find a partner within the usual tolerance


@dataclass(frozen=True, slots=True)
class FramePair:
    """A colour image with its depth image; the stamp is the colour image's."""

    stamp_s: float
    color: StampedFile
    depth: StampedFile


def pair_images(
    colors: list[StampedFile], depths: list[StampedFile], account: Account, sensor: str
) -> list[FramePair]:
    """Pairs by nearest time, in the order of the colour list; images without partner are counted.

    The report contains the tolerance, see `tolerance_of`.
    """
    color_s = np.array([image.stamp_s for image in colors])
    depth_s = np.array([image.stamp_s for image in depths])
    tolerance_s = tolerance_of(color_s, depth_s)
    partner = nearest_partners(color_s, depth_s, tolerance_s)
    taken = np.zeros(len(depths), dtype=np.bool_)
    taken[partner[partner >= 0]] = True
    pairs = []
    for image, index in zip(colors, partner.tolist(), strict=True):
        if index < 0:
            account.refuse(RecordFault(NO_DEPTH, f"within {tolerance_s:.3f} s"), sensor, image.number)
        else:
            pairs.append(FramePair(image.stamp_s, image, depths[index]))
    for index in np.flatnonzero(~taken):
        fault = RecordFault(NO_COLOR, f"within {tolerance_s:.3f} s")
        account.refuse(fault, sensor, depths[index].number)
    if pairs:
        apart_s = max(abs(pair.depth.stamp_s - pair.stamp_s) for pair in pairs)
        text = f"{sensor}: colour and depth paired within {tolerance_s:.3f} s"
        account.report.note(f"{text}, at most {apart_s:.4f} s apart", pairs[0].color.number, apart_s)
    return pairs


def nearest_partners(first_s: FloatArray, second_s: FloatArray, tolerance_s: float) -> NDArray[np.intp]:
    """One-to-one partners, the nearest in time first.

    Parameters
    ----------
    first_s, second_s
        (N,) and (M,) finite stamps in any order.
    tolerance_s
        Maximum time difference.

    Returns
    -------
    (N,) index into ``second_s``, -1 if there is no partner.
    """
    partner = np.full(first_s.size, -1, dtype=np.intp)
    if not first_s.size or not second_s.size:
        return partner
    order = np.argsort(second_s, kind="stable")
    place = np.searchsorted(second_s[order], first_s)
    window = place[:, None] + np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
    inside = (window >= 0) & (window < second_s.size)
    seconds = order[np.clip(window, 0, second_s.size - 1)]
    apart_s = np.where(inside, np.abs(second_s[seconds] - first_s[:, None]), np.inf)
    rows, columns = np.nonzero(apart_s <= tolerance_s)
    nearest_first = np.argsort(apart_s[rows, columns], kind="stable")
    taken = np.zeros(second_s.size, dtype=np.bool_)
    for row, second in zip(
        rows[nearest_first].tolist(), seconds[rows, columns][nearest_first].tolist(), strict=True
    ):
        if partner[row] < 0 and not taken[second]:
            partner[row], taken[second] = second, True
    return partner


def tolerance_of(colors_s: FloatArray, depths_s: FloatArray) -> float:
    """0.02 s; half the median interval of (N,) colour stamps if that is larger and 0.02 s pairs too few."""
    paired = np.count_nonzero(nearest_partners(colors_s, depths_s, TOLERANCE_S) >= 0)
    if colors_s.size < 2 or paired >= _ENOUGH * min(colors_s.size, depths_s.size):
        return TOLERANCE_S
    return max(TOLERANCE_S, 0.5 * float(np.median(np.diff(np.sort(colors_s)))))
