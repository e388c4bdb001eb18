"""Scores and timings of every scan or frame of a run, for the report."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field, fields

import numpy as np

from slam.estimates import MotionEstimate
from slam.measurements import BoolArray, FloatArray
from slam.vision.learned_camera import LearnedCamera
from slam.vision.visual_match import VisualMatch


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """Data of the report on every scan or frame, one array entry each.

    Attributes
    ----------
    stamps_s, seconds
        Stamp of the scan, and its processing time.
    inlier_shares, residuals_m
        Inlier share and residual of the match; NaN if there was none.
    degenerate
        1 if the match had a degenerate direction, else 0.
    overlaps, feature_counts, residuals_px
        Of a camera match, see `slam.vision.visual_match.VisualMatch`; NaN for a scan and without a match, and
        the residual also if no feature agreed.
    """

    stamps_s: FloatArray
    seconds: FloatArray
    inlier_shares: FloatArray
    residuals_m: FloatArray
    degenerate: FloatArray
    overlaps: FloatArray
    feature_counts: FloatArray
    residuals_px: FloatArray

    @property
    def unmatched(self) -> BoolArray:
        """Return (S,) whether nothing matched; False for the first, which has nothing to match."""
        missing = np.isnan(self.inlier_shares)
        missing[:1] = False
        return missing


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """Usage of the frames of one camera.

    Attributes
    ----------
    frames
        Every frame.
    motions, refused_motions
        Number of motions that a robot's camera reported, and of those rejected because they left the floor.
    learned
        Estimated poses of the camera and its colour camera, and its clock offset.
    """

    frames: ScanRecord
    motions: int = 0
    refused_motions: int = 0
    learned: LearnedCamera = field(default_factory=LearnedCamera)


class ScanRecorder:
    """Growing columns of numbers only, so that it stays small in long logs."""

    def __init__(self) -> None:
        self._columns = [array("d") for _ in fields(ScanRecord)]

    def __len__(self) -> int:
        return len(self._columns[0])

    def add(
        self, stamp_s: float, motion: MotionEstimate | None, seconds: float, match: VisualMatch | None = None
    ) -> None:
        """Add one scan, or one frame with its match."""
        row = (
            stamp_s,
            seconds,
            np.nan if motion is None else motion.inlier_share,
            np.nan if motion is None else motion.residual_m,
            0.0 if motion is None else float(motion.degenerate),
            np.nan if match is None else match.overlap,
            np.nan if match is None else float(match.feature_count),
            np.nan if match is None or not match.feature_count else match.residual_px,
        )
        for column, value in zip(self._columns, row, strict=True):
            column.append(value)

    def finish(self) -> ScanRecord:
        """Return the columns as arrays."""
        return ScanRecord(*(np.array(column) for column in self._columns))
