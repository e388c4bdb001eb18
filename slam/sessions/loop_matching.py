"""Match a keyframe of a session to parts of a map: scans, clouds or frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import closer_of
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.keyframe_store import KeyframeStore
from slam.matching.cloud_points import voxel_of
from slam.measurements import FloatArray, Pose, composed, motion_between, row_from_pose2, spatial
from slam.outputs.finished_map import Map
from slam.storage.map_contents import MapContents
from slam.storage.map_sessions import session_numbers
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame


class LoopMatcher(Protocol):
    """Match keyframes of a session, numbered after those of a map, to places of the map.

    Attributes
    ----------
    every_m
        Path length between two attempts.
    """

    every_m: float

    def tried(self, key: int, T_map_session: Pose, sigma_m: float, sigma_rad: float) -> list[LoopCandidate]:
        """Match a keyframe of the session to the places where it should be; accepted or not."""
        ...


class ScanMatcher:
    """Scans on a floor; see `LoopMatcher`."""

    def __init__(self, known: Map, session: Map, config: Config) -> None:
        parts = ((known, 0), (session, len(known.sessions)))
        self._closer = closer_of(
            [scan for part, _ in parts for scan in part.keyframe_scans],
            np.concatenate([part.keyframe_poses for part, _ in parts]),
            np.concatenate([part.contents.path_m for part, _ in parts]),
            np.concatenate([first + session_numbers(part.sessions) for part, first in parts]),
            config,
        )
        self._known, self._session, self._loops = known, session, config.loops
        self._sessions = session_numbers(known.sessions)
        self.every_m = config.loops.every_m

    def tried(self, key: int, T_map_session: Pose, sigma_m: float, sigma_rad: float) -> list[LoopCandidate]:
        """See `LoopMatcher`."""
        if self._session.keyframe_scans[key] is None:
            return []
        known, nodes = self._known.contents, len(self._known.keyframe_poses)
        expected = composed(T_map_session, self._session.contents.node_poses[key])
        covariance = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
        return [
            self._closer.verify(
                place,
                nodes + key,
                row_from_pose2(motion_between(known.node_poses[place], expected)),
                covariance,
            )
            for place in self._places(row_from_pose2(expected))
        ]

    def _places(self, expected: FloatArray) -> Iterator[int]:
        """Return keyframes of the map around a pose (3,), the nearest of each pass first."""
        loops, poses, path_m = self._loops, self._known.keyframe_poses, self._known.contents.path_m
        turns = np.abs((poses[:, 2] - expected[2] + np.pi) % (2.0 * np.pi) - np.pi)
        distances = np.hypot(*(poses[:, :2] - expected[:2]).T)
        # 90 degrees count as one metre, because the lidar may not see in all directions.
        order = np.argsort(distances + turns / (0.5 * np.pi), kind="stable")
        seen = [
            place
            for place in order.tolist()
            if distances[place] <= loops.reach_m and self._known.keyframe_scans[place] is not None
        ]
        return _of_passes(seen, path_m, self._sessions, loops.least_path_m, loops.near)


class CloudMatcher:
    """Clouds of a 3D lidar; see `LoopMatcher`."""

    def __init__(self, known: Map, session: Map, config: Config) -> None:
        one, other = known.contents, session.contents
        first, later = one.clouds, other.clouds
        assert first is not None and later is not None
        voxel_m, count = voxel_of(first.points(0), config.cloud_odometry), len(first)
        self._closer = CloudLoopCloser(
            config, voxel_m, lambda key: first.points(key) if key < count else later.points(key - count)
        )
        for pose, points in zip(one.node_poses, first, strict=True):
            self._closer.add_keyframe(points, spatial(pose))
        self._known, self._session, self._loops = one, other, config.loops
        self._sessions = session_numbers(known.sessions)
        self._positions = np.array([pose.translation() for pose in one.node_poses])
        self._reach_m = config.cloud_loops.reach_voxels * voxel_m
        self.every_m = min(config.loops.every_m, self._reach_m)

    def tried(self, key: int, T_map_session: Pose, sigma_m: float, sigma_rad: float) -> list[LoopCandidate]:
        """See `LoopMatcher`."""
        known, nodes = self._known, len(self._known.node_poses)
        expected = spatial(composed(T_map_session, self._session.node_poses[key]))
        distances = np.linalg.norm(self._positions - expected.translation(), axis=1)
        keys = [k for k in np.argsort(distances, kind="stable").tolist() if distances[k] <= self._reach_m]
        return [
            self._closer.verify(
                place, nodes + key, spatial(known.node_poses[place]).between(expected), sigma_m
            )
            for place in _of_passes(keys, known.path_m, self._sessions, self._reach_m, self._loops.near)
        ]


class FrameMatching:
    """Frames of a camera in space; see `LoopMatcher`."""

    every_m = 0.0

    def __init__(self, known: Map, session: Map, config: Config) -> None:
        self._frames = _Frames(known.contents, session.contents, config)
        self._closer = VisualLoopCloser(config, FrameMatcher(config), self._frames)
        self._known, self._session = known.contents, session.contents
        self._poses = [spatial(pose) for pose in known.contents.node_poses]

    def tried(self, key: int, T_map_session: Pose, sigma_m: float, sigma_rad: float) -> list[LoopCandidate]:
        """See `LoopMatcher`."""
        row = len(self._poses) + key
        expected = spatial(composed(T_map_session, self._session.node_poses[key]))
        depth_m = self._frames.keyframe(row).median_depth_m
        places = self._closer.near(
            range(len(self._poses)), self._poses, expected, [depth_m] * len(self._poses)
        )
        return [self._closer.verify(place, row, self._poses[place].between(expected)) for place in places]


def matcher_of(known: Map, session: Map, config: Config) -> LoopMatcher:
    """Return the matcher for two maps of the same kind."""
    if known.contents.clouds is not None:
        return CloudMatcher(known, session, config)
    return ScanMatcher(known, session, config) if known.planar else FrameMatching(known, session, config)


def _of_passes(
    ordered: Sequence[int], path_m: FloatArray, sessions: NDArray[np.int64], apart_m: float, most: int
) -> Iterator[int]:
    """Return the first of each pass by a place, up to a number."""
    chosen: list[int] = []
    for place in ordered:
        if len(chosen) == most:
            return
        if all(
            sessions[place] != sessions[other] or abs(path_m[place] - path_m[other]) > apart_m
            for other in chosen
        ):
            chosen.append(place)
            yield place


class _Frames:
    """The frames of a map, then those of a session."""

    def __init__(self, known: MapContents, session: MapContents, config: Config) -> None:
        self._known, self._session = (
            KeyframeStore(config.rgbd, config.match.local_map_keyframes, part.frames)
            for part in (known, session)
        )

    def keyframe(self, key: int) -> PreparedFrame:
        """See `slam.graph.visual_loops.Keyframes`."""
        later = key - len(self._known)
        return self._known.keyframe(key) if later < 0 else self._session.keyframe(later)

    def touch(self, key: int) -> None:
        """Do nothing: no stored result is used again."""
