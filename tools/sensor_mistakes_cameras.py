"""Drives with the mistakes that people make of cameras and 3D lidars: are they named, does the remedy mend?

    python tools/sensor_mistakes_cameras.py DRIVE... [--only NAME] [--map] [--every 3]

A drive is a folder that 'scanweave simulate' has written; of its frames every third is taken, so that all of
them stay in memory. Otherwise as tools/sensor_mistakes.py.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets import open_dataset
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import Finding
from slam.estimates import Trajectory
from slam.measurements import Measurement, PointCloud, RgbdFrame
from tools.mistake_rows import CONFIGS, main, mapped_m, mapped_row, told_row

Change = Callable[[Any, float], Any]


@dataclass(frozen=True)
class Mistake:
    """One mistake of a kind of sensor: what it makes of a reading, what it is called, what mends it."""

    sensor: type
    make: Change
    kind: str
    entry: str
    value: Callable[[float], Any]
    sizes: tuple[float, ...]


def _turned(pose: gtsam.Pose3, yaw_deg: float) -> gtsam.Pose3:
    """A mounting given with another yaw, at its true position."""
    turn = gtsam.Rot3.Yaw(math.radians(yaw_deg))
    return gtsam.Pose3(turn.compose(pose.rotation()), pose.translation())


def _rolled(pose: gtsam.Pose3, _: float) -> gtsam.Pose3:
    """A mounting given upside down."""
    turn = gtsam.Rot3.Roll(math.pi)
    return gtsam.Pose3(turn.compose(pose.rotation()), pose.translation())


def _moved(pose: gtsam.Pose3, by_m: float) -> gtsam.Pose3:
    """A mounting given too far ahead."""
    return gtsam.Pose3(pose.rotation(), np.asarray(pose.translation()) + np.array([by_m, 0.0, 0.0]))


def _lens(frame: RgbdFrame, focal: float = 1.0, center: float = 0.0) -> RgbdFrame:
    k = frame.intrinsics
    wrong = replace(k, fx=k.fx * focal, fy=k.fy * focal, cx=k.cx + center * k.width)
    return replace(frame, intrinsics=wrong)


def _late(reading: Any, late_s: float) -> Any:
    return replace(reading, stamp_s=reading.stamp_s + late_s)


def _flipped(frame: RgbdFrame, rows: int) -> RgbdFrame:
    images = (frame.color[::rows, ::-1].copy(), frame.depth_m[::rows, ::-1].copy())
    return replace(frame, color=images[0], depth_m=images[1])


def _times(cloud: PointCloud, factor: float) -> PointCloud:
    """Points with times, of a turn that takes 0.1 s, in another unit."""
    turn_s = 0.1 * np.linspace(0.0, 1.0, len(cloud.points_lidar))
    return replace(cloud, times_s=factor * turn_s)


def _mounting(sensor: type, change: Callable[[gtsam.Pose3, float], gtsam.Pose3], *sizes: float) -> Mistake:
    """A wrong mounting."""
    name = "T_base_camera" if sensor is RgbdFrame else "T_base_lidar"

    def make(reading: Any, size: float) -> Any:
        return replace(reading, **{name: change(getattr(reading, name), size)})

    return Mistake(sensor, make, "mounting", name, lambda _: None, sizes)


def _depth(*sizes: float) -> Mistake:
    """Depth in another unit."""
    return Mistake(
        RgbdFrame,
        lambda f, s: replace(f, depth_m=f.depth_m * np.float32(s)),
        "depth scale",
        "depth_scale",
        lambda s: 1 / s,
        sizes,
    )


MISTAKES: dict[str, Mistake] = {
    "depth scaled a little": _depth(1.1, 0.85),
    "depth scaled": _depth(2.0, 0.5),
    "depth in millimetres": _depth(1000.0, 0.001),
    "depth of 5000 steps": _depth(5.0, 0.2),
    "focal length": Mistake(
        RgbdFrame, lambda f, s: _lens(f, s), "lens", "intrinsics", lambda s: {"fx": 1 / s}, (1.2, 0.8)
    ),
    "principal point": Mistake(
        RgbdFrame,
        lambda f, s: _lens(f, 1.0, s),
        "lens",
        "intrinsics",
        lambda s: {"cx": -s},
        (0.12, -0.2),
    ),
    "camera clock": Mistake(RgbdFrame, _late, "clock", "clock_offset_s", lambda s: s, (0.5, -0.25)),
    "camera yaw a little": _mounting(RgbdFrame, _turned, 10.0, -15.0),
    "camera yaw": _mounting(RgbdFrame, _turned, 90.0, 180.0),
    "camera told upside down": _mounting(RgbdFrame, _rolled, 0.0),
    "images upside down": Mistake(
        RgbdFrame, lambda f, s: _flipped(f, -1), "mounting", "T_base_camera", lambda _: None, (0.0,)
    ),
    "camera off": _mounting(RgbdFrame, _moved, 0.3, -0.5),
    "images mirrored": Mistake(
        RgbdFrame, lambda f, s: _flipped(f, 1), "mirrored", "mirrored", lambda s: True, (0.0,)
    ),
    "frames repeated": Mistake(
        RgbdFrame, lambda f, s: f, "repeated frames", "drop_repeated", lambda s: True, (3.0, 5.0)
    ),
    "3D lidar yaw a little": _mounting(PointCloud, _turned, 10.0, -15.0),
    "3D lidar yaw": _mounting(PointCloud, _turned, 90.0, 180.0),
    "3D lidar upside down": _mounting(PointCloud, _rolled, 0.0),
    "3D lidar off": _mounting(PointCloud, _moved, 0.3, -0.5),
    "3D lidar clock": Mistake(PointCloud, _late, "clock", "clock_offset_s", lambda s: s, (0.3, -0.5)),
    "3D lidar ranges": Mistake(
        PointCloud,
        lambda c, s: replace(c, points_lidar=c.points_lidar * np.float32(s)),
        "range scale",
        "range_scale",
        lambda s: 1 / s,
        (1.1, 1 / 0.3048),
    ),
    "times of points": Mistake(
        PointCloud, _times, "times of points", "times_scale", lambda s: 1 / s, (1000.0, 1e-6)
    ),
    "clouds repeated": Mistake(
        PointCloud, lambda c, s: c, "repeated clouds", "drop_repeated", lambda s: True, (3.0, 5.0)
    ),
}


def wrong_log(log: list[Measurement], mistake: Mistake, size: float) -> list[Measurement]:
    """A log as the first sensor of the sort would tell it by mistake; the order is that of the stamps."""
    first = next(one.sensor for one in log if isinstance(one, mistake.sensor))
    changed = list[Measurement]()
    held: Any = None
    count = 0
    for one in log:
        if isinstance(one, mistake.sensor) and one.sensor == first:
            if mistake.entry == "drop_repeated":
                held = one if held is None or count % int(size) == 0 else replace(held, stamp_s=one.stamp_s)
                one, count = held, count + 1
            else:
                one = mistake.make(one, size)
        changed.append(one)
    return sorted(changed, key=lambda reading: reading.stamp_s) if mistake.kind == "clock" else changed


def expected(log: list[Measurement], mistake: Mistake, size: float) -> Any:
    """What the entry should say."""
    first: Any = next(one for one in log if isinstance(one, mistake.sensor))
    if mistake.entry == "intrinsics":
        (key,) = mistake.value(size)
        # As it was before the mistake.
        return {"fx": first.intrinsics.fx} if key == "fx" else {"cx": first.intrinsics.cx}
    if mistake.entry.startswith("T_base"):
        pose = first.T_base_camera if mistake.sensor is RgbdFrame else first.T_base_lidar
        return {"x_m": pose.x(), "y_m": pose.y()}
    return mistake.value(size)


def is_right(finding: Finding, entry: str, value: Any) -> bool:
    """Whether one of a finding's remedies says about that: to 6 %, 8 cm, 8 px in a hundred, 60 ms."""
    for remedy in finding.remedies:
        for sensors in remedy.values():
            for given in sensors.values():
                if entry in given and _about(given[entry], value, entry):
                    return True
    return False


def _about(given: Any, value: Any, entry: str) -> bool:
    """Whether a value is about another."""
    if isinstance(value, Mapping):
        slack = {"x_m": 0.08, "y_m": 0.08}
        return all(abs(given[key] - one) < slack.get(key, 0.08 * abs(one)) for key, one in value.items())
    if isinstance(value, bool):
        return bool(given == value)
    return bool(abs(given - value) < (0.06 if entry.endswith("_s") else 0.06 * abs(value)))


def loaded(drive: Path, every: int) -> tuple[list[Measurement], Trajectory | None]:
    """A drive, of each camera every so manyth frame; and its truth."""
    dataset, log, counts = open_dataset(drive), list[Measurement](), Counter[str]()
    for one in dataset:
        if isinstance(one, RgbdFrame):
            counts[one.sensor] += 1
            if counts[one.sensor] % every:
                continue
        log.append(one)
    return log, dataset.groundtruth()


def rows(drive: Path, only: str, *, maps: bool, every: int) -> Iterator[list[str]]:
    """One row a mistake and size."""
    log, truth = loaded(drive, every)
    assert truth is not None
    yield [drive.name, "none", "", "", "", "", ", ".join(one.line for one in diagnose(log)) or "nothing"]
    sound_m = mapped_m(log, truth, CONFIGS[1]) if maps else math.nan
    for name, mistake in MISTAKES.items():
        if only not in name or not any(isinstance(one, mistake.sensor) for one in log):
            continue
        for size in mistake.sizes:
            wrong = wrong_log(log, mistake, size)
            findings = diagnose(wrong)
            named = [one for one in findings if one.kind == mistake.kind]
            value = expected(log, mistake, size)
            right = any(is_right(one, mistake.entry, value) for one in named)
            row = told_row(drive, name, size, findings, named, right=right)
            yield row + (mapped_row(wrong, truth, findings, sound_m) if maps else [])


if __name__ == "__main__":
    main(__doc__, rows, "every")
