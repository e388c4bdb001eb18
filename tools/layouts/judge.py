"""Checks whether a reader returns the contents of a sample."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from slam.measurements import CameraIntrinsics, ImuReading, LaserScan, PointCloud, RgbdFrame, WheelOdometry
from tools.layouts.samples import CameraTruth, CloudTruth, Sample, ScanTruth
from tools.layouts.world import hits, looked_at

_STEP_S = 2e-4  # stamps are alike within it
_LENS_SHARE = 0.003
_DEPTH_SHARE = 0.006  # in the middle of all pixels
_GREYS = 14.0


def problems(dataset: Any, sample: Sample) -> list[str]:
    """Differences from the truth, read through the Python interface; none if everything is right."""
    readings = list(dataset)
    found: list[str] = []
    frames: dict[str, list[RgbdFrame]] = {}
    scans: dict[str, list[LaserScan]] = {}
    for one in readings:
        if isinstance(one, RgbdFrame):
            frames.setdefault(one.sensor, []).append(one)
        elif isinstance(one, LaserScan):
            scans.setdefault(one.sensor, []).append(one)
    for kind, got, wanted in (("cameras", frames, sample.cameras), ("2D lidars", scans, sample.scans)):
        if len(got) != len(wanted):
            found.append(f"{len(got)} of {len(wanted)} {kind}: {' '.join(sorted(got))}")
    for name, truth in zip(sorted(frames), sample.cameras, strict=False):
        found += [f"{name}: {words}" for words in _camera(frames[name], truth)]
    for name, scan in zip(sorted(scans), sample.scans, strict=False):
        found += [f"{name}: {words}" for words in _scans(scans[name], scan)]
    clouds = [one for one in readings if isinstance(one, PointCloud)]
    if bool(clouds) != (sample.cloud is not None):
        found.append(f"{len(clouds)} clouds")
    elif sample.cloud is not None:
        found += _clouds(clouds, sample.cloud)
    wheels = [one for one in readings if isinstance(one, WheelOdometry)]
    if len(wheels) < sample.wheels or (wheels and not sample.wheels):
        found.append(f"{len(wheels)} of {sample.wheels} readings of wheels")
    found += _imu([one for one in readings if isinstance(one, ImuReading)], sample.imu)
    if sample.moved is not None:
        found += _truth(dataset.groundtruth(), sample.moved)
    return found


def _stamps(got: list[Any], stamps_s: list[float]) -> list[str]:
    """Count, and steps between stamps."""
    if len(got) != len(stamps_s):
        return [f"{len(got)} of {len(stamps_s)}"]
    apart_s = np.abs(np.diff([one.stamp_s for one in got]) - np.diff(stamps_s)).max(initial=0.0)
    return [f"stamps {apart_s:.4f} s apart"] if apart_s > _STEP_S else []


def _mount(found: Any, wanted: Any) -> list[str]:
    """Whether a sensor sits where it does; without a mounting in the recording it may be at the origin."""
    if wanted is None:
        return []
    if found is None:
        return ["mounting not found"]
    apart = np.abs(found.matrix() - wanted).max()
    return [f"mounting off by {apart:.3f}"] if apart > 2e-3 else []


def _camera(frames: list[RgbdFrame], truth: CameraTruth) -> list[str]:
    """Lens, stamps, mounting, and whether depth and colour are what that lens sees from there."""
    words = [*_stamps(frames, truth.stamps_s), *_mount(frames[0].T_base_camera, truth.mount)]
    lens, wanted = frames[0].intrinsics, truth.lens
    if (lens.width, lens.height) != (wanted.width, wanted.height):
        words.append(f"{lens.width} x {lens.height}, not {wanted.width} x {wanted.height}")
    elif any(
        abs(getattr(lens, name) / getattr(wanted, name) - 1.0) > _LENS_SHARE
        for name in ("fx", "fy", "cx", "cy")
    ):
        words.append(f"lens {lens.fx:.1f} {lens.fy:.1f} {lens.cx:.1f} {lens.cy:.1f}")
    for frame, pose in list(zip(frames, truth.poses, strict=False))[:: max(1, len(frames) - 1)]:
        words += _looks(frame, lens, pose, grey=truth.grey)
    return list(dict.fromkeys(words))


def _looks(frame: RgbdFrame, lens: CameraIntrinsics, pose: Any, *, grey: bool) -> list[str]:
    """Depth against the room through the frame's own lens, colour against the points that its depth shows."""
    depth = np.asarray(frame.depth_m, np.float64)
    valid = depth > 0.0
    words = []
    if valid.mean() < 0.5:
        words.append(f"{valid.mean():.2f} of the depth valid")
    true = looked_at(lens, pose)
    share = np.median(np.abs(depth[valid] / true.depth_m[valid] - 1.0)) if valid.any() else 1.0
    if share > _DEPTH_SHARE:
        ratio = float(np.median(depth[valid] / true.depth_m[valid])) if valid.any() else 0.0
        words.append(f"depth off by {share:.3f}, ratio {ratio:.3f}")
    seen = np.asarray(frame.color, np.float64)
    lit = valid & seen.any(axis=2)
    wanted = true.color.astype(np.float64)
    if grey:
        weights = np.array([0.299, 0.587, 0.114])
        seen, wanted = (np.repeat((one @ weights)[..., None], 3, axis=2) for one in (seen, wanted))
    apart = np.median(np.abs(seen - wanted)[lit]) if lit.any() else 255.0
    if apart > _GREYS:
        words.append(f"colour off by {apart:.0f} of 255")
    return words


def _scans(scans: list[LaserScan], truth: ScanTruth) -> list[str]:
    """Stamps, mounting, and ranges at the true bearings, in the robot's frame."""
    words = _stamps(scans, truth.stamps_s)
    scan = scans[0]
    mount = scan.T_base_laser
    if truth.mount is not None:
        apart = np.abs([mount.x() - truth.mount[0], mount.y() - truth.mount[1]]).max()
        turned = abs(np.angle(np.exp(1j * (mount.theta() - truth.mount[2]))))
        if apart > 2e-3 or turned > 2e-3:
            words.append(f"mounting off by {apart:.3f} m, {turned:.3f} rad")
    bearings = scan.start_angle_rad + scan.step_rad * np.arange(scan.ranges_m.size)
    for got, ranges in list(zip(scans, truth.ranges_m, strict=False))[:2]:
        offsets = np.abs(np.angle(np.exp(1j * (bearings[:, None] - np.asarray(truth.bearings_rad)[None, :]))))
        nearest = offsets.argmin(axis=1)
        fits = (offsets.min(axis=1) < 1e-3) & np.isfinite(got.ranges_m)
        error = np.abs(got.ranges_m - np.asarray(ranges)[nearest])[fits]
        if fits.mean() < 0.9 or np.median(error) > 0.006:
            words.append(
                f"ranges: {fits.mean():.2f} of the beams, {np.median(error) if fits.any() else 9:.3f} m off"
            )
    return words


def _clouds(clouds: list[PointCloud], truth: CloudTruth) -> list[str]:
    """Stamps, mounting, points in any order, each with its time."""
    words = [*_stamps(clouds, truth.stamps_s), *_mount(clouds[0].T_base_lidar, truth.mount)]
    for number, cloud in list(enumerate(clouds))[:2]:
        if not truth.points:  # of packets, in the order of whoever decodes them
            pose = truth.poses[number]
            met = hits(pose[:3, 3], cloud.points_lidar.astype(np.float64) @ pose[:3, :3].T)
            off_m = np.median(np.abs(met - 1.0) * np.linalg.norm(cloud.points_lidar, axis=1))
            if len(cloud.points_lidar) < 10_000 or off_m > truth.apart_m:
                words.append(f"{len(cloud.points_lidar)} points, {off_m:.3f} m off")
            continue
        points, wanted = cloud.points_lidar, truth.points[min(number, len(truth.points) - 1)]
        if len(points) != len(wanted):
            words.append(f"{len(points)} of {len(wanted)} points")
            continue
        if np.abs(points - wanted).max() > truth.apart_m:
            points, wanted = (one[np.lexsort(np.round(one, 2).T)] for one in (points, wanted))
        if np.abs(points - wanted).max() > truth.apart_m:
            words.append("points differ")
        if truth.times_s is None:
            continue
        if cloud.times_s is None:
            words.append("no times of points")
            continue
        apart_s = np.abs(
            np.sort(cloud.times_s + cloud.stamp_s)
            - np.sort(
                np.asarray(truth.times_s[number])
                + truth.stamps_s[number]
                + clouds[0].stamp_s
                - truth.stamps_s[0]
            )
        )
        if apart_s.max() > 5e-4:
            words.append(f"times of points off by {apart_s.max():.4f} s")
    return list(dict.fromkeys(words))


def _imu(readings: list[ImuReading], wanted: int) -> list[str]:
    """A still IMU that feels gravity."""
    if len(readings) < wanted:
        return [f"{len(readings)} of {wanted} readings of an IMU"]
    if not wanted:
        return []
    forces = np.linalg.norm(np.mean([one.specific_force_m_s2 for one in readings], axis=0))
    rates = np.abs(np.mean([one.gyro_rad_s for one in readings], axis=0)).max()
    return [] if abs(forces - 9.81) < 0.1 and rates < 0.02 else [f"IMU feels {forces:.2f}, turns {rates:.3f}"]


def _truth(found: Any, poses: list[Any]) -> list[str]:
    """The true trajectory, in any frame."""
    if found is None or len(found) < 2:
        return ["no true trajectory"]
    if len(found) != len(poses):
        return [f"true trajectory of {len(found)}, not {len(poses)}"]
    first, last = (
        gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), found.positions_m[k])
        for k in (0, -1)
        for x, y, z, w in [found.quaternions_xyzw[k]]
    )
    step = first.between(last).matrix()
    wanted = np.linalg.inv(poses[0]) @ poses[-1]
    return [] if np.abs(step - wanted).max() < 5e-3 else ["true trajectory differs"]
