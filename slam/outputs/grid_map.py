"""A grid map of another program, in which a log can be localised by the walls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from fusion.showing import with_pictures
from slam.errors import MapFileError, path_of
from slam.estimates import Trajectory
from slam.mapping.layered_map import OCCUPANCY, LayeredMap
from slam.mapping.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from slam.outputs.finished_map import Map, load_map
from slam.storage.map_contents import MapContents
from slam.storage.nav2 import Nav2Map, read_nav2_map


@dataclass(frozen=True)
class GridMap:
    """A grid map of any program.

    Attributes
    ----------
    path
        Path of its yaml file.
    grid
        The occupancy grid.
    """

    path: Path
    grid: OccupancyGrid

    def _repr_html_(self) -> str:
        return with_pictures(self, self.grid.picture())

    @cached_property
    def contents(self) -> MapContents:
        """The map without keyframes, for `Localizer`."""
        none = np.zeros(0)
        nowhere = Trajectory.from_planar(none, none.reshape(0, 3))
        return MapContents([], none, none.astype(np.int64), nowhere, grids={OCCUPANCY: self.grid})

    @property
    def layers(self) -> LayeredMap:
        """The same grid as a navigation map."""
        return LayeredMap(self.grid, None)

    def close(self) -> None:
        """Do nothing: no file is open."""


def load_grid_map(path: Path | str) -> GridMap:
    """Load a map of nav2's map server (a yaml file and its image) for localisation.

    Parameters
    ----------
    path
        The yaml file; mode ``trinary``, ``scale`` or ``raw``.

    Raises
    ------
    MapFileError
        If it cannot be read, or has no walls to localise at.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> slam.map_log(write_synthetic_log("monday", seed=1, duration_s=10.0).log_path, out="house").close()
    >>> house = slam.load_grid_map("house/map.yaml")
    >>> tuesday = write_synthetic_log("tuesday", seed=2, duration_s=10.0).log_path
    >>> len(slam.localize_log(house, tuesday).trajectory) > 50
    True
    """
    file = path_of(path, "the map")
    drawn = read_nav2_map(file)
    grid = _grid_of(drawn)
    if not (grid.states() == OCCUPIED).any():
        raise MapFileError(f"{path} shows no wall, so nothing can be localised in it")
    return GridMap(file, grid)


def opened(known: Map | GridMap | Path | str) -> Map | GridMap:
    """Open a map or return an open one; a path is a folder, its ``map.db``, or the yaml file of a grid.

    Raises
    ------
    MapFileError
        As `load_map` and `load_grid_map`.
    """
    if isinstance(known, Map | GridMap):
        return known
    return load_grid_map(known) if str(known).endswith((".yaml", ".yml")) else load_map(known)


def _grid_of(drawn: Nav2Map) -> OccupancyGrid:
    """Return the log-odds of each cell; free and occupied cells get the limits that 256 grey levels allow."""
    least = 1 / 512
    probability = np.clip(drawn.values / 100.0, least, 1.0 - least)
    log_odds = np.where(drawn.values == UNKNOWN, 0.0, np.log(probability / (1.0 - probability)))
    return OccupancyGrid.of_log_odds(log_odds.astype(np.float32), drawn.resolution_m, drawn.T_map_grid)
