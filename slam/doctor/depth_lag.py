"""Estimates how late the depth images of a camera are relative to its colour images.

While the camera turns, late depth edges are shifted against colour edges by the delay times the motion of the
image. A constant shift may be added, because colour is not always registered exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.fft import irfft2, rfft2
from numpy.typing import NDArray

from fusion.estimation import FEWEST, TINY
from fusion.time_alignment import GAP_S
from slam.datasets.frame_pairs import TOLERANCE_S
from slam.doctor.stretches import LASTS_S
from slam.measurements import Float32Array, FloatArray
from slam.vision.color_registration import RIM_SHARE

_LAGS_S = np.arange(-16, 17) * (TOLERANCE_S / 2)


@dataclass(slots=True)
class DepthLag:
    """Correlation of depth edges with colour edges for every delay, summed over the frames of a camera.

    Attributes
    ----------
    fits
        (delays, rows, columns) by delay and constant shift, for each second.
    """

    fits: list[FloatArray] = field(default_factory=list)
    _begun_s: float = -math.inf
    # Stamp, spectrum, edges by shift, motion since the frame before.
    _newest: tuple[float, NDArray[np.complex128], Float32Array, FloatArray | None] | None = None
    _before_s: float = -math.inf

    def add(self, stamp_s: float, gray: NDArray[np.uint8], depth_m: Float32Array) -> None:
        """Add the next frame: brightness (H, W) and depth (H, W), 0 invalid."""
        import cv2

        size = (160, max(2, round(160 * gray.shape[0] / gray.shape[1])))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        spectrum = rfft2((small - small.mean()) * cv2.createHanningWindow(size, cv2.CV_32F))
        spectrum /= np.abs(spectrum) + np.float32(TINY)
        step = None
        if self._newest and 0.0 < stamp_s - self._newest[0] < GAP_S:
            newest_s, known, edges, last = self._newest
            shifts = irfft2(spectrum * np.conj(known), small.shape)  # phase correlation
            half, peak = np.array(shifts.shape) // 2, np.unravel_index(np.argmax(shifts), shifts.shape)
            step = np.asarray((peak + half) % shifts.shape - half, np.float64)
            if last is not None:
                self._sum(newest_s, (step + last) / (stamp_s - self._before_s), edges)
            self._before_s = newest_s
        near_m = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST)
        self._newest = stamp_s, spectrum, _edges_by_shift(small, near_m), step

    def _sum(self, stamp_s: float, flow: FloatArray, edges: Float32Array) -> None:
        """Add the fit of a frame's edges, given the motion of its image, rows and columns per second."""
        shifts = np.arange(-4, 5)
        if not 0.0 <= stamp_s - self._begun_s < LASTS_S / 2:
            self._begun_s = stamp_s
            self.fits.append(np.zeros((len(_LAGS_S), len(shifts), len(shifts))))
        moved = np.rint(_LAGS_S[:, None] * flow).astype(int)[:, :, None] + shifts
        rows, columns = moved[:, 0] % edges.shape[0], moved[:, 1] % edges.shape[1]
        self.fits[-1] += edges[rows[:, :, None], columns[:, None, :]]

    def estimate(self) -> tuple[float, float] | None:
        """Delay of the depth images and its standard deviation, s; None if none fits better than no delay."""
        if 4 * len(self.fits) < FEWEST:
            return None
        total = np.sum(self.fits, axis=0)
        by_lag = total.max(axis=(1, 2))
        # While it turns evenly, or hardly, a delay explains no more than a constant shift.
        if by_lag.max() < (1.0 + RIM_SHARE) * by_lag[len(_LAGS_S) // 2]:
            return None
        others_s = [_best(total - one) for one in self.fits]  # jackknife
        sigma_s = math.sqrt((len(self.fits) - 1) * np.var(others_s))
        return _best(total), max(sigma_s, TOLERANCE_S / 2 / math.sqrt(12))


def _best(fits: FloatArray) -> float:
    """The delay with the best fit, interpolated by a parabola."""
    by_lag = fits.max(axis=(1, 2))
    best = min(max(int(np.argmax(by_lag)), 1), len(by_lag) - 2)
    left, middle, right = by_lag[best - 1 : best + 2].tolist()
    offset = (left - right) / 2 / min(left - 2 * middle + right, -TINY)
    return float(_LAGS_S[best] + min(max(offset, -1), 1) * TOLERANCE_S / 2)


def _edges_by_shift(gray: Float32Array, depth_m: Float32Array) -> Float32Array:
    """(H, W) normalised correlation of colour edges with near sides of jumps in depth, by shift."""
    import cv2

    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    slope = np.minimum(slope, 3 * slope.mean())
    slope -= cv2.blur(slope, (FEWEST, FEWEST))  # compared with its surroundings
    farthest_m = cv2.dilate(depth_m, np.ones((3, 3), np.uint8))
    jumps = ((depth_m > 0.0) & (farthest_m > (1 + 2 * RIM_SHARE) * depth_m)).astype(np.float32)
    norm = max(float(np.linalg.norm(slope) * np.linalg.norm(jumps)), TINY)
    return np.asarray(irfft2(rfft2(slope) * np.conj(rfft2(jumps)), gray.shape) / norm, np.float32)
