"""Grey images in the PGM format, with eight bits (as nav2) and with sixteen, without an image library."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError
from slam.storage.files import replacing

GreyImage: TypeAlias = NDArray[np.uint8]

_ROWS_AT_ONCE = 256
# Magic number, then width, height and the value of white, apart by blanks and comments, then one blank.
_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_HEADER = re.compile(rb"(P[25])" + _GAP + rb"(\d+)" + _GAP + rb"(\d+)" + _GAP + rb"(\d+)\s")


def write_pgm(path: Path, image: GreyImage | NDArray[np.uint16], pixel_of: GreyImage | None = None) -> None:
    """Write a (rows, cols) image, row 0 on top, as binary PGM (P5), whole or not at all.

    Parameters
    ----------
    image
        Of two bytes a pixel if it is uint16, else of one.
    pixel_of
        (256,) what is written for each value; None for the value itself.

    Raises
    ------
    MapFileError
        If the file cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> from pathlib import Path
    >>> from slam.storage.pgm import read_pgm, write_pgm
    >>> write_pgm(Path("map.pgm"), np.array([[0, 254], [205, 205]], np.uint8))
    >>> read_pgm(Path("map.pgm")).tolist()
    [[0, 254], [205, 205]]
    """
    rows, cols = image.shape
    with replacing(path) as temporary, temporary.open("wb") as file:
        kind = np.dtype(">u2" if image.dtype == np.uint16 else np.uint8)
        file.write(b"P5\n%d %d\n%d\n" % (cols, rows, np.iinfo(kind).max))
        # A large map is not held a second time.
        for first in range(0, rows, _ROWS_AT_ONCE):
            part = image[first : first + _ROWS_AT_ONCE].astype(kind, copy=False)
            file.write((part if pixel_of is None else pixel_of[part]).tobytes())


def read_pgm(path: Path) -> GreyImage:
    """Read binary (P5) or plain text (P2) PGM as (rows, cols), 255 white, whatever the file's own white is.

    Raises
    ------
    MapFileError
        If the file cannot be read, is not PGM, or has too few or too bright pixels.

    Examples
    --------
    >>> from pathlib import Path
    >>> from slam.storage.pgm import read_pgm
    >>> Path("plain.pgm").write_text("P2 2 1 100 0 100") > 0
    True
    >>> read_pgm(Path("plain.pgm")).tolist()
    [[0, 255]]
    """
    try:
        content = path.read_bytes()
    except OSError as cause:
        raise MapFileError(f"cannot read {path}: {cause.strerror or cause}") from cause
    header = _HEADER.match(content)
    if header is None:
        raise MapFileError(f"{path}: not a PGM image (P5 or P2)")
    cols, rows, white = (int(number) for number in header.groups()[1:])
    if not (cols and rows and 0 < white < 65536):
        raise MapFileError(f"{path}: PGM header of {cols} x {rows} pixels with white {white}")
    pixels = _pixels(content[header.end() :], header[1], white, path)
    if pixels.size < rows * cols:
        raise MapFileError(f"{path}: cut off, {pixels.size} of {rows} x {cols} pixels; save the map again")
    image = pixels[: rows * cols].reshape(rows, cols).astype(np.float64)
    if image.max() > white:
        raise MapFileError(f"{path}: a pixel of {image.max():g} is brighter than white, {white}")
    return np.rint(image * 255.0 / white).astype(np.uint8)


def _pixels(body: bytes, magic: bytes, white: int, path: Path) -> NDArray[np.integer]:
    """All numbers behind the header, in file order."""
    if magic == b"P5":
        width = 1 if white < 256 else 2
        return np.frombuffer(body[: len(body) // width * width], dtype=np.uint8 if width == 1 else ">u2")
    try:
        return np.array(re.sub(rb"#[^\r\n]*", b"", body).split(), dtype=np.uint16)
    except (ValueError, OverflowError) as cause:
        raise MapFileError(f"{path}: pixels must be whole numbers from 0 to {white}") from cause
