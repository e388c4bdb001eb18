"""A sensor in one file that the product does not know: used by mapper, graph, report and resume."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from ceiling_compass import KIND, CeilingCompass, Heading
from flat_worlds import box, sweep
from test_resume import Log, attempt

import slam
from slam.app.mapping import Measured, run_log
from slam.config import load_config
from slam.errors import DatasetError, GraphError
from slam.graph.edge import Edge, EdgeKind
from slam.mapper.protocol import SENSORS
from slam.matching.planar import compose
from slam.measurements import Measurement, WheelOdometry, pose2_from_row

STEP = np.array([0.05, 0.0, 0.04])
MOMENTS = 60
ROOM = box(-3.0, -2.0, 3.0, 4.0)


def drive(*, compass: bool) -> list[Measurement]:
    """On a curve; wheels turn a third too little, and the lidar sees no wall after the first second."""
    found, true, wheels = [], np.zeros(3), np.zeros(3)
    for n in range(MOMENTS):
        stamp_s = 10.0 + 0.1 * n
        scan = sweep(ROOM, true, beams=181, fov_rad=math.pi, stamp_s=stamp_s)
        if n > 10:
            scan = replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan))
        found += [WheelOdometry(stamp_s, pose2_from_row(wheels)), scan]
        if compass:
            found.insert(-1, Heading(stamp_s, float(true[2]) + 1.0))
        true, wheels = compose(true, STEP), compose(wheels, STEP * [1.0, 1.0, 0.67])
    return found


@pytest.fixture(autouse=True)
def compass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SENSORS, Heading, CeilingCompass)


def missed_rad(measurements: list[Measurement]) -> float:
    """How far the last heading is off."""
    built = slam.build_map(measurements)
    last = built.trajectory.to_planar()[-1, 2]
    return abs(math.remainder(last - (MOMENTS - 1) * STEP[2], 2.0 * math.pi))


def test_it_keeps_the_heading_that_wheels_lose() -> None:
    assert missed_rad(drive(compass=False)) > 0.4
    assert missed_rad(drive(compass=True)) < 0.08


def test_graph_map_and_report_show_it(tmp_path: Path) -> None:
    run = run_log(Measured(drive(compass=True)), out=tmp_path / "map")
    kinds = [factor.edge.kind for factor in slam.load_map(tmp_path / "map").factors]
    assert kinds.count(KIND) == len(run.map.keyframe_poses) - 1 > 10
    assert f"{KIND}: {kinds.count(KIND)} headings" in run.map.notes
    assert f"edges: {KIND}" in (tmp_path / "map" / "report.html").read_text()


def test_an_interrupted_run_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    log, config = Log(drive(compass=True), tmp_path), load_config()
    (tmp_path / "log").write_text("the same")
    attempt(log, config, tmp_path / "whole.db")
    assert attempt(log, config, tmp_path / "broken.db", 25) is None
    attempt(log, config, tmp_path / "broken.db")
    assert (tmp_path / "broken.db").read_bytes() == (tmp_path / "whole.db").read_bytes()


def test_without_it_a_heading_is_no_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(SENSORS, Heading)
    with pytest.raises(DatasetError, match="is a Heading"):
        slam.build_map(drive(compass=True))


@pytest.mark.parametrize(
    ("made", "fault"),
    [
        (lambda key: [edge(0, key, EdgeKind.RGBD)] if key else [], "a name of its own"),
        (lambda key: [edge(key - 1, key, KIND)], "the graph has nodes 0..0"),
    ],
)
def test_an_edge_that_cannot_be_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, made: Callable[[int], list[Edge]], fault: str
) -> None:
    monkeypatch.setattr(CeilingCompass, "factors", lambda self, key, stamp_s: made(key))
    with pytest.raises(GraphError, match=fault):
        slam.build_map(drive(compass=True))


def edge(source: int, target: int, kind: str) -> Edge:
    return Edge(source, target, gtsam.Pose2(), np.eye(3), kind, trusted=False)
