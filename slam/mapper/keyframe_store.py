"""Camera keyframes of a whole run: images on disk, surfaces of the latest used in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slam.config.stages import RgbdConfig
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration, register_color
from slam.vision.prepared_frame import PreparedFrame, prepared_with


class KeyframeStore:
    """Keyframes by number, in the order they came.

    Parameters
    ----------
    config
        How surfaces are made anew of the images.
    cached
        Keyframes that are kept whole.
    spool
        Where the images go; a temporary map by default.
    """

    def __init__(self, config: RgbdConfig, cached: int, spool: MapFrames | None = None) -> None:
        self.images = MapFrames(MapFile.temporary()) if spool is None else spool
        self._config = config
        self._cached = cached
        # None: what `touch` has asked for, and nobody has looked at yet.
        self._cache: OrderedDict[int, PreparedFrame | None] = OrderedDict()

    def __len__(self) -> int:
        return len(self.images)

    def add(
        self, frame: PreparedFrame, registration: ColorRegistration | None = None, node: int | None = None
    ) -> int:
        """Take the next keyframe; its number.

        Parameters
        ----------
        registration
            Where the colour camera sits; the colours are then moved to where the depth camera sees them.
        node
            Of the graph, where that is not the keyframe's own number.
        """
        key = self.add_picture(frame, registration, len(self) if node is None else node)
        self._keep(key, frame)
        return key

    def add_picture(self, frame: PreparedFrame, registration: ColorRegistration | None, node: int) -> int:
        """Take a frame that is for the map alone: nobody matches it to others in this run; its number."""
        image = frame.frame
        if registration is not None and registration.accepted:
            color, known = register_color(image.color, image.depth_m, registration)
            # Depth without colour would paint the map black.
            image = replace(image, color=color, depth_m=np.where(known, image.depth_m, np.float32(0.0)))
        return self.images.add(image, node, frame.features)

    def keyframe(self, key: int) -> PreparedFrame:
        """A keyframe, from memory or made anew from its images."""
        frame = self._cache.get(key)
        if frame is None:
            frame = prepared_with(self.images.frame(key), self.images.features(key), self._config)
        self._keep(key, frame)
        return frame

    def touch(self, key: int) -> None:
        """Do to the memory what `keyframe` would do, without the work."""
        self._keep(key, self._cache.get(key))

    def _keep(self, key: int, frame: PreparedFrame | None) -> None:
        """Remember a keyframe as the latest used."""
        self._cache[key] = frame
        self._cache.move_to_end(key)
        if len(self._cache) > self._cached:
            self._cache.popitem(last=False)


def registration_notes(registrations: Mapping[str, ColorRegistration]) -> list[str]:
    """One line for people about every colour camera that is not registered to its depth camera."""
    return [f"{name}: {found.reason}" for name, found in registrations.items() if found.accepted]
