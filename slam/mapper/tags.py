"""Collect tags and surveyed points along the path, and add them to the graph at the end."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from fusion.estimation import FEWEST, gate
from slam.config import Config
from slam.config.tags import KnownPlaces, SurveyedPlace
from slam.graph.anchors import NOWHERE_M, Anchor, Anchored, seen_from_earth
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.landmarks import Landmark, Sighting, in_plane, landmarks_of
from slam.graph.pose_covariances import used_edges
from slam.graph.pose_graph import BatchResult
from slam.mapper.anchoring import Track, anchor
from slam.measurements import IN_PLANE, FloatArray, RgbdFrame, spatial
from slam.odometry.clock_learner import SensorClock
from slam.storage.map_places import MapPlaces, MapTag
from slam.vision.color_registration import ColorRegistration
from slam.vision.tags import TagView, find_tags


@dataclass(frozen=True, slots=True)
class SeenTag:
    """A tag in a numbered image; stamp by the camera's clock, and pose of the colour camera on the base."""

    image: int
    stamp_s: float
    sensor: str
    T_base_camera: gtsam.Pose3
    view: TagView


@dataclass(slots=True)
class TagFinder:
    """Detects tags in the images of keyframes.

    Attributes
    ----------
    places
        The installed tags; None if they are not given.
    registrations
        Poses of colour cameras that are not registered to depth, by name.
    clocks
        Clock offsets of the cameras against the robot's clock, by name; none for a leading camera.
    """

    places: KnownPlaces | None = None
    registrations: Mapping[str, ColorRegistration] = field(default_factory=dict)
    seen: list[SeenTag] = field(default_factory=list)
    images: int = 0
    clocks: Mapping[str, SensorClock] = field(default_factory=dict)
    _newest_s: dict[str, float] = field(default_factory=dict)

    def look(self, frame: RgbdFrame, T_base_camera: gtsam.Pose3) -> None:
        """Search a frame, given the pose of its depth camera on the base; skip a frame that was searched."""
        if self.places is None or self.places.size_m is None:
            return
        if self._newest_s.get(frame.sensor) == frame.stamp_s:
            return
        self._newest_s[frame.sensor] = frame.stamp_s
        self.images += 1
        lens, registration = frame.intrinsics, self.registrations.get(frame.sensor)
        if registration is not None and registration.accepted:
            lens = registration.intrinsics_color
            T_base_camera = T_base_camera.compose(registration.T_depth_color)
        self.seen += [
            SeenTag(self.images, frame.stamp_s, frame.sensor, T_base_camera, view)
            for view in find_tags(frame.color, lens, self.places)
        ]

    def taken_s(self, tag: SeenTag) -> tuple[float, float]:
        """Return the stamp of an image by the robot's clock, and its uncertainty."""
        clock = self.clocks.get(tag.sensor)
        return (tag.stamp_s, 0.0) if clock is None else (tag.stamp_s - clock.offset_s, clock.sigma_s)


class PlaceAnchors:
    """Position constraints of a map from tags and surveyed places.

    Attributes
    ----------
    found
        The tags, and the pose of the map in the surveyor's frame.
    notes, warnings
        One line each, for the user.
    """

    def __init__(self, places: KnownPlaces) -> None:
        self._places = places
        self.found = MapPlaces(places.family)
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self._seen: dict[int, list[Sighting]] = {}
        self._laid: Anchored | None = None

    def join(
        self,
        finder: TagFinder,
        graph: KeyframeGraph,
        track: Track,
        outcome: BatchResult,
        inlier_probability: float,
    ) -> BatchResult:
        """Close loops by tags that were seen again, and solve again; without any, return the old result."""
        if not finder.seen:
            if finder.images:
                self.warnings.append(
                    f"No tag of family {self._places.family} was found in {finder.images} images of keyframes"
                )
            return outcome
        sigma_px = _sigma_px([item.view for item in finder.seen])
        self._seen, twice = _by_number(finder, track, sigma_px)
        # A check proves nothing if it has moved the map.
        checks = {item.tag for item in self._places.surveyed if item.check}
        edges = self._find([number for number in self._seen if number not in checks], graph, outcome)
        for edge in edges:
            graph.add_edge(edge)
        tags = self.found.tags
        fit, views = sum(tag.fit for tag in tags), sum(tag.views for tag in tags)
        self.notes.append(
            f"tags: {len(tags)} in {finder.images} images, {fit} of {views} views fit, {len(edges)} edges "
            f"between keyframes that saw the same; corners are {sigma_px:.2f} px off"
        )
        self.warnings += [f"Tag {number} was seen at several places; it is not used" for number in twice]
        graph.graph.begin_with([*outcome.kept, *[True] * len(edges)])
        return graph.optimize(inlier_probability)

    def survey(
        self, graph: KeyframeGraph, track: Track, outcome: BatchResult, inlier_probability: float
    ) -> BatchResult:
        """Align the map with surveyed places and the start; return the old result if they do not suffice."""
        used = [
            (place, sighting)
            for place in self._places.surveyed
            if not place.check and (sighting := self._seen_at(place, track)) is not None
        ]
        anchors = [
            Anchor(node, *_place(place.at_m, place.sigma_m**2 + variance), arm_m)
            for place, (node, arm_m, variance) in used
        ]
        anchors += self._start(track)
        if not anchors:
            return outcome
        outcome, self._laid = anchor(graph, anchors, outcome, inlier_probability, EdgeKind.SURVEY)
        if self._laid is None:
            self.warnings.append(
                "The surveyed places do not determine the pose of the map: survey two points farther apart, "
                "or give the start with its yaw_deg"
            )
            return outcome
        self.found = replace(self.found, T_survey_map=self._laid.T_enu_map)
        return outcome

    def check(self, graph: KeyframeGraph, track: Track, outcome: BatchResult, config: Config) -> None:
        """Compare the finished map with surveyed places."""
        checks = [place for place in self._places.surveyed if place.check]
        self._find([place.tag for place in checks if place.tag in self._seen], graph, outcome)
        if self._laid is None:
            return
        poses = graph.poses()
        edges = used_edges(poses, graph.graph.edges, outcome.kept, config)
        spreads = seen_from_earth(poses, edges, self._laid)
        unseen = list[str]()
        for place in self._places.surveyed:
            name = f"tag {place.tag}" if place.stamp_s is None else f"the place at {place.stamp_s:.1f} s"
            if (sighting := self._seen_at(place, track)) is None:
                unseen.append(name)
                continue
            node, arm_m, variance = sighting
            pose, axes = poses[node], 2 if isinstance(poses[node], gtsam.Pose2) else len(place.at_m)
            at_m = self._laid.T_enu_map.transformFrom(spatial(pose).transformFrom(arm_m))
            off_m = (np.asarray(at_m) - [*place.at_m, 0.0][:3])[:axes]
            turn = np.asarray(self._laid.T_enu_map.rotation().compose(spatial(pose).rotation()).matrix())
            slopes = turn @ np.hstack([np.cross(np.eye(3), arm_m).T, np.eye(3)])
            if isinstance(pose, gtsam.Pose2):
                slopes = slopes[:, IN_PLANE]
            spread = (slopes @ spreads[node] @ slopes.T)[:axes, :axes] + variance * np.eye(axes)
            sigma_m = math.sqrt(np.trace(spread) / axes + place.sigma_m**2)
            role = "check" if place.check else "used"
            line = f"survey: {name} ({role}) is {np.linalg.norm(off_m):.3f} m off, sigma {sigma_m:.3f} m"
            wrong = off_m @ np.linalg.solve(spread + place.sigma_m**2 * np.eye(axes), off_m) > gate(axes)
            (self.warnings if wrong else self.notes).append(line)
        if unseen:
            self.warnings.append(f"survey: not seen by the map: {', '.join(unseen)}")

    def _find(self, numbers: Sequence[int], graph: KeyframeGraph, outcome: BatchResult) -> list[Edge]:
        """Estimate the poses of tags; return the edges between nodes that saw the same one."""
        poses, edges = graph.poses(), graph.graph.edges
        if not numbers:
            return []
        spatials = [self._seen[number] for number in numbers]
        planar = isinstance(poses[0], gtsam.Pose2)
        flat = [in_plane(ones) if planar else (ones, gtsam.Rot3()) for ones in spatials]
        inliers = [edge for edge, keep in zip(edges, outcome.kept, strict=True) if keep]
        landmarks = landmarks_of(poses, inliers, [ones for ones, _ in flat])
        found_edges, tags = list[Edge](), list(self.found.tags)
        for number, ones, (_, lean), landmark in zip(numbers, spatials, flat, landmarks, strict=True):
            if landmark is None:
                self.warnings.append(f"Tag {number}: no view fits another; it is not used")
                continue
            tags.append(self._tag(number, ones, lean, landmark))
            found_edges += landmark.edges
            if landmark.elsewhere:
                self.warnings.append(
                    f"Tag {number} is elsewhere in {landmark.elsewhere} of {len(ones)} views, which were "
                    "left out: it was moved, there are two of this number, or something else was taken for it"
                )
        self.found = replace(self.found, tags=tuple(sorted(tags, key=lambda tag: tag.number)))
        return found_edges

    def _tag(self, number: int, spatials: Sequence[Sighting], lean: gtsam.Rot3, mark: Landmark) -> MapTag:
        """Return the saved record of a tag."""
        pose, covariance = mark.T_node_landmark, mark.covariance
        if isinstance(pose, gtsam.Pose2):
            views = [one for one, keep in zip(spatials, mark.holds.tolist(), strict=True) if keep]
            heights = np.array([one.T_node_landmark.translation()[2] for one in views])
            turns = np.array([one.T_node_landmark.rotation().matrix()[2] for one in views])
            weights = 1.0 / np.einsum("ki,kij,kj->k", turns, [one.covariance[3:, 3:] for one in views], turns)
            up = np.array([0.0, 0.0, float(np.average(heights, weights=weights))])
            pose = gtsam.Pose3(gtsam.Rot3.Yaw(pose.theta()).compose(lean), [pose.x(), pose.y(), up[2]])
            variance = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 1.0 / float(weights.sum()))
        else:
            variance = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
        side_m = self._places.sizes_m.get(number, self._places.size_m)
        assert side_m is not None
        fit = int(np.count_nonzero(mark.holds))
        return MapTag(number, side_m, mark.node, pose, math.sqrt(variance), len(spatials), fit)

    def _seen_at(self, place: SurveyedPlace, track: Track) -> tuple[int, FloatArray, float] | None:
        """Return node, (3,) position in its frame and its variance for a surveyed place; None if unseen."""
        if place.stamp_s is not None:
            node = int(track.nearest(np.array([place.stamp_s]))[0])
            T_node_base = track.seen_from(node, place.stamp_s)
            return None if T_node_base is None else (node, np.asarray(T_node_base.translation()), 0.0)
        for tag in self.found.tags:
            if tag.number == place.tag:
                return tag.node, np.asarray(tag.T_node_tag.translation()), tag.sigma_m**2
        return None

    def _start(self, track: Track) -> list[Anchor]:
        """Return the known start as two places, before and behind the base, with its covariance."""
        start = self._places.start
        T_node_base = track.seen_from(0, float(track.stamps_s[0]))
        if start is None or T_node_base is None:
            return []
        yaw, arm_m = math.radians(start.yaw_deg), start.sigma_m / math.radians(start.sigma_deg)
        anchors = []
        for side in (arm_m, -arm_m):
            at, covariance = _place(start.at_m, 2.0 * start.sigma_m**2)
            at = at + side * np.array([math.cos(yaw), math.sin(yaw), 0.0])
            anchors.append(Anchor(0, at, covariance, np.asarray(T_node_base.transformFrom([side, 0.0, 0.0]))))
        return anchors


def _place(at_m: Sequence[float], variance: float) -> tuple[FloatArray, FloatArray]:
    """Return (3,) and (3, 3) of a place with this variance; an unknown height may have any value."""
    covariance = variance * np.eye(3)
    if len(at_m) == 2:
        covariance[2, 2] = NOWHERE_M**2
    return np.array([*at_m, 0.0][:3]), covariance


def _by_number(
    finder: TagFinder, track: Track, sigma_px: float
) -> tuple[dict[int, list[Sighting]], list[int]]:
    """Return sightings of each tag by node, without the numbers seen twice in one image; and those."""
    sightings, images = defaultdict[int, list[Sighting]](list), Counter[tuple[int, int]]()
    taken_s = np.array([finder.taken_s(tag) for tag in finder.seen])
    for tag, node, (stamp_s, sigma_s) in zip(finder.seen, track.nearest(taken_s[:, 0]), taken_s, strict=True):
        then, later = (track.seen_from(int(node), float(at_s)) for at_s in (stamp_s, stamp_s + sigma_s))
        if then is None or later is None:
            continue
        T_base_tag = tag.T_base_camera.compose(tag.view.T_camera_tag)
        # The motion of the robot during the clock error.
        offset = T_base_tag.inverse().AdjointMap() @ gtsam.Pose3.Logmap(then.between(later))
        covariance = tag.view.covariance(sigma_px) + np.outer(offset, offset)
        sightings[tag.view.number].append(Sighting(int(node), then.compose(T_base_tag), covariance))
        images[tag.view.number, tag.image] += 1
    twice = sorted({number for (number, _), count in images.items() if count > 1})
    once = [number for number in sorted(sightings) if number not in twice]
    return {number: sorted(sightings[number], key=lambda tag: tag.node) for number in once}, twice


def _sigma_px(views: Sequence[TagView]) -> float:
    """Return the corner error, from the redundancy of four corners; few views have little weight."""
    misfits = np.array([view.misfit_px2 for view in views])
    # False detections fit badly: the median is robust to them.
    shown = float(np.median(misfits)) / gate(2, 0.5)
    # As long as a log shows no error, corners count as rounded to whole pixels: a variance of 1/12.
    return math.sqrt((FEWEST / 12 + len(views) * shown) / (FEWEST + len(views)))
