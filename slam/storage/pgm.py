"""Write grey images in the PGM format, with eight bits (as nav2) and with sixteen, a few rows at once."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.storage.files import replacing

GreyImage: TypeAlias = NDArray[np.uint8]

_ROWS_AT_ONCE = 256


def write_pgm(path: Path, image: GreyImage | NDArray[np.uint16], pixel_of: GreyImage | None = None) -> None:
    r"""Write a (rows, cols) image, row 0 on top, as binary PGM (P5), whole or not at all.

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
    >>> from slam.storage.pgm import write_pgm
    >>> write_pgm(Path("map.pgm"), np.array([[65, 66], [67, 68]], np.uint8))
    >>> Path("map.pgm").read_bytes()
    b'P5\n2 2\n255\nABCD'
    """
    rows, cols = image.shape
    with replacing(path) as temporary, temporary.open("wb") as file:
        kind = np.dtype(">u2" if image.dtype == np.uint16 else np.uint8)
        file.write(b"P5\n%d %d\n%d\n" % (cols, rows, np.iinfo(kind).max))
        # A large map is not held a second time.
        for first in range(0, rows, _ROWS_AT_ONCE):
            part = image[first : first + _ROWS_AT_ONCE].astype(kind, copy=False)
            file.write((part if pixel_of is None else pixel_of[part]).tobytes())
