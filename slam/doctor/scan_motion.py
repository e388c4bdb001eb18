"""Motion of a lidar over short stretches, from its scans alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.config import Config
from slam.doctor.camera_samples import SensorStep
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import weak_direction
from slam.matching.planar import between, compose
from slam.matching.scan_points import points_by
from slam.measurements import FloatArray, LaserScan, pose2_from_row


@dataclass(frozen=True, slots=True)
class ScanMotion:
    """One stretch, or a part of it.

    Attributes
    ----------
    stamps_s
        (N,) stamps of the matched scans.
    poses
        (N, 3) poses of the laser in its first frame.
    fits
        (N - 1,) robust share of each scan's points that agree with the matched surfaces.
    """

    stamps_s: FloatArray
    poses: FloatArray
    fits: FloatArray


@dataclass(frozen=True, slots=True)
class Steps:
    """Motions of a lidar: (K,) stretch, (K, 2) stamps at the ends, (K, 3) motion in its own frame."""

    stretch: FloatArray
    spans_s: FloatArray
    motions: FloatArray

    @classmethod
    def of(cls, tracked: Sequence[ScanMotion], config: Config) -> Steps:
        """Consecutive steps, each as short as the distance to a new keyframe."""
        rows = list[tuple[float, ...]]()
        for number, one in enumerate(tracked):
            first = 0
            for i in range(1, len(one.stamps_s)):
                step = between(one.poses[first], one.poses[i])
                if config.keyframes.due(*step.tolist()):
                    rows.append((number, one.stamps_s[first], one.stamps_s[i], *step))
                    first = i
        table = np.array(rows).reshape(-1, 6)
        return cls(table[:, 0], table[:, 1:3], table[:, 3:])

    def __len__(self) -> int:
        return len(self.stretch)

    def in_space(self) -> list[SensorStep]:
        """Convert to steps of a sensor in 3D."""
        return [
            SensorStep(begun_s, ended_s, gtsam.Pose3(pose2_from_row(motion)))
            for (begun_s, ended_s), motion in zip(self.spans_s.tolist(), self.motions, strict=True)
        ]


def track_stretches(
    stretches: Iterable[Sequence[LaserScan]], config: Config, angle_scale: float = 1.0
) -> list[ScanMotion]:
    """Match the scans of each stretch to its start, predicted only by their own motion so far.

    A stretch starts again if a match fails or is degenerate (a corridor). ``angle_scale`` is a factor of all
    bearings, about the centre of the field of view.
    """
    return [
        one for scans in stretches for one in _track([_turned(scan, angle_scale) for scan in scans], config)
    ]


def _turned(scan: LaserScan, angle_scale: float) -> LaserScan:
    """A scan in the laser's own frame, with another angular step."""
    half_rad = 0.5 * scan.step_rad * (scan.ranges_m.size - 1)
    return replace(
        scan,
        start_angle_rad=scan.start_angle_rad + half_rad * (1.0 - angle_scale),
        step_rad=scan.step_rad * angle_scale,
        T_base_laser=gtsam.Pose2(),
    )


def _track(scans: Sequence[LaserScan], config: Config) -> Iterator[ScanMotion]:
    """Track one stretch; failed matches split it into parts."""
    limits = config.match
    points = [OrientedPoints.from_scan(points_by(config.scan, scan)) for scan in scans]
    begun = 0
    while begun < len(scans) - 1:
        poses, reference, fits, step = [np.zeros(3)], np.zeros(3), list[float](), np.zeros(3)
        local_map = LocalMap.build([points[begun]], limits)
        for now in range(begun + 1, len(scans)):
            if config.keyframes.due(*between(reference, poses[-1]).tolist()):
                reference, local_map = poses[-1], LocalMap.build([points[now - 1]], limits)
            found = local_map.align(points[now], compose(between(reference, poses[-1]), step))
            fits_well = found.inlier_share >= limits.confident_inlier_share and found.converged
            if not fits_well or weak_direction(found, limits.degenerate_share) is not None:
                break
            fits.append(found.fit)
            poses.append(compose(reference, found.pose))
            step = between(poses[-2], poses[-1])
        if fits:
            stamps_s = np.array([scan.stamp_s for scan in scans[begun : begun + len(poses)]])
            yield ScanMotion(stamps_s, np.array(poses), np.array(fits))
        begun += len(poses)
