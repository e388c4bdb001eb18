"""Scanweave: offline SLAM from lidar and RGB-D logs.

This package is the public Python API; each part is loaded when it is first used. `map_log` maps a log,
`build_map` maps measurements of your program. `load_map` opens a saved map, `join` adds a log to it, `merge`
combines several maps, `roll_back` removes sessions. `localize_log` localises a log in a map, `Localizer` a
robot, one measurement at a time. `diff_maps` finds differences between two maps; `evaluate` scores a
trajectory. The command line tool ``scanweave`` uses the same functions.

These parts work on plain arrays: `match_scans` matches scans, `check_loop` verifies a loop, `PoseGraph` is
the pose graph, `grid_of_scans` builds a grid. The package `fusion` fuses lidar and depth images.

Examples
--------
>>> import slam
>>> house = slam.map_log("monday.log", out="house/")  # doctest: +SKIP
>>> house.trajectory.positions_m, house.grid.states(), house.loops  # doctest: +SKIP
>>> slam.localize_log(house, "tuesday.log").trajectory  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from slam.version import __version__ as __version__

if TYPE_CHECKING:
    from slam.app.differing import Difference as Difference
    from slam.app.differing import diff_maps as diff_maps
    from slam.app.joining import Joined as Joined
    from slam.app.joining import join as join
    from slam.app.localizing import Localization as Localization
    from slam.app.localizing import localize_log as localize_log
    from slam.app.mapping import build_map as build_map
    from slam.app.mapping import map_log as map_log
    from slam.app.merging import Merged as Merged
    from slam.app.merging import merge as merge
    from slam.app.parts import check_loop as check_loop
    from slam.app.parts import grid_of_scans as grid_of_scans
    from slam.app.parts import match_scans as match_scans
    from slam.app.progress import Progress as Progress
    from slam.app.rolling_back import roll_back as roll_back
    from slam.config import Config as Config
    from slam.config import load_config as load_config
    from slam.datasets import open_dataset as open_dataset
    from slam.doctor.diagnosis import diagnose as diagnose
    from slam.errors import ScanweaveError as ScanweaveError
    from slam.estimates import MotionEstimate as MotionEstimate
    from slam.estimates import Trajectory as Trajectory
    from slam.evaluation.score import evaluate as evaluate
    from slam.graph.edge import Edge as Edge
    from slam.graph.edge import EdgeKind as EdgeKind
    from slam.graph.loop_candidate import LoopCandidate as LoopCandidate
    from slam.graph.pose_graph import PoseGraph as PoseGraph
    from slam.localization.localizer import Localizer as Localizer
    from slam.localization.output import LocalizerOutput as LocalizerOutput
    from slam.localization.output import State as State
    from slam.mapper.protocol import register_sensor as register_sensor
    from slam.mapping.occupancy_grid import OccupancyGrid as OccupancyGrid
    from slam.measurements import CameraIntrinsics as CameraIntrinsics
    from slam.measurements import GnssFix as GnssFix
    from slam.measurements import ImuReading as ImuReading
    from slam.measurements import LaserScan as LaserScan
    from slam.measurements import PointCloud as PointCloud
    from slam.measurements import RgbdFrame as RgbdFrame
    from slam.measurements import WheelOdometry as WheelOdometry
    from slam.outputs.finished_map import Map as Map
    from slam.outputs.finished_map import load_map as load_map
    from slam.outputs.grid_map import GridMap as GridMap
    from slam.outputs.grid_map import load_grid_map as load_grid_map

_NAMES = {
    "slam.app.differing": "Difference diff_maps",
    "slam.app.joining": "Joined join",
    "slam.app.localizing": "Localization localize_log",
    "slam.app.mapping": "build_map map_log",
    "slam.app.merging": "Merged merge",
    "slam.app.parts": "check_loop grid_of_scans match_scans",
    "slam.app.progress": "Progress",
    "slam.app.rolling_back": "roll_back",
    "slam.config": "Config load_config",
    "slam.datasets": "open_dataset",
    "slam.doctor.diagnosis": "diagnose",
    "slam.errors": "ScanweaveError",
    "slam.estimates": "MotionEstimate Trajectory",
    "slam.evaluation.score": "evaluate",
    "slam.graph.edge": "Edge EdgeKind",
    "slam.graph.loop_candidate": "LoopCandidate",
    "slam.graph.pose_graph": "PoseGraph",
    "slam.localization.localizer": "Localizer",
    "slam.localization.output": "LocalizerOutput State",
    "slam.mapper.protocol": "register_sensor",
    "slam.mapping.occupancy_grid": "OccupancyGrid",
    "slam.measurements": "CameraIntrinsics GnssFix ImuReading LaserScan PointCloud RgbdFrame WheelOdometry",
    "slam.outputs.finished_map": "Map load_map",
    "slam.outputs.grid_map": "GridMap load_grid_map",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Load a name when it is first used, so that ``import slam`` is cheap."""
    if name not in _HOMES:
        raise AttributeError(f"module 'slam' has no attribute '{name}'; it has {', '.join(_HOMES)}")
    found = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    """List all names, loaded or not."""
    return sorted({*_HOMES, *(name for name in globals() if name.startswith("__"))})
