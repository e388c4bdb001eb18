"""Ground of a 3D lidar's map as layers: its height and its slope."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.mapping.elevation import Elevation
from slam.storage.files import make_folder, write_lines
from slam.storage.nav2_layers import remove_maps, write_raw
from slam.storage.pgm import write_pgm

_ELEVATION, _SLOPE = "elevation", "slope"
_STEP_M, _UNSEEN = 0.01, 65535
_STEEP = "Rise of the ground the steepest way, in percent; 255 is unknown, 100 is as steep or steeper."
_HEIGHT = "Height of the ground in the map: height_zero_m + height_step_m times the pixel; white is unknown."


def write_ground_layers(folder: Path, ground: Elevation | None, driving_yaml: Path) -> list[Path]:
    """Write ``elevation`` (16 bits, centimetres) and ``slope`` (nav2's raw mode); None removes earlier ones.

    Parameters
    ----------
    driving_yaml
        The navigation map, whose form the yaml files have.

    Returns
    -------
    The yaml files.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    if ground is None:
        remove_maps(folder, {_ELEVATION, _SLOPE})
        return []
    make_folder(folder)
    zero_m = float(ground.height_m.min())
    steps = np.minimum(np.rint((ground.height_m - zero_m) / _STEP_M), _UNSEEN - 1)
    pixels = np.where(ground.seen, steps, _UNSEEN).astype(np.uint16)
    write_pgm(folder / f"{_ELEVATION}.pgm", pixels[::-1])
    corner = [round(float(at), 9) for at in ground.origin_xy]
    place = [f"resolution: {ground.cell_m!r}", f"origin: {[*corner, 0.0]}"]
    written = folder / f"{_ELEVATION}.yaml"
    heights = [f"height_zero_m: {zero_m:.3f}", f"height_step_m: {_STEP_M:g}"]
    write_lines(written, [f"# {_HEIGHT}", f"image: {_ELEVATION}.pgm", *place, *heights])
    percent = np.where(ground.seen, np.minimum(np.rint(100.0 * ground.slope()), 100.0), -1.0).astype(np.int8)
    return [written, write_raw(folder / _SLOPE, percent, driving_yaml, _STEEP, place)]
