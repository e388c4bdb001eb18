"""What the report shows of scans and depth images that repaired each other, and of a robot's cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
from flat_worlds import box, sweep
from room_world import LESS, T_BODY_CAMERA, blind, furnished, prepared, render

from fusion import Grade, Provenance, RigEstimate
from slam.config import Config
from slam.datasets.dataset import ReadReport
from slam.estimates import Trajectory
from slam.evaluation.map_report import ReportData, RunCost
from slam.evaluation.report import fusion_section, write_report
from slam.mapper.keyframe_fusion import FusionPair, FusionSummary
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.mapper.scan_record import ScanRecord
from slam.measurements import LaserScan
from slam.storage.map_contents import MapContents
from slam.vision.color_registration import identity_registration

RIG = RigEstimate(
    u=90, yaw_rad=0.0, height_m=-0.4, height_range_m=(-0.4, -0.4), v=0, pairs=8, alignments=(None,), drift=0
)
RED, ORANGE, GREEN, BLUE = (194, 53, 43), (217, 115, 13), (31, 138, 76), (37, 99, 184)


def pairs(repaired: bool = True) -> list[FusionPair]:
    """Four of high grade near the rig's u, three of middle grade beside it, one of low grade far off."""
    grades = [Grade.HIGH] * 4 + [Grade.MIDDLE] * 3 + [Grade.LOW]
    offsets = [90, 91, 90, 91, 88, 88, 87, 140]
    counts = np.zeros(len(Provenance), np.int64)
    counts[[Provenance.MEASURED, Provenance.FILLED, Provenance.INTERPOLATED]] = 150, 20, 10
    return [
        FusionPair(1000.0 + number, u, grade, counts if repaired and grade != Grade.LOW else None)
        for number, (u, grade) in enumerate(zip(offsets, grades, strict=True))
    ]


def example(stamp_s: float = 1000.0) -> tuple[LaserScan, LaserScan]:
    """A round room; ten beams without return get one, ten others get another, ten stay lost."""
    ranges_m = np.full(180, 3.0, np.float32)
    ranges_m[40:50], ranges_m[120:130] = np.inf, np.nan
    before = LaserScan(stamp_s, ranges_m, -math.pi / 2, math.pi / 180, 10.0)
    after = ranges_m.copy()
    after[40:50], after[80:90] = 3.0, 2.5
    return before, replace(before, ranges_m=after)


def summary(repaired: bool = True, estimate: RigEstimate | None = RIG) -> FusionSummary:
    return FusionSummary(pairs(repaired), estimate, "fusion of <8> keyframes")


def frames(count: int = 8) -> ScanRecord:
    return ScanRecord(
        1000.0 + np.arange(count), *(np.full(count, value) for value in [0.1] * 3 + [0.0] + [0.1] * 3)
    )


def page(fused: FusionSummary | None, folder: Path) -> str:
    """The report of a run that stood still."""
    scan = example()[0]
    result = MapResult(
        MapContents(
            node_poses=[gtsam.Pose2()],
            stamps_s=np.array([1000.0]),
            readings=np.array([0]),
            trajectory=Trajectory(frames().stamps_s, np.zeros((8, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (8, 1))),
            keyframe_scans=[scan],
        ),
        frames(),
        fused=fused,
    )
    write_report(folder / "report.html", ReportData("log", ReadReport(), result, Config(), RunCost(1.0, 1.0)))
    return (folder / "report.html").read_text(encoding="utf-8")


def test_a_run_with_fusion_reports_it(tmp_path: Path) -> None:
    html = page(summary(), tmp_path)
    reported = html[html.index("<h2>Fusion of lidar and depth (Xu2024)") :].split("</section>")[0]
    assert "fusion of &lt;8&gt; keyframes" in reported and "7 of 8 pairs were repaired." in reported


def test_a_run_without_fusion_does_not(tmp_path: Path) -> None:
    assert "Fusion of lidar" not in page(None, tmp_path)


def test_pairs_are_counted_by_grade_and_held_against_the_rig() -> None:
    html = fusion_section(summary())
    assert "<tr><td>high<td>4<td>50%<td>0.5\n" in html
    assert "<tr><td>middle<td>3<td>38%<td>2.0\n" in html
    assert "<tr><td>low<td>1<td>12%<td>50.0\n" in html


def test_where_the_rig_was_not_estimated_only_the_pairs_are_shown() -> None:
    html = fusion_section(summary(repaired=False, estimate=None))
    assert "<tr><td>high<td>4<td>50%<td>–\n" in html and "<tr><td>low<td>1<td>12%<td>–\n" in html
    assert "were repaired" not in html


def test_without_a_pair_the_note_stands_alone() -> None:
    html = fusion_section(FusionSummary([], None, "no pair at all"))
    assert "no pair at all" in html and "<table" not in html


def test_what_became_of_every_camera_of_a_robot_is_reported() -> None:
    """Eight frames of one camera, of which the last two see nothing; two of another."""
    mount = gtsam.Pose3(T_BODY_CAMERA.rotation(), np.array([0.1, 0.0, 1.1]))
    refused = identity_registration(LESS, "no clear gain")
    mapper = Mapper(Config(), PlanarRobot(Config(), registrations={"left": refused}))
    for number in range(8):
        pose, stamp_s = np.array([-0.5 + 0.03 * number, -0.7, 0.2]), 100.0 + 0.1 * number
        on_floor = gtsam.Pose3(gtsam.Rot3.Rz(pose[2]), np.array([pose[0], pose[1], 0.0]))
        seen = render(furnished(), on_floor * mount, LESS, stamp_s - 0.01, T_base_camera=mount, smooth=False)
        mapper.add(prepared(replace(blind(seen) if number > 5 else seen, sensor="left")))
        if number < 2:
            mapper.add(prepared(replace(seen, sensor="right")))
        mapper.add(sweep(box(-2.5, -2.0, 2.5, 2.0), pose, beams=181, fov_rad=math.pi, stamp_s=stamp_s))
    cameras = mapper.finish().cameras
    assert list(cameras) == ["left", "right"]
    left, right = cameras["left"], cameras["right"]
    np.testing.assert_allclose(left.frames.stamps_s, 99.99 + 0.1 * np.arange(8))
    assert left.frames.unmatched.tolist() == [False] * 6 + [True] * 2
    assert right.frames.stamps_s.size == 2 and not right.frames.unmatched.any()
    assert (left.frames.seconds > 0.0).all() and np.nanmin(left.frames.feature_counts) > 10
    assert np.nanmin(left.frames.overlaps[1:6]) > 0.5
    assert left.motions > right.motions > 0 and left.refused_motions == 0
    assert left.learned.registration is refused and right.learned.registration is None
