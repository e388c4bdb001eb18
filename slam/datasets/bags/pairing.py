"""Colour and depth images of one camera, paired by their stamps while they stream in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH, nearest_partners
from slam.measurements import FloatArray

_WAIT_S = 0.15  # for a partner, by the recorder's clock: the later image of a pair comes so late at most
_MOST_WAITING = 64  # of one camera; bounds the memory where the recorder's clock stands still


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
    """Pairs as soon as they are certain: at once for equal stamps, else the nearest after a short wait.

    Parameters
    ----------
    sensor
        Name of the camera, for the account.
    tolerance_s
        No partner is farther.
    """

    def __init__(self, sensor: str, tolerance_s: float, account: Account) -> None:
        self._sensor, self._tolerance_s, self._account = sensor, tolerance_s, account
        self._colors: list[StampedImage] = []
        self._depths: list[StampedImage] = []
        self._first: int | None = None
        self._farthest_s = 0.0

    def add(self, image: StampedImage, *, is_depth: bool) -> Iterator[ImagePair]:
        """Take the next image of either kind; the pair that it completes."""
        own, others = (self._depths, self._colors) if is_depth else (self._colors, self._depths)
        for at, other in enumerate(others):
            if other.stamp_s == image.stamp_s:
                del others[at]
                yield self._pair(other, image) if is_depth else self._pair(image, other)
                return
        own.append(image)

    def settle(self, now_s: float) -> Iterator[ImagePair]:
        """What has waited long enough at a time of the recorder's clock."""
        while self._colors and _is_due(self._colors, now_s, _WAIT_S):
            yield from self._settle_first()
        while self._depths and _is_due(self._depths, now_s, 2.0 * _WAIT_S):
            self._refuse(NO_COLOR, self._depths.pop(0))

    def rest(self) -> Iterator[ImagePair]:
        """The end of the bag: what is still waiting."""
        while self._colors:
            yield from self._settle_first()
        while self._depths:
            self._refuse(NO_COLOR, self._depths.pop(0))

    def tell(self) -> None:
        """Note how far apart in time the images of a pair were."""
        if self._first is not None:
            text = f"{self._sensor}: colour and depth paired within {self._tolerance_s:.3f} s"
            apart = f"at most {self._farthest_s:.4f} s apart"
            self._account.report.note(f"{text}, {apart}", self._first, self._farthest_s)

    def _settle_first(self) -> Iterator[ImagePair]:
        """The oldest colour image with its partner, or refused."""
        partner = nearest_partners(_stamps(self._colors), _stamps(self._depths), self._tolerance_s)[0]
        color = self._colors.pop(0)
        if partner < 0:
            self._refuse(NO_DEPTH, color)
            return
        depth = self._depths.pop(int(partner))
        yield self._pair(color, depth)

    def _pair(self, color: StampedImage, depth: StampedImage) -> ImagePair:
        """Two images as one."""
        self._first = self._first or color.number
        self._farthest_s = max(self._farthest_s, abs(depth.stamp_s - color.stamp_s))
        return ImagePair(color, depth)

    def _refuse(self, reason: str, image: StampedImage) -> None:
        """Count an image without a partner."""
        fault = RecordFault(reason, f"within {self._tolerance_s:.3f} s")
        self._account.refuse(fault, self._sensor, image.number)


def _is_due(waiting: list[StampedImage], now_s: float, wait_s: float) -> bool:
    """Whether the first has waited long enough, or too many wait."""
    return now_s - waiting[0].recorded_s > wait_s or len(waiting) > _MOST_WAITING


def _stamps(images: list[StampedImage]) -> FloatArray:
    """(N,) stamps."""
    return np.array([image.stamp_s for image in images], dtype=np.float64)
