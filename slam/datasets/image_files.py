"""Colour and depth images from files, whole or not at all."""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.dataset import RecordFault
from slam.measurements import ColorImage, Float32Array

MISSING = "image file missing"
UNREADABLE = "image file cannot be read"
DAMAGED = "image truncated or damaged"
NOT_COLOR = "colour image not 8-bit RGB or grey"
NOT_16_BIT = "depth image not 16-bit"
MANY_CHANNELS = "depth image has several channels"
NOT_PNG = "depth image not PNG"

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_SCAN = 0xDA
# Within the packed scans of a JPEG, 0xff is followed by a zero, a restart or another 0xff; tables and
# comments may stand between scans. The first other marker must be the end.
_JPEG_LEAVES_SCAN = re.compile(rb"\xff[\x01-\xc3\xc5-\xcb\xcd-\xcf\xd8\xd9]")
_JPEG_END = b"\xff\xd9"


def read_color(path: Path) -> ColorImage:
    """An 8-bit image as (H, W, 3) RGB; grey is spread over the channels, transparency is dropped.

    Raises
    ------
    RecordFault
        Missing, unreadable, damaged, or not 8-bit.
    """
    import cv2

    image = _decode(path, _content(path))
    if image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] not in (1, 3, 4)):
        raise RecordFault(NOT_COLOR, f"{path.name}: {image.dtype} {image.shape}")
    channels = 1 if image.ndim == 2 else image.shape[2]
    conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}[channels]
    return np.ascontiguousarray(cv2.cvtColor(image, conversion))


def read_depth(path: Path, steps_per_m: float, invalid_codes: tuple[int, ...] = ()) -> Float32Array:
    """A 16-bit PNG as metres, (H, W).

    Parameters
    ----------
    steps_per_m
        What the file writes for one metre.
    invalid_codes
        Values that mean "no reading", besides 0.

    Raises
    ------
    RecordFault
        Missing, unreadable, damaged, of 8 bits or of several channels: its metres would be a guess.
    """
    content = _content(path)
    if not content.startswith(_PNG_MAGIC):
        raise RecordFault(NOT_PNG if content else DAMAGED, path.name)
    steps = _decode(path, content)
    if steps.ndim != 2:
        raise RecordFault(MANY_CHANNELS, f"{path.name}: {steps.shape}")
    if steps.dtype != np.uint16:
        raise RecordFault(NOT_16_BIT, f"{path.name}: {steps.dtype}")
    for code in invalid_codes:
        steps[steps == code] = 0
    # Divided, not multiplied: 4020 / 5000 then is the float nearest to 0.804.
    depth_m: Float32Array = np.divide(steps, steps_per_m, dtype=np.float32)
    return depth_m


def _content(path: Path) -> bytes:
    """All of a file."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise RecordFault(MISSING, str(path)) from error
    except (OSError, ValueError) as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error


def _decode(path: Path, content: bytes) -> NDArray[Any]:
    """Pixels as stored; damage is found before the decoder sees it, which would print and go on."""
    import cv2

    if not _is_whole(content):
        raise RecordFault(DAMAGED, path.name)
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordFault(DAMAGED, path.name)
    return np.asarray(image)


def _is_whole(content: bytes) -> bool:
    """Whether a PNG's checksums and a JPEG's markers hold; any other kind is left to the decoder."""
    if content.startswith(_PNG_MAGIC):
        return _is_whole_png(memoryview(content))
    if content.startswith(_JPEG_MAGIC):
        return _is_whole_jpeg(content)
    return bool(content)


def _is_whole_png(content: memoryview) -> bool:
    """Walk the chunks (length, name, data, checksum of name and data) up to the end chunk."""
    start = len(_PNG_MAGIC)
    while start + 12 <= len(content):
        length = int.from_bytes(content[start : start + 4], "big")
        end = start + 8 + length
        if end + 4 > len(content):
            return False
        if zlib.crc32(content[start + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return False
        if bytes(content[start + 4 : start + 8]) == b"IEND":
            return True
        start = end + 4
    return False


def _is_whole_jpeg(content: bytes) -> bool:
    """Whether the packed pixels reach the end marker without a marker that cannot stand among them."""
    start = 2
    while start + 4 <= len(content) and content[start] == 0xFF:
        if content[start + 1] == _JPEG_SCAN:
            leaves = _JPEG_LEAVES_SCAN.search(content, start + 2)
            return leaves is not None and leaves.group() == _JPEG_END
        # Marker, then a length that counts itself.
        start += 2 + int.from_bytes(content[start + 2 : start + 4], "big")
    return False
