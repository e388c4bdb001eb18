"""Drives with typical errors of wheels and a 2D lidar: are they found, and does the remedy correct them?

    python tools/sensor_mistakes.py DRIVE... [--only NAME] [--map]

Prints for each error, at each size, in drives of 'scanweave simulate', whether it is found and corrected;
with ``--map`` also the planar error of the maps of the correct log, the wrong one (doctor off, on) and the
corrected one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets import open_dataset
from slam.datasets.corrections import Unwound
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import Finding
from slam.measurements import LaserScan, WheelOdometry
from tools.mistake_rows import CONFIGS, Log, main, mapped_m, mapped_row, told_row


@dataclass(frozen=True)
class Mistake:
    """One mistake: how a log comes to it at each size, what it is called, what mends it."""

    make: Callable[[Log, float], Log]
    kind: str
    remedy: Callable[[float], Mapping[str, Any]]
    sizes: tuple[float, ...] = (0.0,)


def _wheels(log: Log, change: Callable[[float, float, float, float], tuple[float, float, float]]) -> Log:
    """Every reading of the wheels, changed: x, y, unwound heading and stamp to x, y, heading."""
    heading, changed = Unwound(), Log()
    for one in log:
        if isinstance(one, WheelOdometry):
            pose = one.T_odom_base
            x, y, yaw = change(pose.x(), pose.y(), heading.of(one.stamp_s, pose.theta()), one.stamp_s)
            one = replace(one, T_odom_base=gtsam.Pose2(x, y, yaw))
        changed.append(one)
    return changed


def _turned_more(log: Log, factor: float) -> Log:
    """A wrong wheel base: every turn larger, the way put together of that."""
    place, yaw, last = np.zeros(2), 0.0, None

    def change(x: float, y: float, heading: float, _: float) -> tuple[float, float, float]:
        nonlocal place, yaw, last
        if last is not None:
            turn = heading - last[2]
            ahead = math.atan2(y - last[1], x - last[0]) - last[2] - 0.5 * turn
            ahead += yaw + 0.5 * factor * turn
            way = math.hypot(y - last[1], x - last[0])
            place = np.array([place[0] + way * math.cos(ahead), place[1] + way * math.sin(ahead)])
            yaw += factor * turn
        last = (x, y, heading)
        return float(place[0]), float(place[1]), yaw

    return _wheels(log, change)


def _scans(log: Log, change: Callable[[LaserScan], LaserScan]) -> Log:
    """Every scan, changed; what is then beyond the stated range is no return, as readers take it."""
    changed = [change(one) if isinstance(one, LaserScan) else one for one in log]
    return [
        replace(one, ranges_m=np.where(one.ranges_m >= one.range_max_m, np.float32(np.inf), one.ranges_m))
        if isinstance(one, LaserScan)
        else one
        for one in changed
    ]


def _mounted(scan: LaserScan, x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0) -> LaserScan:
    """Said to sit elsewhere."""
    mount = scan.T_base_laser
    wrong = gtsam.Pose2(mount.x() + x_m, mount.y() + y_m, mount.theta() + math.radians(yaw_deg))
    return replace(scan, T_base_laser=wrong)


def _wider(scan: LaserScan, factor: float) -> LaserScan:
    """Said to look over a wider field of view."""
    half = 0.5 * scan.step_rad * (scan.ranges_m.size - 1)
    return replace(
        scan, step_rad=factor * scan.step_rad, start_angle_rad=scan.start_angle_rad + half * (1.0 - factor)
    )


def _clock(log: Log, late_s: float) -> Log:
    """Wheels stamped late, the log in the order of the stamps."""
    late = [
        replace(one, stamp_s=one.stamp_s + late_s) if isinstance(one, WheelOdometry) else one for one in log
    ]
    return sorted(late, key=lambda one: one.stamp_s)


def _blocked(scan: LaserScan, share: float) -> LaserScan:
    """Beams on the right that end at the robot's own body, with a centimetre of noise."""
    ranges, count = scan.ranges_m.copy(), round(share * scan.ranges_m.size)
    noise = np.random.default_rng(int(1e3 * scan.stamp_s) % 2**32).normal(0.0, 0.01, count)
    ranges[:count] = 0.3 + 0.1 * np.sin(np.arange(count) / 40.0) + noise
    return replace(scan, ranges_m=ranges)


def _repeated(log: Log, each: float) -> Log:
    """So many scans in a row are the first of them."""
    number, shown, changed = 0, None, Log()
    for one in log:
        if isinstance(one, LaserScan):
            shown = one if shown is None or number % int(each) == 0 else shown
            one = replace(shown, stamp_s=one.stamp_s)
            number += 1
        changed.append(one)
    return changed


def _wheel(**entries: Any) -> dict[str, Any]:
    """A remedy for the wheels."""
    return {"wheels": entries}


def _lidar(**entries: Any) -> dict[str, Any]:
    """A remedy for the lidar."""
    return {"lidars": entries}


def _ranges(factor: Callable[[float], float]) -> Callable[[Log, float], Log]:
    """Ranges in another unit."""
    return lambda log, size: _scans(
        log, lambda scan: replace(scan, ranges_m=scan.ranges_m * np.float32(factor(size)))
    )


# What two sensors alone cannot tell apart: the finding then names both remedies.
_UNDECIDED = {"scale": ("lengths",), "range scale": ("lengths",)}

MISTAKES: dict[str, Mistake] = {
    "lidar upside down": Mistake(
        lambda log, _: _scans(log, lambda scan: replace(scan, ranges_m=scan.ranges_m[::-1].copy())),
        "mirrored",
        lambda _: _lidar(upside_down=True),
    ),
    "lidar yaw": Mistake(
        lambda log, size: _scans(log, lambda scan: _mounted(scan, yaw_deg=size)),
        "yaw",
        lambda _: _lidar(T_base_laser={"yaw_deg": 0.0}),
        (10.0, -20.0),
    ),
    "lidar yaw by quarters": Mistake(
        lambda log, size: _scans(log, lambda scan: _mounted(scan, yaw_deg=size)),
        "yaw",
        lambda _: _lidar(T_base_laser={"yaw_deg": 0.0}),
        (90.0, 180.0),
    ),
    "lidar too far ahead": Mistake(
        lambda log, size: _scans(log, lambda scan: _mounted(scan, x_m=size)),
        "offset",
        lambda _: _lidar(T_base_laser={"yaw_deg": 0.0}),
        (0.5, 0.25),
    ),
    "lidar aside": Mistake(
        lambda log, size: _scans(log, lambda scan: _mounted(scan, y_m=size)),
        "offset",
        lambda _: _lidar(T_base_laser={"y_m": 0.0}),
        (0.5, -0.25),
    ),
    "odometry in mm": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (1e3 * x, 1e3 * y, yaw)),
        "scale",
        lambda _: _wheel(scale=1e-3),
    ),
    "odometry in cm": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (1e2 * x, 1e2 * y, yaw)),
        "scale",
        lambda _: _wheel(scale=1e-2),
    ),
    "odometry scaled": Mistake(
        lambda log, size: _wheels(log, lambda x, y, yaw, s: (size * x, size * y, yaw)),
        "scale",
        lambda size: _wheel(scale=1.0 / size),
        (2.0, 0.7),
    ),
    "heading in degrees": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (x, y, math.degrees(yaw))),
        "heading",
        lambda _: _wheel(heading_scale=math.radians(1.0)),
    ),
    "heading of the wrong sign": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (x, y, -yaw)),
        "heading",
        lambda _: _wheel(heading_scale=-1.0),
    ),
    "heading off by a constant": Mistake(
        lambda log, size: _wheels(log, lambda x, y, yaw, s: (x, y, yaw + math.radians(size))),
        "heading offset",
        lambda size: _wheel(heading_offset_deg=-size),
        (20.0, -10.0),
    ),
    "heading scaled": Mistake(
        lambda log, size: _wheels(log, lambda x, y, yaw, s: (x, y, size * yaw)),
        "heading",
        lambda size: _wheel(heading_scale=1.0 / size),
        (2.0, 0.5),
    ),
    "y of the wrong sign": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (x, -y, yaw)), "axes", lambda _: _wheel(axes="x -y")
    ),
    "x of the wrong sign": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (-x, y, yaw)), "axes", lambda _: _wheel(axes="-x y")
    ),
    "x and y swapped": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (y, x, yaw)), "axes", lambda _: _wheel(axes="y x")
    ),
    "x and y of the wrong sign": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (-x, -y, yaw)),
        "axes",
        lambda _: _wheel(axes="-x -y"),
    ),
    "wheels left for right": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (x, -y, -yaw)),
        "mirrored",
        lambda _: _wheel(mirrored=True),  # or the lidar: undecidable without an IMU, and reported as such
    ),
    "wheel base wrong": Mistake(
        _turned_more, "turn scale", lambda size: _wheel(turn_scale=1.0 / size), (1.5, 0.7)
    ),
    "odometry clock": Mistake(_clock, "clock", lambda size: _wheel(clock_offset_s=size), (0.5, 0.25, -0.5)),
    "frozen wheels": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (1.0, 2.0, 0.5)),
        "frozen wheels",
        lambda _: {},  # the mapper leaves them out
    ),
    "field of view 270 for 180": Mistake(
        lambda log, size: _scans(log, lambda scan: _wider(scan, size)),
        "field of view",
        lambda _: _lidar(step_share=1.0),
        (1.5, 1.2),
    ),
    "field of view 190 for 180": Mistake(
        lambda log, size: _scans(log, lambda scan: _wider(scan, size)),
        "field of view",
        lambda _: _lidar(step_share=1.0),
        (190.0 / 180.0, 170.0 / 180.0),
    ),
    "ranges scaled a little": Mistake(
        _ranges(lambda size: size),
        "range scale",
        lambda size: _lidar(range_scale=1.0 / size),
        (1.1, 0.85),
    ),
    "ranges scaled": Mistake(
        _ranges(lambda size: size),
        "range scale",
        lambda size: _lidar(range_scale=1.0 / size),
        (2.0, 0.5),
    ),
    "ranges in mm or cm": Mistake(
        lambda log, size: _scans(
            log,
            lambda scan: replace(
                scan, ranges_m=scan.ranges_m * np.float32(size), range_max_m=size * scan.range_max_m
            ),
        ),
        "range scale",
        lambda size: _lidar(range_scale=1.0 / size),
        (1e3, 1e2),
    ),
    "wheels tell nothing of turns": Mistake(
        lambda log, _: _wheels(log, lambda x, y, yaw, s: (x, y, 0.5)), "no agreement", lambda _: {}
    ),
    "ranges in feet": Mistake(
        _ranges(lambda _: 1.0 / 0.3048),
        "range scale",
        lambda _: _lidar(range_scale=0.3048),
    ),
    "beams blocked": Mistake(
        lambda log, size: _scans(log, lambda scan: _blocked(scan, size)),
        "blocked beams",
        lambda _: _lidar(),
        (0.5, 0.25),
    ),
    "scans repeated": Mistake(_repeated, "repeated scans", lambda _: _lidar(drop_repeated=True), (5.0, 3.0)),
}


def right_remedy(finding: Finding, expected: Mapping[str, Any], log: Log) -> bool:
    """Whether one of a finding's remedies is about the expected one."""
    if not expected:
        return not finding.remedies
    ((kind, entries),) = expected.items()
    for remedy in finding.remedies:
        for given in remedy.get(kind, {}).values():
            if all(_about(given, name, value, log) for name, value in entries.items()):
                return True
    return False


def _about(given: Mapping[str, Any], name: str, value: Any, log: Log) -> bool:
    """Whether an entry is what was expected, to 6 %, 5 cm, 3 degrees, 50 ms."""
    if name == "step_share":
        scan = next(one for one in log if isinstance(one, LaserScan))
        return (
            "step_deg" in given and abs(given["step_deg"] / math.degrees(scan.step_rad) / value - 1.0) < 0.02
        )
    if name not in given:
        return False
    if isinstance(value, Mapping):
        slack = {"yaw_deg": 3.0}
        return all(abs(given[name][key] - one) < slack.get(key, 0.05) for key, one in value.items())
    if name.endswith("_deg"):
        return bool(abs(given[name] - value) < 3.0)
    if isinstance(value, float):
        return abs(given[name] - value) < (0.05 if name.endswith("_s") else 0.06 * abs(value))
    return bool(given[name] == value)


def rows(drive: Path, only: str, *, maps: bool) -> Iterator[list[str]]:
    """One row a mistake and size."""
    dataset = open_dataset(drive, images=False)
    truth = dataset.groundtruth()
    assert truth is not None
    log = list(dataset)
    sound_m = mapped_m(log, truth, CONFIGS[1]) if maps else math.nan
    for name, mistake in MISTAKES.items():
        for size in mistake.sizes if only in name else ():
            wrong = mistake.make(log, size)
            findings = diagnose(wrong)
            named = [one for one in findings if one.kind in (mistake.kind, *_UNDECIDED.get(mistake.kind, ()))]
            right = any(right_remedy(one, mistake.remedy(size), log) for one in named)
            row = told_row(drive, name, size, findings, named, right=right)
            yield row + (mapped_row(wrong, truth, findings, sound_m) if maps else [])


if __name__ == "__main__":
    main(__doc__, rows)
