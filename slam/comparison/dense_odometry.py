"""Dense RGB-D odometry with Open3D (Park 2017), initialised by ORB features (Yang2021) or a guess."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from slam.comparison.open3d_library import load_open3d
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.measurements import FloatArray
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, covariance_of

# With this `rgbd_odometry.correlated_points`, surface points have no weight, so that features decide.
POINTS_IGNORED = 1e9
_ITERATIONS = (6, 4, 3)  # per level, coarse to fine
_INTENSITY_SCALE = 0.1  # of the Huber kernel on brightness, 0..1
# Like GTSAM, Open3D has rotation first, but it counts each pixel as an independent reading of 1 m^-2.
_LEAST_FITNESS = 0.3
# Far from the initial guess, the method finds other minima, so such results are rejected.
_REACH_RAD, _REACH_M = 0.07, 0.13


class DenseOdometry:
    """Aligns a frame to the nearest keyframe by surfaces and brightness; by features if that fails."""

    def __init__(self, config: Config) -> None:
        self._match, self._config = config.match, config.rgbd_odometry
        features = self._config.model_copy(update={"correlated_points": POINTS_IGNORED})
        self._by_features = FrameMatcher(config.model_copy(update={"rgbd_odometry": features}))

    def match(
        self, frame: PreparedFrame, local: list[VisualKeyframe], guess: gtsam.Pose3
    ) -> VisualMatch | None:
        """See `slam.odometry.rgbd_odometry.RgbdOdometry`."""
        seed = self._by_features.match(frame, local, guess)
        start = seed.pose if seed is not None else guess
        keyframe = local[0]
        o3d = load_open3d()

        odometry = o3d.t.pipelines.odometry
        source, target = _image(frame), _image(keyframe.frame)
        depth_m, k = frame.depth
        camera = o3d.core.Tensor.from_numpy(np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]]))
        farthest_m = float(depth_m.max())
        if farthest_m <= 0.0:
            return seed
        loss = odometry.OdometryLossParams(self._config.gate_m, 0.5 * self._config.gate_m, _INTENSITY_SCALE)
        try:
            result = odometry.rgbd_odometry_multi_scale(
                source,
                target,
                camera,
                o3d.core.Tensor.from_numpy(keyframe.pose.between(start).matrix()),
                1.0,
                farthest_m,
                [odometry.OdometryConvergenceCriteria(count) for count in _ITERATIONS],
                odometry.Method.Hybrid,
                loss,
            )
        except RuntimeError:
            return seed  # Open3D's result for a singular system
        step: FloatArray = result.transformation.numpy()
        if not np.isfinite(step).all() or result.fitness < _LEAST_FITNESS:
            return seed
        offset = gtsam.Pose3.Logmap(keyframe.pose.between(start).between(_exact(step)))
        if np.linalg.norm(offset[:3]) > _REACH_RAD or np.linalg.norm(offset[3:]) > _REACH_M:
            return seed
        information = odometry.compute_odometry_information_matrix(
            source.depth, target.depth, camera, result.transformation, self._config.gate_m, 1.0, farthest_m
        ).numpy()
        return self._judge(
            keyframe, step, information, float(result.inlier_rmse), float(result.fitness), seed
        )

    def _judge(
        self,
        keyframe: VisualKeyframe,
        step: FloatArray,
        information: FloatArray,
        residual_m: float,
        fitness: float,
        seed: VisualMatch | None,
    ) -> VisualMatch:
        """Rescale Open3D's information from 1 m to the measured residual, and from pixels to readings."""
        config = self._config
        variance = max(residual_m, config.depth_floor_m) ** 2
        T_keyframe_camera = _exact(step)
        # Open3D's matrix is for a motion of the target frame; the covariance must be in the camera frame.
        adjoint = T_keyframe_camera.AdjointMap()
        scaled = adjoint.T @ information @ adjoint / (config.correlated_points * variance)
        covariance, weak = covariance_of(scaled, fitness, self._match)
        motion = MotionEstimate(
            T_reference_base=keyframe.pose.compose(T_keyframe_camera),
            covariance=covariance,
            inlier_share=fitness,
            fit=fitness,
            residual_m=residual_m,
            converged=True,
            degenerate=bool(weak.any()),
            weak_direction=weak,
        )
        return VisualMatch(
            motion,
            fitness,
            seed.feature_count if seed else 0,
            seed.residual_px if seed else 0.0,
        )


def _exact(step: FloatArray) -> gtsam.Pose3:
    """A pose from a transform (4, 4) in single precision, with orthonormalised rotation."""
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(step[:3, :3]), step[:3, 3])


def _image(frame: PreparedFrame) -> Any:
    """The frame as an RGBDImage of Open3D, reduced to the size of its depth image."""
    import cv2

    o3d = load_open3d()

    depth_m = frame.depth[0]
    height, width = depth_m.shape
    color = cv2.resize(frame.frame.color, (width, height), interpolation=cv2.INTER_AREA)
    return o3d.t.geometry.RGBDImage(
        o3d.t.geometry.Image(np.ascontiguousarray(color)),
        o3d.t.geometry.Image(np.ascontiguousarray(depth_m)),
    )
