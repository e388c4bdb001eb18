"""Motions of a sensor and of the robot's base over the same times."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from fusion.time_alignment import GAP_S, ClockOffset, clock_offset
from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.doctor.camera_samples import SensorStep
from slam.doctor.finding import Finding, remedied
from slam.measurements import FloatArray, WheelOdometry

JOINED = 5  # steps of a sensor that are joined to one motion


@dataclass(frozen=True, slots=True)
class BaseTrack:
    """Poses of the base over time, from wheels or a lidar.

    Attributes
    ----------
    rows
        (N, 4) stamp, x, y, heading, with increasing stamps.
    """

    rows: FloatArray

    def poses(self, stamps_s: FloatArray) -> FloatArray:
        """(K, 3) interpolated x, y, unwrapped heading; NaN if no reading is near."""
        rows_s = self.rows[:, 0]
        columns = [*self.rows[:, 1:3].T, np.unwrap(self.rows[:, 3])]
        poses = np.stack([np.interp(stamps_s, rows_s, column) for column in columns], axis=1)
        after = np.searchsorted(rows_s, stamps_s).clip(1, len(rows_s) - 1)
        gaps = (rows_s[after] - rows_s[after - 1] > GAP_S) | (stamps_s < rows_s[0]) | (stamps_s > rows_s[-1])
        poses[gaps] = np.nan
        return poses

    def steps(self, begun_s: FloatArray, ended_s: FloatArray) -> FloatArray:
        """(K, 3) x, y and rotation from one stamp to another, in the base frame at the first."""
        before, after = self.poses(begun_s), self.poses(ended_s)
        cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
        x, y, turn = (after - before).T
        return np.stack([cos * x + sin * y, cos * y - sin * x, turn], axis=1)


def clock_of(runs: Sequence[Sequence[SensorStep]], base: BaseTrack, most_s: float) -> ClockOffset | None:
    """How far a sensor's clock is ahead of the base's, from the rotation of both; None if not determined.

    For a sensor with unknown mounting, the axis with most rotation is used.
    """
    steps = [step for run in runs for step in run]
    if not steps:
        return None
    turns = turns_of(steps)
    _, _, axes = np.linalg.svd(turns, full_matrices=False)
    about = turns @ axes[0]
    spans = np.array([(step.begun_s, step.ended_s) for step in steps])
    at_s = base.rows[:, 0]
    base_spans, base_turns = np.stack([at_s[:-1], at_s[1:]], axis=1), np.diff(np.unwrap(base.rows[:, 3]))
    # The wheels cover all the time, the sensor only stretches, so its steps are searched in theirs.
    found = [clock_offset(spans, sign * about, base_spans, base_turns, most_s) for sign in (1.0, -1.0)]
    best = max((fit for fit in found if fit is not None), key=lambda fit: fit.correlation, default=None)
    return None if best is None else replace(best, offset_s=-best.offset_s)


def runs_of(stretches: Sequence[Sequence[SensorStep]]) -> list[list[SensorStep]]:
    """Runs of consecutive steps without a gap, also across stretches."""
    found: list[list[SensorStep]] = []
    for step in itertools.chain.from_iterable(stretches):
        if found and found[-1][-1].ended_s == step.begun_s:
            found[-1].append(step)
        else:
            found.append([step])
    return found


def turns_of(steps: Sequence[SensorStep]) -> FloatArray:
    """(N, 3) rotation vectors of the steps."""
    return np.array([gtsam.Rot3.Logmap(step.motion.rotation()) for step in steps]).reshape(-1, 3)


def joined(runs: Sequence[Sequence[SensorStep]], count: int) -> list[SensorStep]:
    """Join ``count`` consecutive steps to one; joined steps overlap by half."""
    found = []
    for run in runs:
        for first in range(0, len(run) - count + 1, max(1, count // 2)):
            motion = gtsam.Pose3()
            for step in run[first : first + count]:
                motion = motion.compose(step.motion)
            found.append(SensorStep(run[first].begun_s, run[first + count - 1].ended_s, motion))
    return found


def mended_rows(wheels: str, rows: FloatArray, findings: Sequence[Finding]) -> FloatArray | None:
    """(N, 4) rows of wheels corrected by findings; None if a correction is ambiguous, or for too few rows."""
    own = [one for one in findings if one.sensor == wheels or any("wheels" in each for each in one.remedies)]
    if len(rows) < FEWEST or any(len(finding.remedies) != 1 for finding in own):
        return None
    calibration = remedied(Calibration(), own, only_sure=False)
    readings = [WheelOdometry(float(row[0]), gtsam.Pose2(*row[1:].tolist()), wheels) for row in rows]
    return np.array(
        [
            (one.stamp_s, one.T_odom_base.x(), one.T_odom_base.y(), one.T_odom_base.theta())
            for one in corrected(readings, calibration)
            if isinstance(one, WheelOdometry)
        ]
    ).reshape(-1, 4)
