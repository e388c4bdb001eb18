"""An IMU beside a 3D lidar that says what cannot be, or that says it late."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import SMALL, look
from imu_world import readings, walk

from slam.app.mapping import Measured
from slam.config import load_config
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import after_readings, build_map
from slam.measurements import ImuReading, Measurement, WheelOdometry
from slam.storage.map_file import MapFile
from slam.storage.map_tables import CLOUDS as CLOUD_ROWS

SECONDS = 4.0
SAID = list(readings(walk, SECONDS))
CLOUDS = [look(walk(stamp_s), stamp_s, seed=n) for n, stamp_s in enumerate(np.arange(0.1, SECONDS, 0.1))]


def run(imu: Iterator[ImuReading] | list[ImuReading], file: MapFile | None = None) -> MapResult:
    log: list[Measurement] = sorted([*imu, *CLOUDS], key=lambda one: one.stamp_s)
    config = load_config(None, ["sensors.doctor=false", *SMALL])
    return build_map(Measured(log), config, checkpoint=Checkpoint(file))


def worst_m(result: MapResult) -> float:
    """How far a place, as the first pose sees it, is off at most."""
    found = result.map.trajectory.poses()
    base = [walk(cloud.stamp_s) for cloud in CLOUDS]
    return max(
        float(
            np.linalg.norm(found[0].between(found[n]).translation() - base[0].between(base[n]).translation())
        )
        for n in range(len(base))
    )


def test_the_way_is_begun_again_without_the_forces_of_another(tmp_path: Path) -> None:
    aside = np.array([2.0, 0.0, 0.0])
    wrong = [
        replace(one, specific_force_m_s2=one.specific_force_m_s2 + aside * (one.stamp_s > 1.5))
        for one in readings(walk, SECONDS)
    ]
    result = run(wrong, MapFile.create(tmp_path / "map.db"))
    assert any("imu: its forces" in note and "force_scale: 0" in note for note in result.notes)
    assert any("imu: its gyroscope alone" in note for note in result.notes)
    assert worst_m(result) < 0.05


def test_one_whose_readings_end_was_used() -> None:
    result = run([one for one in SAID if one.stamp_s < 3.0])
    assert not any("imu is not used" in warning for warning in result.warnings)
    result = run([one for one in SAID if one.stamp_s < 0.8])
    assert any("imu is not used" in warning for warning in result.warnings)


def test_of_a_way_that_is_begun_again_no_cloud_is_left(tmp_path: Path) -> None:
    file = MapFile.create(tmp_path / "map.db")
    checkpoint = Checkpoint(file)
    checkpoint.cloud_spool().add(0.0, np.ones((5, 3)), gtsam.Pose3())
    checkpoint.begin_again([], {}, {})
    assert file.count(CLOUD_ROWS) == 0


def test_clouds_wait_for_readings_and_all_keeps_its_order() -> None:
    said = SAID
    wheels = [WheelOdometry(stamp_s, gtsam.Pose2(), "odom") for stamp_s in (0.4, 0.6)]
    found = list(after_readings([wheels[0], CLOUDS[4], wheels[1], *said[:200]]))
    assert [one for one in found if not isinstance(one, ImuReading)] == [wheels[0], CLOUDS[4], wheels[1]]
    assert found.index(CLOUDS[4]) > found.index(said[100])
    # A clock of another time holds nothing up for long.
    late = [one.stamp_s for one in after_readings([replace(said[0], stamp_s=-100.0), *CLOUDS])]
    assert late == [-100.0, *(one.stamp_s for one in CLOUDS)]


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_late_readings_are_used_as_if_they_came_in_time(late_s: float) -> None:
    said = readings(walk, SECONDS)
    log: list[Measurement] = sorted(
        [*said, *CLOUDS], key=lambda one: one.stamp_s + late_s * isinstance(one, ImuReading)
    )
    config = load_config(None, ["sensors.doctor=false", *SMALL])
    result = build_map(Measured(log), config)
    assert any("gravity to" in note for note in result.notes)
