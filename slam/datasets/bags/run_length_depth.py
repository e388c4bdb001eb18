"""Depth images compressed by RVL (Wilson 2017, "Fast Lossless Depth Image Compression"), as ROS sends them.

Runs of invalid pixels and of readings alternate; a reading is stored as difference to the previous one.
Numbers are written in groups of three bits, lowest first, each with a bit that says whether more follow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.datasets.budget import MOST_PIXELS, Budget
from slam.datasets.dataset import RecordFault

DAMAGED_RUNS = "depth image of run lengths that is damaged"

_SIZE_BYTES = 8  # width and height come first


def unpacked(content: bytes, budget: Budget) -> NDArray[np.uint16]:
    """Return the (H, W) image; RecordFault if the runs have another size, or the budget is used up."""
    if len(content) < _SIZE_BYTES:
        raise RecordFault(DAMAGED_RUNS, f"{len(content)} bytes")
    width, height = (int(value) for value in np.frombuffer(content, "<u4", 2))
    if not 0 < width * height <= MOST_PIXELS:
        raise RecordFault(DAMAGED_RUNS, f"{width} x {height}")
    end = len(content) // 4 * 4
    words = np.frombuffer(content[_SIZE_BYTES:end], "<u4").astype(np.uint32)
    budget.take(2 * width * height, 0)
    pixels = np.zeros(width * height, dtype=np.uint16)
    if not _fill(words, pixels):
        raise RecordFault(DAMAGED_RUNS, f"{width} x {height} in {len(content)} bytes")
    return pixels.reshape(height, width)


@kernel
def _fill(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """Write all pixels; False if there are too few or too many."""
    at, done, before = 0, 0, 0
    while done < len(pixels):
        at, empty = _number(words, at)
        at, filled = _number(words, at)
        if at < 0 or empty + filled == 0 or done + empty + filled > len(pixels):
            return False
        done += empty
        for _ in range(filled):
            at, folded = _number(words, at)
            if at < 0:
                return False
            before += -(folded + 1) // 2 if folded & 1 else folded // 2
            if not 0 < before < 1 << 16:
                return False
            pixels[done] = before
            done += 1
    return True


@kernel
def _number(words: NDArray[np.uint32], at: int) -> tuple[int, int]:
    """The number that starts at a group, and the group after it; -1 at the end of the data."""
    value, shift, more = 0, 0, 8
    while more:
        if at < 0 or at >= 8 * len(words) or shift > 30:
            return -1, 0
        group = (int(words[at // 8]) >> (28 - 4 * (at % 8))) & 15
        more = group & 8
        value |= (group & 7) << shift
        shift += 3
        at += 1
    return at, value
