"""Camera keyframes of a run: images on disk, surfaces of the recently used ones in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from slam.config.stages import RgbdConfig
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration, register_color
from slam.vision.prepared_frame import PreparedFrame


class KeyframeStore:
    """Keyframes by number, in the order they were added.

    Parameters
    ----------
    config
        Settings with which surfaces are rebuilt from the images.
    cached
        Number of keyframes that are kept in memory.
    spool
        Storage of the images; a temporary map by default.
    """

    def __init__(self, config: RgbdConfig, cached: int, spool: MapFrames | None = None) -> None:
        self.images = MapFrames(MapFile.temporary()) if spool is None else spool
        self._config = config
        self._cached = cached
        # None: requested by `touch`, and not read yet.
        self._cache: OrderedDict[int, PreparedFrame | None] = OrderedDict()

    def __len__(self) -> int:
        return len(self.images)

    def add(
        self,
        frame: PreparedFrame,
        registration: ColorRegistration | None = None,
        node: int | None = None,
        mounting: gtsam.Pose3 | None = None,
        *,
        matched: bool = True,
    ) -> int:
        """Store the next keyframe; return its number.

        Parameters
        ----------
        registration
            Pose of the colour camera; the colours are then projected into the depth image.
        node
            Node of the graph, if it is not the keyframe's own number.
        mounting
            ``T_base_camera`` of the image, if it differs from that of the frame.
        matched
            Whether others are matched to it in this run; else it only serves the map.
        """
        image = replace(frame.frame, T_base_camera=mounting or frame.frame.T_base_camera)
        if registration is not None and registration.accepted:
            color, known = register_color(image.color, image.depth_m, registration)
            # Depth without colour would paint the map black.
            image = replace(image, color=color, depth_m=np.where(known, image.depth_m, np.float32(0.0)))
        key = self.images.add(image, len(self) if node is None else node, frame.features)
        if matched:
            self._keep(key, frame)
        return key

    def keyframe(self, key: int) -> PreparedFrame:
        """Return a keyframe, from memory or rebuilt from its images."""
        frame = self._cache.get(key)
        if frame is None:
            frame = PreparedFrame(self.images.frame(key), self._config, None, self.images.features(key))
        self._keep(key, frame)
        return frame

    def touch(self, key: int) -> None:
        """Update the memory as `keyframe` would, without computing anything."""
        self._keep(key, self._cache.get(key))

    def _keep(self, key: int, frame: PreparedFrame | None) -> None:
        """Mark a keyframe as the most recently used."""
        self._cache[key] = frame
        self._cache.move_to_end(key)
        if len(self._cache) > self._cached:
            self._cache.popitem(last=False)


def registration_notes(registrations: Mapping[str, ColorRegistration]) -> list[str]:
    """Return one line for the user on each colour camera that is not registered to its depth camera."""
    return [f"{name}: {found.reason}" for name, found in registrations.items() if found.accepted]
