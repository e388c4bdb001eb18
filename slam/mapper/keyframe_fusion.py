"""Mutual repair of scan and depth images of each keyframe, without calibration between them (Xu2024)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import fusion
from slam.config.stages import FusionConfig
from slam.forked import Begun
from slam.mapper.robot_cameras import Picture
from slam.mapping.sensor_packing import depth_steps_per_m, packed_depth, unpacked_depth
from slam.measurements import CameraIntrinsics, Float32Array, FloatArray, LaserScan, RgbdFrame
from slam.spool import Spool

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FusionPair:
    """Registration result of one keyframe.

    Attributes
    ----------
    u, grade
        Best offset along the lidar curve, and the reliability of the pair.
    repaired
        (5,) beams by `fusion.Provenance`; None if nothing was repaired.
    """

    stamp_s: float
    u: int
    grade: fusion.Grade
    repaired: NDArray[np.int64] | None = None


@dataclass(frozen=True, slots=True)
class FusionSummary:
    """Fusion result of a run.

    Attributes
    ----------
    pairs
        One a keyframe with scan and images.
    estimate
        Estimate of the rig from the whole drive; None if it could not be estimated.
    note
        Summary for the user in one line.
    """

    pairs: list[FusionPair]
    estimate: fusion.RigEstimate | None
    note: str


class _DepthSpool:
    """Depth images of keyframes, stored on disk."""

    def __init__(self) -> None:
        self._packed, self._heads = Spool(), list[tuple[float, CameraIntrinsics]]()

    def __len__(self) -> int:
        return len(self._heads)

    def add(self, frame: RgbdFrame) -> None:
        """Store the next image."""
        steps_per_m = depth_steps_per_m(frame)
        self._packed.append(packed_depth(frame.depth_m, steps_per_m))
        self._heads.append((steps_per_m, frame.intrinsics))

    def depth(self, index: int, T_level_camera: FloatArray) -> fusion.DepthImage:
        """Return an image in the form that fusion takes."""
        steps_per_m, camera = self._heads[index]
        depth_m = unpacked_depth(self._packed[index], steps_per_m, camera)
        return fusion.DepthImage(depth_m, camera, T_level_camera)


class KeyframeFusion:
    """Collects the pairs of a run, then repairs every scan with the rig estimated from all pairs."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._rig = fusion.Rig()
        self._images = _DepthSpool()
        self._pairs: list[FusionPair] = []
        self._views: dict[int, tuple[range, tuple[FloatArray, ...]]] = {}
        self._cameras = 0

    def add(self, key: int, scan: LaserScan, pictures: Sequence[Picture]) -> None:
        """Store the scan of a keyframe with the newest image of every camera."""
        in_time = [p for p in pictures if abs(p.frame.stamp_s - scan.stamp_s) <= self._config.tolerance_s]
        if not in_time or len(in_time) < self._cameras:
            return  # a pair is compared by all cameras or not at all
        if len(in_time) > self._cameras:
            # Another camera has started: pairs of fewer cameras belong to another rig.
            self._cameras, self._rig = len(in_time), fusion.Rig()
            self._pairs.clear()
            self._views.clear()
        frames = [picture.frame.frame for picture in in_time]
        turns = tuple(picture.T_base_camera.rotation().matrix() for picture in in_time)
        try:
            pair = fusion.register(_curve(scan), _depths(frames, turns))
        except ValueError:
            return  # nothing to compare: no common reading
        self._rig.add(pair)
        first = len(self._images)
        for frame in frames:
            self._images.add(frame)
        self._views[key] = (range(first, first + len(frames)), turns)
        self._pairs.append(FusionPair(scan.stamp_s, pair.u, pair.grade))

    def repair(
        self, scans: Sequence[LaserScan | None]
    ) -> tuple[list[LaserScan | None], FusionSummary | None]:
        """Return the scans of all keyframes, repaired if the pairs suffice to estimate the rig."""
        if not self._pairs:
            return list(scans), None
        estimate = self._rig.estimate() if len(self._pairs) >= self._config.least_pairs else None
        if estimate is None:
            note = f"{len(self._pairs)} pairs of scan and image do not fix the rig: nothing was repaired"
            return list(scans), FusionSummary(self._pairs, None, note)
        views = list(self._views.items())
        half = len(views) // 2

        def repairs(first: int, end: int) -> list[tuple[NDArray[np.int64] | None, Float32Array | None, str]]:
            return [self._repaired(scans[key], *view, estimate) for key, view in views[first:end]]

        rest = Begun(lambda: repairs(half, len(views)))
        repaired = list(scans)
        pairs: list[FusionPair] = []
        for (key, _), pair, result in zip(views, self._pairs, repairs(0, half) + rest(), strict=True):
            counts, ranges_m, fault = result
            scan = scans[key]
            if scan is None:
                continue
            if fault:
                log.warning("keyframe %d was not repaired: %s", key, fault)
            pairs.append(pair if fault else replace(pair, repaired=counts))
            if ranges_m is not None:
                repaired[key] = replace(scan, ranges_m=ranges_m)
        return repaired, FusionSummary(pairs, estimate, _note(pairs, estimate))

    def _repaired(
        self,
        scan: LaserScan | None,
        numbers: range,
        turns: tuple[FloatArray, ...],
        estimate: fusion.RigEstimate,
    ) -> tuple[NDArray[np.int64] | None, Float32Array | None, str]:
        """Return beams by `fusion.Provenance` and ranges, or None and the reason why nothing was repaired."""
        if scan is None:
            return None, None, ""
        depths = [self._images.depth(image, turn) for image, turn in zip(numbers, turns, strict=True)]
        try:
            result = fusion.denoise(_curve(scan), depths, estimate)
        except ValueError as error:  # an image that is not like the others: the scan stays as it is
            return None, None, str(error)
        if not result.applied:
            return None, None, ""
        counts = np.bincount(result.lidar_source, minlength=len(fusion.Provenance))
        return counts, _with_repairs(scan, result), ""


def _with_repairs(scan: LaserScan, result: fusion.Denoised) -> Float32Array:
    """Return the ranges of a scan, with those beams replaced that the repair has changed."""
    touched = (result.lidar_source != fusion.Provenance.MEASURED) & (
        result.lidar_source != fusion.Provenance.HOLE
    )
    return np.where(touched, result.ranges_m, scan.ranges_m).astype(np.float32)


def _curve(scan: LaserScan) -> fusion.LidarCurve:
    """Return a scan in the form that fusion takes."""
    return fusion.LidarCurve(scan.ranges_m, scan.start_angle_rad, scan.step_rad, scan.range_max_m)


def _depths(frames: Sequence[RgbdFrame], turns: Sequence[FloatArray]) -> list[fusion.DepthImage]:
    """Return depth images in the form that fusion takes: no position, only the direction of up."""
    return [
        fusion.DepthImage(frame.depth_m, frame.intrinsics, turn)
        for frame, turn in zip(frames, turns, strict=True)
    ]


def _note(pairs: Sequence[FusionPair], estimate: fusion.RigEstimate) -> str:
    """Return a note on what was found and repaired."""
    counts = np.sum([pair.repaired for pair in pairs if pair.repaired is not None], axis=0)
    high = sum(pair.grade == fusion.Grade.HIGH for pair in pairs)
    yaw = f"{np.degrees(estimate.yaw_rad):.1f} degrees"
    filled = counts[fusion.Provenance.FILLED] if np.ndim(counts) else 0
    interpolated = counts[fusion.Provenance.INTERPOLATED] if np.ndim(counts) else 0
    drift = "; the last pairs differ: a sensor may have moved" if estimate.drift else ""
    return (
        f"fusion of {len(pairs)} keyframes ({high} of high grade): lidar {-estimate.height_m:.2f} m below "
        f"the camera, yaw between them {yaw}; "
        f"{filled:,} beams filled, {interpolated:,} interpolated{drift}"
    )
