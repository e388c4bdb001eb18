"""Loops that the user forbids, forces or adds, and loops verified again with other settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import closer_of
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.keyframe_store import KeyframeStore
from slam.matching.cloud_points import voxel_of
from slam.matching.planar import between
from slam.measurements import FloatArray, pose2_from_row, spatial
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.map_edits import AppliedEdits, Pair
from slam.storage.map_sessions import MapSession, session_numbers
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.frame_matcher import FrameMatcher

FORBIDDEN = "forbidden by hand"
_FEW = ("too few points fit", "too few readings fit")
_OFF = "no loops are closed"


def pair_of(loop: LoopCandidate) -> Pair:
    """Return the two keyframes of a loop, the lower first."""
    return min(loop.place, loop.keyframe), max(loop.place, loop.keyframe)


def edited_loops(
    base: MapContents, entries: Sequence[AppliedEdits], before: Config, config: Config
) -> tuple[list[SavedFactor], list[LoopCandidate]]:
    """Return the factors and loop candidates of a map with edits, not yet optimised.

    Parameters
    ----------
    before, config
        The settings of the unedited map, and those of the edited one.

    Returns
    -------
    Factors without those of permanently rejected loops: no later optimisation brings these back.
    """
    loops = [*base.loops]
    state: dict[int, bool] = {}  # True: forced, False: forbidden
    for entry in entries:
        for pair in entry.forbidden:
            state.update(dict.fromkeys(_numbers(loops, pair), False))
        loops += entry.added
        for pair in entry.forced:
            state[best_of(loops, pair)] = True
    if config.loops != before.loops:
        loops = [_rejudged(loop, config) for loop in loops]
    forced = {decided for decided, on in state.items() if on}
    for decided, on in state.items():
        loops[decided] = (
            replace(loops[decided], accepted=True, reason="") if on else loops[decided].refused(FORBIDDEN)
        )
    factors, there = [], set[int]()
    for factor in base.factors:
        number = factor.edge.loop
        if number is None:
            factors.append(factor)
            continue
        there.add(number)
        # Rejected by the user or a setting, not by other loops.
        if loops[number].reason in (FORBIDDEN, _OFF, *_FEW):
            continue
        factors.append(_trusted(factor) if number in forced else factor)
    for candidate, loop in enumerate(loops):
        if candidate not in there and loop.accepted and loop.motion is not None:
            new = SavedFactor(loop.edge(candidate), True)
            factors.append(_trusted(new) if candidate in forced else new)
    return factors, loops


def best_of(loops: Sequence[LoopCandidate], pair: Pair) -> int:
    """Return the number of the best loop between two keyframes: accepted, else with the best score.

    Raises
    ------
    MapFileError
        If none of them has a match.
    """
    matched = [number for number in _numbers(loops, pair) if loops[number].motion is not None]
    if not matched:
        raise MapFileError("a loop that was to be forced has no match; add it under loops: add")
    return max(matched, key=lambda number: (loops[number].accepted, loops[number].score, -number))


def _numbers(loops: Sequence[LoopCandidate], pair: Pair) -> list[int]:
    """Return the numbers of all loops between two keyframes."""
    return [number for number, loop in enumerate(loops) if pair_of(loop) == pair]


def _trusted(factor: SavedFactor) -> SavedFactor:
    """Return a factor that no optimisation rejects."""
    return SavedFactor(replace(factor.edge, trusted=True), True)


def _rejudged(loop: LoopCandidate, config: Config) -> LoopCandidate:
    """Verify a loop with other limits, as far as its match allows."""
    settings, motion = config.loops, loop.motion
    if not settings.enabled:
        return loop.refused(_OFF)
    if motion is None or not (loop.accepted or "GNC" in loop.reason or loop.reason in _FEW):
        return loop
    if motion.inlier_share < settings.least_inlier_share:
        return loop if loop.reason in _FEW else loop.refused(_FEW[0])
    return replace(loop, accepted=True, reason="") if loop.reason in _FEW else loop


def refuse_unknown(loops: Sequence[LoopCandidate], pair: Pair, ends: str, *, matched: bool) -> None:
    """Raise an error if a loop to forbid or force does not exist.

    Parameters
    ----------
    matched
        Whether the loop needs a match.

    Raises
    ------
    MapFileError
        If it does not exist; the message names it.
    """
    numbers = _numbers(loops, pair)
    if not numbers:
        raise MapFileError(f"no loop was ever tried between {ends}; 'loops: add' matches the two")
    if matched and all(loops[number].motion is None for number in numbers):
        reason = loops[numbers[-1]].reason
        raise MapFileError(f"the loop between {ends} has no match ({reason}); 'loops: add' matches them anew")


def matched_loops(
    contents: MapContents,
    sessions: Sequence[MapSession],
    pairs: Sequence[tuple[int, int, FloatArray | None, str]],
    config: Config,
) -> list[LoopCandidate]:
    """Match pairs of keyframes.

    Parameters
    ----------
    pairs
        Two rows each, the pose (3,) of the second relative to the first or None, and their names.

    Raises
    ------
    MapFileError
        If two do not match, with the reason.
    """
    if not pairs:
        return []
    if not contents.planar:
        return [_checked(*_match_in_space(contents, pair, config)) for pair in pairs]
    poses, path_m = contents.keyframe_poses, contents.path_m
    closer = closer_of(contents.keyframe_scans, poses, path_m, session_numbers(sessions), config)
    matched, loops = [], config.loops
    for first, second, guess, ends in pairs:
        if guess is None:
            # At about the same position, with any heading.
            widths = loops.reach_m, np.pi
            expected = np.array([0.0, 0.0, between(poses[first], poses[second])[2]])
        else:
            widths, expected = (config.match.search_half_width_m, config.match.search_half_yaw_rad), guess
        earlier, later = min(first, second), max(first, second)
        if earlier != first:
            expected = between(expected, np.zeros(3))
        sigmas = np.array([widths[0], widths[0], widths[1]]) / loops.sigmas
        matched.append(_checked(closer.verify(earlier, later, expected, np.diag(sigmas**2)), ends))
    return matched


def _match_in_space(
    contents: MapContents, named_pair: tuple[int, int, FloatArray | None, str], config: Config
) -> tuple[LoopCandidate, str]:
    """Return the match of two clouds, or of two frames of a camera alone, and its name."""
    first, second, row, ends = named_pair
    earlier, later = min(first, second), max(first, second)
    guess = None if row is None else gtsam.Pose3(pose2_from_row(row))
    if guess is not None and earlier != first:
        guess = guess.inverse()
    poses, clouds, frames = [spatial(pose) for pose in contents.node_poses], contents.clouds, contents.frames
    if clouds is not None:
        voxel_m = voxel_of(clouds.points(0), config.cloud_odometry)
        closer = CloudLoopCloser(config, voxel_m, clouds.points)
        for pose, points in zip(poses, clouds, strict=True):
            closer.add_keyframe(points, pose)
        sigma_m = config.match.search_half_width_m / config.loops.sigmas
        wide_m = config.loops.reach_m / config.loops.sigmas
        return closer.verify(earlier, later, guess, wide_m if guess is None else sigma_m), ends
    assert frames is not None
    store = KeyframeStore(config.rgbd, config.match.local_map_keyframes, frames)
    visual = VisualLoopCloser(config, FrameMatcher(config), store)
    if guess is not None:
        T_base_camera = frames.head(0).T_base_camera or T_BODY_CAMERA
        guess = T_base_camera.inverse().compose(guess).compose(T_base_camera)
    return visual.verify(earlier, later, guess), ends


def _checked(loop: LoopCandidate, ends: str) -> LoopCandidate:
    """Return a loop that matches.

    Raises
    ------
    MapFileError
        If it does not, with the reason.
    """
    if not loop.accepted:
        raise MapFileError(f"no loop between {ends}: {loop.reason}")
    return loop
