"""Reads colour and depth images from files; rejects incomplete ones.

Damaged images are detected with OpenCV's decoders, and their messages are hidden from the user: their
JPEG library fills damaged parts with grey, and reports this only on the standard error stream.
"""

from __future__ import annotations

import io
import os
import re
import stat
import struct
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES, MOST_PIXELS, Budget
from slam.datasets.calibration import Calibration
from slam.datasets.dataset import RecordFault
from slam.datasets.plain_points import load_array
from slam.datasets.stamped_files import StampedFile
from slam.measurements import ColorImage, Float32Array

MISSING = "image file missing"
UNREADABLE = "image file cannot be read"
DAMAGED = "image truncated or damaged"
NOT_COLOR = "colour image not 8-bit RGB or grey"
NOT_16_BIT = "depth image not 16-bit"
MANY_CHANNELS = "depth image has several channels"
NOT_PNG = "depth image neither PNG, PGM nor .npy: convert it to PNG of 16 bits, in mm"
NOT_METRES = "depth array not of metres"
OTHER_CONFIDENCE = "confidence image does not fit the depth"

_EXACT_MAGICS = (b"\x89PNG\r\n\x1a\n", b"P5")  # JPEG would mix depths
_NPY_MAGIC = b"\x93NUMPY"

# OpenCV reads this when it is loaded. A few bytes may claim to be a gigapixel image.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
_STDERR = 2
_PNG = b"\x89PNG\r\n\x1a\n"
# Messages of libjpeg and libpng, and OpenCV's log.
_CHATTER = re.compile(
    rb"^(?:Corrupt JPEG|Premature end of JPEG|Invalid JPEG|Inconsistent|Unsupported|libpng |\[ ?\w+:).*\n?",
    re.MULTILINE,
)
# Some cameras write a few padding bytes before a marker; all other messages mean lost pixels.
_HARMLESS = re.compile(rb" \d{1,2} extraneous bytes before marker|libpng warning|\[ ?(?:INFO|WARN)")

# There is one standard error stream: two threads that redirect it would interfere.
_one_at_a_time = threading.Lock()


class ImageSource(Protocol):
    """Source of a camera's images; called on the prefetching thread, in the order of the log.

    Both raise `RecordFault` if an image is missing, damaged, of another type, or over the budget.
    """

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """(H, W, 3) RGB."""
        ...

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """(H, W) in metres, 0 for no reading."""
        ...


@dataclass(frozen=True, slots=True)
class ImageFiles:
    """Images with one file each.

    Attributes
    ----------
    confidence
        The folder of confidence images with the same names, or None; depth with confidence 0 is omitted.
    float_png
        Whether the four bytes of a depth PNG's pixel are a float in metres.
    """

    confidence: Path | None = None
    float_png: bool = False

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `ImageSource`."""
        return color_of(file_content(file.path, budget), file.path.name, budget)

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `ImageSource`."""
        content = file_content(file.path, budget)
        depth_m = depth_of(content, file.path.name, calibration, budget, float_png=self.float_png)
        if self.confidence and (trust_file := self.confidence / file.path.name).is_file():
            trust = decoded(file_content(trust_file, budget), trust_file.name, budget)
            if trust.shape != depth_m.shape:
                raise RecordFault(OTHER_CONFIDENCE, f"{trust_file.name}: {trust.shape}, {depth_m.shape}")
            depth_m[trust == 0] = 0.0
        return depth_m


FILES = ImageFiles()


def color_of(content: bytes, name: str, budget: Budget) -> ColorImage:
    """Decode an 8-bit image to (H, W, 3) RGB without transparency; RecordFault if damaged or not 8-bit."""
    image = decoded(content, name, budget)
    color = rgb_of(image)
    if color is None:
        raise RecordFault(NOT_COLOR, f"{name}: {image.dtype} {image.shape}")
    return color


def rgb_of(image: NDArray[Any]) -> ColorImage | None:
    """Convert pixels from OpenCV's order to (H, W, 3) RGB; None if they are not 8-bit colour or grey."""
    import cv2

    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != np.uint8 or channels not in (1, 3, 4):
        return None
    conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}[channels]
    return np.ascontiguousarray(cv2.cvtColor(image, conversion))


def depth_of(
    content: bytes, name: str, calibration: Calibration, budget: Budget, *, float_png: bool = False
) -> Float32Array:
    """Decode a 16-bit PNG or PGM, or an array of metres, to metres (H, W); RecordFault if it is neither."""
    if content.startswith(_NPY_MAGIC):
        array = _array(content, name)
        steps_of_array = array.ndim == 2 and array.dtype == np.uint16
        return metres_of(array, calibration) if steps_of_array else usable_metres(array, name, budget)
    if content and not content.startswith(_EXACT_MAGICS):
        raise RecordFault(NOT_PNG, name)
    steps = decoded(content, name, budget)
    if float_png and steps.dtype == np.uint8 and steps.shape[2:] == (4,):
        return usable_metres(steps.view("<f4")[..., 0], name, budget)
    if steps.ndim != 2:
        raise RecordFault(MANY_CHANNELS, f"{name}: {steps.shape}")
    if steps.dtype != np.uint16:
        raise RecordFault(NOT_16_BIT, f"{name}: {steps.dtype}")
    return metres_of(steps, calibration)


def metres_of(steps: NDArray[Any], calibration: Calibration) -> Float32Array:
    """Convert raw depth to metres; codes for "no reading" become 0."""
    for code in filter(None, calibration.invalid_codes):
        steps[steps == code] = 0
    # Divided, not multiplied, so that 4020 / 5000 is the float nearest to 0.804.
    depth_m: Float32Array = np.divide(steps, calibration.depth_steps_per_m, dtype=np.float32)
    return depth_m


def usable_metres(depth: NDArray[Any], name: str, budget: Budget) -> Float32Array:
    """Depth stored as floats; values that are not finite or not positive become 0."""
    if depth.ndim != 2 or depth.dtype.kind != "f" or not 0 < depth.size <= MOST_PIXELS:
        raise RecordFault(NOT_METRES, f"{name}: {depth.dtype} {depth.shape}")
    budget.take(depth.nbytes, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        depth_m = depth.astype(np.float32)
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0.0))] = 0.0
    return depth_m


def _array(content: bytes, name: str) -> NDArray[Any]:
    """An array in NumPy's format; arrays of objects are rejected."""
    try:
        return load_array(io.BytesIO(content))
    except (ValueError, OSError) as error:
        raise RecordFault(DAMAGED, f"{name}: {error}") from error


def file_content(path: Path, budget: Budget) -> bytes:
    """The content of a file; pipes and devices are rejected."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST_BYTES:
            raise RecordFault(UNREADABLE, f"{path.name}: no file, or one of {status.st_size} bytes")
        budget.add_file(path, status.st_size)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise RecordFault(MISSING, str(path)) from error
    except (OSError, ValueError) as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error


def decoded(content: bytes, name: str, budget: Budget) -> NDArray[Any]:
    """All pixels as stored."""
    image = decode_quietly(content, budget) if content else None
    if image is None:
        raise RecordFault(DAMAGED, name)
    return image


def decode_quietly(content: bytes, budget: Budget) -> NDArray[Any] | None:
    """Pixels of an image file as stored, None if any of them could not be decoded.

    The pixels are charged to the budget; `RecordFault` if it is exhausted.

    Changes that leave a valid JPEG are not detected, because the format has no checksum.

    Other output to the standard error stream is passed on.
    """
    import cv2

    budget.take(0, 0)
    if content.startswith(_PNG) and not _chunks_fit(content):
        return None
    with _one_at_a_time, tempfile.TemporaryFile() as sink:
        stderr = os.dup(_STDERR)
        try:
            os.dup2(sink.fileno(), _STDERR)
            try:
                image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
            except cv2.error:  # a header with more pixels than OpenCV allows
                image = None
            finally:
                os.dup2(stderr, _STDERR)
            sink.seek(0)
            output = sink.read()
            if others := _CHATTER.sub(b"", output):
                os.write(stderr, others)
        finally:
            os.close(stderr)
    budget.take(0 if image is None else image.nbytes, 0)
    damaged = any(not _HARMLESS.search(line) for line in _CHATTER.findall(output))
    return None if image is None or damaged else np.asarray(image)


def _chunks_fit(content: bytes) -> bool:
    """Whether no chunk of a PNG is longer than the file; OpenCV allocates the stated size."""
    at = len(_PNG)
    while at + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, at)
        at += 12 + size
        if at > len(content):
            return False
        if kind == b"IEND":
            break
    return True
