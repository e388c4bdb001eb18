"""What the report shows of cameras: frames not scans, losses, the truth, and the cloud the right way up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from reading_pages import page_data

from slam.config import Config
from slam.datasets.dataset import ReadReport
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.evaluation.map_report import Beside, ReportData, RunCost, beside_of
from slam.evaluation.report import write_report
from slam.evaluation.trajectory_error import compare_with_truth
from slam.graph.edge import Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import CameraRecord, ScanRecord
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import CameraIntrinsics, FloatArray, LaserScan
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.ply import write_cloud_ply
from slam.vision.color_registration import identity_registration
from slam.vision.learned_camera import LearnedCamera

COUNT = 100
LENS = CameraIntrinsics(300.0, 300.0, 160.0, 120.0, 320, 240)


def frames(lost: slice = slice(0, 1)) -> ScanRecord:
    """A hundred frames, 10 a second; the first and the lost ones matched nothing."""

    def column(value: float) -> FloatArray:
        values = np.full(COUNT, value)
        values[[0]] = values[lost] = np.nan
        return values

    return ScanRecord(
        stamps_s=0.1 * np.arange(COUNT),
        seconds=np.full(COUNT, 0.02),
        inlier_shares=column(0.9),
        residuals_m=column(0.0042),
        degenerate=np.zeros(COUNT),
        overlaps=column(0.85),
        feature_counts=column(321.0),
        residuals_px=column(1.25),
    )


def trajectory() -> Trajectory:
    angle = np.linspace(0.0, 3.0, COUNT)
    positions = np.column_stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(2.0 * angle)])
    return Trajectory(0.1 * np.arange(COUNT), positions, np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)))


def result(
    origin: gtsam.Pose2 | gtsam.Pose3 = gtsam.Pose3(),  # noqa: B008
    kind: EdgeKind = EdgeKind.RGBD,
    lost: slice = slice(0, 1),
    keep: bool = True,
) -> MapResult:
    """Keyframes at 0, 40 and 80; on a floor a lidar that sees nothing is there too."""
    size = 3 if isinstance(origin, gtsam.Pose2) else 6
    edges = [Edge(key - 1, key, origin, np.eye(size), kind, trusted=True) for key in (1, 2)]
    scan = LaserScan(0.0, np.ones(3, np.float32), -1.0, 1.0, 10.0)
    return MapResult(
        MapContents(
            node_poses=[origin] * 3,
            stamps_s=trajectory().stamps_s[[0, 40, 80]],
            readings=np.array([0, 40, 80]),
            trajectory=trajectory(),
            factors=[SavedFactor(edge, keep) for edge in edges],
            keyframe_scans=[scan, scan, scan] if size == 3 else [],
        ),
        frames(lost),
        cameras={"RGBD_1": CameraRecord(frames(lost))},
    )


def report(run: MapResult, beside: Beside = Beside()) -> ReportData:  # noqa: B008
    return ReportData("log", ReadReport(), run, Config(), RunCost(1.0, 1.0), beside)


def page(run: MapResult, folder: Path, beside: Beside = Beside()) -> str:  # noqa: B008
    write_report(folder / "report.html", report(run, beside))
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("fitted", "stated"), [(1, True), (5, False)])
def test_places_that_do_not_fit_are_reported(fitted: int, stated: bool) -> None:
    loops = [LoopCandidate(0, 2, 0.1, 0.1, 1.0, None, number < fitted, "") for number in range(15)]
    run = replace(result(), map=replace(result().map, loops=loops))
    assert any("of the 15 revisited places" in line for line in report(run).warnings) == stated


def test_a_map_by_cameras_is_reported_in_frames(tmp_path: Path) -> None:
    html = page(result(lost=slice(20, 27)), tmp_path)
    assert "<dt>frames</dt><dd>100</dd>" in html and "median time per frame" in html
    assert "<dt>scans" not in html
    assert "<tr><td>RGBD_1<td>100<td>7<td>0<td>–<td>–<td>0.85<td>321<td>1.25<td>4.2" in html
    assert "7 of 100 frames matched nothing; their motion is from dead reckoning." in html
    assert "<h2>Trajectory</h2>" in html


def test_a_map_by_lidar_is_reported_in_scans(tmp_path: Path) -> None:
    html = page(replace(result(gtsam.Pose2(), EdgeKind.LIDAR), cameras={}), tmp_path)
    assert "<dt>scans</dt><dd>100</dd>" in html
    assert "<h2>Cameras" not in html


@pytest.mark.parametrize(
    ("kind", "keep", "expected"),
    [
        (
            EdgeKind.RGBD,
            True,
            "At 30 of 100 moments only the cameras gave a motion, not the lidar.",
        ),
        (EdgeKind.RGBD, False, "30 of 100 scans matched nothing; their motion is from dead reckoning."),
        (EdgeKind.WHEEL, True, "30 of 100 scans matched nothing; their motion is from dead reckoning."),
    ],
)
def test_dead_reckoning_is_what_no_camera_measured(kind: EdgeKind, keep: bool, expected: str) -> None:
    run = result(gtsam.Pose2(), kind, lost=slice(60, 90), keep=keep)
    assert report(run).warnings == [expected]


def test_only_the_steps_that_cameras_measured_are_theirs() -> None:
    run = result(gtsam.Pose2(), lost=slice(30, 60))
    first, *others = run.map.factors
    first = replace(first, edge=replace(first.edge, kind=EdgeKind.WHEEL))
    run.map = replace(run.map, factors=[first, *others])
    assert report(run).warnings == [
        "11 of 100 scans matched nothing; their motion is from dead reckoning.",  # 30 to 40
        "At 19 of 100 moments only the cameras gave a motion, not the lidar.",  # 41 to 59
    ]


def test_a_registration_is_reported_with_its_reason(tmp_path: Path) -> None:
    refused = identity_registration(LENS, "taken as registered: <no clear gain>")
    record = CameraRecord(frames(), motions=1234, refused_motions=56, learned=LearnedCamera(refused))
    html = page(replace(result(), cameras={"left": record}), tmp_path)
    assert "<td>1,234<td>56<td>" in html and "taken as registered: &lt;no clear gain&gt;" in html
    found = replace(record, learned=LearnedCamera(replace(refused, accepted=True, reason="1.7 cm beside")))
    assert "registered by the log itself: 1.7 cm beside" in page(
        replace(result(), cameras={"left": found}), tmp_path
    )


def test_the_path_of_a_camera_is_measured_in_space(tmp_path: Path) -> None:
    climb = replace(trajectory(), positions_m=np.outer(np.arange(COUNT), [0.0, 0.0, 0.02]))
    run = replace(result(), map=replace(result().map, trajectory=climb))
    assert f"{0.02 * (COUNT - 1):.1f} m" in page(run, tmp_path)


@pytest.fixture
def moved() -> tuple[Trajectory, Trajectory]:
    """A trajectory, and the same seen from another frame with one pose 10 cm off."""
    path = trajectory()
    turn = gtsam.Rot3.Ypr(0.4, -0.3, 1.0).matrix()
    truth = replace(path, positions_m=path.positions_m @ turn.T + [3.0, -2.0, 5.0])
    return path, truth


def test_the_truth_is_laid_over_the_map(moved: tuple[Trajectory, Trajectory]) -> None:
    path, truth = moved
    comparison = compare_with_truth(path, truth)
    np.testing.assert_allclose(comparison.true_positions_m, path.positions_m, atol=1e-9)
    assert comparison.errors_m.max() < 1e-9


def test_an_error_shows_where_it_is(moved: tuple[Trajectory, Trajectory], tmp_path: Path) -> None:
    path, truth = moved
    wrong = path.positions_m.copy()
    wrong[70] += [0.0, 0.0, 0.5]
    comparison = compare_with_truth(replace(path, positions_m=wrong), truth)
    assert int(comparison.errors_m.argmax()) == 70
    assert np.sqrt(np.mean(comparison.errors_m**2)) == pytest.approx(comparison.error.translation_m.rmse)
    html = page(result(), tmp_path, Beside(truth=comparison))
    assert "RMSE against the truth" in html and "over 100 poses: RMSE 0.0" in html


class Log:
    """A dataset as far as the report asks it."""

    def __init__(self, truth: Trajectory | Exception | None) -> None:
        self._truth = truth

    def groundtruth(self) -> Trajectory | None:
        if isinstance(self._truth, Exception):
            raise self._truth
        return self._truth


def test_what_cannot_be_compared_is_a_warning_and_the_report_is_made(tmp_path: Path) -> None:
    line = replace(trajectory(), positions_m=np.zeros((COUNT, 3)))
    for log in (Log(line), Log(DatasetError("groundtruth.txt is a mess"))):
        beside = beside_of(log, result(), [])  # type: ignore[arg-type]
        assert beside.truth is None and "Not compared with the ground truth" in beside.warnings[0]
        assert "Not compared with the ground truth" in page(result(), tmp_path, beside)
    assert beside_of(Log(None), result(), []) == Beside()  # type: ignore[arg-type]


def square(
    side_m: float, height_m: float, color: tuple[int, int, int], up: float, at: FloatArray
) -> ColoredCloud:
    """A level square of points a centimetre apart."""
    steps = np.arange(0.0, side_m, 0.01)
    x, y = np.meshgrid(steps, steps)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)]) + np.append(at, 0.0)
    return ColoredCloud(
        points.astype(np.float32),
        np.tile(np.array(color, np.uint8), (x.size, 1)),
        np.tile(np.array([0.0, 0.0, up], np.float32), (x.size, 1)),
    )


RED, GREEN, BLUE = (200, 0, 0), (0, 200, 0), (0, 0, 200)


def room() -> ColoredCloud:
    """A red floor, a green table in its corner of large x and y, a blue ceiling over all."""
    parts = [
        square(0.7, 0.8, GREEN, 1.0, np.array([1.3, 1.3])),
        square(2.0, 0.0, RED, 1.0, np.zeros(2)),
        square(2.0, 2.5, BLUE, -1.0, np.zeros(2)),
    ]
    columns = zip(*((p.points_map, p.colors, p.normals_map) for p in parts), strict=True)
    return ColoredCloud(*map(np.concatenate, columns))


PATH = np.array([[0.2, 0.2, 1.0], [1.0, 1.0, 1.0]])


def test_the_cloud_is_read_from_the_written_file(tmp_path: Path) -> None:
    write_cloud_ply(tmp_path / "cloud.ply", [room()])
    seen = replace(result(), map=replace(result().map, frames=[]))
    beside = beside_of(Log(None), seen, [tmp_path / "map.pgm", tmp_path / "cloud.ply"])  # type: ignore[arg-type]
    assert beside.cloud is not None and len(beside.cloud.points_map) == len(room().points_map)
    assert len(page_data(page(result(), tmp_path, beside))["cloud"]["points"]) > 1000
    (tmp_path / "cloud.ply").write_bytes(b"ply\n")
    beside = beside_of(Log(None), seen, [tmp_path / "cloud.ply"])  # type: ignore[arg-type]
    assert beside.cloud is None and "No picture of the coloured map" in beside.warnings[0]
