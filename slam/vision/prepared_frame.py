"""Data that odometry needs of an RGB-D frame, computed once; can be done ahead in another thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np

from slam.config.stages import RgbdConfig
from slam.measurements import CameraIntrinsics, Float32Array, Measurement, RgbdFrame
from slam.vision.color_registration import ColorRegistration, register_features
from slam.vision.features import Features, extract_features, gray_of
from slam.vision.surface import Surface, SurfacePoints, points_of, surface_of, working_depth


class PreparedFrame:
    """A frame with its features and surfaces, each computed at first use.

    Parameters
    ----------
    config
        Numbers of features and points, and the resolution.
    registration
        Pose of the colour camera; None if colour is registered to depth.
    features
        Where they are known.
    """

    def __init__(
        self,
        frame: RgbdFrame,
        config: RgbdConfig,
        registration: ColorRegistration | None = None,
        features: Features | None = None,
    ) -> None:
        self.frame = frame
        self._config = config
        self._registration = registration
        if features is not None:
            self.features = features

    @property
    def stamp_s(self) -> float:
        """Return the stamp of the frame."""
        return self.frame.stamp_s

    def forget_surface(self) -> None:
        """Discard large data that are quickly recomputed from the depth image."""
        _ = self.median_depth_m
        self.__dict__.pop("surface", None)
        self.__dict__.pop("points", None)

    @cached_property
    def features(self) -> Features:
        """Return features at full resolution, all in the depth camera's image."""
        depth_m = self.frame.depth_m
        features = extract_features(gray_of(self.frame), depth_m, self._config.features)
        if self._registration is None:
            return features
        pixels, depth_m = register_features(features.pixels, depth_m, self._registration)
        return Features(pixels, features.descriptors, features.sigma_px, depth_m).where(depth_m > 0.0)

    @cached_property
    def depth(self) -> tuple[Float32Array, CameraIntrinsics]:
        """Return the reduced depth image and its intrinsics."""
        return working_depth(self.frame.depth_m, self.frame.intrinsics, self._config.working_width)

    @cached_property
    def points(self) -> SurfacePoints:
        """Return the surface points of the reduced depth image."""
        config = self._config
        return points_of(*self.depth, config.plane_radius, config.farthest_m, config.points)

    @cached_property
    def surface(self) -> Surface:
        """Return the whole surface, which only a keyframe needs."""
        return surface_of(*self.depth, self._config.plane_radius, self._config.farthest_m)

    @cached_property
    def median_depth_m(self) -> float:
        """Return the median depth of the surface points; 1 without any."""
        return float(np.median(self.points.points[:, 2])) if len(self.points) else 1.0


class FramePreparer:
    """Extracts features and surface points; the colour camera may be another than the depth camera.

    Parameters
    ----------
    config
        How many of them, and at which resolution.
    registrations
        Registrations by camera name; one that was not accepted has no effect.
    idle
        Whether frames are returned without data, which are then computed at first use.
    """

    def __init__(
        self,
        config: RgbdConfig,
        registrations: Mapping[str, ColorRegistration],
        idle: Callable[[], bool] = lambda: False,
    ) -> None:
        self._config = config
        self._registrations = {name: known for name, known in registrations.items() if known.accepted}
        self._idle = idle

    def __call__(self, measurement: Measurement) -> Measurement | PreparedFrame:
        """Return a frame with its features; other measurements unchanged."""
        if not isinstance(measurement, RgbdFrame):
            return measurement
        frame = PreparedFrame(measurement, self._config, self._registrations.get(measurement.sensor))
        if not self._idle():
            _ = frame.features, frame.points  # the data for a match
        return frame
