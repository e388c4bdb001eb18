"""Outputs of a localiser over a whole log, and its files: trajectory.tum and trajectory.csv."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.showing import one_line
from slam.estimates import Trajectory
from slam.localization.output import LocalizerOutput, State
from slam.measurements import BoolArray, FloatArray, row_from_pose
from slam.storage.files import write_lines
from slam.storage.tum import write_tum

STATES = (State.SEARCHING, State.TRACKING, State.LOST)
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
# Upper triangles of the covariance, GTSAM's tangent order.
_PLANAR_AXES = ("x", "y", "yaw")
_SPATIAL_AXES = ("rx", "ry", "rz", "x", "y", "z")


class DriveLog:
    """Outputs of a localiser as growing columns of numbers, which stay small for a long log."""

    def __init__(self) -> None:
        self._rows = array("d")
        self._poses = array("d")
        self._covariances: list[FloatArray | None] = []
        self._recovered: list[tuple[float, list[float]]] = []

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self._covariances)

    def add(self, output: LocalizerOutput, seconds: float) -> None:
        """Add the output for a measurement, and its computing time."""
        state = STATES.index(output.state)
        self._rows.extend((output.stamp_s, state, output.confidence, output.support, seconds))
        self._poses.extend([np.nan] * 7 if output.pose is None else row_from_pose(output.pose))
        self._covariances.append(output.covariance)
        self._recovered += [(past.stamp_s, row_from_pose(past.pose)) for past in output.recovered]

    @property
    def stamps_s(self) -> FloatArray:
        """Return (N,) values of the measurements."""
        return self._columns()[:, 0]

    @property
    def states(self) -> FloatArray:
        """(N,) index into `STATES`."""
        return self._columns()[:, 1]

    @property
    def confidences(self) -> FloatArray:
        """Return (N,) values of the measurements."""
        return self._columns()[:, 2]

    @property
    def supports(self) -> FloatArray:
        """(N,) share of the measurement that the map explains; NaN if not computed."""
        return self._columns()[:, 3]

    @property
    def seconds(self) -> FloatArray:
        """(N,) computing time of each measurement."""
        return self._columns()[:, 4]

    @property
    def poses(self) -> FloatArray:
        """(N, 7) position and quaternion (x, y, z, w); NaN while searching."""
        return np.array(self._poses).reshape(-1, 7)

    def share_of(self, state: State) -> float:
        """Share of the measurements in a state."""
        return float(np.mean(self.states == STATES.index(state))) if len(self) else 0.0

    def trajectory(self) -> Trajectory:
        """Return poses while tracking, and those of earlier measurements found later; sorted by stamp."""
        tracked, order = self._tracked_and_order()
        stamps = np.array([*self.stamps_s[tracked], *(stamp for stamp, _ in self._recovered)])
        rows = np.array([*self.poses[tracked], *(pose for _, pose in self._recovered)]).reshape(-1, 7)
        return Trajectory(stamps[order], rows[order, :3], rows[order, 3:])

    def of_trajectory(self, values: FloatArray) -> FloatArray:
        """Return (M,) values of the poses in `trajectory` from (N,) of measurements; nan if found later."""
        tracked, order = self._tracked_and_order()
        return np.concatenate([values[tracked], np.full(len(self._recovered), np.nan)])[order]

    def sigmas(self) -> tuple[FloatArray, FloatArray]:
        """Return (N,) largest position sigma, m, and yaw sigma, rad; nan if unknown."""
        positions, yaws = np.full(len(self), np.nan), np.full(len(self), np.nan)
        for number, covariance in enumerate(self._covariances):
            if covariance is not None:
                place = covariance[:2, :2] if len(covariance) == len(_PLANAR_AXES) else covariance[3:, 3:]
                positions[number] = np.sqrt(np.linalg.eigvalsh(place)[-1])
                yaws[number] = np.sqrt(covariance[2, 2])
        return positions, yaws

    def write(self, folder: Path) -> list[Path]:
        """Write ``trajectory.csv``, and ``trajectory.tum`` if there is any pose; return the files."""
        written = [folder / "trajectory.csv"]
        write_lines(written[0], self._csv())
        trajectory = self.trajectory()
        if len(trajectory):
            written.insert(0, folder / "trajectory.tum")
            write_tum(written[0], trajectory)
        return written

    def _csv(self) -> Iterator[str]:
        """Return one line per measurement in log order, then the recovered poses; empty means unknown."""
        known = next((covariance for covariance in self._covariances if covariance is not None), None)
        axes = _SPATIAL_AXES if known is not None and len(known) == 6 else _PLANAR_AXES
        pairs = [f"cov_{a}_{b}" for n, a in enumerate(axes) for b in axes[n:]]
        yield ",".join(["stamp_s", "source", "state", "confidence", "support", *_POSE, *pairs])
        upper = np.triu_indices(len(axes))
        for row, pose, covariance in zip(self._columns(), self.poses, self._covariances, strict=True):
            entries = [np.nan] * len(pairs) if covariance is None else covariance[upper].tolist()
            head = [_number(row[0]), "live", STATES[int(row[1])].value, _number(row[2]), _number(row[3])]
            yield ",".join([*head, *map(_number, pose), *map(_number, entries)])
        for stamp_s, recovered in self._recovered:
            head = [_number(stamp_s), "recovered", State.TRACKING.value, "", ""]
            yield ",".join([*head, *map(_number, recovered), *[""] * len(pairs)])

    def _tracked_and_order(self) -> tuple[BoolArray, NDArray[np.intp]]:
        """Return (N,) which measurements the trajectory has, and (M,) its order, later finds last."""
        tracked = self.states == STATES.index(State.TRACKING)
        stamps = [*self.stamps_s[tracked], *(stamp for stamp, _ in self._recovered)]
        return tracked, np.argsort(stamps, kind="stable")

    def _columns(self) -> FloatArray:
        """(N, 5) stamp, state, confidence, support, seconds."""
        return np.array(self._rows).reshape(-1, 5)


def _number(value: float) -> str:
    """Return the shortest text that gives the same number when read; empty for NaN."""
    return "" if np.isnan(value) else repr(float(value))
