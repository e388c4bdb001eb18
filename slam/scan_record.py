"""Scores and timings of every scan of a run, for the report."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np

from slam.measurements import FloatArray, MotionEstimate


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """What the report tells of every scan, one array entry a scan.

    Attributes
    ----------
    stamps_s, seconds
        Time of the scan and the time that its processing took.
    inlier_shares, residuals_m
        Of the lidar match; NaN where there was none.
    degenerate
        1 where the match had a weak direction, 0 elsewhere.
    """

    stamps_s: FloatArray
    seconds: FloatArray
    inlier_shares: FloatArray
    residuals_m: FloatArray
    degenerate: FloatArray


class ScanRecorder:
    """Flat, growing columns: numbers only, so that it stays small on a long log."""

    def __init__(self) -> None:
        self._columns = [array("d") for _ in range(5)]

    def add(self, stamp_s: float, motion: MotionEstimate | None, seconds: float) -> None:
        """Take one scan."""
        row = (
            stamp_s,
            seconds,
            np.nan if motion is None else motion.inlier_share,
            np.nan if motion is None else motion.residual_m,
            0.0 if motion is None else float(motion.degenerate),
        )
        for column, value in zip(self._columns, row, strict=True):
            column.append(value)

    def finish(self) -> ScanRecord:
        """As arrays."""
        return ScanRecord(*(np.array(column) for column in self._columns))
