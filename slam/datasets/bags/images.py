"""Converts Image and CompressedImage messages to pixels."""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.run_length_depth import unpacked
from slam.datasets.bags.topics import is_infrared
from slam.datasets.budget import MOST_PIXELS, Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.image_files import decoded, rgb_of
from slam.measurements import ColorImage, Float32Array

BAD_SIZE = "image with fewer bytes than its size requires"
BAD_ENCODING = "unsupported image encoding"

MILLIMETRES_PER_M = 1000.0  # REP-118
_CONFIG_BYTES = 12  # compressedDepth header: a format number and two parameters
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
# Two pixels share their colour, planar or interleaved: OpenCV's conversion, and bytes per pixel.
_SHARED_COLOR = {
    **dict.fromkeys(("yuv422", "uyvy"), ("COLOR_YUV2RGB_UYVY", 2)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), ("COLOR_YUV2RGB_YUY2", 2)),
    "nv12": ("COLOR_YUV2RGB_NV12", 1),
    "nv21": ("COLOR_YUV2RGB_NV21", 1),
}
# Named by the first two pixels of the first two rows; OpenCV names them by the second row.
_MOSAIC = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_DEPTH_NAME = re.compile(r"depth|tof|range|stereo", re.IGNORECASE)
_PNG_16_BIT_GREY = (b"\x89PNG", b"\x10\x00")
_COLOR: dict[str, tuple[int, tuple[int, ...]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}


def is_depth(message: Any, topic: str) -> bool:
    """Whether an image contains depth: by its encoding or format, or else by its topic."""
    if not hasattr(message, "encoding"):
        words, head = str(message.format), bytes(message.data[:26])
        is_stated = "compressedDepth" in words or words.startswith(("16UC1", "32FC1"))
        grey = (head[:4], head[24:26]) == _PNG_16_BIT_GREY
        return is_stated or (grey and not is_infrared(topic))
    encoding = str(message.encoding)
    if encoding == "mono16":
        return bool(_DEPTH_NAME.search(topic)) and not is_infrared(topic)
    return encoding in _DEPTH and not is_infrared(topic)


def color_of(message: Any, budget: Budget) -> ColorImage:
    """Return (H, W, 3) RGB, grey as three channels; RecordFault if damaged or of an unknown encoding."""
    if not hasattr(message, "encoding"):
        return _compressed_color(message, budget)
    encoding = str(message.encoding)
    if encoding in _COLOR:
        channels, order = _COLOR[encoding]
        pixels = _pixels(message, np.dtype(np.uint8), channels)
        return np.ascontiguousarray(pixels[..., list(order)])
    if encoding.lower() in _SHARED_COLOR:
        return _from_shared_color(message, *_SHARED_COLOR[encoding.lower()])
    if encoding.startswith("bayer_") and encoding[6:10] in _MOSAIC and encoding[10:] in ("8", "16"):
        return _from_mosaic(message, encoding[6:10], int(encoding[10:]))
    if encoding in ("mono16", "16UC1"):
        return _from_wide_grey(_pixels(message, _order(message, "u2"), 1)[..., 0])
    raise RecordFault(BAD_ENCODING, f"colour {encoding[:24]!r}")


def _from_shared_color(message: Any, conversion: str, size: int) -> ColorImage:
    """Convert YUV, as cameras send it."""
    import cv2

    height, width = int(message.height), int(message.width)
    if size == 1:  # a plane of brightness above half a plane of colour
        rows = _pixels(message, np.dtype(np.uint8), 1, 3 * height // 2)
    else:
        rows = _pixels(message, np.dtype(np.uint8), size)
    if width % 2 or (size == 1 and height % 2):
        raise RecordFault(BAD_SIZE, f"{width} x {height} of an encoding with pixel pairs")
    return np.ascontiguousarray(cv2.cvtColor(rows, getattr(cv2, conversion)))


def _from_mosaic(message: Any, pattern: str, bits: int) -> ColorImage:
    """Convert a Bayer mosaic."""
    import cv2

    pixels = _pixels(message, _order(message, f"u{bits // 8}"), 1)[..., 0]
    if min(pixels.shape) < 2:
        raise RecordFault(BAD_SIZE, f"{pixels.shape} of an encoding with pixel pairs")
    brightest = pixels if bits == 8 else (pixels >> 8).astype(np.uint8)
    return np.ascontiguousarray(cv2.cvtColor(brightest, getattr(cv2, f"COLOR_Bayer{_MOSAIC[pattern]}2RGB")))


def _from_wide_grey(pixels: NDArray[Any]) -> ColorImage:
    """Convert 16-bit infrared or thermal images: the brightest pixel becomes white."""
    brightest = max(int(pixels.max(initial=0)), 255)
    grey = (pixels.astype(np.uint32) * 255 // brightest).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def depth_of(message: Any, budget: Budget, steps_per_m: float = MILLIMETRES_PER_M) -> Float32Array:
    """(H, W) depth in metres, 0 if invalid.

    Parameters
    ----------
    steps_per_m
        Units per metre of 16-bit images.

    Raises
    ------
    RecordFault
        The image is damaged, or its encoding is not supported.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, budget, steps_per_m)
    encoding = str(message.encoding)
    if encoding not in _DEPTH:
        raise RecordFault(BAD_ENCODING, f"depth {encoding[:24]!r}")
    return _metres(_pixels(message, _order(message, _DEPTH[encoding]), 1)[..., 0], steps_per_m)


def _order(message: Any, kind: str) -> np.dtype[Any]:
    """A number type with the byte order of a message."""
    return np.dtype((">" if message.is_bigendian else "<") + kind)


def _pixels(message: Any, kind: np.dtype[Any], channels: int, rows: int = 0) -> NDArray[Any]:
    """(H, W, C) pixels of a raw image without the padding of its rows; ``rows`` rows if given."""
    height, width, step = rows or int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8).ravel()
    row = width * channels * kind.itemsize
    if min(height, width) < 1 or height * width > MOST_PIXELS or step < row or data.size < step * height:
        text = f"{width} x {height} in rows of {step} bytes, {data.size} there"
        raise RecordFault(BAD_SIZE, text)
    packed = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    return packed.view(kind).reshape(height, width, channels)


def _metres(steps: NDArray[Any], steps_per_m: float = MILLIMETRES_PER_M) -> Float32Array:
    """Depth in metres from integer steps or metres; negative and infinite values become 0."""
    if steps.dtype.kind == "u":
        depth_m: Float32Array = np.divide(steps, steps_per_m, dtype=np.float32)
        return depth_m
    with np.errstate(invalid="ignore"):
        metres = steps.astype(np.float32)
        valid = np.isfinite(metres) & (metres > 0.0)
    return np.where(valid, metres, np.float32(0.0))


def _compressed_color(message: Any, budget: Budget) -> ColorImage:
    """Decode a PNG or JPEG, which `cv_bridge` writes with the usual channel order."""
    image = decoded(bytes(message.data), "a compressed image", budget)
    color = rgb_of(image)
    if color is None:
        raise RecordFault(BAD_ENCODING, f"compressed {image.dtype} {image.shape}")
    return color


def _compressed_depth(message: Any, budget: Budget, steps_per_m: float) -> Float32Array:
    """Decode PNG or RVL after the compressedDepth header; for 32-bit images they contain inverse depth."""
    content, words = bytes(message.data), str(message.format)
    with_header = "compressedDepth" in words
    image = content[_CONFIG_BYTES:] if with_header else content
    runs = with_header and "rvl" in words.lower()
    steps = unpacked(image, budget) if runs else decoded(image, "compressed depth", budget)
    if steps.ndim != 2 or steps.dtype not in (np.uint16, np.float32):
        raise RecordFault(BAD_ENCODING, f"compressed depth {steps.dtype} {steps.shape}")
    if not (with_header and words.startswith("32FC1")):
        return _metres(steps, steps_per_m)
    _, scale, offset = struct.unpack_from("<iff", content)
    # The transport writes round(a / depth + b), and 0 for an invalid reading.
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.where(steps > 0, np.float32(scale) / (steps - np.float32(offset)), 0.0)
    return _metres(metres.astype(np.float32))
