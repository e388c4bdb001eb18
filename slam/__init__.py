"""Scanweave: offline SLAM from lidar and RGB-D logs.

What programs use is found here, and loaded when it is first asked for: `open_dataset` reads a log,
`load_map` a saved map, `Localizer` finds and follows a robot in one, measurement by measurement;
`examples/localize_step_by_step.py` shows them at work. The command line is ``scanweave``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slam.config import Config as Config
    from slam.config import load_config as load_config
    from slam.datasets import open_dataset as open_dataset
    from slam.errors import ScanweaveError as ScanweaveError
    from slam.localization.localizer import Localizer as Localizer
    from slam.localization.output import LocalizerOutput as LocalizerOutput
    from slam.localization.output import State as State
    from slam.measurements import CameraIntrinsics as CameraIntrinsics
    from slam.measurements import LaserScan as LaserScan
    from slam.measurements import PointCloud as PointCloud
    from slam.measurements import RgbdFrame as RgbdFrame
    from slam.measurements import WheelOdometry as WheelOdometry
    from slam.storage.saved_map import SavedMap as SavedMap
    from slam.storage.saved_map import open_saved_map

    load_map = open_saved_map

_HOMES = {
    "CameraIntrinsics": ("slam.measurements", "CameraIntrinsics"),
    "Config": ("slam.config", "Config"),
    "LaserScan": ("slam.measurements", "LaserScan"),
    "Localizer": ("slam.localization.localizer", "Localizer"),
    "LocalizerOutput": ("slam.localization.output", "LocalizerOutput"),
    "PointCloud": ("slam.measurements", "PointCloud"),
    "RgbdFrame": ("slam.measurements", "RgbdFrame"),
    "SavedMap": ("slam.storage.saved_map", "SavedMap"),
    "ScanweaveError": ("slam.errors", "ScanweaveError"),
    "State": ("slam.localization.output", "State"),
    "WheelOdometry": ("slam.measurements", "WheelOdometry"),
    "load_config": ("slam.config", "load_config"),
    "load_map": ("slam.storage.saved_map", "open_saved_map"),
    "open_dataset": ("slam.datasets", "open_dataset"),
}


def __getattr__(name: str) -> Any:
    """Load what is asked for: to import slam alone costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'slam' has no attribute '{name}'; it has {', '.join(_HOMES)}")
    module, attribute = _HOMES[name]
    found = globals()[name] = getattr(import_module(module), attribute)
    return found


def __dir__() -> list[str]:
    """What is here, loaded or not."""
    return sorted({*globals(), *_HOMES})
