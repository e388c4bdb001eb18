"""A run that is interrupted and goes on: the same map, to the byte, whatever its sensors and whenever."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from flat_worlds import box, sweep
from room_world import SMALL, T_BODY_CAMERA, furnished, render

from slam import forked
from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.datasets.dataset import ReadReport
from slam.errors import MapFileError
from slam.mapper import lookahead
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.mapper import Mapper
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.pipeline import build_map
from slam.matching.planar import compose
from slam.measurements import LaserScan, Measurement, RgbdFrame, WheelOdometry, pose2_from_row
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import write_contents
from slam.storage.map_file import MapFile
from slam.storage.map_identity import identity_of
from slam.storage.map_tables import CHECKPOINT, FRAMES
from slam.vision.features import extract_features
from tools.kill_trials import run_trials

WALLS = np.concatenate([box(-2.5, -2.0, 2.5, 2.0), box(1.6, 0.4, 2.5, 1.5), box(-2.5, -2.0, -1.7, -1.1)])
MOUNT = gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.1, 0.0, 1.1])) * T_BODY_CAMERA
MOMENTS = 24


class InterruptedHere(Exception):
    """What stands for a dying process."""


@dataclass
class Log:
    """Measurements in memory."""

    measurements: list[Measurement]
    path: Path
    name: str = "in memory"
    report: ReadReport = field(default_factory=ReadReport)

    def __iter__(self) -> Iterator[Measurement]:
        return iter(self.measurements)


@pytest.fixture(scope="module")
def drive() -> list[Measurement]:
    """Wheels, a lidar and a camera on a robot that turns through a room, and comes back to its beginning."""
    found: list[Measurement] = []
    pose, wheels, rng = np.array([0.3, -0.7, 0.2]), np.zeros(3), np.random.default_rng(0)
    for n in range(MOMENTS):
        stamp_s = 100.0 + 0.1 * n
        on_floor = gtsam.Pose3(pose2_from_row(pose))
        frame = render(
            furnished(), on_floor * MOUNT, SMALL, stamp_s - 0.01, noise=(0.001, 0.0012), seed=n, smooth=False,
            T_base_camera=MOUNT,
        )  # fmt: skip
        scan = sweep(WALLS, pose, beams=181, fov_rad=math.pi, sigma_m=0.01, seed=rng, stamp_s=stamp_s)
        found += [frame, WheelOdometry(stamp_s, pose2_from_row(wheels)), scan]
        step = np.array([0.04, 0.0, 0.08]) * (1.0 if n < MOMENTS // 2 else -1.0)
        pose, wheels = compose(pose, step), compose(wheels, 1.02 * step)
    return found


@pytest.fixture(scope="module")
def lidar_log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A round and a half: loops close."""
    path = write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=55.0).log_path
    return Log(list(open_dataset(path)), path)


def only(drive: list[Measurement], *kinds: type) -> list[Measurement]:
    return [measurement for measurement in drive if isinstance(measurement, kinds)]


def attempt(log: Log, config: Config, path: Path, stop_at: float = math.inf) -> Any:
    """Map, going on where the map is begun; die at a scan, or finish the map."""
    file = MapFile.resume(path) or MapFile.create(path)

    def on_step(stage: str, count: int) -> None:
        if count >= stop_at:
            raise InterruptedHere

    try:
        result = build_map(log, config, on_step, Checkpoint(file))  # type: ignore[arg-type]
    except InterruptedHere:
        file.commit()
        file.close()
        return None
    for key, value in identity_of(path.parent / "log", config).to_meta().items():
        file.add_meta(key, value)
    write_contents(file, result.map)
    file.seal()
    return result


def assert_resumes(log: Log, tmp_path: Path, *stops: float, settings: tuple[str, ...] = ()) -> None:
    config = load_config(None, ["dense_map.enabled=false", "visual_loops.least_gap=4", *settings])
    (tmp_path / "log").write_text("the same")
    whole, broken = tmp_path / "whole.db", tmp_path / "broken.db"
    attempt(log, config, whole)
    for stop_at in stops:
        assert attempt(log, config, broken, stop_at) is None
    result = attempt(log, config, broken)
    assert len(result.map.loops) > 0
    assert broken.read_bytes() == whole.read_bytes()


class TestTheSameMap:
    def test_lidar(self, lidar_log: Log, tmp_path: Path) -> None:
        assert_resumes(lidar_log, tmp_path, 1, 100, 100, 250)

    def test_lidar_and_camera(self, drive: list[Measurement], tmp_path: Path) -> None:
        few = (
            "keyframes.distance_m=0.05",
            "keyframes.angle_rad=0.1",
            "loops.least_path_m=0.5",
            "loops.every_m=0.1",
        )
        assert_resumes(Log(drive, tmp_path), tmp_path, 9, 17, settings=few)

    def test_a_camera_alone(self, drive: list[Measurement], tmp_path: Path) -> None:
        few = ("keyframes.angle_rad=0.1", "match.local_map_keyframes=2")
        assert_resumes(Log(only(drive, RgbdFrame), tmp_path), tmp_path, 9, 17, settings=few)

    def test_a_second_pass(
        self, drive: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Interrupted in the first pass, or in the second, which then needs no first one."""
        passes: list[int] = []
        learned = {"camera": LearnedMounting(MOUNT, "as it is")}

        def learned_mountings(mapper: Mapper) -> dict[str, LearnedMounting]:
            passes.append(mapper.scan_count)
            return learned

        monkeypatch.setattr(Mapper, "learned_mountings", learned_mountings)
        log = Log(drive, tmp_path)
        config = load_config(None, ["dense_map.enabled=false"])
        (tmp_path / "log").write_text("the same")
        whole, broken = tmp_path / "whole.db", tmp_path / "broken.db"
        attempt(log, config, whole)
        for stops in ((12,), (MOMENTS + 12, MOMENTS + 18)):
            broken.unlink(missing_ok=True)
            passes.clear()
            for stop_at in stops:
                file = MapFile.resume(broken) or MapFile.create(broken)

                def on_step(stage: str, count: int, stop_at: int = stop_at) -> None:
                    if count + MOMENTS * len(passes) >= stop_at:
                        raise InterruptedHere

                with pytest.raises(InterruptedHere):
                    build_map(log, config, on_step, Checkpoint(file))  # type: ignore[arg-type]
                file.commit()
                file.close()
            before = len(passes)
            attempt(log, config, broken)
            assert (len(passes) > before) == (stops == (12,))
            assert broken.read_bytes() == whole.read_bytes()

    def test_killed(self, tmp_path: Path) -> None:
        """SIGKILL, by the tool that does it fifty times."""
        log = write_synthetic_log(tmp_path / "log", duration_s=15.0).log_path
        found = run_trials(log, tmp_path / "out", kills=1, seed=3, begins=0.3)
        assert (found.kills, found.faults) == (1, [])
        assert found.finished >= 1


class TestASecondCore:
    """The same map where frames are matched in another process, each of them there and none here."""

    def mapped_twice(self, log: Log, config: Config, tmp_path: Path, patch: pytest.MonkeyPatch) -> list[str]:
        """What was found ahead."""
        found, found_ahead = list[str](), Checkpoint._found_ahead

        def count(checkpoint: Checkpoint, question: str, key: float) -> Any:
            answer = found_ahead(checkpoint, question, key)
            found.extend([question] if answer[0] is not None else [])
            return answer

        patch.setattr(Checkpoint, "_found_ahead", count)
        (tmp_path / "log").write_text("the same")
        for free in (False, True):
            for module in (lookahead, forked):
                patch.setattr(module, "is_core_free", lambda free=free: free)
            attempt(log, config, tmp_path / f"{free}.db")
        assert (tmp_path / "False.db").read_bytes() == (tmp_path / "True.db").read_bytes()
        return found

    def test_lidar_and_camera(
        self, drive: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        config = load_config(None, ["dense_map.enabled=false"])
        found = self.mapped_twice(Log(drive, tmp_path), config, tmp_path, monkeypatch)
        assert found.count("frame") >= MOMENTS - 1 and "scan" not in found

    def test_a_camera_alone(
        self, drive: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        log, config = Log(only(drive, RgbdFrame), tmp_path), load_config(None, ["dense_map.enabled=false"])
        found = self.mapped_twice(log, config, tmp_path, monkeypatch)
        assert found.count("frame") >= MOMENTS - 1

    def test_a_second_pass(
        self, drive: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        learned = {"camera": LearnedMounting(MOUNT, "as it is")}
        monkeypatch.setattr(Mapper, "learned_mountings", lambda _: learned)
        config = load_config(None, ["dense_map.enabled=false"])
        found = self.mapped_twice(Log(drive, tmp_path), config, tmp_path, monkeypatch)
        assert found.count("frame") >= 2 * (MOMENTS - 1)


def test_known_answers_are_not_computed_again(
    drive: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, config = Log(drive, tmp_path), load_config(None, ["dense_map.enabled=false", "fusion.enabled=false"])
    file = MapFile.create(tmp_path / "map.db")
    whole = build_map(log, config, None, Checkpoint(file))  # type: ignore[arg-type]
    file.commit()
    rows, frames = file.count(CHECKPOINT), file.count(FRAMES)
    file.close()
    assert rows > 0 and frames > 0

    def refuse(*_: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr(SurfelOdometry, "match", refuse)
    monkeypatch.setattr("slam.graph.loop_closure.search_place", refuse)
    monkeypatch.setattr("slam.mapping.sensor_packing.packed_color", refuse)
    asked: list[int] = []
    monkeypatch.setattr(
        "slam.vision.prepared_frame.extract_features",
        lambda *arguments: asked.append(1) or extract_features(*arguments),
    )
    again = MapFile.resume(tmp_path / "map.db")
    assert again is not None
    result = build_map(log, config, None, Checkpoint(again))  # type: ignore[arg-type]
    np.testing.assert_array_equal(result.map.trajectory.positions_m, whole.map.trajectory.positions_m)
    assert (again.count(CHECKPOINT), again.count(FRAMES)) == (rows, frames)
    # Only those that became keyframes.
    assert len(asked) == frames < MOMENTS
    again.close()


class TestOtherEvents:
    """A checkpoint that does not fit what happens now is noticed, not believed."""

    def checkpoint(self, path: Path, reported: Callable[[Checkpoint], object]) -> Checkpoint:
        file = MapFile.create(path)
        reported(Checkpoint(file))
        file.commit()
        file.close()
        begun = MapFile.resume(path)
        assert begun is not None
        return Checkpoint(begun)

    @pytest.mark.parametrize(("question", "key"), [("loop", 1.0), ("scan", np.nextafter(1.0, 2.0))])
    def test_another_question(self, tmp_path: Path, question: str, key: float) -> None:
        checkpoint = self.checkpoint(
            tmp_path / "map.db", lambda checkpoint: checkpoint.cached("scan", 1.0, lambda: None)
        )
        assert checkpoint.replaying
        with pytest.raises(MapFileError, match=r"cannot be resumed.*map anew"):
            checkpoint.cached(question, key, lambda: None)

    def test_the_answers_come_back_in_their_order(self, tmp_path: Path) -> None:
        result_cache = [None, 1.5, np.arange(70000.0), "text", [True, (2, b"")], gtsam.Pose2(1.0, 2.0, 3.0)]
        checkpoint = self.checkpoint(
            tmp_path / "map.db",
            lambda checkpoint: [
                checkpoint.cached("scan", n, lambda a=a: a) for n, a in enumerate(result_cache)
            ],
        )
        for n, answer in enumerate(result_cache):
            found = checkpoint.cached("scan", n, lambda: pytest.fail("computed"))
            if isinstance(answer, np.ndarray):
                np.testing.assert_array_equal(found, answer)
            elif isinstance(answer, gtsam.Pose2):
                assert found.matrix().tobytes() == answer.matrix().tobytes()
            else:
                assert found == answer and type(found) is type(answer)
        assert not checkpoint.replaying
        assert checkpoint.cached("scan", 9.0, lambda: "new") == "new"

    def test_a_key_that_is_no_number(self, tmp_path: Path) -> None:
        checkpoint = self.checkpoint(
            tmp_path / "map.db", lambda checkpoint: checkpoint.cached("looks", math.nan, list)
        )
        assert checkpoint.cached("looks", math.nan, lambda: pytest.fail("computed")) == []

    def test_another_frame(self, drive: list[Measurement], tmp_path: Path) -> None:
        log = Log(only(drive, RgbdFrame, LaserScan), tmp_path)
        config = load_config(None, ["dense_map.enabled=false"])
        assert attempt(log, config, tmp_path / "map.db", 12) is None
        file = MapFile.resume(tmp_path / "map.db")
        assert file is not None
        frames = only(drive, RgbdFrame)
        spool = Checkpoint(file).spool()
        assert spool is not None and isinstance(frames[5], RgbdFrame)
        features = extract_features(np.zeros((40, 40), np.uint8), np.ones((40, 40), np.float32), 10)
        with pytest.raises(MapFileError, match=r"cannot be resumed.*frame of camera"):
            spool.add(frames[5], 0, features)
        file.close()
