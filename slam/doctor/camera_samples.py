"""Data of an RGB-D camera for the doctor: its motions in stretches of the log, from matched features."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fusion.height_band import back_project, pixel_rays
from fusion.time_alignment import GAP_S
from slam.config.stages import RgbdConfig, RgbdOdometryConfig
from slam.doctor.depth_lag import DepthLag
from slam.doctor.stretches import Repeats, Stretches
from slam.measurements import CameraIntrinsics, FloatArray, RgbdFrame
from slam.vision.feature_pose import pose_from_features
from slam.vision.features import Features, extract_features, gray_of, match_features

# Pixel step along rows and columns for the sample of depths.
_EVERY_PIXEL = 16
# Frames that are matched to the newest: the previous one for motion, an earlier one for the lens.
_BACK = (1, 6)
SPREAD = 0.2  # largest residual of a fit, as a fraction of a sensor's motions
_MODELS, _WAYS = RgbdConfig(), RgbdOdometryConfig()


@dataclass(frozen=True, slots=True)
class SensorStep:
    """A sensor's motion between two stamps of its own clock, ``T_begun_ended``."""

    begun_s: float
    ended_s: float
    motion: gtsam.Pose3


@dataclass(frozen=True, slots=True)
class MatchedPair:
    """Features that two frames share, as columns, rows and depths: (N, 3) for each frame."""

    first: FloatArray
    second: FloatArray


@dataclass(slots=True)
class CameraSamples:
    """Samples of one camera.

    Attributes
    ----------
    steps
        Motions by stretch.
    pairs
        Features of frames that are some distance apart, for the lens.
    points
        (N, 3) blocks of points that it saw, camera frame, with the stated intrinsics.
    count, repeats
        Number of frames, and of those that are bit-identical to the previous one.
    """

    steps: list[list[SensorStep]] = field(default_factory=list)
    pairs: list[MatchedPair] = field(default_factory=list)
    points: list[FloatArray] = field(default_factory=list)
    count: int = 0
    repeats: Repeats = field(default_factory=Repeats)
    lag: DepthLag = field(default_factory=DepthLag)
    intrinsics: CameraIntrinsics | None = None
    T_base_camera: gtsam.Pose3 | None = None
    _stretches: Stretches = field(default_factory=Stretches)
    _recent: deque[tuple[float, Features]] = field(default_factory=lambda: deque(maxlen=max(_BACK)))
    _newest: RgbdFrame | None = None

    def add(self, frame: RgbdFrame, *, compared: bool) -> None:
        """Add the next frame; its motion is only computed if it will be compared with another sensor's."""
        self.count += 1
        if self.repeats.take(self._newest, frame):
            return
        self._newest, self.intrinsics, self.T_base_camera = frame, frame.intrinsics, frame.T_base_camera
        if not self._stretches.wants(frame.stamp_s):
            return
        if self._recent and not 0.0 < frame.stamp_s - self._recent[-1][0] < GAP_S:
            self._recent.clear()
        if self._stretches.begins:
            if self._stretches.thinned:
                del self.steps[1::2], self.pairs[1::2], self.points[1::2]
            self.steps.append([])
            self._look(frame)
        gray = gray_of(frame)
        self.lag.add(frame.stamp_s, gray, frame.depth_m)
        features = extract_features(gray, frame.depth_m, _MODELS.features, again=True)
        features = features.where(features.depth_m > 0.0)
        for back in _BACK[0 if compared else 1 :]:
            if back <= len(self._recent):
                self._match(*self._recent[-back], features, frame, back)
        self._recent.append((frame.stamp_s, features))

    def _look(self, frame: RgbdFrame) -> None:
        """Sample depths and points."""
        depth_m, rays = frame.depth_m, pixel_rays(frame.depth_m.shape, frame.intrinsics)
        every = slice(None, None, _EVERY_PIXEL)
        self.points.append(back_project(depth_m[every, every], rays[every, every]))

    def _match(
        self, begun_s: float, known: Features, features: Features, frame: RgbdFrame, back: int
    ) -> None:
        """Match to the previous frame for motion, or to an earlier one for a pair."""
        matches = match_features(known.descriptors, features.descriptors, _WAYS.match_ratio)
        one, other = known.where(matches.first), features.where(matches.second)  # type: ignore[arg-type]
        found = pose_from_features(
            one.points_camera(frame.intrinsics),
            other.pixels.astype(np.float64),
            frame.intrinsics,
            _WAYS.kernel_sigmas,
            _WAYS.least_inliers,
        )
        if found is None:
            return
        if back == 1:
            self.steps[-1].append(SensorStep(begun_s, frame.stamp_s, found.T_reference_camera))
            return
        rows = [
            np.column_stack([side.pixels, side.depth_m])[found.inliers].astype(np.float64)
            for side in (one, other)
        ]
        self.pairs.append(MatchedPair(rows[0], rows[1]))
