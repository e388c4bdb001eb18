"""Detects damaged images with OpenCV's decoders, and hides their messages from the user.

Their JPEG library fills damaged parts with grey, and reports this only on the standard error stream.
"""

from __future__ import annotations

import os
import re
import struct
import tempfile
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import MOST_PIXELS, Budget

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
