"""Every layer of a fused map for nav2: states as trinary maps, the fused probability as a raw one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.mapping.layered_map import LAYERS, LayeredMap
from slam.mapping.occupancy_grid import StateArray
from slam.storage.files import make_folder, write_lines
from slam.storage.nav2 import write_nav2_states
from slam.storage.pgm import write_pgm


def write_layers(folder: Path, built: LayeredMap) -> list[Path]:
    """Write ``lidar``, ``depth``, ``fused`` and ``decision`` (trinary) and ``fused_probability`` (raw).

    A robot drives by ``decision.yaml``. A layer whose sensor gave nothing is left out. In the raw map a
    pixel is the probability in percent, and 255, which nav2 reads as unknown, where it is one half.

    Returns
    -------
    The yaml files.

    Raises
    ------
    MapFileError
        Where a file cannot be written.
    """
    make_folder(folder)
    missing = {"lidar": built.lidar is None, "depth": built.depth is None}
    written = [
        write_nav2_states(folder / name, built.states(name), built.resolution_m, built.T_map_grid)[0]
        for name in LAYERS
        if not missing.get(name, False)
    ]
    return [*written, _write_raw(folder / "fused_probability", built.percent(), written[-1])]


def _write_raw(stem: Path, percent: StateArray, trinary_yaml: Path) -> Path:
    """A raw map with the resolution and origin of a trinary one; -1 becomes 255."""
    image_path, yaml_path = stem.with_name(f"{stem.name}.pgm"), stem.with_name(f"{stem.name}.yaml")
    write_pgm(image_path, percent[::-1].view(np.uint8))
    lines = trinary_yaml.read_text(encoding="utf-8").splitlines()
    told = {"image": image_path.name, "mode": "raw"}
    write_lines(yaml_path, [_replaced(line, told) for line in lines])
    return yaml_path


def _replaced(line: str, told: dict[str, str]) -> str:
    """A line of the yaml, with another value where there is one."""
    key = line.split(":", 1)[0]
    return f"{key}: {told[key]}" if key in told else line
