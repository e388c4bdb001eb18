"""Convert clouds and RGB-D images to bytes and back.

Images: colour as JPEG, depth as a 16-bit PNG.

Clouds: points in integer steps, stored as differences, compressed by Zstandard. Intensities, if there are
any, follow unchanged (float32), with the upper bytes separate from the lower. Maps of schema 5 and older
used zlib, at seven times the cost and the same size.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np

from fusion.kernel import ZERO, kernel
from slam.errors import ScanweaveError
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, FloatArray, RgbdFrame
from slam.zstandard import zstd

STEPS_PER_M = 5000.0  # 0.2 mm, as in TUM's logs; coarser only for a frame that reaches beyond 13.1 m
MAX_STEPS = np.iinfo(np.uint16).max
_PNG_HEAD = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"

STEP_M = 0.001  # a thirtieth of a 3D lidar's noise; coarser only for a cloud that reaches beyond 500 km
_MOST_BYTES = 1 << 27  # unpacked
_HEAD = struct.Struct("<dI")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def depth_steps_per_m(frame: RgbdFrame) -> float:
    """Return the steps per metre of a frame's stored depth.

    Raises
    ------
    ScanweaveError
        If a depth is not finite.
    """
    reach_m = float(frame.depth_m.max(initial=0.0))
    if not math.isfinite(reach_m):
        raise ScanweaveError(
            f"depth image at {frame.stamp_s:.6f} s holds {reach_m}; an invalid reading must be 0"
        )
    return min(STEPS_PER_M, MAX_STEPS / reach_m) if reach_m > 0.0 else STEPS_PER_M


def packed_color(color: ColorImage) -> bytes:
    """Encode an (H, W, 3) RGB image as JPEG (quality 95), which changes it by a few grey levels."""
    import cv2

    bgr = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr)[1].tobytes()


def packed_depth(depth_m: Float32Array, steps_per_m: float) -> bytes:
    """Encode an (H, W) depth image, rounded to steps, as PNG."""
    import cv2

    steps = cv2.multiply(np.ascontiguousarray(depth_m), steps_per_m, dtype=cv2.CV_16U)
    # Differences to the row above, run-length encoded: on a Kinect frame 4 ms instead of the 11 of plain
    # level 1, on a noisy one 8 instead of 13, and the files are smaller.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    options += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return cv2.imencode(".png", steps, options)[1].tobytes()


def unpacked_images(
    color: bytes, depth: bytes, steps_per_m: float, camera: CameraIntrinsics
) -> tuple[ColorImage, Float32Array]:
    """Decode colour (H, W, 3) and depth (H, W) in metres.

    Raises
    ------
    ValueError
        If the bytes are no images, or not of the camera's size, which is checked before decoding.
    """
    import cv2

    _check_size(_jpeg_size(color), camera)
    rgb = cv2.imdecode(np.frombuffer(color, np.uint8), cv2.IMREAD_COLOR_RGB)
    if rgb is None:
        raise ValueError("an image that cannot be decoded")
    return np.asarray(rgb, np.uint8), unpacked_depth(depth, steps_per_m, camera)


def unpacked_depth(depth: bytes, steps_per_m: float, camera: CameraIntrinsics) -> Float32Array:
    """Decode depth (H, W) in metres; errors as in `unpacked_images`."""
    import cv2

    _check_size(_png_size(depth), camera)
    steps = cv2.imdecode(np.frombuffer(depth, np.uint8), cv2.IMREAD_UNCHANGED)
    if steps is None or steps.dtype != np.uint16 or steps.ndim != 2:
        raise ValueError("an image that cannot be decoded")
    return steps.astype(np.float32) / np.float32(steps_per_m)


def _check_size(actual: tuple[int, int] | None, camera: CameraIntrinsics) -> None:
    """Reject an image that does not have the camera's size."""
    size = (camera.width, camera.height)
    if actual != size:
        raise ValueError(f"an image of {actual} pixels, the camera has {size}")


def _png_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height of a PNG."""
    if not content.startswith(_PNG_HEAD) or len(content) < len(_PNG_HEAD) + 8:
        return None
    width, height = struct.unpack_from(">2I", content, len(_PNG_HEAD))
    return width, height


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height of a JPEG from its frame header (markers C0 to C2)."""
    at = 2
    while content[:2] == b"\xff\xd8" and at + 9 <= len(content) and content[at] == 0xFF:
        if 0xC0 <= content[at + 1] <= 0xC2:
            height, width = struct.unpack_from(">2H", content, at + 5)
            return width, height
        at += 2 + max(2, struct.unpack_from(">H", content, at + 2)[0])
    return None


def packed_cloud(rows: FloatArray) -> bytes:
    """Pack points (N, 3), rounded to steps of `STEP_M`, in order; a fourth column contains intensities.

    Raises
    ------
    ScanweaveError
        If a point is not finite.
    """
    reach_m = float(np.abs(rows[:, :3]).max(initial=0.0))
    if not np.isfinite(reach_m):
        raise ScanweaveError(f"a cloud holds a point at {reach_m}; only finite points can be kept")
    step_m = max(STEP_M, reach_m / 2**29)
    ways = np.diff(np.rint(rows[:, :3] / step_m), axis=0, prepend=0.0).astype(np.int64)
    # The sign is the lowest bit: the upper bytes of small differences are zero for either sign.
    planes = (ways << 1 ^ ways >> 63).astype("<u4").view(np.uint8).reshape(-1, 3, 4).T
    intensities = rows[:, 3:].astype("<f4").view(np.uint8).reshape(-1, 4).T.tobytes()
    return _HEAD.pack(step_m, len(rows)) + zstd.compress(planes.tobytes() + intensities, 1)


def unpacked_cloud(content: bytes, *, intensities: bool = True) -> FloatArray:
    """Unpack points (N, 3), or (N, 4) with their intensities if requested.

    Raises
    ------
    ValueError
        If they are not the output of `packed_cloud`; no more than the stated size is unpacked.
    """
    if len(content) < _HEAD.size:
        raise ValueError("a cloud that ends too soon")
    step_m, count = _HEAD.unpack_from(content)
    sizes = [columns * np.dtype(np.int32).itemsize * count for columns in (3, 4)]
    if not 0.0 < step_m < np.inf:
        raise ValueError(f"a packed cloud in steps of {step_m:g} m")
    packed = content[_HEAD.size :]
    unpacker: Any = zstd.ZstdDecompressor() if packed.startswith(_ZSTD_MAGIC) else zlib.decompressobj()
    try:
        plain = unpacker.decompress(packed, min(sizes[-1], _MOST_BYTES) + 1)
    except (zlib.error, zstd.ZstdError) as error:
        raise ValueError(f"a packed cloud that is damaged: {error}") from error
    if len(plain) not in sizes or not unpacker.eof or unpacker.unused_data:
        raise ValueError(f"a packed cloud that is not of {count} points")
    rows = np.empty((count, 3 + (intensities and len(plain) > sizes[0])))
    planes = np.frombuffer(plain, np.uint8)
    _added_up(planes[: sizes[0]].reshape(4, 3, count), step_m, rows)
    if rows.shape[1] > 3:
        rows[:, 3] = np.ascontiguousarray(planes[sizes[0] :].reshape(4, count).T).view("<f4")[:, 0]
    return rows


@kernel(nogil=True)
def _added_up(planes, step_m, points):  # type: ignore[no-untyped-def]
    """Sum points (N, 3 or 4) from the bytes (4, 3, N) of their differences."""
    for axis in range(3):
        steps = ZERO
        for i in range(points.shape[0]):
            signless = np.int64(planes[0, axis, i]) | (np.int64(planes[1, axis, i]) << 8)
            signless |= (np.int64(planes[2, axis, i]) << 16) | (np.int64(planes[3, axis, i]) << 24)
            steps += (signless >> 1) ^ -(signless & 1)
            # As 32-bit integers, which a damaged cloud may exceed.
            steps = ((steps + (1 << 31)) & ((1 << 32) - 1)) - (1 << 31)
            points[i, axis] = steps * step_m
