"""A comparison as a viewer recording: path and map of each run with the ground truth, error over time."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam.comparison.files import ERRORS, MAPS, TRAJECTORY
from slam.comparison.perform import Row
from slam.comparison.store import ResultStore
from slam.measurements import planar, pose2_from_row
from slam.storage.tum import read_tum
from slam.viewer.viewer import Viewer

_MOST_ERRORS = 2000  # points per curve


def record_comparison(viewer: Viewer, rows: Sequence[Row], store: ResultStore) -> None:
    """Show every run with a result, under its data set, configuration and seed."""
    for row in rows:
        if row["status"] != "ok" or not row["dataset"]:
            continue
        folder = store.of(row["key"])
        name = f"{row['dataset']}/{row['configuration']}/seed {row['seed']}"
        T_true_map = np.eye(4)
        if (folder / ERRORS).is_file():
            with np.load(folder / ERRORS, allow_pickle=False) as errors:
                T_true_map = errors["T_true_map"]
                stamps_s, errors_m = errors["stamps_s"], errors["errors_m"]
            step = max(1, len(stamps_s) // _MOST_ERRORS)
            for stamp_s, error_m in zip(stamps_s[::step], errors_m[::step], strict=True):
                viewer.at(float(stamp_s))
                viewer.figure(f"error/{name}", float(error_m))
        if (folder / TRAJECTORY).is_file():
            trajectory = read_tum(folder / TRAJECTORY)
            viewer.at(float(trajectory.stamps_s.max()))
            positions = trajectory.positions_m @ T_true_map[:3, :3].T + T_true_map[:3, 3]
            viewer.polyline(name, positions)
        if (folder / MAPS).is_file():
            with np.load(folder / MAPS, allow_pickle=False) as maps:
                which = "decision" if "decision" in maps.files else "plane"
                states, at = maps[which], maps[f"{which}_at"]
            corner = planar(gtsam.Pose3(T_true_map))
            viewer.grid(name, states, float(at[0]), corner.compose(pose2_from_row(at[1:])))
