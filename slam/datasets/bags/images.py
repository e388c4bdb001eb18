"""Image and CompressedImage messages as pixels."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.run_length_depth import unpacked
from slam.datasets.budget import MOST_PIXELS, Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.image_files import rgb_of
from slam.datasets.quiet_decoder import decode_quietly
from slam.measurements import ColorImage, Float32Array

BAD_SIZE = "image with fewer bytes than its size says"
BAD_ENCODING = "image encoding that is not read"
DAMAGED = "image truncated or damaged"

_MILLIMETRES_PER_M = 1000.0  # REP-118
_CONFIG_BYTES = 12  # of compressedDepth: a format number and two parameters
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
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


def is_depth(message: Any) -> bool:
    """Whether an image holds distances, by its encoding or format."""
    if hasattr(message, "encoding"):
        return str(message.encoding) in _DEPTH
    words = str(message.format)
    return "compressedDepth" in words or words.startswith(("16UC1", "32FC1"))


def color_of(message: Any, budget: Budget) -> ColorImage:
    """(H, W, 3) RGB; grey is spread over the channels.

    Raises
    ------
    RecordFault
        Damaged, or of an encoding that is not read.
    """
    if not hasattr(message, "encoding"):
        return _compressed_color(message, budget)
    encoding = str(message.encoding)
    if encoding not in _COLOR:
        raise RecordFault(BAD_ENCODING, f"colour {encoding[:24]!r}")
    channels, order = _COLOR[encoding]
    pixels = _pixels(message, np.dtype(np.uint8), channels)
    return np.ascontiguousarray(pixels[..., list(order)])


def depth_of(message: Any, budget: Budget) -> Float32Array:
    """(H, W) metres, 0 where the reading is invalid; 16-bit images are in millimetres (REP-118).

    Raises
    ------
    RecordFault
        Damaged, or of an encoding that is not read.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, budget)
    encoding = str(message.encoding)
    if encoding not in _DEPTH:
        raise RecordFault(BAD_ENCODING, f"depth {encoding[:24]!r}")
    order = ">" if message.is_bigendian else "<"
    return _metres(_pixels(message, np.dtype(order + _DEPTH[encoding]), 1)[..., 0])


def _pixels(message: Any, kind: np.dtype[Any], channels: int) -> NDArray[Any]:
    """(H, W, C) pixels of a raw image, the padding of its rows left out."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8).ravel()
    row = width * channels * kind.itemsize
    if min(height, width) < 1 or height * width > MOST_PIXELS or step < row or data.size < step * height:
        text = f"{width} x {height} in rows of {step} bytes, {data.size} there"
        raise RecordFault(BAD_SIZE, text)
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    return rows.view(kind).reshape(height, width, channels)


def _metres(steps: NDArray[Any]) -> Float32Array:
    """Distances of millimetres (integers) or metres; nothing below zero, nothing infinite."""
    if steps.dtype.kind == "u":
        depth_m: Float32Array = np.divide(steps, _MILLIMETRES_PER_M, dtype=np.float32)
        return depth_m
    with np.errstate(invalid="ignore"):
        metres = steps.astype(np.float32)
        valid = np.isfinite(metres) & (metres > 0.0)
    return np.where(valid, metres, np.float32(0.0))


def _compressed_color(message: Any, budget: Budget) -> ColorImage:
    """A PNG or JPEG; `cv_bridge` stores both so that every decoder shows them right."""
    image = _decoded(bytes(message.data), budget)
    color = rgb_of(image)
    if color is None:
        raise RecordFault(BAD_ENCODING, f"compressed {image.dtype} {image.shape}")
    return color


def _compressed_depth(message: Any, budget: Budget) -> Float32Array:
    """PNG or RVL after the header of compressedDepth; of 32-bit images they hold inverse depth."""
    content, words = bytes(message.data), str(message.format)
    with_header = "compressedDepth" in words
    image = content[_CONFIG_BYTES:] if with_header else content
    steps = unpacked(image, budget) if with_header and "rvl" in words.lower() else _decoded(image, budget)
    if steps.ndim != 2 or steps.dtype != np.uint16:
        raise RecordFault(BAD_ENCODING, f"compressed depth {steps.dtype} {steps.shape}")
    if not (with_header and words.startswith("32FC1")):
        return _metres(steps)
    _, scale, offset = struct.unpack_from("<iff", content)
    # The transport writes round(a / depth + b), and 0 for an invalid reading.
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.where(steps > 0, np.float32(scale) / (steps - np.float32(offset)), 0.0)
    return _metres(metres.astype(np.float32))


def _decoded(content: bytes, budget: Budget) -> NDArray[Any]:
    """Pixels of an image file, all of them."""
    image = decode_quietly(content, budget) if content else None
    if image is None:
        raise RecordFault(DAMAGED, f"{len(content)} bytes")
    return image
