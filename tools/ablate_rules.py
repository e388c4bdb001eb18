"""Switch off, one at a time, the rules by which a planar run decides whom to believe, and measure it.

    python tools/ablate_rules.py DRIVE... --cache FOLDER --out FILE [--rule TEXT...] [--kind KIND...]

Kinds of runs are the real logs (`logs`: mean translation error of the SLAM benchmark's relations, metres),
and simulated drives (ATE RMSE, metres) with everything (`fused`), with a camera whose mounting is reported 20
degrees wrongly (`lying`), by lidar and wheels (`lidar`), and by these with a lidar that is blind for 3 s
(`blind`); the last two are begun at three scans each, and how much that changes is noise. A camera's own
odometry depends on none of the rules: it runs once a drive and is kept in the cache. Results are appended to
FILE; what is in it is not run again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np
from worsened_logs import worsened

from slam.comparison.methods import ODOMETRIES
from slam.config import load_config
from slam.datasets import open_dataset
from slam.estimates import MotionEstimate, Trajectory
from slam.evaluation.relations import read_relations, score_relations
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.mapper.pipeline import build_map
from slam.measurements import LaserScan, Measurement, RgbdFrame, row_from_pose2
from slam.odometry import STANDARD, Odometries
from slam.odometry.camera_odometry import CameraOdometry
from slam.odometry.rgbd_tracker import TrackedFrame
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualMatch

_QUICK = ["dense_map.enabled=false", "layers.enabled=false", "fusion.enabled=false"]
_LOGS = ("fr079", "intel", "intel kiss_matching", "intel jumps")
_KINDS = ("logs", "fused", "lying", "lidar", "blind")
_LATER_SCANS = (0, 7, 14)
_BLIND_S = (15.0, 18.0)
_LIE_RAD = np.radians(20.0)
_NO_POINTS = np.zeros((0, 0))

_TRACKER = "slam.odometry.motion_tracker"
_CHAIN = "slam.mapper.planar_chain.PlanarChain"
_INF = float("inf")
# A rule is switched off by settings, and by what stands in the place of an attribute.
RULES: dict[str, tuple[str | tuple[str, Any], ...]] = {
    "none": (),
    "wheels' jumps are refused": (("slam.odometry.wheel_tracker.WheelTracker.plausible", lambda *_: True),),
    "predictors learn their scale": (("slam.odometry.predictor.Predictor.judge", lambda *_: None),),
    "exact wheels speak up": ((f"{_TRACKER}._LEAST_SHARE", 1.0),),
    "exact wheels swing in turns": ("wheels.swing_m_per_rad=0.0",),
    "only sure matches judge": ((f"{_TRACKER}._JUDGE_INLIER_SHARE", 0.0),),
    "one surprise is bounded": (("slam.odometry.predictor._GREATEST_SURPRISE", _INF),),
    "other guesses and search": ("match.confident_inlier_share=0.01",),
    "least inlier share": ("match.least_inlier_share=0.01",),
    "predictions contest a match": ((f"{_TRACKER}.MotionTracker._rivals", lambda *_: []),),
    "so do the wheels over 1 s": ((f"{_TRACKER}.MotionTracker._predict_by_window", lambda *_: []),),
    "a lost contest rewrites that second": (
        (f"{_TRACKER}.MotionTracker._follow_the_wheels", lambda *_: None),
    ),
    "an object is one witness": ((f"{_TRACKER}._MOST_AN_OBJECT", _INF),),
    "an undecided contest is a dispute": ("prediction.disputed_within=0.0",),
    "cameras are 1 cm uncertain": ((f"{_TRACKER}._CAMERA_FLOOR", np.eye(3) * 1e-12),),
    "match and camera are fused": (
        (f"{_TRACKER}.MotionTracker._fused", lambda _, motion: row_from_pose2(motion.T_reference_base)),
    ),
    "a doubtful match may be refused": ((f"{_CHAIN}._doubtful", lambda *_: False),),
    "matches past a guess": ((f"{_CHAIN}._past_a_guess", lambda _, match, *__: (match, None)),),
    "cameras are asked again at the end": (
        ("slam.mapper.robot_cameras.RobotCameras.settle_clocks", lambda _: None),
    ),
    "matches are steadied by the wheels": (
        ("slam.trajectory.readings.steadied", lambda matched, *_: matched),
    ),
}


def main() -> None:
    """Run what is asked for, and print every rule's figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drives", nargs="*", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="holds lidar2d/")
    parser.add_argument("--cache", type=Path, required=True, help="folder for the cameras' odometries")
    parser.add_argument("--rule", action="append", help="part of a rule's name; repeatable; all by default")
    parser.add_argument("--kind", action="append", choices=_KINDS, help="repeatable; all by default")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines: rule, run, error")
    options = parser.parse_args()
    done: dict[tuple[str, str], float] = {}
    if options.out.exists():
        rows = map(json.loads, options.out.read_text().splitlines())
        done = {(rule, run): error_m for rule, run, error_m in rows}
    rules = [name for name in RULES if name == "none" or any(part in name for part in options.rule or [""])]
    runs = list(_runs(options))
    for rule in rules:
        for run, score in runs:
            if (rule, run) not in done:
                with ExitStack() as off:
                    for change in RULES[rule]:
                        if not isinstance(change, str):
                            off.enter_context(patch(*change))
                    done[rule, run] = score([change for change in RULES[rule] if isinstance(change, str)])
                with options.out.open("a") as out:
                    out.write(json.dumps([rule, run, done[rule, run]]) + "\n")
    print(table(rules, done))


def table(rules: Iterable[str], done: dict[tuple[str, str], float]) -> str:
    """A row a rule: of drives the median error, the worst, and the geometric mean of the error's ratio."""
    lines = ["| rule switched off | " + " | ".join([*_KINDS[1:], *_LOGS]) + " |", "|---" * 9 + "|"]
    for rule in rules:
        cells = []
        for kind in _KINDS[1:]:
            runs = [run for name, run in done if name == rule and run.split()[1:2] == [kind]]
            if not runs:
                cells.append("")
                continue
            errors = np.array([done[rule, run] for run in runs])
            ratio = np.exp(np.mean(np.log(errors / [done["none", run] for run in runs])))
            cells.append(f"{np.median(errors):.4f}, {errors.max():.3f}, x {ratio:.2f}")
        cells += [f"{done[rule, run]:.4f}" if (rule, run) in done else "" for run in _LOGS]
        lines.append(f"| {rule} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _runs(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[list[str]], float]]]:
    """Name of every run, and what scores it under some settings."""
    kinds = options.kind or _KINDS
    if "logs" in kinds:
        yield from ((run, partial(_log_error_m, options.data / "lidar2d", run)) for run in _LOGS)
    for kind in kinds:
        for drive in options.drives if kind != "logs" else ():
            tracks = options.cache / f"{drive.name}.npz"
            if kind in ("fused", "lying"):
                if not tracks.exists():
                    record_cameras(drive, tracks)
                yield f"{drive.name} {kind}", partial(_drive_error_m, drive, tracks, kind)
                continue
            for later in _LATER_SCANS:
                yield f"{drive.name} {kind} {later}", partial(_drive_error_m, drive, later, kind)


def _log_error_m(folder: Path, run: str, overrides: list[str]) -> float:
    """Mean translation error of a real log's relations."""
    name, kind = (*run.split(), "as recorded")[:2]
    log = _log(folder / name / f"{name}.log.gz", "as recorded" if kind in ODOMETRIES else kind)
    trajectory = _mapped(log, overrides, ODOMETRIES.get(kind, STANDARD))
    relations = read_relations(folder / name / f"{name}.relations")
    return float(score_relations(trajectory, relations).all.translation_m.mean)


def _drive_error_m(drive: Path, source: Path | int, kind: str, overrides: list[str]) -> float:
    """ATE RMSE of a simulated drive, by its cameras' tracks too or from a later scan on."""
    if isinstance(source, int):
        trajectory = _mapped(_without_cameras(drive, source, kind), overrides)
    else:
        with ExitStack() as stack:
            stack.enter_context(patch("slam.mapper.robot_cameras.CameraOdometry", RecordedCamera))
            stack.enter_context(
                patch("slam.mapper.camera_keyframes.CameraKeyframes.add", lambda *_, **__: None)
            )
            trajectory = _mapped(_with_cameras(drive, source, lying=kind == "lying"), overrides)
    return float(absolute_error(trajectory, open_dataset(drive).groundtruth()).translation_m.rmse)


def _mapped(
    measurements: Iterable[Any], overrides: list[str], odometries: Odometries = STANDARD
) -> Trajectory:
    """The trajectory of a run; no grid is drawn."""
    config = load_config(None, [*_QUICK, *overrides])
    mapper = Mapper(config, PlanarRobot(config, odometries=odometries))
    for measurement in measurements:
        mapper.add(measurement)
    with patch("slam.mapper.lidar2d.grid_of_keyframes", lambda *_: None):
        return mapper.finish().trajectory


@cache
def _log(path: Path, kind: str = "as recorded") -> list[Measurement]:
    """A log's measurements, made worse; read once."""
    return list(worsened(path, kind, np.random.default_rng(1)))


def _without_cameras(drive: Path, later_scans: int, kind: str) -> Iterator[Measurement]:
    """Lidar and wheels of a drive from a scan on."""
    log, scans = _log(drive / "scans.log"), 0
    for measurement in log:
        if isinstance(measurement, LaserScan):
            scans += 1
            since_s = measurement.stamp_s - log[0].stamp_s
            if kind == "blind" and _BLIND_S[0] < since_s < _BLIND_S[1]:
                measurement = replace(measurement, ranges_m=np.full_like(measurement.ranges_m, np.nan))
        if scans > later_scans:
            yield measurement


def record_cameras(drive: Path, out: Path) -> None:
    """Map a drive once and keep what its cameras' odometries said, in the order of the log."""
    reported: dict[tuple[str, float], tuple[Any, ...]] = {}
    add = CameraOdometry.add

    def recorded(self: CameraOdometry, frame: PreparedFrame) -> TrackedFrame:
        tracked = add(self, frame)
        covariance = np.zeros((6, 6)) if tracked.match is None else tracked.match.motion.covariance
        flags = [tracked.match is not None, tracked.new_keyframe, tracked.restarted]
        reported[frame.frame.sensor, frame.stamp_s] = (flags, tracked.pose.matrix(), covariance)
        return tracked

    with patch.object(CameraOdometry, "add", recorded):
        build_map(open_dataset(drive), load_config(None, _QUICK))
    names, stamps, mounts, rows = [], [], [], []
    for measurement in open_dataset(drive):
        name, mount = "", np.eye(4)
        if isinstance(measurement, RgbdFrame) and measurement.T_base_camera is not None:
            name, mount = measurement.sensor, measurement.T_base_camera.matrix()
            rows.append(reported[name, measurement.stamp_s])
        names.append(name)
        stamps.append(measurement.stamp_s)
        mounts.append(mount)
    flags, poses, covariances = map(list, zip(*rows, strict=True))
    kept = {"flags": flags, "poses": poses, "covariances": covariances}
    np.savez(out, names=names, stamps=stamps, mounts=mounts, **kept)


class RecordedCamera(CameraOdometry):
    """A camera's odometry that says again what it said: the answer comes with the frame."""

    def add(self, frame: Any) -> TrackedFrame:
        """Take the next frame."""
        tracker: Any = SimpleNamespace(track=lambda _: frame.parts, add_keyframe=lambda *_: None)
        self._tracker = tracker
        return super().add(frame)


def _with_cameras(drive: Path, tracks: Path, *, lying: bool) -> Iterator[Any]:
    """All of a drive in the order of its log, frames with their answers in the place of their images."""
    rows = dict(np.load(tracks))
    rest = iter(_log(drive / "scans.log"))
    result_cache = zip(rows["flags"], rows["poses"], rows["covariances"], strict=True)
    liar = next(name for name in rows["names"] if name)
    for name, stamp_s, mount in zip(rows["names"], rows["stamps"], rows["mounts"], strict=True):
        if not name:
            yield next(rest)
            continue
        (matched, keyframe, restarted), matrix, covariance = next(result_cache)
        T_base_camera, T_odom_camera = gtsam.Pose3(mount), gtsam.Pose3(matrix)
        if lying and name == liar:
            T_base_camera = T_base_camera.compose(gtsam.Pose3(gtsam.Rot3.Pitch(_LIE_RAD), np.zeros(3)))
        motion = MotionEstimate(T_odom_camera, covariance, 1.0, 1.0, 0.01, True, False, np.zeros(6))
        match = VisualMatch(motion, 1.0, 100, 1.0) if matched else None
        tracked: Any = TrackedFrame(T_odom_camera, match, bool(keyframe), bool(restarted))
        images: Any = (_NO_POINTS, _NO_POINTS, None)
        yield PreparedFrame(RgbdFrame(float(stamp_s), *images, T_base_camera, str(name)), tracked)


if __name__ == "__main__":
    main()
