"""ORB features with depth (Yang2021 Eq. (1)-(2)), and their matching by ratio and cross check."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from slam.measurements import BoolArray, CameraIntrinsics, Float32Array, FloatArray, RgbdFrame
from slam.vision.color_registration import RIM_SHARE
from slam.vision.place_recognition_vocabulary import ones

if TYPE_CHECKING:
    import cv2

Descriptors: TypeAlias = NDArray[np.uint8]

# Lower than the usual 20, for dim rooms and blurred images.
_FAST_THRESHOLD = 12


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints of one RGB-D frame.

    Attributes
    ----------
    pixels
        (N, 2) column and row.
    descriptors
        (N, 32) ORB.
    sigma_px
        (N,) standard deviation of a coordinate, by the pyramid's level.
    depth_m
        (N,) along the optical axis; 0 where the depth image has no reading.
    """

    pixels: Float32Array
    descriptors: Descriptors
    sigma_px: Float32Array
    depth_m: Float32Array

    def __len__(self) -> int:
        return int(self.depth_m.size)

    def where(self, keep: BoolArray) -> Features:
        """The features that a mask (N,) keeps."""
        return Features(self.pixels[keep], self.descriptors[keep], self.sigma_px[keep], self.depth_m[keep])

    def points_camera(self, intrinsics: CameraIntrinsics) -> FloatArray:
        """(N, 3) in the camera frame, Yang2021 Eq. (14); zero where there is no depth."""
        z = self.depth_m.astype(np.float64)
        x = (self.pixels[:, 0] - intrinsics.cx) / intrinsics.fx
        y = (self.pixels[:, 1] - intrinsics.cy) / intrinsics.fy
        return np.stack([x * z, y * z, z], axis=1)


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of features, (M,) numbers into either side."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.first.size)

    def where(self, keep: BoolArray) -> Matches:
        """The pairs that a mask (M,) keeps."""
        return Matches(self.first[keep], self.second[keep])


def gray_of(frame: RgbdFrame) -> NDArray[np.uint8]:
    """(H, W) brightness of a frame."""
    import cv2

    return np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)


def extract_features(gray: NDArray[np.uint8], depth_m: Float32Array, count: int) -> Features:
    """ORB keypoints (Rublee 2011), each with the depth at its pixel.

    Parameters
    ----------
    gray
        (H, W) brightness.
    depth_m
        (H, W) registered to it, 0 where invalid.
    count
        Keypoints at most.
    """
    detector = _orb(count)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    if descriptors is None or not keypoints:
        return Features(
            np.zeros((0, 2), np.float32),
            np.zeros((0, 32), np.uint8),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
        )
    pixels = np.array([point.pt for point in keypoints], np.float32)
    levels = np.array([point.octave for point in keypoints])
    # ORB's pyramid: a keypoint of level n is located as exactly as a pixel of that level.
    sigma_px = (detector.getScaleFactor() ** levels).astype(np.float32)
    return Features(pixels, np.asarray(descriptors, np.uint8), sigma_px, depth_at(depth_m, pixels))


def depth_at(depth_m: Float32Array, pixels: Float32Array) -> Float32Array:
    """Depth (N,) at pixels (N, 2): mean of the 3 x 3 around, of its nearer part at a rim; 0 where none."""
    height, width = depth_m.shape
    column = np.rint(pixels[:, 0]).astype(np.int64).clip(1, width - 2)
    row = np.rint(pixels[:, 1]).astype(np.int64).clip(1, height - 2)
    around = np.stack([depth_m[row + dv, column + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=1)
    around = np.where(around > 0.0, around, np.inf)
    nearest = around.min(axis=1)
    known = np.isfinite(nearest)
    same = around <= (nearest * (1.0 + RIM_SHARE))[:, None]
    total = np.where(same & known[:, None], around, 0.0).sum(axis=1)
    # A lone speck is noise, not a surface.
    solid = known & (same.sum(axis=1) >= 3)
    return np.where(solid, total / np.maximum(same.sum(axis=1), 1), 0.0).astype(np.float32)


def match_features(first: Descriptors, second: Descriptors, ratio: float, greatest_distance: int) -> Matches:
    """Pairs that are each other's nearest and clearly nearer than the next (Lowe's ratio).

    Parameters
    ----------
    first, second
        (N, 32) and (M, 32) ORB descriptors.
    ratio
        Greatest share of the second nearest's distance.
    greatest_distance
        Hamming distance, of 256 bits, above which two descriptors differ.
    """
    if len(first) < 2 or len(second) < 2:
        return Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))
    words = [np.ascontiguousarray(side).view(np.uint64) for side in (first, second)]
    farther = 8 * first.shape[1] + 1
    target, back = np.zeros(len(first), np.int64), np.zeros(len(second), np.int64)
    two_least, least = np.full((len(first), 2), farther), np.full(len(second), farther)
    _nearest(words[0], words[1], target, two_least, back, least)
    good = (two_least[:, 0] <= greatest_distance) & (two_least[:, 0] < ratio * two_least[:, 1])
    source = np.flatnonzero(good & (back[target] == np.arange(len(first))))
    return Matches(source, target[source])


@kernel(nogil=True)
def _nearest(  # type: ignore[no-untyped-def]
    first, second, target, two_least, back, least
):
    """The nearest of the other side of each descriptor, the first of several; of ``first`` two distances."""
    for i in range(first.shape[0]):
        best, second_best, chosen = two_least[i, 0], two_least[i, 1], ZERO
        for j in range(second.shape[0]):
            distance = ones(first[i, 0] ^ second[j, 0]) + ones(first[i, 1] ^ second[j, 1])
            distance += ones(first[i, 2] ^ second[j, 2]) + ones(first[i, 3] ^ second[j, 3])
            if distance < best:
                second_best, best, chosen = best, distance, j
            elif distance < second_best:
                second_best = distance
            if distance < least[j]:
                least[j], back[j] = distance, i
        two_least[i, 0], two_least[i, 1], target[i] = best, second_best, chosen


@lru_cache(maxsize=8)
def _orb(count: int) -> cv2.ORB:
    """The detector; making one costs more than using it on a small image."""
    import cv2

    return cv2.ORB.create(nfeatures=count, fastThreshold=_FAST_THRESHOLD)
