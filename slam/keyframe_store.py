"""Camera keyframes of a whole run: images on disk, features in memory, surfaces of the latest used."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slam.config_stages import RgbdConfig
from slam.mapping.keyframe_images import KeyframeImages
from slam.vision.color_registration import ColorRegistration, register_color
from slam.vision.features import Features
from slam.vision.prepared_frame import PreparedFrame, prepared_with


class KeyframeStore:
    """Keyframes by number, in the order they came.

    Parameters
    ----------
    config
        How surfaces are made anew of the images.
    cached
        Keyframes that are kept whole.
    """

    def __init__(self, config: RgbdConfig, cached: int) -> None:
        self.images = KeyframeImages()
        self._config = config
        self._cached = cached
        self._features: list[Features] = []
        self._cache: OrderedDict[int, PreparedFrame] = OrderedDict()

    def __len__(self) -> int:
        return len(self._features)

    def add(self, frame: PreparedFrame, registration: ColorRegistration | None = None) -> int:
        """Take the next keyframe; its number.

        Parameters
        ----------
        registration
            Where the colour camera sits; the colours are then moved to where the depth camera sees them.
        """
        image = frame.frame
        if registration is not None and registration.accepted:
            color, known = register_color(image.color, image.depth_m, registration)
            # Depth without colour would paint the map black.
            image = replace(image, color=color, depth_m=np.where(known, image.depth_m, np.float32(0.0)))
        key = self.images.add(image)
        self._features.append(frame.features)
        self._keep(key, frame)
        return key

    def keyframe(self, key: int) -> PreparedFrame:
        """A keyframe, from memory or made anew from its images."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        frame = prepared_with(self.images.frame(key), self._features[key], self._config)
        self._keep(key, frame)
        return frame

    def _keep(self, key: int, frame: PreparedFrame) -> None:
        self._cache[key] = frame
        if len(self._cache) > self._cached:
            self._cache.popitem(last=False)


def registration_notes(registrations: Mapping[str, ColorRegistration]) -> list[str]:
    """One line for people about every colour camera that is not registered to its depth camera."""
    return [f"{name}: {found.reason}" for name, found in registrations.items() if found.accepted]
