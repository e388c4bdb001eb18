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
    """What the report tells of every scan or frame, one array entry each.

    Attributes
    ----------
    stamps_s, seconds
        Time of the scan and the time that its processing took.
    inlier_shares, residuals_m
        Of the match; NaN where there was none.
    degenerate
        1 where the match had a weak direction, 0 elsewhere.
    overlaps, feature_counts, residuals_px
        Of a camera's match, see `slam.vision.visual_match.VisualMatch`; NaN for a scan, where nothing
        matched, and the residual also where no feature agreed.
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
        """(S,) where nothing matched; the first has nothing to be matched with, and is not counted."""
        missing = np.isnan(self.inlier_shares)
        missing[:1] = False
        return missing


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """What became of the frames of one camera.

    Attributes
    ----------
    frames
        Every frame.
    motions, refused_motions
        How many motions a robot's camera reported, and how many of them were refused because they left the
        floor.
    learned
        Where the camera and its colour camera sit, and its clock.
    """

    frames: ScanRecord
    motions: int = 0
    refused_motions: int = 0
    learned: LearnedCamera = field(default_factory=LearnedCamera)


class ScanRecorder:
    """Flat, growing columns: numbers only, so that it stays small on a long log."""

    def __init__(self) -> None:
        self._columns = [array("d") for _ in fields(ScanRecord)]

    def __len__(self) -> int:
        return len(self._columns[0])

    def add(
        self, stamp_s: float, motion: MotionEstimate | None, seconds: float, match: VisualMatch | None = None
    ) -> None:
        """Take one scan, or one frame with its match."""
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
        """As arrays."""
        return ScanRecord(*(np.array(column) for column in self._columns))
