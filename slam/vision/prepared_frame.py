"""What odometry needs of an RGB-D frame, computed once; safe to do ahead in another thread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.config_stages import RgbdConfig
from slam.measurements import CameraIntrinsics, Float32Array, Measurement, RgbdFrame
from slam.vision.color_registration import ColorRegistration, register_features
from slam.vision.features import Features, extract_features, gray_of
from slam.vision.surface import Surface, SurfacePoints, points_of, surface_of, working_depth


@dataclass(frozen=True)
class PreparedFrame:
    """Features and surface points of a frame.

    Attributes
    ----------
    frame
        The images themselves.
    features
        At the full resolution.
    points
        Of the reduced depth image.
    depth_m, depth_intrinsics
        The reduced depth image.
    """

    frame: RgbdFrame
    features: Features
    points: SurfacePoints
    depth_m: Float32Array
    depth_intrinsics: CameraIntrinsics
    _plane_radius: int
    _farthest_m: float

    @property
    def stamp_s(self) -> float:
        """Time of the frame."""
        return self.frame.stamp_s

    @cached_property
    def surface(self) -> Surface:
        """The whole surface: only a keyframe needs it."""
        return surface_of(self.depth_m, self.depth_intrinsics, self._plane_radius, self._farthest_m)

    @cached_property
    def median_depth_m(self) -> float:
        """Median depth of the surface points; 1 where there are none."""
        return float(np.median(self.points.points[:, 2])) if len(self.points) else 1.0


class FramePreparer:
    """Extracts features and surface points; the colour camera may be another than the depth camera.

    Parameters
    ----------
    config
        How many of them, and at which resolution.
    registrations
        Where the colour camera sits, by the camera's name; one that was not accepted changes nothing.
    """

    def __init__(self, config: RgbdConfig, registrations: Mapping[str, ColorRegistration]) -> None:
        self._config = config
        self._registrations = {name: found for name, found in registrations.items() if found.accepted}

    def __call__(self, measurement: Measurement) -> Measurement | PreparedFrame:
        """A frame with its features, all of them in the depth camera's image; anything else as it is."""
        if not isinstance(measurement, RgbdFrame):
            return measurement
        features = extract_features(gray_of(measurement), measurement.depth_m, self._config.features)
        registration = self._registrations.get(measurement.sensor)
        if registration is not None:
            pixels, depth_m = register_features(features.pixels, measurement.depth_m, registration)
            features = Features(pixels, features.descriptors, features.sigma_px, depth_m).where(depth_m > 0.0)
        return prepared_with(measurement, features, self._config)


def prepared_with(frame: RgbdFrame, features: Features, config: RgbdConfig) -> PreparedFrame:
    """Surface points anew, beside features that are known."""
    depth, intrinsics = working_depth(frame.depth_m, frame.intrinsics, config.working_width)
    return PreparedFrame(
        frame=frame,
        features=features,
        points=points_of(depth, intrinsics, config.plane_radius, config.farthest_m, config.points),
        depth_m=depth,
        depth_intrinsics=intrinsics,
        _plane_radius=config.plane_radius,
        _farthest_m=config.farthest_m,
    )
