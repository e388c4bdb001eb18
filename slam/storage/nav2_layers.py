"""Finished map for nav2: the navigation map, and beside it the layers from which it was made.

The ground of a 3D lidar's map has two layers: its height and its slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.mapping.elevation import Elevation
from slam.mapping.layered_map import LAYERS, LayeredMap, LayerName
from slam.mapping.occupancy_grid import OccupancyGrid, StateArray
from slam.storage.files import make_folder, write_lines
from slam.storage.nav2 import write_nav2_map
from slam.storage.pgm import write_pgm

MAP_YAML = "map.yaml"
_PROBABILITY = "fused_probability"
_PASSED_BY = "passed_by"

_WHAT: dict[LayerName, str] = {
    "lidar": "What the lidar alone saw, at its own height; the map to drive by is ../map.yaml.",
    "depth": "What the cameras alone saw within the robot's height; the map to drive by is ../map.yaml.",
    "fused": "Lidar and cameras as one probability (Li2020 Eq. (10)); the map to drive by is ../map.yaml.",
    "decision": "What the robot must not hit, by lidar or cameras (by layers.rule): the same as ../map.yaml.",
}
_GONE = "What the lidar saw stand for a while and then no more, occupied here; it is not in ../map.yaml."
_RAW = "Probability of being occupied by lidar and cameras, in percent; the map to drive by is ../map.yaml."

_ELEVATION, _SLOPE = "elevation", "slope"
_STEP_M, _UNSEEN = 0.01, 65535
_STEEP = "Rise of the ground the steepest way, in percent; 255 is unknown, 100 is as steep or steeper."
_HEIGHT = "Height of the ground in the map: height_zero_m + height_step_m times the pixel; white is unknown."


def write_driving_map(stem: Path, layers: LayeredMap) -> tuple[Path, Path]:
    """Write obstacles as ``stem.yaml`` and ``stem.pgm``: the map that the robot loads.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    by = [name for name, grid in (("lidar", layers.lidar), ("cameras", layers.depth)) if grid is not None]
    rule = f", by rule {layers.rule.rule} (layers.rule)" if len(by) > 1 else ""
    what = f"The map to drive by: what the robot must not hit, as seen by {' and '.join(by)}{rule}."
    return write_nav2_map(stem, layers.states("decision"), layers.resolution_m, layers.T_map_grid, what)


def write_layers(folder: Path, layers: LayeredMap) -> list[Path]:
    """Write ``lidar``, ``depth``, ``fused`` and ``decision`` (trinary) and ``fused_probability`` (raw).

    A layer without data of its sensor is left out; without cameras, the only layer is the map itself, and
    nothing is written. In the raw map a pixel is the probability in percent, and 255, which nav2 reads as
    unknown, where it is one half. Returns the yaml files; MapFileError if one cannot be written.
    """
    remove_maps(folder, set(LAYERS) - set(layers.names))
    if not layers.names:
        remove_maps(folder, {_PROBABILITY})
        return []
    make_folder(folder)
    place = (layers.resolution_m, layers.T_map_grid)
    written = [
        write_nav2_map(folder / name, layers.states(name), *place, _WHAT[name])[0] for name in layers.names
    ]
    return [*written, write_raw(folder / _PROBABILITY, layers.percent(), written[-1], _RAW)]


def write_passed_by(folder: Path, grid: OccupancyGrid | None) -> list[Path]:
    """Write removed temporary objects as ``passed_by`` (trinary); None deletes an earlier file.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    if grid is None:
        remove_maps(folder, {_PASSED_BY})
        return []
    make_folder(folder)
    stem = folder / _PASSED_BY
    return [write_nav2_map(stem, grid.states(), grid.resolution_m, grid.T_map_grid, _GONE)[0]]


def remove_maps(folder: Path, names: Iterable[str]) -> None:
    """Remove maps of an earlier run by their names: they would belong to another map."""
    try:
        for path in [folder / f"{name}{ending}" for name in names for ending in (".yaml", ".pgm")]:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise MapFileError(f"cannot write {folder}: {error.strerror or error}") from error


def write_raw(
    stem: Path, percent: StateArray, trinary_yaml: Path, what: str, place: Sequence[str] = ()
) -> Path:
    """Write a raw map with the resolution and origin of a trinary one, or those given; -1 becomes 255."""
    image_path, yaml_path = stem.with_name(f"{stem.name}.pgm"), stem.with_name(f"{stem.name}.yaml")
    write_pgm(image_path, percent[::-1].view(np.uint8))
    lines = [*trinary_yaml.read_text(encoding="utf-8").splitlines()[1:], *place]
    fields = dict(line.split(": ", 1) for line in lines) | {"image": image_path.name, "mode": "raw"}
    write_lines(yaml_path, [f"# {what}", *(f"{key}: {value}" for key, value in fields.items())])
    return yaml_path


def write_ground_layers(folder: Path, ground: Elevation | None, driving_yaml: Path) -> list[Path]:
    """Write ``elevation`` (16 bits, centimetres) and ``slope`` (nav2's raw mode); None removes earlier ones.

    Returns the yaml files; MapFileError if one cannot be written.

    Parameters
    ----------
    driving_yaml
        The navigation map, whose form the yaml files have.
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
