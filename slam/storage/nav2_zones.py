"""Zones that the user drew, as masks of nav2's costmap filters beside the navigation map.

The keep-out mask is 100 where the robot must not go (KeepoutFilter). The speed mask holds percent of the
usual speed, and 0, which is no limit, elsewhere (SpeedFilter of type 1, base 0, multiplier 1).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.mapping.polygons import cells_inside
from slam.measurements import FloatArray
from slam.storage.nav2 import Nav2Map, read_nav2_map, write_nav2_map
from slam.storage.nav2_layers import remove_maps, write_raw

KEEP_OUT, SPEED = "keepout_mask", "speed_mask"
_WHAT = {
    KEEP_OUT: "Where the robot must not go, for nav2's KeepoutFilter.",
    SPEED: "Percent of the usual speed, 0 without a limit, for nav2's SpeedFilter of type 1.",
}


def write_zones(
    folder: Path, layers: LayeredMap, keep_out: Iterable[FloatArray], slow: Iterable[tuple[FloatArray, float]]
) -> list[Path]:
    """Write the masks, as large as the map; a mask without a zone is removed.

    Parameters
    ----------
    keep_out
        (n, 2) corners of each zone, map frame.
    slow
        The same, with percent of the usual speed; where zones overlap the least counts.

    Returns
    -------
    The yaml files.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    masks: dict[str, StateArray] = {}
    size, place = layers.states("decision").shape, (layers.resolution_m, layers.T_map_grid)
    for polygon in keep_out:
        mask = masks.setdefault(KEEP_OUT, np.full(size, FREE, np.int8))
        mask[cells_inside(polygon, size, *place)] = OCCUPIED
    for polygon, percent in slow:
        mask = masks.setdefault(SPEED, np.zeros(size, np.int8))
        within = cells_inside(polygon, size, *place) & ((mask == 0) | (mask > percent))
        mask[within] = max(round(percent), 1)
    remove_maps(folder, {KEEP_OUT, SPEED} - masks.keys())
    written = []
    for name, mask in masks.items():
        states = np.where(mask == OCCUPIED, mask, np.int8(FREE))
        written.append(write_nav2_map(folder / name, states, *place, _WHAT[name])[0])
        if name == SPEED:
            write_raw(folder / name, mask, written[-1], _WHAT[name])
    return written


def without_keep_out(grid: Nav2Map, path: Path) -> StateArray:
    """Return the values of a map, with the cells of its keep-out mask occupied.

    Parameters
    ----------
    path
        The yaml of the map; the mask, if any, is beside it.

    Raises
    ------
    MapFileError
        If the mask cannot be read.
    """
    mask_path = path.with_name(f"{KEEP_OUT}.yaml")
    if not mask_path.is_file():
        return grid.values
    mask = read_nav2_map(mask_path)
    same = mask.values.shape == grid.values.shape and mask.T_map_grid.equals(grid.T_map_grid, 1e-6)
    return np.where(mask.values == OCCUPIED, np.int8(OCCUPIED), grid.values) if same else grid.values
