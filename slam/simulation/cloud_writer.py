"""Writes clouds of a 3D lidar as KITTI files: four little-endian floats per point, one file per cloud."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.simulation.events import CloudEvent
from slam.simulation.ordered_pool import OrderedPool
from slam.simulation.tum_writer import transform_fields, write_yaml


class CloudWriter:
    """Writes ``points/`` and its index ``points.txt``; use it as a context manager.

    A point is x, y, z in the frame of the lidar, and its ring in place of KITTI's intensity. The pose of the
    lidar is in ``points/calibration.yaml``.
    """

    def __init__(self, folder: Path, T_base_lidar: gtsam.Pose3, pool: OrderedPool) -> None:
        self._folder, self._pool = folder, pool
        (folder / "points").mkdir()
        write_yaml(folder / "points" / "calibration.yaml", {"T_base_lidar": transform_fields(T_base_lidar)})
        self._index = (folder / "points.txt").open("w", encoding="ascii", newline="\n")
        self._index.write(
            "# point clouds: x y z ring, float32\n# simulated by scanweave\n# timestamp filename\n"
        )

    def __enter__(self) -> CloudWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._index.close()

    def write(self, event: CloudEvent) -> None:
        """Queue one revolution."""
        name = f"points/{event.stamp_s:.6f}.bin"
        self._index.write(f"{event.stamp_s:.6f} {name}\n")
        rows = np.column_stack([event.points_laser, event.ring.astype(np.float32)])
        self._pool.submit(rows.astype("<f4").tofile, self._folder / name)
