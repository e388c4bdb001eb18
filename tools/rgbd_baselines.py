"""Run unmodified RGB-D odometry of other libraries, frame to frame from identity; see ``benchmark_rgbd.py``.

    python tools/rgbd_baselines.py BASELINE FOLDER OUT.tum

Each uses the defaults of its library. A failed step counts as no motion; their number is printed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.comparison.open3d_library import load_open3d
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.measurements import RgbdFrame
from slam.storage.tum import write_tum

Matrix: TypeAlias = NDArray[np.float64]
# Takes a frame; its motion since the frame before, T_before_frame, None where it fails.
Step: TypeAlias = Callable[[RgbdFrame], Matrix | None]

_RATIO = 0.8
_LEAST_MATCHES = 6
_RANSAC_PX = 3.0
_RANSAC_ROUNDS = 500
_FEATURES = 1000
_FARTHEST_M = 4.0


def main() -> None:
    """Run one baseline over a dataset and write its trajectory."""
    name, folder, out = sys.argv[1:]
    make, every = BASELINES[name]
    frames = (reading for reading in open_dataset(Path(folder)) if isinstance(reading, RgbdFrame))
    step: Step | None = None
    pose = np.eye(4)
    stamps, poses, failed = [], [], 0
    for number, frame in enumerate(frames):
        if number % every:
            continue
        step = step or make(frame)
        motion = step(frame)
        failed += motion is None and bool(poses)
        pose = pose if motion is None else pose @ motion
        stamps.append(frame.stamp_s)
        poses.append(pose)
    write_tum(Path(out), trajectory_of(stamps, poses))
    if failed:
        print(f"{failed} of {len(poses) - 1} steps failed")


def trajectory_of(stamps_s: list[float], poses: list[Matrix]) -> Trajectory:
    """Matrices as a trajectory."""
    import gtsam

    quaternions = []
    for pose in poses:
        q: Any = gtsam.Rot3(pose[:3, :3]).toQuaternion()
        quaternions.append([q.x(), q.y(), q.z(), q.w()])
    return Trajectory(np.array(stamps_s), np.array([pose[:3, 3] for pose in poses]), np.array(quaternions))


def camera_matrix(frame: RgbdFrame) -> Matrix:
    """(3, 3) intrinsics."""
    k = frame.intrinsics
    return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])


def open3d_step(method: str) -> Callable[[RgbdFrame], Step]:
    """Open3D's multi-scale tensor odometry by one of its methods."""

    def make(first: RgbdFrame) -> Step:
        o3d = load_open3d()
        odometry = o3d.t.pipelines.odometry
        camera = o3d.core.Tensor.from_numpy(camera_matrix(first))
        before: list[Any] = []

        def step(frame: RgbdFrame) -> Matrix | None:
            image = o3d.t.geometry.RGBDImage(
                o3d.t.geometry.Image(np.ascontiguousarray(frame.color)),
                o3d.t.geometry.Image(np.ascontiguousarray(frame.depth_m)),
            )
            before.append(image)
            if len(before) < 2:
                return None
            try:
                found = odometry.rgbd_odometry_multi_scale(
                    image,
                    before.pop(0),
                    camera,
                    depth_scale=1.0,
                    depth_max=_FARTHEST_M,
                    method=getattr(odometry.Method, method),
                )
            except RuntimeError:
                return None
            motion: Matrix = found.transformation.numpy()
            return motion if np.isfinite(motion).all() else None

        return step

    return make


def opencv_step(first: RgbdFrame) -> Step:
    """OpenCV's RGB-D odometry."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera_matrix(first).astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    before: list[Any] = []

    def step(frame: RgbdFrame) -> Matrix | None:
        depth = np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan))
        prepared = cv2.OdometryFrame(depth, cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        odometry.prepareFrame(prepared)
        before.append(prepared)
        if len(before) < 2:
            return None
        done, motion = odometry.compute(before[1], before.pop(0))
        return np.asarray(motion, dtype=np.float64) if done else None

    return step


def orb_step(first: RgbdFrame) -> Step:
    """ORB features, brute-force matching with ratio test, PnP-RANSAC on the depth of the frame before."""
    camera = camera_matrix(first)
    orb = cv2.ORB_create(_FEATURES)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    before: list[tuple[Any, Any, RgbdFrame]] = []

    def step(frame: RgbdFrame) -> Matrix | None:
        keypoints, descriptors = orb.detectAndCompute(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), None)
        before.append((keypoints, descriptors, frame))
        if len(before) < 2:
            return None
        known, known_descriptors, last = before.pop(0)
        if descriptors is None or known_descriptors is None:
            return None
        pairs = [
            pair[0]
            for pair in matcher.knnMatch(known_descriptors, descriptors, k=2)
            if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance
        ]
        points, pixels = [], []
        for pair in pairs:
            u, v = known[pair.queryIdx].pt
            z = float(
                last.depth_m[
                    min(round(v), last.depth_m.shape[0] - 1), min(round(u), last.depth_m.shape[1] - 1)
                ]
            )
            if 0.0 < z < _FARTHEST_M:
                points.append(
                    [(u - camera[0, 2]) * z / camera[0, 0], (v - camera[1, 2]) * z / camera[1, 1], z]
                )
                pixels.append(keypoints[pair.trainIdx].pt)
        if len(points) < _LEAST_MATCHES:
            return None
        cv2.setRNGSeed(0)
        done, turn, shift, _ = cv2.solvePnPRansac(
            np.array(points), np.array(pixels), camera, None, iterationsCount=_RANSAC_ROUNDS,
            reprojectionError=_RANSAC_PX,
        )  # fmt: skip
        if not done:
            return None
        T_frame_before = np.eye(4)
        T_frame_before[:3, :3] = cv2.Rodrigues(turn)[0]
        T_frame_before[:3, 3] = shift[:, 0]
        return np.linalg.inv(T_frame_before)

    return step


# What makes the step, and every how manieth frame is used.
BASELINES: dict[str, tuple[Callable[[RgbdFrame], Step], int]] = {
    "Open3D hybrid": (open3d_step("Hybrid"), 1),
    "Open3D point-to-plane": (open3d_step("PointToPlane"), 1),
    "Open3D intensity": (open3d_step("Intensity"), 1),
    "cv2.Odometry RGB-D": (opencv_step, 1),
    "ORB + PnP-RANSAC": (orb_step, 1),
    "ORB + PnP-RANSAC, every 5th frame": (orb_step, 5),
}

if __name__ == "__main__":
    main()
