"""Readers, one per file format, all behind `open_dataset`; loaded on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slam.datasets.dataset import Dataset as Dataset
    from slam.datasets.dataset import ReadReport as ReadReport
    from slam.datasets.opening import open_dataset as open_dataset


_HOMES = {"Dataset": "dataset", "ReadReport": "dataset", "open_dataset": "opening"}


def __getattr__(name: str) -> Any:
    """Load names on first use, because reading a map needs no log reader."""
    if name not in _HOMES:
        raise AttributeError(f"module 'slam.datasets' has no attribute '{name}'; it has {', '.join(_HOMES)}")
    return getattr(import_module(f"slam.datasets.{_HOMES[name]}"), name)
