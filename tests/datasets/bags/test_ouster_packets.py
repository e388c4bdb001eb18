"""Packets of an Ouster, encoded by the manual in `tools/layouts/ouster.py`, are read as they were sent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from slam.datasets import open_dataset
from slam.datasets.bags.ouster import DAMAGED, LATE, Ouster
from slam.datasets.bags.ouster_model import NOT_READ, OusterModel
from slam.datasets.dataset import RecordFault
from slam.errors import DatasetError
from slam.measurements import PointCloud
from tools.layouts import ouster
from tools.layouts.judge import problems
from tools.layouts.world import placed

PROFILE = "RNG19_RFL8_SIG16_NIR16"


@pytest.fixture(scope="module")
def turns() -> list[list[bytes]]:
    """Three turns of packets."""
    told_m = ouster.looked(placed(0.0, 0.0, 1.0))[0]
    return [[data for _, data in ouster.packets(told_m, 100.0 + 0.1 * k, k, PROFILE)] for k in range(3)]


def sensor(**changes: object) -> Ouster:
    """A sensor of the profile, its form stated otherwise in places."""
    stated = json.loads(ouster.metadata(PROFILE))
    stated["lidar_data_format"] |= changes
    return Ouster(OusterModel.of(json.dumps(stated)))


@pytest.mark.parametrize("profile", ouster.PROFILES)
def test_packets_in_a_bag_are_turns_with_the_metadata_beside_it(profile: str, tmp_path: Path) -> None:
    sample = ouster.bag(tmp_path, profile, inside=profile == PROFILE)
    dataset = open_dataset(sample.path, strict=True)
    assert problems(dataset, sample) == [] and not dataset.report.ignored
    bright = next(one for one in dataset if isinstance(one, PointCloud)).intensities
    assert bright is not None and (np.diff(np.unique(bright)) == 1.0).all() and bright.max() == ouster.ROWS


def test_a_capture_of_a_sensor_without_a_clock(tmp_path: Path) -> None:
    pytest.importorskip("dpkt")
    sample = ouster._ouster_pcap(tmp_path)
    dataset = open_dataset(sample.path, strict=True)
    found = list(dataset)
    assert problems(dataset, sample) == []
    assert found[0].stamp_s == pytest.approx(ouster.STAMPS[0], abs=0.01)
    assert ["clock is" in warning for warning in dataset.report.warnings] == [True]
    (tmp_path / "drive.json").unlink()
    with pytest.raises(DatasetError, match=r"put its \.json, named as the recording"):
        list(open_dataset(sample.path))


def test_turns_that_lack_packets_are_reported_or_left_out(turns: list[list[bytes]]) -> None:
    one = sensor()
    sent = [*turns[0][20:], *turns[1][:5], *turns[1][9:], *turns[2]]
    found = [cloud for at, data in enumerate(sent) if (cloud := one.add(100.0 + 0.003 * at, data))]
    assert [cloud.width for cloud in found] == [28 * 512, 32 * 512]
    assert (one.left_out, one.lacking) == (1, 1) and len(one.notes()) == 2
    assert one.rest() is None


def test_the_last_turn_is_read_where_it_was_cut(turns: list[list[bytes]]) -> None:
    one = sensor()
    assert all(one.add(100.0, data) is None for data in turns[0][:-4])
    left = one.rest()
    assert left is not None and left.width == 28 * 512 and one.lacking == 1


def test_columns_that_are_not_valid_are_left_out(turns: list[list[bytes]]) -> None:
    one, packets = sensor(), list(turns[0])
    broken = np.frombuffer(packets[3], one.model.packet).copy()
    broken["columns"]["status"][0, 5] = 0
    packets[3] = broken.tobytes()
    assert not [cloud for data in packets if (cloud := one.add(100.0, data))]
    left = one.rest()
    assert left is not None and left.width == 511 * 32


def test_a_window_of_bearings_is_a_whole_turn(turns: list[list[bytes]]) -> None:
    one = sensor(column_window=[384, 127])
    sent = turns[0][:8] + turns[0][24:]
    (found,) = [cloud for data in sent if (cloud := one.add(100.0, data))]
    assert found.width == 16 * 512 and one.lacking == 0


def test_damaged_and_late_packets_are_refused(turns: list[list[bytes]]) -> None:
    one = sensor()
    packets = turns[0]
    for data in packets:
        one.add(100.0, data)
    far = np.frombuffer(packets[0], one.model.packet).copy()
    far["frame"], far["columns"]["number"][0, 3] = 1, 700
    aged = np.frombuffer(packets[0], one.model.packet).copy()
    aged["frame"], aged["columns"]["stamp_ns"][0, 3] = 1, 10**15
    for data, reason in (
        (packets[0][:-1], DAMAGED),
        (far.tobytes(), DAMAGED),
        (aged.tobytes(), DAMAGED),
        (packets[0], LATE),
    ):
        with pytest.raises(RecordFault) as stated:
            one.add(100.0, data)
        assert stated.value.reason == reason
    with pytest.raises(RecordFault):
        one.imu(100.0, bytes(47))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[]", NOT_READ),
        ("{", NOT_READ),
        ("{}", "lacks 'beam_altitude_angles'"),
        (ouster.metadata("FUSA_RNG15_RFL8_NIR8_DUAL"), "profile FUSA"),
        (ouster.metadata(PROFILE).replace("4.2,", "NaN,"), NOT_READ),
        (
            ouster.metadata(PROFILE).replace('"columns_per_frame": 512', '"columns_per_frame": 99999'),
            NOT_READ,
        ),
    ],
)
def test_metadata_that_cannot_be_used_is_refused_with_why(text: str, reason: str) -> None:
    with pytest.raises(RecordFault) as stated:
        OusterModel.of(text)
    assert reason in stated.value.reason
