"""Pairs colour and depth images of one camera by their stamps, as a stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH, nearest_partners
from slam.measurements import FloatArray

_WAIT_S = 0.15  # by the recorder's clock: maximum delay of the later image of a pair
_MOST_WAITING = 64  # of one camera; limits the memory if the recorder's clock stands still


@dataclass(frozen=True, slots=True, eq=False)
class StampedImage:
    """An image message whose ``size`` bytes of pixels are not decoded yet."""

    stamp_s: float
    number: int
    recorded_s: float
    message: Any
    size: int


@dataclass(frozen=True, slots=True, eq=False)
class ImagePair:
    """A colour image and its depth image."""

    color: StampedImage
    depth: StampedImage


class PairStream:
    """Returns pairs as soon as they are certain: equal stamps at once, else the nearest after a short wait.

    Parameters
    ----------
    sensor
        Name of the camera, for the account.
    tolerance_s
        Maximum time difference of a pair.
    """

    def __init__(self, sensor: str, tolerance_s: float, account: Account) -> None:
        self._sensor, self._tolerance_s, self._account = sensor, tolerance_s, account
        self._colors: list[StampedImage] = []
        self._depths: list[StampedImage] = []
        self._first: int | None = None
        self._farthest_s = 0.0

    def add(self, image: StampedImage, *, is_depth: bool) -> Iterator[ImagePair]:
        """Add the next image of either kind; returns the pair that it completes."""
        own, others = (self._depths, self._colors) if is_depth else (self._colors, self._depths)
        for at, other in enumerate(others):
            if other.stamp_s == image.stamp_s:
                del others[at]
                yield self._pair(other, image) if is_depth else self._pair(image, other)
                return
        own.append(image)

    def settle(self, now_s: float) -> Iterator[ImagePair]:
        """Pairs that have waited long enough at a time of the recorder's clock."""
        while self._colors and _is_due(self._colors, now_s, _WAIT_S):
            yield from self._settle_first()
        while self._depths and _is_due(self._depths, now_s, 2.0 * _WAIT_S):
            self._refuse(NO_COLOR, self._depths.pop(0))

    def rest(self) -> Iterator[ImagePair]:
        """The pairs still waiting at the end of the bag."""
        while self._colors:
            yield from self._settle_first()
        while self._depths:
            self._refuse(NO_COLOR, self._depths.pop(0))

    def note_offsets(self) -> None:
        """Note the time differences between the images of pairs."""
        if self._first is not None:
            text = f"{self._sensor}: colour and depth paired within {self._tolerance_s:.3f} s"
            offset = f"at most {self._farthest_s:.4f} s apart"
            self._account.report.note(f"{text}, {offset}", self._first, self._farthest_s)

    def _settle_first(self) -> Iterator[ImagePair]:
        """Pair the oldest colour image, or reject it."""
        partner = nearest_partners(_stamps(self._colors), _stamps(self._depths), self._tolerance_s)[0]
        color = self._colors.pop(0)
        if partner < 0:
            self._refuse(NO_DEPTH, color)
            return
        depth = self._depths.pop(int(partner))
        yield self._pair(color, depth)

    def _pair(self, color: StampedImage, depth: StampedImage) -> ImagePair:
        """Combine two images."""
        self._first = self._first or color.number
        self._farthest_s = max(self._farthest_s, abs(depth.stamp_s - color.stamp_s))
        return ImagePair(color, depth)

    def _refuse(self, reason: str, image: StampedImage) -> None:
        """Count an image without a partner."""
        fault = RecordFault(reason, f"within {self._tolerance_s:.3f} s")
        self._account.refuse(fault, self._sensor, image.number)


def _is_due(waiting: list[StampedImage], now_s: float, wait_s: float) -> bool:
    """Whether the first has waited long enough, or too many are waiting."""
    return now_s - waiting[0].recorded_s > wait_s or len(waiting) > _MOST_WAITING


def _stamps(images: list[StampedImage]) -> FloatArray:
    """(N,) stamps."""
    return np.array([image.stamp_s for image in images], dtype=np.float64)
