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
# Cache of keypoints of images used by the doctor and later by the mapper, and its limit.
_KEPT: dict[tuple[int, tuple[int, ...], int], tuple[Float32Array, Descriptors, Float32Array]] = {}
_MOST_KEPT = 1024


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
        """Return the features selected by a mask (N,)."""
        return Features(self.pixels[keep], self.descriptors[keep], self.sigma_px[keep], self.depth_m[keep])

    def points_camera(self, intrinsics: CameraIntrinsics) -> FloatArray:
        """Return (N, 3) points in the camera frame, Yang2021 Eq. (14); zero without depth."""
        z = self.depth_m.astype(np.float64)
        x = (self.pixels[:, 0] - intrinsics.cx) / intrinsics.fx
        y = (self.pixels[:, 1] - intrinsics.cy) / intrinsics.fy
        return np.stack([x * z, y * z, z], axis=1)


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of features, (M,) indices for both sides."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.first.size)

    def where(self, keep: BoolArray) -> Matches:
        """Return the pairs selected by a mask (M,)."""
        return Matches(self.first[keep], self.second[keep])


def gray_of(frame: RgbdFrame) -> NDArray[np.uint8]:
    """Return the (H, W) brightness of a frame."""
    import cv2

    return np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)


def extract_features(
    gray: NDArray[np.uint8], depth_m: Float32Array, count: int, *, again: bool = False
) -> Features:
    """Extract ORB keypoints (Rublee 2011) with the depth at each pixel.

    Parameters
    ----------
    gray
        (H, W) brightness.
    depth_m
        (H, W) registered to it, 0 where invalid.
    again
        Whether the image will be used again: its keypoints are cached until then.
    """
    name = (hash(gray.tobytes()), gray.shape, count)
    keypoints = _KEPT.pop(name, None) or _keypoints(gray, count)
    if again:
        _KEPT[name] = keypoints
        for oldest in list(_KEPT)[:-_MOST_KEPT]:
            _KEPT.pop(oldest, None)
    pixels, descriptors, sigma_px = keypoints
    return Features(pixels, descriptors, sigma_px, depth_at(depth_m, pixels))


def forget_keypoints() -> None:
    """Discard cached keypoints that were not used again."""
    _KEPT.clear()


def _keypoints(gray: NDArray[np.uint8], count: int) -> tuple[Float32Array, Descriptors, Float32Array]:
    """Return pixels (N, 2), descriptors (N, 32) and sigma (N,) of keypoints."""
    import cv2

    detector = _orb(count)
    points, descriptors = detector.detectAndCompute(gray, None)
    if descriptors is None or not points:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros(0, np.float32)
    levels = np.array([point.octave for point in points])
    # ORB's pyramid: a keypoint of level n is as accurate as a pixel of that level.
    sigma_px = (detector.getScaleFactor() ** levels).astype(np.float32)
    return np.asarray(cv2.KeyPoint.convert(points), np.float32), np.asarray(descriptors, np.uint8), sigma_px


def depth_at(depth_m: Float32Array, pixels: Float32Array) -> Float32Array:
    """Return depth (N,) at pixels (N, 2): mean of 3 x 3, of its nearer part at an edge; 0 without any."""
    depths_m = np.zeros(len(pixels), np.float32)
    if len(pixels):
        _depth_at(depth_m, pixels, np.empty(9, np.float32), depths_m)
    return depths_m


@kernel(nogil=True)
def _depth_at(depth_m, pixels, around, depths_m):  # type: ignore[no-untyped-def]
    """Read the depth of each pixel, with a buffer for its 3 x 3 window."""
    height, width = depth_m.shape
    for i in range(pixels.shape[0]):
        column = min(max(int(np.rint(pixels[i, 0])), 1), width - 2)
        row = min(max(int(np.rint(pixels[i, 1])), 1), height - 2)
        nearest = np.float32(np.inf)
        for n in range(9):
            around[n] = depth_m[row + n // 3 - 1, column + n % 3 - 1]
            if around[n] > 0.0:
                nearest = min(nearest, around[n])
        farthest, count = nearest * np.float32(1.0 + RIM_SHARE), ZERO
        for n in range(9):
            on = around[n] > 0.0 and around[n] <= farthest
            count += 1 if on else 0
            around[n] = around[n] if on else np.float32(0.0)
        # A single pixel is noise, not a surface.
        if count >= 3:
            upper = (around[0] + around[1]) + (around[2] + around[3])
            lower = (around[4] + around[5]) + (around[6] + around[7])
            depths_m[i] = (upper + lower + around[8]) / count


def match_features(
    first: Descriptors, second: Descriptors, ratio: float, greatest_distance: int = 64
) -> Matches:
    """Match features that are mutual nearest neighbours and pass Lowe's ratio test.

    Parameters
    ----------
    first, second
        (N, 32) and (M, 32) ORB descriptors.
    ratio
        Largest ratio of the nearest to the second nearest distance.
    greatest_distance
        Hamming distance, of 256 bits, above which two descriptors differ.
    """
    if len(first) < 2 or len(second) < 2:
        return Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))
    words = [np.ascontiguousarray(side).view(np.uint64) for side in (first, second)]
    counts = np.array([len(first), len(second)])
    nearest = np.zeros((len(first), 2), np.int64)
    back = np.full(len(second), np.iinfo(np.int64).max)
    _nearest(
        words[0], np.ascontiguousarray(words[1].T), counts, nearest, np.zeros(len(second), np.int64), back
    )
    (least, next_least), target = nearest.T // counts[1], nearest[:, 0] % counts[1]
    good = (least <= greatest_distance) & (least < ratio * next_least)
    source = np.flatnonzero(good & (back[target] % counts[0] == np.arange(counts[0])))
    return Matches(source, target[source])


@kernel(nogil=True)
def _nearest(first, second, counts, nearest, row, back):  # type: ignore[no-untyped-def]
    """Find the two nearest of ``second`` (4, M) for each of ``first`` (N, 4), and the nearest in reverse.

    Each is encoded as distance times the other side's count plus its index: the minimum is the nearest, the
    first among equals, and is found by vector instructions.
    """
    for i in range(first.shape[0]):
        a, b, c, d = first[i, 0], first[i, 1], first[i, 2], first[i, 3]
        for j in range(row.size):
            distance = ones(a ^ second[0, j]) + ones(b ^ second[1, j])
            distance += ones(c ^ second[2, j]) + ones(d ^ second[3, j])
            row[j] = distance * counts[1] + j
            back[j] = min(back[j], distance * counts[0] + i)
        for rank in range(2):
            least = row[0]
            for j in range(row.size):
                least = min(least, row[j])
            nearest[i, rank] = least
            row[least % counts[1]] = np.iinfo(np.int64).max


@lru_cache(maxsize=8)
def _orb(count: int) -> cv2.ORB:
    """Return the detector; creating one costs more than using it on a small image."""
    import cv2

    return cv2.ORB.create(nfeatures=count, fastThreshold=_FAST_THRESHOLD)
