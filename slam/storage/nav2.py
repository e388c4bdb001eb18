"""Maps in the format of nav2's map server: ``map.yaml`` and ``map.pgm``."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from warnings import catch_warnings

import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator

from slam.config.files import model_of, read_tree
from slam.errors import ConfigError, MapFileError
from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, StateArray
from slam.storage.files import write_lines
from slam.storage.pgm import GreyImage, write_pgm

logger = logging.getLogger(__name__)

OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196
_PIXELS = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_UNKNOWN_PIXEL = _PIXELS[UNKNOWN]
_NO_PIXEL = 1  # pixel of invalid states


@dataclass(frozen=True, slots=True)
class Nav2Map:
    """A map in nav2's interpretation.

    Attributes
    ----------
    values
        (rows, cols), row 0 at the lowest y: 100 occupied, 0 free, -1 unknown; in the modes ``scale`` and
        ``raw`` also values between 0 and 100.
    T_map_grid
        The lower-left corner of cell (0, 0).
    what
        The comment on the yaml's first line, if there is one.
    """

    values: StateArray
    resolution_m: float
    T_map_grid: gtsam.Pose2
    what: str = ""


def write_nav2_map(
    stem: Path, states: StateArray, resolution_m: float, T_map_grid: gtsam.Pose2, what: str
) -> tuple[Path, Path]:
    """Write a trinary map as ``stem.yaml`` and ``stem.pgm`` (254 free, 0 occupied, 205 unknown).

    Parameters
    ----------
    stem
        Path without ending, ``out/map`` for instance.
    states
        (rows, cols) of 100, 0 and -1; row 0 at the lowest y.
    T_map_grid
        The lower-left corner of cell (0, 0).
    what
        One line for the user, a comment in the yaml, since map servers have no key for it.

    Returns
    -------
    The two paths, yaml first.

    Raises
    ------
    MapFileError
        If there are other states, no cells, or the files cannot be written.
    """
    stem = Path(stem)
    image_path, yaml_path = stem.with_name(f"{stem.name}.pgm"), stem.with_name(f"{stem.name}.yaml")
    pixel_of = np.full(256, _NO_PIXEL, dtype=np.uint8)
    for state, pixel in _PIXELS.items():
        pixel_of[np.uint8(state % 256)] = pixel
    if states.dtype != np.int8:
        states = np.clip(states, UNKNOWN - 1, OCCUPIED + 1).astype(np.int8)  # too large stays invalid
    values = np.ascontiguousarray(states).view(np.uint8)
    if states.ndim != 2 or not states.size or any((pixel_of[row] == _NO_PIXEL).any() for row in values):
        raise MapFileError(
            f"cannot write {yaml_path}: needs a grid of 100, 0 and -1, got shape {states.shape}"
        )
    # The image first, so that a new yaml always has its image.
    write_pgm(image_path, values[::-1], pixel_of)
    name, is_plain = image_path.name, re.fullmatch(r"[^\W\d_][\w.-]*", image_path.name)
    origin = ", ".join(_decimal(value) for value in (T_map_grid.x(), T_map_grid.y(), T_map_grid.theta()))
    write_lines(
        yaml_path,
        [
            f"# {what}",
            "image: " + (name if is_plain else "'" + name.replace("'", "''") + "'"),
            "mode: trinary",
            f"resolution: {_decimal(resolution_m)}",
            f"origin: [{origin}]",
            "negate: 0",
            f"occupied_thresh: {OCCUPIED_THRESH}",
            f"free_thresh: {FREE_THRESH}",
        ],
    )
    return yaml_path, image_path


def read_nav2_map(path: Path) -> Nav2Map:
    """Read a map as nav2's map server does (its ``map_io.cpp``): trinary, scale or raw, negated or not.

    A pixel's occupancy is p = (255 - pixel) / 255, or pixel / 255 where negated. ``trinary``: p >=
    ``occupied_thresh`` is 100, p <= ``free_thresh`` is 0, else -1. ``scale``: values between the two are
    scaled to 0 to 100. ``raw``: the pixel itself, -1 above 100. Pixels that are not opaque are unknown, but
    in ``raw``. A warning is given if the thresholds turn saved unknown cells (205) into free ones.

    Raises
    ------
    MapFileError
        In one line, if the yaml or its image cannot be read, or a value is missing or invalid.
    """
    path = Path(path)
    try:
        fields = model_of(_Description, read_tree(path), str(path))
    except ConfigError as error:
        raise MapFileError(str(error)) from error
    image, opaque = _read_image(path.parent / fields.image)
    if fields.mode == "raw":
        values = image.astype(np.int8)
        values[image > OCCUPIED] = UNKNOWN
    else:
        _warn_of_freed_unknowns(path, image, fields.negate, fields.free_thresh)
        values = _occupancy(image, fields)
        values[~opaque] = UNKNOWN
    what = path.read_text(encoding="utf-8").splitlines()[0]
    what = what.removeprefix("# ") if what.startswith("#") else ""
    return Nav2Map(np.ascontiguousarray(values[::-1]), fields.resolution, gtsam.Pose2(*fields.origin), what)


class _Description(BaseModel, allow_inf_nan=False):
    """What is read of the yaml."""

    image: str = Field(min_length=1)
    resolution: float = Field(gt=0)
    origin: tuple[float, float, float]
    negate: bool = False
    occupied_thresh: float = Field(le=1)
    free_thresh: float = Field(ge=0)
    mode: Literal["trinary", "scale", "raw"] = "trinary"

    @model_validator(mode="after")
    def _in_order(self) -> _Description:
        """Check that a cell cannot be both free and occupied."""
        if self.free_thresh >= self.occupied_thresh:
            raise ValueError("free_thresh must be below occupied_thresh")
        return self


def _occupancy(image: GreyImage, fields: _Description) -> StateArray:
    """Return the values of an image in trinary or scale mode, row 0 still on top."""
    # There are only 256 greys: decide once for each.
    grey = np.arange(256) / 255.0
    p = grey if fields.negate else (255 - np.arange(256)) / 255.0
    table = np.full(256, UNKNOWN, dtype=np.int8)
    if fields.mode == "scale":
        share = (p - fields.free_thresh) / (fields.occupied_thresh - fields.free_thresh)
        table = np.rint(100.0 * np.clip(share, 0.0, 1.0)).astype(np.int8)
    table[p >= fields.occupied_thresh] = OCCUPIED
    table[p <= fields.free_thresh] = FREE
    values: StateArray = table[image]
    return values


def _warn_of_freed_unknowns(path: Path, image: GreyImage, negate: bool, free_thresh: float) -> None:
    """Warn once if 205, which savers write for unknown, is read as free."""
    count = int(np.count_nonzero(image == _UNKNOWN_PIXEL))
    if count and not negate and free_thresh >= (255 - _UNKNOWN_PIXEL) / 255.0:
        logger.warning(
            "%s: free_thresh %g turns %d unknown cells (pixel 205) into free ones; set it below 0.1961",
            path,
            free_thresh,
            count,
        )


def _read_image(path: Path) -> tuple[GreyImage, NDArray[np.bool_]]:
    """Read grey pixels, 255 white, and whether each is opaque, row 0 on top."""
    from PIL import Image

    try:
        with catch_warnings(action="ignore"), Image.open(path) as image:
            if image.mode.startswith("I"):  # 16 bits
                grey = np.rint(np.asarray(image) / 257.0).astype(np.uint8)
            else:
                grey = np.asarray(image.convert("L"))
            if "A" in image.getbands() or "transparency" in image.info:
                return grey, np.asarray(image.convert("RGBA"))[:, :, 3] == 255
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as cause:
        why = (
            getattr(cause, "strerror", None) or "not an image that can be read (pgm, png or bmp), or cut off"
        )
        raise MapFileError(f"cannot read {path}: {why}") from cause
    return grey, np.ones(grey.shape, dtype=np.bool_)


def _decimal(value: float) -> str:
    """Format a number without exponent (yaml parses 1e-05 as text) that reads back as the same."""
    return np.format_float_positional(value, unique=True, trim="0")
