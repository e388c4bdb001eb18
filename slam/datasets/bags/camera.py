"""Converts pairs of image messages to frames: undistorted, colour projected into the depth camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.images import MILLIMETRES_PER_M, color_of, depth_of
from slam.datasets.bags.lens import Lens
from slam.datasets.bags.pairing import ImagePair
from slam.datasets.bags.registered import ColorView
from slam.datasets.budget import Budget
from slam.datasets.calibration import KINECT, Calibration, same_aspect
from slam.datasets.camera_frames import SIZES_DIFFER, resized
from slam.datasets.dataset import RecordFault
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, RgbdFrame

_Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
_View = tuple[_Maps | None, ColorView | None]
APART_M = 0.001  # colour and depth closer than this are one camera

ASSUMED = "no CameraInfo: intrinsics assumed (525 525 319.5 239.5 at 640 x 480)"


@dataclass(slots=True)
class BagCamera:
    """One camera of a bag.

    Attributes
    ----------
    depth_lens, color_lens
        None if the topic has no CameraInfo.
    T_depth_color
        Pose of the colour camera's optical frame in that of the depth camera.
    T_base_camera
        Pose of the depth camera's optical frame; None if tf does not contain it.
    tolerance_s
        Maximum time difference between the two images of a pair.
    depth_steps_per_m
        Units per metre of 16-bit depth images.
    """

    sensor: str
    depth_lens: Lens | None
    color_lens: Lens | None
    T_depth_color: gtsam.Pose3
    T_base_camera: gtsam.Pose3 | None
    tolerance_s: float
    depth_steps_per_m: float = MILLIMETRES_PER_M
    _depth_maps: dict[tuple[int, int], _Maps | None] = field(default_factory=dict, repr=False)
    _color_views: dict[tuple[int, int, int, int], _View] = field(default_factory=dict, repr=False)

    @property
    def assumed(self) -> str:
        """Why the intrinsics are assumed; empty if the bag contains them."""
        return "" if self.depth_lens or self.color_lens else ASSUMED

    def frame(self, pair: ImagePair, budget: Budget) -> RgbdFrame:
        """A frame at the depth image's size; its stamp is the colour image's.

        Raises
        ------
        RecordFault
            An image is damaged, its encoding is unsupported, its size fits no lens, or the budget is used up.
        """
        depth_m = depth_of(pair.depth.message, budget, self.depth_steps_per_m)
        depth_m = self.flat_depth(depth_m)
        height, width = depth_m.shape
        intrinsics = self._intrinsics(width, height)
        color = self.fitted(color_of(pair.color.message, budget), depth_m, intrinsics)
        return RgbdFrame(pair.color.stamp_s, color, depth_m, intrinsics, self.T_base_camera, self.sensor)

    def _intrinsics(self, width: int, height: int) -> CameraIntrinsics:
        """Intrinsics for depth images of this size; from the colour camera's lens if only that is known."""
        lens = self.depth_lens or self.color_lens
        known = Calibration(lens.intrinsics if lens else KINECT, 1.0, assumed=self.assumed)
        return known.intrinsics_for(width, height)

    def flat_depth(self, depth_m: Float32Array) -> Float32Array:
        """Undistorted depth: nearest-neighbour lookup, so no two readings are averaged."""
        size = (depth_m.shape[1], depth_m.shape[0])
        if size not in self._depth_maps:
            lens = _at(self.depth_lens, size)
            self._depth_maps[size] = None if lens is None else lens.maps()
        maps = self._depth_maps[size]
        if maps is None:
            return depth_m
        import cv2

        return np.asarray(cv2.remap(depth_m, *maps, cv2.INTER_NEAREST), dtype=np.float32)

    def fitted(self, color: ColorImage, depth_m: Float32Array, target: CameraIntrinsics) -> ColorImage:
        """The colour image as seen from the depth camera."""
        size = (color.shape[1], color.shape[0])
        key = (*size, target.width, target.height)
        if key not in self._color_views:
            self._color_views.clear()  # images may have any size: keep only the latest view
            self._color_views[key] = self._view_of_color(size, target)
        maps, color_view = self._color_views[key]
        import cv2

        if maps is not None:
            color = np.asarray(cv2.remap(color, *maps, cv2.INTER_LINEAR))
        if color_view is not None:
            return color_view.of(color, depth_m)
        if color.shape[:2] == depth_m.shape:
            return color
        return resized(color, (target.width, target.height))

    def _view_of_color(self, size: tuple[int, int], target: CameraIntrinsics) -> _View:
        """Lookup maps of the pixels; none if the views differ only in size.

        One map if both cameras are at the same place, because then nothing depends on depth; otherwise the
        image is first undistorted and then looked up by the depth of each pixel.
        """
        lens = _at(self.color_lens, size)
        if lens is None:
            # Without its own lens, a colour image of the same aspect ratio counts as already registered.
            if not same_aspect(size, (target.width, target.height)):
                text = f"{size[0]} x {size[1]} and {target.width} x {target.height}"
                raise RecordFault(SIZES_DIFFER, f"{text}; give the intrinsics of each by --calibration")
            return None, None
        if float(np.linalg.norm(self.T_depth_color.translation())) > APART_M:
            return lens.maps(), ColorView(target, lens.intrinsics, self.T_depth_color)
        return lens.maps(target, np.asarray(self.T_depth_color.rotation().matrix())), None


def _at(lens: Lens | None, size: tuple[int, int]) -> Lens | None:
    """A lens for images of this size; None if there is none, or if the images show another field of view."""
    if lens is None:
        return None
    try:
        return replace(lens, intrinsics=Calibration(lens.intrinsics, 1.0).intrinsics_for(*size))
    except RecordFault:
        return None
