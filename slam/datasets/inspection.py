"""What a log holds, in one pass and constant memory: ``scanweave inspect``."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass, field

import numpy as np

from slam.datasets.dataset import Dataset, Tally, Thinned
from slam.datasets.inspection_bag import BagSummary, bag_summary
from slam.datasets.inspection_camera import CameraFigures, CameraSummary
from slam.datasets.inspection_cloud import CloudFigures, CloudSummary
from slam.measurements import LaserScan, PointCloud, RgbdFrame, WheelOdometry


@dataclass(frozen=True, slots=True)
class LaserSummary:
    """The beams of one laser.

    Attributes
    ----------
    beams_min, beams_max
        Beams a scan.
    first_angle_rad, last_angle_rad, step_rad
        Bearings of the latest scan in the laser frame.
    range_max_m
        Range that a beam without a return clears.
    longest_return_m
        Longest true reading, None if there was none.
    no_return_share, invalid_share
        Of all beams, 0..1.
    mount_x_m, mount_y_m, mount_yaw_rad
        The laser on the robot.
    """

    beams_min: int
    beams_max: int
    first_angle_rad: float
    last_angle_rad: float
    step_rad: float
    range_max_m: float
    longest_return_m: float | None
    no_return_share: float
    invalid_share: float
    mount_x_m: float
    mount_y_m: float
    mount_yaw_rad: float


@dataclass(frozen=True, slots=True)
class OdometrySummary:
    """The drive by the wheels: length of the path and sum of all turning, either way."""

    path_m: float
    rotation_rad: float


@dataclass(frozen=True, slots=True)
class SensorSummary:
    """One stream of measurements.

    Attributes
    ----------
    rate_hz
        One over the median interval, None for fewer than two stamps.
    longest_gap_s, longest_gap_at_s
        The longest interval and where it begins, seconds after the log's first stamp.
    clock_steps_backward, largest_clock_step_s
        Stamps earlier than the one before, and by how much at most.
    """

    sensor: str
    count: int
    rate_hz: float | None
    longest_gap_s: float
    longest_gap_at_s: float
    clock_steps_backward: int
    largest_clock_step_s: float
    laser: LaserSummary | None = None
    odometry: OdometrySummary | None = None
    camera: CameraSummary | None = None
    cloud: CloudSummary | None = None


@dataclass(frozen=True, slots=True)
class Inspection:
    """A log at a glance.

    Attributes
    ----------
    first_stamp_s, duration_s
        Earliest stamp, and latest minus earliest.
    sensors
        By name.
    records, ignored
        Records used and not used, by type in the file.
    dropped, notes
        Damaged records by reason, and oddities, with counts and first lines.
    odometry_jumps
        Odometry steps faster than any robot; ``largest`` in metres.
    bag
        Topics, clocks and frames of a ROS bag.
    """

    name: str
    path: str
    first_stamp_s: float
    duration_s: float
    sensors: tuple[SensorSummary, ...]
    records: dict[str, int]
    ignored: dict[str, int]
    dropped: dict[str, Tally]
    notes: dict[str, Tally]
    odometry_jumps: Tally
    bag: BagSummary | None = None

    def to_dict(self) -> dict[str, object]:
        """Plain types for JSON; angles in radians, every number finite."""
        return asdict(self)


def inspect_dataset(dataset: Dataset) -> Inspection:
    """Read a log once, from end to end, and summarise it.

    Raises
    ------
    DatasetError
        The log cannot be read or holds nothing.
    BadRecordError
        A damaged record, where the dataset was opened with ``strict``.
    """
    streams: dict[str, _Stream] = {}
    earliest_s, latest_s = math.inf, -math.inf
    for measurement in dataset:
        stream = streams.setdefault(measurement.sensor, _Stream())
        stream.add_stamp(measurement.stamp_s)
        if isinstance(measurement, LaserScan):
            stream.add_scan(measurement)
        elif isinstance(measurement, RgbdFrame):
            stream.camera.add(measurement)
        elif isinstance(measurement, PointCloud):
            stream.cloud.add(measurement)
        else:
            stream.add_odometry(measurement)
        earliest_s = min(earliest_s, measurement.stamp_s)
        latest_s = max(latest_s, measurement.stamp_s)
    report = dataset.report
    return Inspection(
        name=dataset.name,
        path=str(dataset.path),
        first_stamp_s=earliest_s,
        duration_s=latest_s - earliest_s,
        sensors=tuple(
            streams[name].summary(name, earliest_s, report.backward_steps.get(name, Tally()))
            for name in sorted(streams)
        ),
        records=dict(report.records),
        ignored=dict(report.ignored),
        dropped=dict(report.dropped),
        notes=dict(report.notes),
        odometry_jumps=report.odometry_jumps,
        bag=bag_summary(dataset),
    )


@dataclass(slots=True)
class _Stream:
    """Running figures of one sensor."""

    count: int = 0
    intervals: Thinned = field(default_factory=Thinned)
    last_stamp_s: float | None = None
    gap_s: float = 0.0
    gap_from_s: float | None = None
    beams: Counter[str] = field(default_factory=Counter)
    beams_min: int = 0
    beams_max: int = 0
    longest_return_m: float | None = None
    last_scan: LaserScan | None = None
    last_odometry: WheelOdometry | None = None
    path_m: float = 0.0
    rotation_rad: float = 0.0
    camera: CameraFigures = field(default_factory=CameraFigures)
    cloud: CloudFigures = field(default_factory=CloudFigures)

    def add_stamp(self, stamp_s: float) -> None:
        """Rate and gaps; a backward step is no interval."""
        self.count += 1
        if self.last_stamp_s is not None and (interval_s := stamp_s - self.last_stamp_s) > 0.0:
            self.intervals.add(interval_s)
            if interval_s > self.gap_s:
                self.gap_s, self.gap_from_s = interval_s, self.last_stamp_s
        self.last_stamp_s = stamp_s

    def add_scan(self, scan: LaserScan) -> None:
        """Beams, returns, and what the rest of them say."""
        ranges = scan.ranges_m
        returns = ranges[np.isfinite(ranges)]
        self.beams.update(
            all=ranges.size,
            invalid=int(np.count_nonzero(np.isnan(ranges))),
            no_return=int(np.count_nonzero(np.isinf(ranges))),
        )
        if returns.size:
            self.longest_return_m = max(self.longest_return_m or 0.0, float(returns.max()))
        self.beams_min = ranges.size if self.last_scan is None else min(self.beams_min, ranges.size)
        self.beams_max = max(self.beams_max, ranges.size)
        self.last_scan = scan

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Path and turning."""
        if self.last_odometry is not None:
            step = self.last_odometry.T_odom_base.between(reading.T_odom_base)
            self.path_m += math.hypot(step.x(), step.y())
            self.rotation_rad += abs(step.theta())
        self.last_odometry = reading

    def summary(self, sensor: str, origin_s: float, backward: Tally) -> SensorSummary:
        """The figures, frozen."""
        median_s = self.intervals.median()
        return SensorSummary(
            sensor=sensor,
            count=self.count,
            rate_hz=None if median_s is None else 1.0 / median_s,
            longest_gap_s=self.gap_s,
            longest_gap_at_s=0.0 if self.gap_from_s is None else self.gap_from_s - origin_s,
            clock_steps_backward=backward.count,
            largest_clock_step_s=backward.largest,
            laser=None if self.last_scan is None else self._laser(self.last_scan),
            odometry=OdometrySummary(self.path_m, self.rotation_rad) if self.last_odometry else None,
            camera=self.camera.summary(),
            cloud=self.cloud.summary(),
        )

    def _laser(self, scan: LaserScan) -> LaserSummary:
        """The laser's part of the figures."""
        return LaserSummary(
            beams_min=self.beams_min,
            beams_max=self.beams_max,
            first_angle_rad=scan.start_angle_rad,
            last_angle_rad=scan.start_angle_rad + scan.step_rad * (scan.ranges_m.size - 1),
            step_rad=scan.step_rad,
            range_max_m=scan.range_max_m,
            longest_return_m=self.longest_return_m,
            no_return_share=self.beams["no_return"] / self.beams["all"],
            invalid_share=self.beams["invalid"] / self.beams["all"],
            mount_x_m=scan.T_base_laser.x(),
            mount_y_m=scan.T_base_laser.y(),
            mount_yaw_rad=scan.T_base_laser.theta(),
        )
