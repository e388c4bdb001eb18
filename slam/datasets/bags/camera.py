"""Pairs of image messages as frames: distortion taken out, colour brought into the depth camera's view."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.images import color_of, depth_of
from slam.datasets.bags.lens import Lens
from slam.datasets.bags.pairing import ImagePair
from slam.datasets.budget import Budget
from slam.datasets.calibration import Calibration, same_aspect
from slam.datasets.camera_frames import SIZES_DIFFER
from slam.datasets.dataset import RecordFault
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, RgbdFrame

_Maps = tuple[NDArray[np.float32], NDArray[np.float32]]

# What drivers give for a Kinect without calibration; scaled to the width of the images.
_ASSUMED = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
ASSUMED = "no CameraInfo: intrinsics assumed (525 525 319.5 239.5 at 640 x 480)"


@dataclass(slots=True)
class BagCamera:
    """One camera of a bag.

    Attributes
    ----------
    sensor
        Its name.
    depth_lens, color_lens
        None where no CameraInfo goes with the topic.
    turn_depth_color
        (3, 3) rotation of the colour camera in the depth camera's frame.
    T_base_camera
        Of the depth camera's optical frame; None where tf does not tell it.
    tolerance_s
        Greatest time between the two images of a pair.
    """

    sensor: str
    depth_lens: Lens | None
    color_lens: Lens | None
    turn_depth_color: NDArray[np.float64]
    T_base_camera: gtsam.Pose3 | None
    tolerance_s: float
    _depth_maps: dict[tuple[int, int], _Maps | None] = field(default_factory=dict, repr=False)
    _color_maps: dict[tuple[int, int, int, int], _Maps | None] = field(default_factory=dict, repr=False)

    @property
    def assumed(self) -> str:
        """Why the intrinsics are a guess; empty where the bag gives them."""
        return "" if self.depth_lens or self.color_lens else ASSUMED

    def frame(self, pair: ImagePair, budget: Budget) -> RgbdFrame:
        """A frame at the depth image's size; its stamp is the colour image's.

        Raises
        ------
        RecordFault
            An image is damaged or of an encoding that is not read, the sizes fit no known lens, or the
            budget is used up.
        """
        depth_m = self._flat_depth(depth_of(pair.depth.message, budget))
        height, width = depth_m.shape
        intrinsics = self._intrinsics(width, height)
        color = self._fitted(color_of(pair.color.message, budget), intrinsics)
        return RgbdFrame(pair.color.stamp_s, color, depth_m, intrinsics, self.T_base_camera, self.sensor)

    def _intrinsics(self, width: int, height: int) -> CameraIntrinsics:
        """Of depth images of a size; by the colour camera's lens where only that is known."""
        lens = self.depth_lens or self.color_lens
        known = Calibration(lens.intrinsics if lens else _ASSUMED, 1.0, assumed=self.assumed)
        return known.intrinsics_for(width, height)

    def _flat_depth(self, depth_m: Float32Array) -> Float32Array:
        """Depth without distortion: each pixel takes the nearest reading, none are mixed."""
        size = (depth_m.shape[1], depth_m.shape[0])
        if size not in self._depth_maps:
            lens = self.depth_lens
            fits = lens is not None and size == (lens.intrinsics.width, lens.intrinsics.height)
            self._depth_maps[size] = lens.maps() if lens is not None and fits else None
        maps = self._depth_maps[size]
        if maps is None:
            return depth_m
        import cv2

        return np.asarray(cv2.remap(depth_m, *maps, cv2.INTER_NEAREST), dtype=np.float32)

    def _fitted(self, color: ColorImage, wanted: CameraIntrinsics) -> ColorImage:
        """Colour as the depth camera would see it from the colour camera's place."""
        size = (color.shape[1], color.shape[0])
        key = (*size, wanted.width, wanted.height)
        if key not in self._color_maps:
            self._color_maps.clear()  # one image may be of any size: the maps of none but the latest are kept
            self._color_maps[key] = self._maps_of_color(size, wanted)
        maps = self._color_maps[key]
        import cv2

        if maps is not None:
            return np.asarray(cv2.remap(color, *maps, cv2.INTER_LINEAR))
        if size == (wanted.width, wanted.height):
            return color
        shrinks = wanted.width < size[0]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(color, (wanted.width, wanted.height), interpolation=how))

    def _maps_of_color(self, size: tuple[int, int], wanted: CameraIntrinsics) -> _Maps | None:
        """Where each pixel of the depth image is looked up; None where the views differ in size alone."""
        lens = self.color_lens
        if lens is None or size != (lens.intrinsics.width, lens.intrinsics.height):
            # Without a lens of its own, colour of the same proportions is taken as already registered.
            if not same_aspect(size, (wanted.width, wanted.height)):
                text = f"{size[0]} x {size[1]} and {wanted.width} x {wanted.height}"
                raise RecordFault(SIZES_DIFFER, text)
            return None
        return lens.maps(wanted, self.turn_depth_color)
