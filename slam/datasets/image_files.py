"""Colour and depth images from files, whole or not at all."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.quiet_decoder import decode_quietly
from slam.measurements import ColorImage, Float32Array

MISSING = "image file missing"
UNREADABLE = "image file cannot be read"
DAMAGED = "image truncated or damaged"
NOT_COLOR = "colour image not 8-bit RGB or grey"
NOT_16_BIT = "depth image not 16-bit"
MANY_CHANNELS = "depth image has several channels"
NOT_PNG = "depth image not PNG"

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def read_color(path: Path, budget: Budget) -> ColorImage:
    """An 8-bit image as (H, W, 3) RGB; grey is spread over the channels, transparency is dropped.

    Raises
    ------
    RecordFault
        Missing, unreadable, damaged, not 8-bit, or beyond the budget.
    """
    image = _decode(path, budget)
    color = rgb_of(image)
    if color is None:
        raise RecordFault(NOT_COLOR, f"{path.name}: {image.dtype} {image.shape}")
    return color


def rgb_of(image: NDArray[Any]) -> ColorImage | None:
    """Pixels as OpenCV decodes them as (H, W, 3) RGB; None where they are not 8-bit colour or grey."""
    import cv2

    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != np.uint8 or channels not in (1, 3, 4):
        return None
    conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}[channels]
    return np.ascontiguousarray(cv2.cvtColor(image, conversion))


def read_depth(
    path: Path, steps_per_m: float, budget: Budget, invalid_codes: tuple[int, ...] = ()
) -> Float32Array:
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
        Missing, unreadable, damaged, beyond the budget, of 8 bits or of several channels: its metres would be
        a guess.
    """
    steps = _decode(path, budget, _PNG_MAGIC)
    if steps.ndim != 2:
        raise RecordFault(MANY_CHANNELS, f"{path.name}: {steps.shape}")
    if steps.dtype != np.uint16:
        raise RecordFault(NOT_16_BIT, f"{path.name}: {steps.dtype}")
    for code in invalid_codes:
        steps[steps == code] = 0
    # Divided, not multiplied: 4020 / 5000 then is the float nearest to 0.804.
    depth_m: Float32Array = np.divide(steps, steps_per_m, dtype=np.float32)
    return depth_m


def _content(path: Path, budget: Budget) -> bytes:
    """All of a file; pipes and devices are none."""
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > LARGEST_BYTES:
            raise RecordFault(UNREADABLE, f"{path.name}: no file, or one of {found.st_size} bytes")
        budget.add_file(path, found.st_size)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise RecordFault(MISSING, str(path)) from error
    except (OSError, ValueError) as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error


def _decode(path: Path, budget: Budget, magic: bytes = b"") -> NDArray[Any]:
    """Pixels as stored, all of them; where the file must begin so, it is a PNG."""
    content = _content(path, budget)
    if content and not content.startswith(magic):
        raise RecordFault(NOT_PNG, path.name)
    image = decode_quietly(content, budget) if content else None
    if image is None:
        raise RecordFault(DAMAGED, path.name)
    return image
