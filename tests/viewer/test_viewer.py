"""A recording holds what the log held, on the log's clock; without one nothing is shown or written."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import Mock

import gtsam
import numpy as np
import pytest
from command_line import Scanweave, assert_one_line_error, log, mapped, scanweave

from slam.errors import ScanweaveError
from slam.localization.output import LocalizerOutput, State
from slam.measurements import CameraIntrinsics, LaserScan, RgbdFrame
from slam.simulation.synthetic_log import SyntheticLog
from slam.viewer.map_recording import record_localization
from slam.viewer.viewer import recording

__all__ = ["log", "mapped", "scanweave"]


def entities(path: Path) -> set[str]:
    """What a recording holds, read back by Rerun itself."""
    from rerun.chunk import RrdReader

    return {str(chunk.entity_path) for chunk in RrdReader(path).stream().to_chunks()}


def test_nothing_is_shown_without_a_path(tmp_path: Path) -> None:
    with recording(None) as viewer:
        assert viewer is None
    assert list(tmp_path.iterdir()) == []


def test_points_of_a_scan_lie_where_the_laser_stood() -> None:
    ranges = np.array([1.0, np.inf, 2.0, np.nan, 90.0], dtype=np.float32)
    scan = LaserScan(0.0, ranges, 0.0, np.pi / 4.0, 80.0, gtsam.Pose2(0.5, 0.0, 0.0))
    np.testing.assert_allclose(scan.points_laser(), [[1.0, 0.0], [0.0, 2.0]], atol=1e-9)
    pose, shown = gtsam.Pose2(10.0, 0.0, np.pi / 2.0), []
    viewer = Mock()
    viewer.scan = shown.append
    record_localization(viewer, scan, LocalizerOutput(0.0, State.TRACKING, pose, None, 1.0, (), 1.0))
    np.testing.assert_allclose(shown[0], [[10.0, 1.5], [8.0, 0.5]], atol=1e-9)


def test_frames_of_a_localisation_are_shown() -> None:
    lens = CameraIntrinsics(4.0, 4.0, 1.0, 1.0, 3, 2)
    frame = RgbdFrame(0.0, np.zeros((2, 3, 3), np.uint8), np.ones((2, 3), np.float32), lens, sensor="left")
    shown: list[str] = []
    viewer = Mock()
    viewer.image = lambda sensor, *images: shown.append(sensor)
    record_localization(viewer, frame, LocalizerOutput(0.0, State.SEARCHING, None, None, 0.0, (), 1.0))
    assert shown == ["left"]


def test_a_map_and_a_localisation_are_recorded(
    log: SyntheticLog, mapped: Path, tmp_path: Path, scanweave: Scanweave
) -> None:
    pytest.importorskip("rerun", reason="recordings need rerun-sdk (the extra 'viewer')")
    run = scanweave("map", log.log_path, "-o", tmp_path / "out", "--record", tmp_path / "run.rrd")
    assert run.code == 0, run.err
    found = entities(tmp_path / "run.rrd")
    assert {"/map/robot", "/map/scan", "/map/graph", "/map/ways/trajectory", "/map/grids/occupancy"} <= set(
        found
    )
    localized = scanweave(
        "localize", mapped, log.log_path, "-o", tmp_path / "found", "--record", tmp_path / "found.rrd"
    )
    assert localized.code == 0, localized.err
    assert {"/map/robot", "/map/scan", "/map/grids/saved\\ map", "/figures/confidence"} <= set(
        entities(tmp_path / "found.rrd")
    )


def test_a_failed_run_leaves_no_recording(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="recordings need rerun-sdk (the extra 'viewer')")
    with pytest.raises(RuntimeError), recording(tmp_path / "run.rrd") as viewer:
        viewer.note("begun")
        raise RuntimeError("stopped")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ScanweaveError, match="there is no folder"), recording(tmp_path / "no" / "run.rrd"):
        pass


def test_a_missing_extra_is_one_line_before_the_work(
    log: SyntheticLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scanweave: Scanweave
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    outcome = scanweave("map", log.log_path, "-o", tmp_path / "out", "--record", tmp_path / "run.rrd")
    assert_one_line_error(outcome, "needs rerun", "pip install 'scanweave[viewer]'")
    assert not (tmp_path / "out" / "trajectory.tum").exists()
