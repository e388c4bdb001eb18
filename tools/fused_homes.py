"""Map simulated drives by lidar, by cameras, by both, with one failed, and with wrong mountings.

Usage: python tools/fused_homes.py DRIVE... [--variants fused,lidar,rgbd,dead,mounting] [--out table.md]
A DRIVE is a folder of `scanweave simulate`.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import gtsam
import numpy as np

import slam
from slam.config import load_config
from slam.datasets import Dataset, open_dataset
from slam.evaluation.trajectory_error import absolute_error
from slam.measurements import LaserScan, Measurement, RgbdFrame

_DEAD_S = 20.0
_WRONG_TURN_RAD, _WRONG_SHIFT_M = np.radians(30.0), 0.3
_OVERRIDES = {
    "fused": (),
    "lidar": ("sensors.rgbd=false",),
    "rgbd": ("sensors.lidar=false",),
    "dead": (),
    "mounting": ("sensors.mounting=estimate",),
}


class Altered:
    """A drive with an error: failed sensors, or a wrong mounting."""

    def __init__(self, dataset: Dataset, variant: str) -> None:
        self._dataset = dataset
        self._variant = variant

    def __iter__(self) -> Iterator[Measurement]:
        first_s: float | None = None
        for measurement in self._dataset:
            first_s = measurement.stamp_s if first_s is None else first_s
            since_s = measurement.stamp_s - first_s
            if self._variant == "dead" and _is_dead(measurement, since_s):
                continue
            if self._variant == "mounting" and isinstance(measurement, RgbdFrame):
                measurement = _misplaced(measurement)
            yield measurement


def _is_dead(measurement: Measurement, since_s: float) -> bool:
    """Whether the sensor has failed: the lidar early, the cameras later; both scaled for a short drive."""
    if isinstance(measurement, LaserScan):
        return 8.0 < since_s < 8.0 + _DEAD_S
    return isinstance(measurement, RgbdFrame) and 32.0 < since_s < 32.0 + _DEAD_S


def _misplaced(frame: RgbdFrame) -> RgbdFrame:
    """The frame with a rotated and shifted mounting."""
    if frame.T_base_camera is None:
        return frame
    wrong = gtsam.Pose3(gtsam.Rot3.Yaw(_WRONG_TURN_RAD), np.array([_WRONG_SHIFT_M, 0.0, 0.0]))
    return dataclasses.replace(frame, T_base_camera=wrong.compose(frame.T_base_camera))


def main() -> None:
    """Run every variant on every drive and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drives", nargs="+", type=Path)
    parser.add_argument("--variants", default=",".join(_OVERRIDES))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    variants = arguments.variants.split(",")
    lines = [f"| drive | {' | '.join(variants)} |", "|---" * (len(variants) + 1) + "|"]
    errors = []
    for drive in arguments.drives:
        row = [_error_m(drive, variant) for variant in variants]
        errors.append(row)
        lines.append(f"| {drive.name} | {' | '.join(f'{error:.4f}' for error in row)} |")
        print(lines[-1], flush=True)
    lines.append(f"| median | {' | '.join(f'{error:.4f}' for error in np.median(errors, axis=0))} |")
    print("\n".join(lines))
    if arguments.out:
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _error_m(drive: Path, variant: str) -> float:
    """ATE RMSE after rigid alignment, metres; learned mountings go to stderr."""
    dataset = open_dataset(drive)
    truth = dataset.groundtruth()
    assert truth is not None
    settings = ["dense_map.enabled=false", *_OVERRIDES[variant]]
    with closing(slam.build_map(Altered(dataset, variant), load_config(None, settings))) as found:
        for note in found.notes if variant == "mounting" else ():
            print(f"{drive.name}: {note}", file=sys.stderr)
        return absolute_error(found.trajectory, truth).translation_m.rmse


if __name__ == "__main__":
    main()
