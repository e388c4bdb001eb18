"""Camera keyframes in ``map.db``: images and features are read when they are needed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import gtsam
import numpy as np

from slam.datasets.budget import MOST_PIXELS
from slam.errors import MapFileError
from slam.mapping.sensor_packing import depth_steps_per_m, packed_color, packed_depth, unpacked_images
from slam.measurements import CameraIntrinsics, Pose, RgbdFrame, spatial
from slam.storage.map_edits import mask_of
from slam.storage.map_file import MapFile
from slam.storage.map_soundness import of, require, sound_name, sound_stamp
from slam.storage.map_tables import FRAMES, IMAGES, Table, Value
from slam.storage.packing import pack, unpack
from slam.vision.features import Features


@dataclass(frozen=True, slots=True)
class FrameHead:
    """Data of a camera keyframe without its images.

    Attributes
    ----------
    T_base_camera
        Pose of the camera at the frame relative to the base at the node; in 3D the mounting, and None if the
        camera is its own base.
    """

    node: int
    stamp_s: float
    sensor: str
    steps_per_m: float
    intrinsics: CameraIntrinsics
    T_base_camera: gtsam.Pose3 | None


class MapFrames:
    """The camera keyframes of a map.

    Parameters
    ----------
    begun
        Whether the map is being written: frames of an interrupted run are visible only after they are added
        again, without cost.
    erased
        Packed bits of the pixels removed by edits, by frame.
    """

    def __init__(
        self, file: MapFile, *, begun: bool = False, erased: Mapping[int, bytes] | None = None
    ) -> None:
        self._file, self._erased = file, erased or {}
        self._count = 0 if begun else file.count(FRAMES)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Yield the frames in order, one in memory at a time."""
        return (self.frame(index) for index in range(len(self)))

    def add(self, frame: RgbdFrame, node: int, features: Features) -> int:
        """Write the next frame; return its index.

        Raises
        ------
        ScanweaveError
            If a depth is not finite, or the map cannot be written.
        """
        index = self._count
        self._count += 1
        if index < self._file.count(FRAMES):
            head = self.head(index)
            if (head.stamp_s, head.sensor, head.node) != (frame.stamp_s, frame.sensor, node):
                raise MapFileError(
                    f"{self._file.path} cannot be resumed: it has a frame of {head.sensor} at "
                    f"{head.stamp_s:.6f} s where one of {frame.sensor} at {frame.stamp_s:.6f} s comes; "
                    "map anew, without --resume"
                )
            return index
        steps_per_m = depth_steps_per_m(frame)
        camera = pack((frame.intrinsics, frame.T_base_camera))
        self._file.append(FRAMES, node, frame.stamp_s, frame.sensor, steps_per_m, camera, pack(features))
        color, depth = packed_color(frame.color), packed_depth(frame.depth_m, steps_per_m)
        return self._file.append(IMAGES, color, depth)

    def place(self, index: int, T_base_camera: gtsam.Pose3) -> None:
        """Update the pose of a frame; errors as in `frame`, and if the map cannot be written."""
        *row, _, features = self._row(index)
        camera = pack((self.head(index).intrinsics, T_base_camera))
        self._file.replace(FRAMES, index, *row, camera, features)

    def head(self, index: int) -> FrameHead:
        """Return the data of a frame without its images; errors as in `frame`."""
        node, stamp_s, sensor, steps_per_m, camera = self._row(index)[:5]
        with self._file.naming_row(FRAMES, index):
            fields = of(tuple, unpack(cast(bytes, camera)))
            require(len(fields) == 2 and 0.0 < cast(float, steps_per_m) < math.inf, "its camera is none")
            intrinsics = of(CameraIntrinsics, fields[0])
            require(
                intrinsics.width * intrinsics.height <= MOST_PIXELS, "its camera has more pixels than any"
            )
            T_base_camera = None if fields[1] is None else of(gtsam.Pose3, fields[1])
            sound_stamp(stamp_s)
            sound_name(sensor)
        return FrameHead(
            cast(int, node),
            cast(float, stamp_s),
            str(sensor),
            cast(float, steps_per_m),
            intrinsics,
            T_base_camera,
        )

    def features(self, index: int) -> Features:
        """Return the ORB features of a frame, in the depth camera's image; errors as in `frame`."""
        with self._file.naming_row(FRAMES, index):
            features = of(Features, unpack(cast(bytes, self._row(index)[5])))
            counts = {len(features.pixels), len(features.descriptors), len(features.sigma_px)}
            require(counts == {len(features)}, "its features are not as many as their places")
        return features

    def without(self, erased: Mapping[int, bytes]) -> MapFrames:
        """Return the same frames with other pixels removed."""
        return MapFrames(self._file, erased=erased)

    def frame(self, index: int, *, taken: bool = False) -> RgbdFrame:
        """Return a frame with its images.

        Parameters
        ----------
        taken
            Whether depth removed by edits is negative, rather than no reading: the rays there were free up to
            it.

        Raises
        ------
        IndexError
            If there is no such frame.
        MapFileError
            If its row is damaged.
        """
        head = self.head(index)
        images = self._file.row(IMAGES, index)
        with self._file.naming_row(IMAGES, index):
            color, depth_m = unpacked_images(
                cast(bytes, images[0]), cast(bytes, images[1]), head.steps_per_m, head.intrinsics
            )
            if index in self._erased:
                erased = mask_of(self._erased[index], depth_m.size).reshape(depth_m.shape)
                depth_m = np.where(erased, -depth_m if taken else np.float32(0.0), depth_m)
        return RgbdFrame(head.stamp_s, color, depth_m, head.intrinsics, head.T_base_camera, head.sensor)

    def jpeg(self, index: int) -> bytes:
        """Return the stored JPEG of a frame; errors as in `frame`."""
        return cast(bytes, self._row(index, IMAGES)[0])

    def taken(self) -> Iterator[RgbdFrame]:
        """Yield the frames, with removed depth negative."""
        return (self.frame(index, taken=True) for index in range(len(self)))

    def copy_to(self, file: MapFile, nodes: int = 0, most: int | None = None) -> None:
        """Copy frames to another map unchanged, with nodes numbered after so many others.

        Parameters
        ----------
        most
            Only frames of so many nodes; None for all.

        Raises
        ------
        MapFileError
            If a row is damaged, or the other map cannot be written.
        """
        for index in range(len(self)):
            node, *rest = self._row(index)
            if most is None or cast(int, node) < most:
                file.append(FRAMES, cast(int, node) + nodes, *rest)
                file.append(IMAGES, *self._file.row(IMAGES, index))

    def poses(self, node_poses: Sequence[Pose], bases: bool = False) -> list[gtsam.Pose3]:
        """Return ``T_map_camera`` of every frame.

        Parameters
        ----------
        bases
            Whether nodes in 3D are bases, not the cameras themselves; on a floor they always are.
        """
        poses = []
        for index in range(len(self)):
            head = self.head(index)
            pose = spatial(node := node_poses[head.node])
            if bases or isinstance(node, gtsam.Pose2):
                assert head.T_base_camera is not None
                pose = pose.compose(head.T_base_camera)
            poses.append(pose)
        return poses

    def _row(self, index: int, table: Table = FRAMES) -> tuple[Value, ...]:
        """The values of a row."""
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        return self._file.row(table, index)
