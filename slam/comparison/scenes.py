"""Pictures of the runs on each data set: paths, error over time, maps side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from slam.comparison.files import ERRORS, MAPS, TRAJECTORY
from slam.comparison.map_score import read_true_grid
from slam.comparison.perform import Row
from slam.comparison.pictures import errors_png, maps_png, trajectories_png
from slam.comparison.runs import Plan, Source
from slam.comparison.store import ResultStore
from slam.errors import EvaluationError
from slam.evaluation.alignment import align
from slam.evaluation.trajectory_error import associate
from slam.mapping.occupancy_grid import StateArray
from slam.measurements import FloatArray
from slam.storage.tum import read_tum

# Caption, PNG, and class in the style sheet.
Picture: TypeAlias = tuple[str, bytes, str]
_ALIGN_WITHIN_S = 0.1


def scenes(plan: Plan, rows: Sequence[Row], store: ResultStore) -> Iterator[tuple[str, list[Picture]]]:
    """The pictures of every data set, by name; only the first seed is shown."""
    for source in plan.sources:
        shown: dict[str, Row] = {}
        for row in rows:
            if row["dataset"] == source.name and row["status"] == "ok":
                shown.setdefault(row["configuration"], row)
        folders = {name: store.of(row["key"]) for name, row in shown.items()}
        if pictures := list(_pictures(source, folders, plan.reference)):
            yield source.name, pictures


def _pictures(source: Source, folders: dict[str, Path], reference: str) -> Iterator[Picture]:
    """The pictures of one data set."""
    errors = {name: arrays for name, folder in folders.items() if (arrays := _arrays(folder / ERRORS))}
    if errors:
        paths = {name: _in_truth(arrays, "positions_m") for name, arrays in errors.items()}
        truth = max((_in_truth(arrays, "true_positions_m") for arrays in errors.values()), key=len)
        yield f"paths on {source.name} over the true one", trajectories_png(paths, truth), "plot"
        over_time = {name: (arrays["stamps_s"], arrays["errors_m"]) for name, arrays in errors.items()}
        yield f"error over time on {source.name}", errors_png(over_time), "plot"
    elif paths := _aligned_paths(folders, reference):
        yield f"paths on {source.name}", trajectories_png(paths, None), "plot"
    maps = {name: known for name, folder in folders.items() if (known := _map(folder / MAPS))}
    if maps:
        if (truth_map := _true_map(source)) is not None:
            maps = {"truth": truth_map, **maps}
        yield f"maps of {source.name} side by side", maps_png(maps), "map"


def _arrays(path: Path) -> dict[str, Any] | None:
    """The arrays in an npz file of a run, None if there is none."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _in_truth(arrays: dict[str, Any], name: str) -> FloatArray:
    """(N, 2) positions in the frame of the ground truth, which is the same for all runs."""
    T_true_map, positions = arrays["T_true_map"], arrays[name]
    return np.asarray((positions @ T_true_map[:3, :3].T + T_true_map[:3, 3])[:, :2])


def _aligned_paths(folders: dict[str, Path], reference: str) -> dict[str, FloatArray]:
    """(N, 2) paths, the reference first, the others aligned to it as well as possible."""
    by_name = {name: read_tum(path) for name, f in folders.items() if (path := f / TRAJECTORY).is_file()}
    if not by_name:
        return {}
    by_name = {name: by_name[name] for name in sorted(by_name, key=lambda name: name != reference)}
    base = next(iter(by_name.values()))
    paths = {}
    for name, trajectory in by_name.items():
        try:
            own, others = associate(trajectory, base, _ALIGN_WITHIN_S)
            T = align(own, others).T_target_point
        except EvaluationError:
            T = np.eye(4)  # nothing in common: not aligned
        paths[name] = (trajectory.positions_m @ T[:3, :3].T + T[:3, 3])[:, :2]
    return paths


def _map(path: Path) -> tuple[StateArray, float] | None:
    """The navigation map, or else the map at the lidar's height."""
    arrays = _arrays(path)
    if arrays is None:
        return None
    name = "decision" if "decision" in arrays else "plane"
    return arrays[name], float(arrays[f"{name}_at"][0])


def _true_map(source: Source) -> tuple[StateArray, float] | None:
    """The true plan of a simulated home, as states."""
    path = source.path / "truth" / "grid_robot.npz"
    if not path.is_file():
        return None
    truth = read_true_grid(path)
    return np.where(truth.occupied, 100, 0).astype(np.int8), truth.resolution_m
