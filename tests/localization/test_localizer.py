"""Whole drives in a small building: found, tracked, carried off, found again; never sure and wrong."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.errors import MapFileError
from slam.localization.drive_log import DriveLog
from slam.localization.known_map import Walls
from slam.localization.localizer import Localizer, look_alikes
from slam.localization.output import LocalizerOutput, State
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.poses import Measured
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.mapper.pipeline import build_map
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.layered_map import OCCUPANCY
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, Measurement, pose2_from_row, row_from_pose2
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import MapContents

CONFIG = load_config()


class Drive:
    """A log with the true pose at each of its stamps."""

    def __init__(self, folder: Path, seed: int, duration_s: float) -> None:
        written = write_synthetic_log(folder, seed=seed, duration_s=duration_s)
        self.dataset = open_dataset(written.log_path)
        self.log = list(self.dataset)
        self._stamps_s = written.truth.stamps_s
        self._poses = written.truth.to_planar()

    def truth(self, stamp_s: float) -> FloatArray:
        """True pose (3,) at a stamp."""
        return np.asarray(self._poses[int(np.abs(self._stamps_s - stamp_s).argmin())])


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[MapContents, FloatArray]:
    """The map of a drive through all rooms, and where its frame lies in the truth's."""
    drive = Drive(tmp_path_factory.mktemp("mapped"), 1, 85.0)
    result = build_map(drive.dataset, CONFIG)
    return result.map, drive.truth(drive.log[0].stamp_s)


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """Another drive in the same building."""
    return Drive(tmp_path_factory.mktemp("other"), 2, 85.0)


def follow(
    known_map: MapContents, log: Iterable[Measurement], config: Config = CONFIG
) -> Iterator[LocalizerOutput]:
    localizer = Localizer(known_map, config)
    for measurement in log:
        output = localizer.add(measurement)
        if output is not None:
            yield output


def errors(outputs: list[LocalizerOutput], drive: Drive, T_truth_map: FloatArray) -> FloatArray:
    """(N, 2) metres and radians of the poses that are tracked."""
    rows = []
    for output in outputs:
        if output.state is State.TRACKING:
            assert output.pose is not None
            found = compose(T_truth_map, row_from_pose2(output.pose))
            offset = between(drive.truth(output.stamp_s), found)
            rows.append([math.hypot(offset[0], offset[1]), abs(offset[2])])
    return np.array(rows).reshape(-1, 2)


@pytest.mark.parametrize("start", [0, 200, 640])
def test_a_drive_is_found_and_tracked(
    mapped: tuple[MapContents, FloatArray], other: Drive, start: int
) -> None:
    outputs = list(follow(mapped[0], other.log[start : start + 200]))
    found = errors(outputs, other, mapped[1])
    assert len(found) > 0.6 * len(outputs)
    assert np.median(found[:, 0]) < 0.03 and np.median(found[:, 1]) < math.radians(0.5)
    assert found[:, 0].max() < 0.25
    for output in outputs:
        assert 0.0 <= output.confidence <= 1.0
        assert (output.pose is None) == (output.state is State.SEARCHING)
        if output.covariance is not None:
            assert np.linalg.eigvalsh(output.covariance)[0] > 0.0


def test_the_way_to_where_it_was_found_is_recovered(
    mapped: tuple[MapContents, FloatArray], other: Drive
) -> None:
    outputs = list(follow(mapped[0], other.log[300:600]))
    first = next(n for n, output in enumerate(outputs) if output.state is State.TRACKING)
    assert first > 0, "found at once: nothing to recover"
    recovered = outputs[first].recovered
    assert [past.stamp_s for past in recovered] == [output.stamp_s for output in outputs[:first]]
    for past in recovered:
        offset = between(other.truth(past.stamp_s), compose(mapped[1], row_from_pose2(past.pose)))
        assert math.hypot(offset[0], offset[1]) < 0.15
    drive = DriveLog()
    for output in outputs:
        drive.add(output, 0.001)
    tracked = sum(output.state is State.TRACKING for output in outputs)
    trajectory = drive.trajectory()
    assert len(trajectory) == tracked + len(recovered)
    assert np.all(np.diff(trajectory.stamps_s) >= 0.0)


def test_carried_off_and_found_again(mapped: tuple[MapContents, FloatArray], other: Drive) -> None:
    """From the corridor into a room far away, in the midst of the log: stamps and wheels jump too."""
    outputs = list(follow(mapped[0], [*other.log[:260], *other.log[620:]]))
    jump_s = other.log[620].stamp_s
    before = [output for output in outputs if output.stamp_s < jump_s]
    after = [output for output in outputs if output.stamp_s >= jump_s]
    assert before[-1].state is State.TRACKING and after[-1].state is State.TRACKING
    found = errors(outputs, other, mapped[1])
    assert found[-1, 0] < 0.05
    reported = [output for output in outputs if output.state is State.TRACKING]
    confident = [row[0] for output, row in zip(reported, found, strict=True) if output.confidence > 0.5]
    assert max(confident) < 0.25


def mirrored(scan: LaserScan) -> LaserScan:
    """The scan of a building that is built the other way round."""
    return replace(scan, ranges_m=np.ascontiguousarray(scan.ranges_m[::-1]))


def test_another_building_leads_to_no_pose(mapped: tuple[MapContents, FloatArray], other: Drive) -> None:
    log = [mirrored(m) for m in other.log if isinstance(m, LaserScan)]
    without_wheels = load_config(None, ["sensors.wheels=false"])
    outputs = list(follow(mapped[0], log[:140], without_wheels))
    assert all(output.state is State.SEARCHING and output.pose is None for output in outputs)


def test_a_map_without_what_the_sensors_need_is_refused(mapped: tuple[MapContents, FloatArray]) -> None:
    with pytest.raises(MapFileError, match="no scans or camera keyframes"):
        Localizer(mapped[0], load_config(None, ["sensors.lidar=false"]))


def test_blind_scans_are_endured(mapped: tuple[MapContents, FloatArray], other: Drive) -> None:
    blind = [
        replace(m, ranges_m=np.full_like(m.ranges_m, math.inf)) if isinstance(m, LaserScan) else m
        for m in other.log[:60]
    ]
    assert all(output.state is State.SEARCHING for output in follow(mapped[0], blind))


def test_a_room_that_looks_the_same_turned_round_is_said_so() -> None:
    """A bare rectangle: two poses are as good as each other, and none is chosen."""
    stamps = np.arange(25) * 0.25
    known_map = mapped_room(stamps).map
    last = list(follow(known_map, room_drive(stamps, seed=1)))[-1]
    assert last.state is State.SEARCHING and last.pose is None
    assert len(last.hypotheses) >= 2
    first, second = last.hypotheses[:2]
    assert first.probability + second.probability > 0.8
    assert second.probability > 0.2
    offset = between(row_from_pose2(first.pose), row_from_pose2(second.pose))
    assert abs(abs(offset[2]) - math.pi) < 0.1


def room_drive(stamps: FloatArray, seed: int) -> list[LaserScan]:
    """All-round scans of a bare room, 7 x 4 m, from a short way through it."""
    rng = np.random.default_rng(seed)
    bearings = np.arange(360) * math.radians(1.0)
    scans = []
    for stamp_s in stamps:
        x, y, yaw = -1.0 + 0.3 * stamp_s, 0.4, 0.1 * stamp_s
        angles = bearings + yaw
        with np.errstate(divide="ignore"):
            along_x = np.where(np.cos(angles) > 0.0, 3.5 - x, -3.5 - x) / np.cos(angles)
            along_y = np.where(np.sin(angles) > 0.0, 2.0 - y, -2.0 - y) / np.sin(angles)
        ranges = np.minimum(along_x, along_y) + rng.normal(0.0, 0.005, 360)
        scans.append(LaserScan(float(stamp_s), ranges.astype(np.float32), 0.0, math.radians(1.0), 30.0))
    return scans


def mapped_room(stamps: FloatArray) -> MapResult:
    """The map of a drive through it."""
    mapper = Mapper(CONFIG, PlanarRobot(CONFIG))
    for scan in room_drive(stamps, seed=0):
        mapper.add(scan)
    return mapper.finish()


def test_places_that_look_alike_are_counted(mapped: tuple[MapContents, FloatArray]) -> None:
    """The building once more, 60 m beside itself."""
    once = mapped[0]
    poses = np.vstack([once.keyframe_poses, once.keyframe_poses + np.array([60.0, 0.0, 0.0])])
    scans = [*once.keyframe_scans, *once.keyframe_scans]
    grid = grid_of_keyframes(scans, poses, CONFIG)
    assert grid is not None
    twice = replace(
        once,
        node_poses=[pose2_from_row(pose) for pose in poses],
        keyframe_scans=scans,
        grids={OCCUPANCY: grid},
    )
    for known_map, least, most in (
        (once, 0.0, 0.0),
        (twice, 1.0, 1.0),
        (drawn(once), 0.0, 0.0),
        (drawn(twice), 0.6, 1.0),  # some free places see hardly any wall
    ):
        walls = Walls(known_map, CONFIG)
        assert least <= look_alikes(walls, PlanarSensor(walls, CONFIG), CONFIG.localization) <= most


def drawn(known_map: MapContents) -> MapContents:
    """Its grid alone."""
    return replace(
        known_map, node_poses=[], stamps_s=np.zeros(0), readings=np.zeros(0, int), keyframe_scans=[]
    )


def test_looks_alone_are_not_believed_where_places_look_alike(
    mapped: tuple[MapContents, FloatArray], other: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = compose(between(mapped[1], np.zeros(3)), other.truth(other.log[0].stamp_s))
    known = Measured(pose2_from_row(true), np.diag([0.01, 0.01, 0.01]))
    for share, start, stated in ((0.0, None, False), (0.8, None, True), (0.8, known, False)):
        monkeypatch.setattr("slam.localization.localizer.look_alikes", lambda *_, share=share: share)
        localizer = Localizer(mapped[0], CONFIG, start=start)
        said = [output for output in map(localizer.add, other.log[:200]) if output is not None]
        surest = max(output.confidence for output in said if output.state is State.TRACKING)
        assert (0.15 < surest <= 0.2) if stated else surest > 0.9
        assert stated == ("80% of the map's own scans match other places" in (localizer.warning() or ""))


def test_own_scans_are_asked_from_all_of_the_way(mapped: tuple[MapContents, FloatArray]) -> None:
    few = replace(
        mapped[0], node_poses=mapped[0].node_poses[:30], keyframe_scans=mapped[0].keyframe_scans[:30]
    )
    asked = [row_from_pose2(pose) for pose, _ in Walls(few, CONFIG).sampled(20)]
    assert len(asked) == 20 and np.allclose(asked[-1], mapped[0].keyframe_poses[28])
