"""Synthetic logs, their runs and their errors: what the tests of the main loop share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from slam.config import load_config
from slam.datasets import open_dataset
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.matching.planar import between
from slam.measurements import FloatArray, WheelOdometry
from slam.measurements import row_from_pose2 as row_of
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log

SCAN_STEP_M = 0.13  # the synthetic robot's greatest way between two scans

Edit = Callable[[int, list[str]], Iterable[list[str]]]
Row = np.ndarray


def run(log: Path, *overrides: str) -> MapResult:
    return build_map(open_dataset(log), load_config(None, overrides))


@pytest.fixture(scope="session")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    """A drive of a round and a half: loops close."""
    return write_synthetic_log(tmp_path_factory.mktemp("long"), duration_s=60.0)


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("short"), duration_s=20.0)


@pytest.fixture(scope="session")
def mapped(long_log: SyntheticLog) -> MapResult:
    return run(long_log.log_path)


def edited(log: SyntheticLog, path: Path, edit: Edit) -> Path:
    """The log with each ODOM and FLASER line replaced by what ``edit(number, fields)`` gives."""
    lines = []
    for number, line in enumerate(log.log_path.read_text().splitlines()):
        fields = line.split()
        kept = [fields] if fields[0] not in ("ODOM", "FLASER") else edit(number, fields)
        lines += [" ".join(new) for new in kept]
    path.write_text("\n".join(lines) + "\n")
    return path


def stamp(fields: list[str]) -> float:
    return float(fields[-3])


def with_stamp(fields: list[str], stamp_s: float) -> list[str]:
    return [*fields[:-3], f"{stamp_s:.6f}", *fields[-2:]]


def moved(fields: list[str], dx_m: float) -> list[str]:
    """A line whose wheels (and, in a scan, laser) say ``dx_m`` more."""
    at = [1] if fields[0] == "ODOM" else [len(fields) - 9, len(fields) - 6]
    return [f"{float(f) + dx_m:.6f}" if n in at else f for n, f in enumerate(fields)]


def line_numbers(result: MapResult) -> np.ndarray:
    """For every pose the number of its reading; a scan and the odometry of its line or stamp are one."""
    return np.concatenate([[0], np.cumsum(np.diff(result.map.trajectory.stamps_s) != 0.0)])


def errors_m(result: MapResult, truth: FloatArray) -> FloatArray:
    """Distance of every reading's pose from its truth, both seen from the first, in file order."""
    readings = line_numbers(result)
    assert readings[-1] + 1 == len(truth)
    last = np.flatnonzero(np.diff(readings, append=readings[-1] + 1))
    poses = result.map.trajectory.to_planar()[last]
    return np.array(
        [
            math.hypot(*(between(poses[0], pose) - between(truth[0], true))[:2])
            for pose, true in zip(poses, truth, strict=True)
        ]
    )


def wheel_rows(log: Path) -> FloatArray:
    return np.array([row_of(m.T_odom_base) for m in open_dataset(log) if isinstance(m, WheelOdometry)])
