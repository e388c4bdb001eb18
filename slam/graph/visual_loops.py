"""Loop closure by camera: places that should be in view, and places that look similar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np

from slam.config import Config
from slam.graph.loop_candidate import LoopCandidate, report
from slam.result_cache import COMPUTED, ResultCache
from slam.vision.features import Descriptors
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.place_recognition import PlaceIndex
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, dissimilarity


class Keyframes(Protocol):
    """Storage of keyframes."""

    def keyframe(self, key: int) -> PreparedFrame:
        """Return a keyframe by its number."""
        ...

    def touch(self, key: int) -> None:
        """Record that a keyframe was requested."""
        ...


class VisualLoopCloser:
    """Proposes and verifies loops for the newest keyframe of one camera."""

    def __init__(
        self,
        config: Config,
        matcher: FrameMatcher,
        keyframes: Keyframes,
        result_cache: ResultCache = COMPUTED,
    ) -> None:
        self._loops, self._config = config.loops, config.visual_loops
        self._confirmed = config.rgbd_odometry.keyframe_parallax
        self._matcher = matcher
        self._keyframes = keyframes
        self._result_cache = result_cache
        self._places = PlaceIndex(config.seed)
        self._depths_m: list[float] = []
        self._segments: list[int] = []
        self._newest: Descriptors | None = None

    def add_keyframe(self, frame: PreparedFrame, *, adrift: bool = False) -> None:
        """Store the appearance of the next keyframe.

        Parameters
        ----------
        adrift
            Whether nothing measured the motion to it: its pose is known only after a loop by appearance.
        """
        if self._newest is not None:
            # A place is queried before it is added, so that its neighbour sets the scale.
            self._places.add(self._newest)
        self._newest = frame.features.descriptors
        self._depths_m.append(frame.median_depth_m)
        last = self._segments[-1] if self._segments else 0
        self._segments.append(last + 1 if adrift else last)

    def close(self, key: int, poses: Sequence[gtsam.Pose3]) -> list[LoopCandidate]:
        """Try to close loops with places to which a keyframe may have returned.

        Parameters
        ----------
        key
            The newest keyframe.
        poses
            Current estimates of the cameras of all keyframes, map frame.

        Returns
        -------
        Every candidate that was tried, accepted or rejected.
        """
        config = self._config
        if not self._loops.enabled or key < config.least_gap:
            return []
        segment = self._segments[key]
        places = [p for p in range(key - config.least_gap + 1) if self._segments[p] == segment]
        near = self.near(places, poses, poses[key], self._depths_m)
        similar = self._result_cache.cached("looks", float(key), lambda: self._by_appearance(key))
        tried = [self._verify(place, key, poses[place].between(poses[key]), 1.0) for place in near]
        tried += [self._verify(place, key, None, score) for place, score in similar if place not in near]
        for candidate in tried:
            self._join(candidate)
            report("visual loop", candidate)
        return tried

    def near(
        self,
        places: Sequence[int],
        poses: Sequence[gtsam.Pose3],
        camera: gtsam.Pose3,
        depths_m: Sequence[float],
    ) -> list[int]:
        """Return places whose cameras should see the same as one, each from another stretch of the path.

        Parameters
        ----------
        poses, depths_m
            Poses of the cameras of all keyframes, and the depths of what they see.
        """
        config = self._config
        scores = np.array([dissimilarity(poses[p], camera, depths_m[p]) for p in places])
        chosen: list[int] = []
        for n in np.argsort(scores, kind="stable"):
            if len(chosen) == self._loops.near or scores[n] > config.near_dissimilarity:
                break
            if all(abs(places[n] - other) >= config.least_gap for other in chosen):
                chosen.append(places[n])
        return chosen

    def verify(self, place: int, key: int, guess: gtsam.Pose3 | None) -> LoopCandidate:
        """Match a keyframe to a place, from a guess (``T_place_camera``) or without one."""
        return self._verify(place, key, guess, 1.0)

    def _join(self, candidate: LoopCandidate) -> None:
        """Connect a segment of unknown pose by a loop."""
        ends = {self._segments[candidate.place], self._segments[candidate.keyframe]}
        if candidate.accepted and len(ends) == 2:
            low, high = min(ends), max(ends)
            self._segments = [low if segment == high else segment for segment in self._segments]

    def _by_appearance(self, key: int) -> list[tuple[int, float]]:
        """Return places that look the same, with their relative score."""
        config = self._config
        if self._newest is None:
            return []
        matches = self._places.query(self._newest, key - config.least_gap + 1, self._loops.by_appearance)
        return [(m.key, m.relative_score) for m in matches if m.relative_score > 0.0]

    def _verify(self, place: int, key: int, guess: gtsam.Pose3 | None, score: float) -> LoopCandidate:
        """Match the keyframe to the place, and accept or reject the result."""
        # The content of the memory must not depend on the source of the result.
        self._keyframes.touch(key)
        self._keyframes.touch(place)
        return self._result_cache.cached(
            "visual loop",
            score if guess is None else guess.x(),
            lambda: self._match(place, key, guess, score),
        )

    def _match(self, place: int, key: int, guess: gtsam.Pose3 | None, score: float) -> LoopCandidate:
        """Match, and accept or reject the result."""
        config = self._config
        candidate = LoopCandidate(place, key, 0.0, 0.0, score, None, False, "")
        frame = self._keyframes.keyframe(key)
        local = [VisualKeyframe(self._keyframes.keyframe(place), gtsam.Pose3())]
        match: VisualMatch | None
        if guess is None:
            match = self._matcher.match_anywhere(frame, local)
            if match is None or match.feature_count < config.least_features:
                return candidate.refused("too few features agree")
        else:
            match = self._matcher.match(frame, local, guess)
            if match is None:
                return candidate.refused("too little fits")
        if match.motion.inlier_share < self._loops.least_inlier_share:
            return candidate.refused("too few readings fit")
        if match.overlap < self._loops.least_overlap and match.feature_count < config.least_features:
            return candidate.refused("too little overlap")
        moved = 0.0 if guess is None else dissimilarity(guess, match.pose, frame.median_depth_m)
        # All corners of three walls look alike: without features, a match may only confirm a guess.
        if moved > self._confirmed and match.feature_count < config.least_features:
            return candidate.refused("geometry alone leads elsewhere")
        if match.motion.degenerate:
            return candidate.refused("a direction is not determined")
        return LoopCandidate(place, key, 0.0, 0.0, score, match.motion, True, "")
