"""A map that is written and read back: every pose, scan, image, factor and cell; damage is refused."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from box_world import box_frames
from test_packing import same

from slam.config import Config, load_config
from slam.errors import MapFileError
from slam.estimates import MotionEstimate, Trajectory
from slam.graph.edge import Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.mapping.layered_map import OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import CameraIntrinsics, LaserScan, Pose, RgbdFrame
from slam.outputs.finished_map import load_map
from slam.storage.map_contents import MapContents, SavedFactor, write_contents
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_identity import MapIdentity
from slam.storage.map_tables import FACTORS, FRAMES, GRIDS, IMAGES, KEYFRAMES, LOOPS, TRAJECTORY
from slam.storage.packing import pack, pack_small
from slam.vision.features import Features
from tools.fuzz import map_content, map_outcome, spoilt_bytes
from tools.hostile_maps import forge

MOUNT = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([0.1, 0.0, 1.0]))
IDENTITY = MapIdentity(load_config(None, ["seed=7"]), "drive.log", "f00d", {"numpy": "2.0", "code": "abc"})


def scan(stamp_s: float) -> LaserScan:
    ranges = np.array([1.0, np.inf, np.nan, 2.5], np.float32)
    return LaserScan(stamp_s, ranges, -1.0, 0.5, 30.0, gtsam.Pose2(0.1, 0.0, 3.1), "front")


def features(count: int = 5) -> Features:
    rng = np.random.default_rng(count)
    return Features(
        rng.random((count, 2), np.float32),
        rng.integers(0, 255, (count, 32), np.uint8),
        rng.random(count, np.float32),
        rng.random(count, np.float32),
    )


def contents(*, planar: bool = True) -> MapContents:
    step: Pose = gtsam.Pose2(0.3, 0.01, 0.4) if planar else gtsam.Pose3(gtsam.Pose2(0.3, 0.0, 0.4))
    poses = [gtsam.Pose2() if planar else gtsam.Pose3()]
    for _ in range(4):
        poses.append(poses[-1].compose(step))
    covariance = np.eye(3 if planar else 6) * 1e-4
    motion = MotionEstimate(step, covariance, 0.9, 0.8, 0.01, True, False, np.zeros(len(covariance)))
    loops = [
        LoopCandidate(0, 3, 0.5, 0.1, 0.7, motion, True, ""),
        LoopCandidate(1, 4, np.inf, 0.1, 0.2, None, False, "too few points fit"),
    ]
    edges = [Edge(n, n + 1, step, covariance * (n + 1), EdgeKind.LIDAR, True) for n in range(4)]
    factors = [SavedFactor(edge, True) for edge in edges]
    factors.append(SavedFactor(Edge(0, 3, step, covariance, EdgeKind.LOOP, False, loop=0), False))
    repaired = replace(scan(2.0), ranges_m=np.ones(4, np.float32))
    count = 10_000
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return MapContents(
        node_poses=poses,
        stamps_s=np.arange(5.0),
        readings=np.array([0, 2, 5, 6, 9]),
        measured_scans=[scan(0.0), None, scan(2.0), scan(3.0), scan(4.0)],
        keyframe_scans=[scan(0.0), None, repaired, scan(3.0), scan(4.0)],
        factors=factors,
        loops=loops,
        trajectory=Trajectory(rng.random(count), rng.random((count, 3)), turns),
        covariances=np.eye(3 if planar else 6) + 0.1 * rng.random((count, 1, 1)),
        grids={
            OCCUPANCY: OccupancyGrid(
                rng.integers(-999, 999, (7, 9), np.int16), 0.05, gtsam.Pose2(-1.0, 2.0, 0.1)
            )
        },
    )


def write(path: Path, what: MapContents, frames: list[RgbdFrame]) -> Path:
    file = MapFile.create(path)
    for key, value in IDENTITY.to_meta().items():
        file.add_meta(key, value)
    spool = MapFrames(file, begun=True)
    for number, frame in enumerate(frames):
        assert spool.add(frame, 2 * number, features(number)) == number
    write_contents(file, what)
    file.seal()
    return path


@pytest.fixture(scope="module")
def frames() -> list[RgbdFrame]:
    return [replace(frame, T_base_camera=MOUNT, sensor="kinect") for frame in box_frames(count=3)]


@pytest.fixture(scope="module")
def map_db(frames: list[RgbdFrame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("map") / "map.db", contents(), frames)


class TestReadBack:
    def test_everything(self, map_db: Path, frames: list[RgbdFrame]) -> None:
        saved, reported = load_map(map_db.parent), contents()
        found = saved.contents
        assert saved.planar and saved.identity == IDENTITY and saved.config.seed == 7
        for name in ("node_poses", "measured_scans", "keyframe_scans", "loops"):
            assert same(getattr(found, name), getattr(reported, name)), name
        for name in ("stamps_s", "readings", "trajectory", "covariances"):
            assert same(getattr(found, name), getattr(reported, name)), name
        for one, other in zip(saved.factors, reported.factors, strict=True):
            assert same(one, other)
        assert saved.grid is not None
        assert same(saved.grid.steps, reported.grids[OCCUPANCY].steps)
        assert same(saved.grid.T_map_grid, reported.grids[OCCUPANCY].T_map_grid)
        np.testing.assert_array_equal(
            saved.keyframe_poses, [[pose.x(), pose.y(), pose.theta()] for pose in reported.node_poses]
        )
        saved.check()
        saved.close()

    def test_frames(self, map_db: Path, frames: list[RgbdFrame]) -> None:
        saved = load_map(map_db)
        kept = saved.contents.frames
        assert kept is not None
        assert [kept.head(number).node for number in range(3)] == [0, 2, 4]
        for number, (found, frame) in enumerate(zip(kept, frames, strict=True)):
            assert (found.stamp_s, found.sensor) == (frame.stamp_s, "kinect")
            assert found.intrinsics == frame.intrinsics
            assert same(found.T_base_camera, MOUNT)
            assert same(kept.features(number), features(number))
            np.testing.assert_allclose(found.depth_m, frame.depth_m, atol=1.01e-4)
        np.testing.assert_array_equal(
            saved.contents.frame_poses()[1].matrix(),
            gtsam.Pose3(saved.contents.node_poses[2]).compose(MOUNT).matrix(),
        )
        with pytest.raises(IndexError):
            kept.frame(3)
        saved.close()

    def test_a_camera_alone(self, tmp_path: Path) -> None:
        reported = replace(contents(planar=False), measured_scans=[], keyframe_scans=[], grids={})
        frames = [replace(frame, T_base_camera=None) for frame in box_frames(count=3)]
        saved = load_map(write(tmp_path / "map.db", reported, frames))
        assert not saved.planar and saved.grid is None
        assert list(saved.keyframe_scans) == [None] * 5
        assert same(saved.contents.frame_poses(), list(reported.node_poses[::2]))
        assert saved.contents.frames is not None
        assert saved.contents.frames.frame(0).T_base_camera is None
        np.testing.assert_allclose(saved.keyframe_poses[1], [0.3, 0.0, 0.4])
        saved.close()

    def test_the_digest_distinguishes_maps(
        self, map_db: Path, frames: list[RgbdFrame], tmp_path: Path
    ) -> None:
        again = load_map(write(tmp_path / "again.db", contents(), frames))
        other = load_map(write(tmp_path / "other.db", contents(), frames[:2]))
        assert load_map(map_db).digest == again.digest != other.digest

    def test_writing_twice_leaves_one(self, map_db: Path, frames: list[RgbdFrame], tmp_path: Path) -> None:
        file = MapFile.create(tmp_path / "map.db")
        for key, value in IDENTITY.to_meta().items():
            file.add_meta(key, value)
        spool = MapFrames(file, begun=True)
        for number, frame in enumerate(frames):
            spool.add(frame, 2 * number, features(number))
        write_contents(file, contents())  # an interrupt comes here
        file.commit()
        write_contents(file, contents())
        file.seal()
        assert (tmp_path / "map.db").read_bytes() == map_db.read_bytes()


MOTION3 = pack(gtsam.Pose3())
NAN = float("nan")


def stretch_with(**values: float) -> bytes:
    """The first 4096 poses of the trajectory, with one number in one of them changed."""
    whole = contents().trajectory[:4096]
    for name, value in values.items():
        getattr(whole, name)[7] = value
    return pack_small(whole)


LIES = [
    (KEYFRAMES, 1, {"stamp_s": "noon"}, "its stamp_s is no REAL"),
    (KEYFRAMES, 1, {"stamp_s": 1e300}, "its stamp cannot be"),
    (KEYFRAMES, 1, {"reading": None}, "its reading is no INTEGER"),
    (KEYFRAMES, 4, {"reading": -1}, "readings of session 0"),
    (KEYFRAMES, 4, {"reading": 10_000}, "readings of session 0"),
    (KEYFRAMES, 4, {"reading": 6}, "readings of session 0"),
    (KEYFRAMES, 1, {"pose": b"2" + struct.pack("<4d", NAN, 0.0, 1.0, 0.0)}, "not a pose"),
    (KEYFRAMES, 1, {"pose": b"3" + struct.pack("<12d", *[0.0] * 12)}, "not a pose"),
    (KEYFRAMES, 3, {"scan": pack_small(replace(scan(3.0), step_rad=NAN))}, "step_rad cannot be"),
    (KEYFRAMES, 3, {"scan": pack_small(replace(scan(3.0), T_base_laser=None))}, "T_base_laser cannot be"),
    (KEYFRAMES, 3, {"scan": pack_small(replace(scan(3.0), range_max_m="far"))}, "range_max_m cannot be"),
    (FACTORS, 2, {"covariance": pack(np.zeros((3, 3)))}, "positive definite"),
    (FACTORS, 2, {"covariance": pack(np.full((3, 3), NAN))}, "positive definite"),
    (FACTORS, 2, {"covariance": pack(np.diag([1.0, 1.0, -1.0]))}, "positive definite"),
    (FACTORS, 2, {"covariance": pack(np.eye(3) + np.eye(3, k=1))}, "symmetric"),
    (LOOPS, 1, {"place": 2}, "columns contradict it"),
    (LOOPS, 1, {"candidate": pack(replace(contents().loops[1], score=NAN))}, "score cannot be"),
    (TRAJECTORY, 0, {"stretch": stretch_with(positions_m=NAN)}, "positions_m: 3 of"),
    (TRAJECTORY, 0, {"stretch": stretch_with(stamps_s=np.inf)}, "stamps_s: 1 of"),
    (TRAJECTORY, 0, {"stretch": stretch_with(quaternions_xyzw=0.0)}, "not of unit length"),
    (GRIDS, 0, {"resolution_m": 1e-300}, "resolution cannot be"),
    (GRIDS, 0, {"resolution_m": np.inf}, "resolution cannot be"),
    (GRIDS, 0, {"corner": b"2" + struct.pack("<4d", np.inf, 0.0, 1.0, 0.0)}, "not a pose"),
    (GRIDS, 0, {"cells": pack_small(np.full((7, 9), NAN, np.float32))}, "cells are not finite"),
    (FRAMES, 1, {"stamp_s": np.inf}, "its stamp cannot be"),
    (FRAMES, 1, {"camera": pack((CameraIntrinsics(NAN, 1.0, 0.0, 0.0, 9, 9), MOUNT))}, "fx cannot be"),
    (FRAMES, 1, {"camera": pack((CameraIntrinsics(1.0, 1.0, 0.0, 0.0, 65535, 65535), None))}, "more pixels"),
    (FRAMES, 1, {"features": pack(replace(features(2), sigma_px=np.zeros(3, np.float32)))}, "as many"),
]


class TestRefused:
    @pytest.mark.parametrize(
        ("table", "number", "values", "said"),
        [
            (FACTORS, 1, {"source": 5}, "its ends are no nodes"),
            (FACTORS, 4, {"loop": 2}, "its loop is none"),
            (FACTORS, 2, {"kind": ""}, "kind is no name"),
            (FACTORS, 2, {"motion": MOTION3}, "Pose3 where a Pose2 belongs"),
            (FACTORS, 2, {"covariance": pack(np.eye(6))}, "covariance is not finite"),
            (FACTORS, 2, {"covariance": b"\x80\x04."}, "not packed values"),
            (LOOPS, 1, {"candidate": pack(1.0)}, "float where a LoopCandidate belongs"),
            (KEYFRAMES, 3, {"scan": pack_small([])}, "list where a LaserScan belongs"),
            (KEYFRAMES, 3, {"pose": pack(3.0)}, "float where a Pose3 belongs"),
            (TRAJECTORY, 1, {"poses": 5}, "arrays have other sizes"),
            (GRIDS, 0, {"rows": 8}, "cells have another size"),
            (GRIDS, 0, {"resolution_m": 0.0}, "resolution cannot be"),
            (FRAMES, 1, {"node": 9}, "no node"),
            (FRAMES, 1, {"steps_per_m": 0.0}, "camera is none"),
            (FRAMES, 1, {"features": pack(None)}, "NoneType where a Features belongs"),
            (IMAGES, 2, {"color": b"\xff\xd8"}, "an image of None pixels"),
            *LIES,
            (IMAGES, 2, {"depth": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\x7f" * 8}, "pixels, the camera has"),
        ],
    )
    def test_a_lie_is_reported_by_table_and_row(
        self, map_db: Path, tmp_path: Path, table: object, number: int, values: dict[str, object], said: str
    ) -> None:
        path = tmp_path / "map.db"
        path.write_bytes(map_db.read_bytes())
        name = table.name  # type: ignore[attr-defined]
        with pytest.raises(MapFileError, match=rf"table {name}, row \d+: .*({said})") as caught:
            load_map(forge(path, name, number, **values)).check()
        assert len(str(caught.value).splitlines()) == 1

    def test_a_file_that_was_cut_is_to_be_copied_again(self, map_db: Path, tmp_path: Path) -> None:
        path = tmp_path / "map.db"
        path.write_bytes(map_db.read_bytes()[:20_000])
        with pytest.raises(MapFileError, match="copy it again, or map its log anew"):
            load_map(path)

    def test_settings_of_another_version(self, map_db: Path, tmp_path: Path) -> None:
        path = tmp_path / "map.db"
        path.write_bytes(map_db.read_bytes())
        with pytest.raises(MapFileError, match="settings that this version does not take"):
            load_map(forge(path, "meta", 0, value='{"grid": {"resolution_m": -1.0}}'))
        forge(path, "meta", 0, value=Config().model_dump_json())
        with pytest.raises(MapFileError, match="versions cannot be read"):
            load_map(forge(path, "meta", 4, value="{"))
        with pytest.raises(MapFileError, match="does not contain its config"):
            load_map(forge(path, "meta", 0, key="konfig"))

    def test_a_spoilt_file_is_refused_or_harmless(self, map_db: Path, tmp_path: Path) -> None:
        """As tools/fuzz.py does for minutes."""
        whole, content = map_db.read_bytes(), map_content(map_db)
        outcomes: Counter[str] = Counter()
        for trial in range(120):
            # Half of them where most meets the eye of SQLite: its header, the tables, the first rows.
            rng, whole_file = np.random.default_rng([1, trial]), trial % 2
            head = whole if whole_file else whole[:4096]
            spoilt = spoilt_bytes(head, rng) + (b"" if whole_file else whole[4096:])
            (tmp_path / "map.db").write_bytes(spoilt)
            outcomes[map_outcome(tmp_path / "map.db", content)] += 1
        assert set(outcomes) == {"refused", "harmless"}, outcomes
        assert outcomes["refused"] > 60
