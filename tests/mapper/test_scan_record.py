"""A record holds one entry a scan; what was not measured is NaN, and the first scan is no loss."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.estimates import MotionEstimate
from slam.mapper.scan_record import ScanRecorder
from slam.vision.visual_match import VisualMatch

MOTION = MotionEstimate(gtsam.Pose3(), np.eye(6), 0.8, 0.7, 0.004, True, True, np.eye(6)[3])


def test_a_match_of_a_camera_stands_beside_its_motion() -> None:
    recorder = ScanRecorder()
    recorder.add(1.0, None, 0.1)
    recorder.add(2.0, MOTION, 0.2, VisualMatch(MOTION, 0.9, 120, 1.5))
    recorder.add(3.0, MOTION, 0.3, VisualMatch(MOTION, 0.6, 0, 0.0))
    recorder.add(4.0, None, 0.4)
    record = recorder.finish()
    nan = np.nan
    expected = {
        "stamps_s": [1.0, 2.0, 3.0, 4.0],
        "seconds": [0.1, 0.2, 0.3, 0.4],
        "inlier_shares": [nan, 0.8, 0.8, nan],
        "residuals_m": [nan, 0.004, 0.004, nan],
        "degenerate": [0.0, 1.0, 1.0, 0.0],
        "overlaps": [nan, 0.9, 0.6, nan],
        "feature_counts": [nan, 120.0, 0.0, nan],
        "residuals_px": [nan, 1.5, nan, nan],
        "unmatched": [False, False, False, True],
    }
    for name, column in expected.items():
        np.testing.assert_array_equal(getattr(record, name), column, err_msg=name)


def test_a_scan_has_nothing_of_a_camera() -> None:
    recorder = ScanRecorder()
    recorder.add(1.0, MOTION, 0.1)
    record = recorder.finish()
    assert np.isnan([record.overlaps, record.feature_counts, record.residuals_px]).all()
    assert not record.unmatched.any()
