"""Camera keyframes of a whole run: images on disk, surfaces of the latest used in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from slam.config.stages import RgbdConfig
from slam.mapping.keyframe_images import KeyframeImages
from slam.measurements import RgbdFrame
from slam.vision.color_registration import ColorRegistration, register_color
from slam.vision.features import Features
from slam.vision.prepared_frame import PreparedFrame, prepared_with


class KeyframeSpool(Protocol):
    """Where images and features lie while a log is mapped: in the map, or in a temporary folder."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[RgbdFrame]: ...

    def add(self, frame: RgbdFrame, node: int, features: Features) -> int:
        """Keep the next frame, taken at a node of the graph; its index."""
        ...

    def frame(self, index: int) -> RgbdFrame:
        """A frame, nearly as it was added."""
        ...

    def features(self, index: int) -> Features:
        """The features of a frame, exactly."""
        ...


class TemporarySpool:
    """Images in a temporary folder, features in memory; both go with it."""

    def __init__(self) -> None:
        self._images = KeyframeImages()
        self._features: list[Features] = []

    def __len__(self) -> int:
        return len(self._features)

    def __iter__(self) -> Iterator[RgbdFrame]:
        return iter(self._images)

    def add(self, frame: RgbdFrame, node: int, features: Features) -> int:
        """Keep the next frame; its index."""
        self._features.append(features)
        return self._images.add(frame)

    def frame(self, index: int) -> RgbdFrame:
        """A frame, nearly as it was added."""
        return self._images.frame(index)

    def features(self, index: int) -> Features:
        """The features of a frame, exactly."""
        return self._features[index]


class KeyframeStore:
    """Keyframes by number, in the order they came.

    Parameters
    ----------
    config
        How surfaces are made anew of the images.
    cached
        Keyframes that are kept whole.
    spool
        Where the images go; a temporary folder by default.
    """

    def __init__(self, config: RgbdConfig, cached: int, spool: KeyframeSpool | None = None) -> None:
        self.images = TemporarySpool() if spool is None else spool
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
