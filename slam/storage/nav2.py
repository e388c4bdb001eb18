"""Maps in the format of nav2's map server: ``map.yaml`` and ``map.pgm``."""

from __future__ import annotations

import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError
from slam.foreign import from_yaml
from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, StateArray
from slam.storage.files import write_lines
from slam.storage.pgm import GreyImage, read_pgm, write_pgm

logger = logging.getLogger(__name__)

Mode: TypeAlias = Literal["trinary", "scale", "raw"]

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
    resolution_m
        Side of a cell.
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
    fields = _load_yaml(path)
    occupied_thresh = _number(fields, "occupied_thresh", path)
    free_thresh = _number(fields, "free_thresh", path)
    if not 0.0 <= free_thresh < occupied_thresh <= 1.0:
        raise MapFileError(
            f"{path}: free_thresh {free_thresh:g} and occupied_thresh {occupied_thresh:g}"
            " must be in this order, from 0 to 1"
        )
    mode = _mode(fields, path)
    negate = fields.get("negate", 0)
    if negate not in (0, 1):
        raise MapFileError(f"{path}: negate is {negate!r}, it must be 0 or 1")
    image, opaque = _read_image(_image_path(fields, path))
    if mode == "raw":
        values = image.astype(np.int8)
        values[image > OCCUPIED] = UNKNOWN
    else:
        _warn_of_freed_unknowns(path, image, bool(negate), free_thresh)
        values = _occupancy(image, bool(negate), occupied_thresh, free_thresh, mode)
        values[~opaque] = UNKNOWN
    resolution_m = _number(fields, "resolution", path)
    if not resolution_m > 0.0:
        raise MapFileError(f"{path}: resolution is {resolution_m:g} m, it must be positive")
    what = path.read_text(encoding="utf-8").splitlines()[0]
    what = what.removeprefix("# ") if what.startswith("#") else ""
    return Nav2Map(np.ascontiguousarray(values[::-1]), resolution_m, _origin(fields, path), what)


def _occupancy(
    image: GreyImage, negate: bool, occupied_thresh: float, free_thresh: float, mode: Mode
) -> StateArray:
    """Return the values of an image in trinary or scale mode, row 0 still on top."""
    # There are only 256 greys: decide once for each.
    grey = np.arange(256) / 255.0
    p = grey if negate else (255 - np.arange(256)) / 255.0
    table = np.full(256, UNKNOWN, dtype=np.int8)
    if mode == "scale":
        share = (p - free_thresh) / (occupied_thresh - free_thresh)
        table = np.rint(100.0 * np.clip(share, 0.0, 1.0)).astype(np.int8)
    table[p >= occupied_thresh] = OCCUPIED
    table[p <= free_thresh] = FREE
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
    """Read grey pixels and whether each is opaque, row 0 on top."""
    if path.suffix.lower() == ".pgm":
        image = read_pgm(path)
        return image, np.ones(image.shape, dtype=np.bool_)
    # Only png and bmp maps of other programs need the image library.
    import cv2

    try:
        content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as cause:
        raise MapFileError(f"cannot read {path}: {cause.strerror or cause}") from cause
    loaded: Any = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if loaded is None:
        raise MapFileError(f"{path}: not an image that can be read (pgm, png or bmp)")
    if loaded.dtype != np.uint8:
        loaded = (loaded // 257).astype(np.uint8)
    if loaded.ndim == 2:
        return loaded, np.ones(loaded.shape, dtype=np.bool_)
    grey = cv2.cvtColor(np.ascontiguousarray(loaded[:, :, :3]), cv2.COLOR_BGR2GRAY)
    opaque = loaded[:, :, 3] == 255 if loaded.shape[2] == 4 else np.ones(grey.shape, dtype=np.bool_)
    return np.asarray(grey, dtype=np.uint8), opaque


def _load_yaml(path: Path) -> dict[str, Any]:
    """Read the fields of the yaml."""
    try:
        fields = from_yaml(path.read_text(encoding="utf-8"))
    except OSError as cause:
        raise MapFileError(f"cannot read {path}: {cause.strerror or cause}") from cause
    except ValueError as cause:
        raise MapFileError(f"{path}: not a yaml file: {cause}") from cause
    if not isinstance(fields, dict):
        raise MapFileError(
            f"{path}: not a map description; it needs image, resolution, origin and thresholds"
        )
    return fields


def _image_path(fields: dict[str, Any], path: Path) -> Path:
    """Return the path of the image, relative to the yaml unless absolute."""
    image = fields.get("image")
    if not isinstance(image, str) or not image:
        raise MapFileError(f"{path}: image is {image!r}, it must be a file name")
    return path.parent / image


def _mode(fields: dict[str, Any], path: Path) -> Mode:
    """Return the mode; trinary by default."""
    mode = fields.get("mode", "trinary")
    if mode == "trinary" or mode == "scale" or mode == "raw":
        return mode
    raise MapFileError(f"{path}: mode is {mode!r}, it must be trinary, scale or raw")


def _number(fields: dict[str, Any], key: str, path: Path) -> float:
    """Return a finite number of the yaml."""
    if key not in fields:
        raise MapFileError(f"{path}: {key} is missing")
    return _to_number(fields[key], key, path)


def _to_number(value: Any, key: str, path: Path) -> float:
    """Convert a number, also from text, since yaml parses 1e-2 as text."""
    try:
        number = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not math.isfinite(number):
        raise MapFileError(f"{path}: {key} is {value!r}, it must be a finite number")
    return number


def _origin(fields: dict[str, Any], path: Path) -> gtsam.Pose2:
    """Return the lower-left corner."""
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise MapFileError(f"{path}: origin is {origin!r}, it must be [x, y, yaw]")
    return gtsam.Pose2(*(_to_number(value, "origin", path) for value in origin))


def _decimal(value: float) -> str:
    """Format a number without exponent (yaml parses 1e-05 as text) that reads back as the same."""
    return np.format_float_positional(value, unique=True, trim="0")
