"""Wheels that slip in turns where a robot on a floor sees nothing: the gyroscope keeps its map straight."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gyro_world import imu_of
from pipeline_runs import edited, errors_m, run, short_log, stamp

from slam.graph.edge import EdgeKind
from slam.matching.planar import between, compose
from slam.simulation.imu import ImuRecord, write_euroc
from slam.simulation.synthetic_log import SyntheticLog

__all__ = ["short_log"]  # a fixture
BLIND_S = (1012.0, 1017.0)


@pytest.fixture(scope="module")
def slipping(short_log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an IMU, without echoes for five seconds in which the wheels turn half as much again."""
    folder = tmp_path_factory.mktemp("slipping") / "drive"
    folder.mkdir()
    before = written = np.zeros(3)

    def slip(number: int, fields: list[str]) -> Iterable[list[str]]:
        nonlocal before, written
        at = 1 if fields[0] == "ODOM" else len(fields) - 9
        now = np.array(fields[at : at + 3], np.float64)
        inside = BLIND_S[0] < stamp(fields) < BLIND_S[1]
        written = compose(written, between(before, now) * [1.0, 1.0, 1.5 if inside else 1.0])
        before, row = now, [f"{value:.6f}" for value in written]
        fields[at : at + 3] = row
        if fields[0] == "FLASER":
            fields[at + 3 : at + 6] = row
            beams = int(fields[1]) if inside else 0
            fields[2 : 2 + beams] = ["30.000"] * beams
        yield fields

    edited(short_log, folder / "scans.log", slip)
    said = imu_of(short_log.truth)
    stamps_s = np.array([one.stamp_s for one in said])
    rates = np.array([one.gyro_rad_s for one in said])
    record = ImuRecord(stamps_s, stamps_s, rates, np.array([one.specific_force_m_s2 for one in said]))
    write_euroc(folder / "imu0", record, gtsam.Pose3())
    return folder


def test_wheels_that_slip_in_a_turn_bend_the_map_no_more(slipping: Path, short_log: SyntheticLog) -> None:
    truth = short_log.truth.to_planar()
    errors = {imu: errors_m(run(slipping, f"sensors.imu={imu}"), truth) for imu in ("false", "true")}
    assert errors["false"].max() > 0.2
    assert errors["true"].max() < 0.5 * errors["false"].max()


@pytest.mark.parametrize("wheels", ["true", "false"])
def test_it_says_what_it_found_and_joins_every_keyframe(slipping: Path, wheels: str) -> None:
    result = run(slipping, f"sensors.wheels={wheels}")
    joined = {
        factor.edge.target
        for factor in result.map.factors
        if factor.edge.kind is EdgeKind.IMU and factor.kept
    }
    assert len(joined) >= len(result.map.node_poses) - 2
    assert any("its gyroscope is" in note and "95 %" in note for note in result.notes)
    assert {use.sensor: use.why_not for use in result.uses}["imu"] == ""
