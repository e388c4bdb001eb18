"""Wheels that measure speed without its sign are corrected where the robot backs up, and only there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.config import Config
from slam.datasets import open_dataset
from slam.doctor.diagnosis import diagnose
from slam.doctor.lost_sign import starts_after_stops
from slam.mapper.pipeline import findings_of
from slam.measurements import LaserScan, Measurement, WheelOdometry
from slam.simulation.synthetic_log import write_synthetic_log
from tools.sensor_mistakes import Log

CHUNK_S = 4.0


@pytest.fixture(scope="module")
def to_and_fro(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A drive that goes each stretch ahead, back, and ahead again."""
    path = write_synthetic_log(tmp_path_factory.mktemp("drive"), seed=1, duration_s=40.0).log_path
    log = [one for one in open_dataset(path) if isinstance(one, LaserScan | WheelOdometry)]
    return list(_to_and_fro(log))


def _to_and_fro(log: Log) -> Iterator[Measurement]:
    first_s = log[0].stamp_s
    chunks: dict[int, Log] = {}
    for one in log:
        chunks.setdefault(int((one.stamp_s - first_s) / CHUNK_S), []).append(one)
    for number, chunk in chunks.items():
        end_s = first_s + (number + 1) * CHUNK_S
        late_s = 2.0 * CHUNK_S * number
        for passed, part in enumerate((chunk, chunk[::-1], chunk)):
            for one in part:
                stamp_s = 2.0 * end_s - one.stamp_s if passed == 1 else one.stamp_s + passed * CHUNK_S
                yield replace(one, stamp_s=stamp_s + late_s)


def without_sign(log: Log) -> Iterator[Measurement]:
    """The same, every step of the wheels being one ahead."""
    written, before = gtsam.Pose2(), None
    for one in log:
        if not isinstance(one, WheelOdometry):
            yield one
            continue
        pose = one.T_odom_base
        if before is not None:
            step = before.between(pose)
            ahead = math.copysign(1.0, step.x())
            written = written.compose(gtsam.Pose2(ahead * step.x(), ahead * step.y(), step.theta()))
        before = pose
        yield replace(one, T_odom_base=written)


def test_wheels_that_roll_back_have_their_sign(to_and_fro: Log) -> None:
    assert diagnose(to_and_fro) == []


def test_wheels_that_never_roll_back_are_reported(to_and_fro: Log) -> None:
    (finding,) = diagnose(list(without_sign(to_and_fro)))
    assert finding.kind == "lost sign" and finding.sure and not finding.remedies
    assert "never goes backward" in finding.line


def test_the_mapper_is_reported_as_well(to_and_fro: Log, tmp_path: Path) -> None:
    """What the doctor reads more than once the mapper hands it whole each time."""

    class Drive(list[Measurement]):
        name, path = "drive", tmp_path

    found = findings_of(Drive(without_sign(to_and_fro)), Config())  # type: ignore[arg-type]
    assert [one.kind for one in found] == ["lost sign"]


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 200.0])
def test_a_stop_is_one_by_time_however_often_the_wheels_report(rate_hz: float) -> None:
    """A robot at 0.3 m/s that stops for a second each 4 s leaves five stops in 20 s, and never else."""
    stamps_s = np.arange(0.0, 20.0, 1.0 / rate_hz)
    speed = np.where(stamps_s % 4.0 < 1.0, 0.0, 0.3)
    rows = np.column_stack([stamps_s, np.cumsum(speed) / rate_hz, 0.0 * stamps_s, 0.0 * stamps_s])
    spans_s = starts_after_stops(rows, 0.2)
    assert len(spans_s) == 5
    assert spans_s[:, 0] % 4.0 == pytest.approx(np.ones(5), abs=0.25)
    assert np.ptp(spans_s, axis=1) == pytest.approx(0.67 * np.ones(5), abs=0.25)


def test_who_stops_again_may_have_gone_both_ways() -> None:
    stamps_s = np.arange(0.0, 20.0, 0.05)
    speed = np.where(stamps_s % 1.0 < 0.5, 0.0, 0.3)  # 0.15 m between two stops
    rows = np.column_stack([stamps_s, np.cumsum(speed) / 20.0, 0.0 * stamps_s, 0.0 * stamps_s])
    assert len(starts_after_stops(rows, 0.2)) == 0
    assert len(starts_after_stops(rows, 0.1)) == 20
