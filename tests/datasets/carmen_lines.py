"""CARMEN lines for tests, and what comes out of them."""

from __future__ import annotations

from pathlib import Path

from slam.datasets import open_dataset
from slam.datasets.recording import Recording
from slam.measurements import LaserScan, Measurement, WheelOdometry


def flaser(
    ranges: str = "1.0 2.0 3.0 4.0", *, count: int | None = None, stamp: str = "10.0", name: str = "FLASER"
) -> str:
    count = len(ranges.split()) if count is None else count
    return f"{name} {count} {ranges} 1 2 0.5 1 2 0.5 {stamp} host 0.1"


def odom(x: float = 0.0, *, stamp: float = 9.0) -> str:
    return f"ODOM {x} 0 0 0 0 0 {stamp} host 0.0"


def robotlaser(
    ranges: str = "1 2 3 4", *, laser: str = "1.2 2 0", robot: str = "1 2 0", name: str = "ROBOTLASER1"
) -> str:
    count = len(ranges.split())
    tail = f"{laser} {robot} 0 0 0.3 0.3 1e6 10.0 host 0.1"
    return f"{name} 0 -1.0 2.0 0.5 25.0 0.01 0 {count} {ranges} 2 7 8 {tail}"


def write(directory: Path, *lines: str, name: str = "a.log", end: str = "\n") -> Path:
    path = directory / name
    path.write_bytes("".join(line + end for line in lines).encode())
    return path


def read(path: Path, *, strict: bool = False) -> tuple[list[Measurement], Recording]:
    dataset = open_dataset(path, strict=strict)
    assert isinstance(dataset, Recording)
    return list(dataset), dataset


def scans(measurements: list[Measurement]) -> list[LaserScan]:
    return [m for m in measurements if isinstance(m, LaserScan)]


def poses(measurements: list[Measurement]) -> list[tuple[float, float]]:
    return [(m.stamp_s, m.T_odom_base.x()) for m in measurements if isinstance(m, WheelOdometry)]


GOOD = (odom(0.0, stamp=1.0), flaser(stamp="2.0"), odom(0.1, stamp=3.0))
