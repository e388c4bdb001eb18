"""Frame pairs from the start of a log, to estimate the pose of the colour camera."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import TypeAlias

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.config.stages import RgbdOdometryConfig
from slam.datasets.recording import fewer_frames
from slam.measurements import Measurement, RgbdFrame
from slam.vision.color_registration import ColorRegistration
from slam.vision.color_registration_fit import FramePair, estimate_registration
from slam.vision.features import Features, extract_features, gray_of, match_features

log = logging.getLogger(__name__)

Seen: TypeAlias = tuple[RgbdFrame, Features]

_EVERY_S = 0.19  # less than six frames at 30 Hz, because two logs of one drive round stamps differently
_LONGEST_S = 40.0
_PAIRS = 24
# Limits of the features' median motion, as a share of the image width: informative, and still matched.
_LEAST_MOTION, _GREATEST_MOTION = 0.03, 0.25


def paired_frames(_: str, stamps_s: Sequence[float]) -> list[bool]:
    """The frames of a camera that `registrations_of` reads first, by stamp."""
    looked_s, chosen = -np.inf, []
    for stamp_s in stamps_s:
        chosen.append(stamp_s - looked_s >= _EVERY_S)
        looked_s = stamp_s if chosen[-1] else looked_s
    return chosen


def registrations_of(
    log: Iterable[Measurement], cameras: Sequence[str], config: Config
) -> dict[str, ColorRegistration]:
    """Pose of the colour camera in the depth camera, with the reason, for every camera in the log.

    If a camera moved too far between two of these frames, and for a short log, every frame is used.

    Parameters
    ----------
    log
        Read from its start, once or twice, until every camera has enough pairs, at most 40 seconds; only the
        needed images are read if the log supports that.
    """
    if not cameras or config.rgbd.registration == "given":
        return {}
    collectors = {name: _Collector(config) for name in cameras}
    with fewer_frames(log, paired_frames):
        _collect(log, collectors)
    if fast := {name: collector for name, collector in collectors.items() if collector.look_closer()}:
        with fewer_frames(
            log, lambda name, stamps_s: [name in fast and fast[name].asks(s) for s in stamps_s]
        ):
            _collect(log, fast)
    found = {name: collector.registration(config.seed) for name, collector in collectors.items()}
    return {name: registration for name, registration in found.items() if registration is not None}


def _collect(log: Iterable[Measurement], collectors: Mapping[str, _Collector]) -> None:
    """Pass the cameras' frames to their collectors."""
    first_s: float | None = None
    for measurement in log:
        first_s = measurement.stamp_s if first_s is None else first_s
        if measurement.stamp_s - first_s > _LONGEST_S or all(c.done for c in collectors.values()):
            break
        if isinstance(measurement, RgbdFrame) and measurement.sensor in collectors:
            collectors[measurement.sensor].add(measurement)


class _Collector:
    """Frame pairs of one camera."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._pairs: list[FramePair] = []
        self._anchors: list[Seen] = []
        self._looked_s: list[float] = []
        self._missed_s: list[tuple[float, float]] = []  # intervals between frames with too much motion
        self._known_s: frozenset[float] = frozenset()

    @property
    def done(self) -> bool:
        """Whether there are enough pairs."""
        return len(self._pairs) >= _PAIRS

    def look_closer(self) -> bool:
        """Whether frames between those that were read may help; they are then requested."""
        if 0 < len(self._looked_s) < _PAIRS:
            self._missed_s = [(-math.inf, math.inf)]
        self._known_s = frozenset(self._looked_s)
        return not self.done and bool(self._missed_s)

    def asks(self, stamp_s: float) -> bool:
        """Whether the frame with this stamp is used."""
        if self._known_s:
            return any(first_s <= stamp_s <= last_s for first_s, last_s in self._missed_s)
        return not self._looked_s or stamp_s - self._looked_s[-1] >= _EVERY_S

    def add(self, frame: RgbdFrame) -> None:
        """Pair a frame with the anchor before it, if the motion between them is suitable."""
        if self.done or not self.asks(frame.stamp_s):
            return
        self._looked_s.append(frame.stamp_s)
        count = self._config.rgbd.features
        features = extract_features(gray_of(frame), frame.depth_m, count, again=True)
        seen, pair, motion = (frame, features), None, np.inf
        if self._anchors:
            before_s = self._anchors[-1][0].stamp_s
            if not self._known_s.issuperset((before_s, frame.stamp_s)):
                pair, motion = _pair(self._anchors[-1], seen, self._config.rgbd_odometry)
            if motion > _GREATEST_MOTION and not self._known_s:
                self._missed_s.append((before_s, frame.stamp_s))
        if pair is not None:
            self._pairs.append(pair)
        if pair is not None or motion > _GREATEST_MOTION:
            self._anchors.append(seen)
            del self._anchors[:-_PAIRS]

    def registration(self, seed: int) -> ColorRegistration | None:
        """The estimate, which may be that colour is already registered; None without frames."""
        if not self._anchors:
            return None
        pairs = [*self._pairs, *islice(self._farther_pairs(), _PAIRS - len(self._pairs))]
        frame, _ = self._anchors[0]
        registration = estimate_registration(pairs, frame.intrinsics, seed)
        log.info("%s: %s", frame.sensor, registration.reason)
        return registration

    def _farther_pairs(self) -> Iterator[FramePair]:
        """Pairs of anchors that are not consecutive, to get more pairs from a short log."""
        for gap in range(2, len(self._anchors)):
            for before, after in zip(self._anchors, self._anchors[gap:], strict=False):
                pair, _ = _pair(before, after, self._config.rgbd_odometry)
                if pair is not None:
                    yield pair


def _pair(before: Seen, after: Seen, config: RgbdOdometryConfig) -> tuple[FramePair | None, float]:
    """The matched pair, None if the motion is too small or too large; and the motion."""
    (frame_a, known), (frame_b, features) = before, after
    matches = match_features(known.descriptors, features.descriptors, config.match_ratio)
    if len(matches) < 3 * FEWEST:  # a third of them must agree on a motion
        return None, np.inf
    a, b = known.pixels[matches.first], features.pixels[matches.second]
    motion = float(np.median(np.linalg.norm(a - b, axis=1))) / frame_b.intrinsics.width
    if not _LEAST_MOTION <= motion <= _GREATEST_MOTION:
        return None, motion
    return FramePair(a, b, frame_a.depth_m, frame_b.depth_m), motion
