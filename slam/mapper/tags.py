"""Tags and surveyed places: gathered along the way, and what they do to the graph when it is done."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.estimation import FEWEST, gate
from slam.config.tags import KnownPlaces, SurveyedPlace
from slam.graph.anchors import NOWHERE_M, Anchor
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.landmarks import Landmark, Sighting, in_plane, landmarks_of
from slam.graph.pose_graph import BatchResult, EdgeKind
from slam.mapper.anchoring import Way, anchor
from slam.measurements import FloatArray, RgbdFrame
from slam.storage.map_places import MapPlaces, MapTag
from slam.vision.color_registration import ColorRegistration
from slam.vision.tags import TagView, find_tags

# Corners are as sure as a whole pixel, until a log has shown its own: of the variance of what is rounded.
_ROUNDED_PX2 = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class SeenTag:
    """A tag in an image of a keyframe, and where the colour camera was, seen from the node."""

    image: int
    node: int
    T_node_camera: gtsam.Pose3
    view: TagView


class TagFinder:
    """Looks for tags in the images of keyframes.

    Parameters
    ----------
    places
        What hangs; None where nobody has said that.

    Attributes
    ----------
    seen
        All so far.
    images
        How many were looked at.
    """

    def __init__(self, places: KnownPlaces | None) -> None:
        self._places = places
        self.seen: list[SeenTag] = []
        self.images = 0

    def look(
        self, frame: RgbdFrame, node: int, T_node_camera: gtsam.Pose3, registration: ColorRegistration | None
    ) -> None:
        """Take a frame of a node, and where its depth camera was, seen from there."""
        if self._places is None or self._places.size_m is None:
            return
        self.images += 1
        lens = frame.intrinsics
        if registration is not None and registration.accepted:
            lens, T_node_camera = (
                registration.intrinsics_color,
                T_node_camera.compose(registration.T_depth_color),
            )
        for view in find_tags(frame.color, lens, self._places):
            self.seen.append(SeenTag(self.images, node, T_node_camera, view))


class PlaceAnchors:
    """What tags and surveyed places know of a map.

    Parameters
    ----------
    places
        What a person knows.

    Attributes
    ----------
    found
        The tags, and where the map lies in the surveyor's frame.
    notes, warnings
        One line each, for people.
    """

    def __init__(self, places: KnownPlaces) -> None:
        self._places = places
        self.found = MapPlaces(places.family)
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def join(
        self, finder: TagFinder, graph: KeyframeGraph, outcome: BatchResult, inlier_probability: float
    ) -> BatchResult:
        """Let tags that were seen again close loops, and solve anew; the old outcome without any."""
        # Of a check the place is found, and the way goes on without it.
        seen = _unrepeated(finder.seen)
        numbers = sorted(seen)
        if not numbers:
            if finder.images:
                self.warnings.append(
                    f"No tag of family {self._places.family} was found in {finder.images} images of keyframes"
                )
            return outcome
        sigma_px = _sigma_px([one.view for one in finder.seen])
        planar = isinstance(graph.poses()[0], gtsam.Pose2)
        sightings = [[_sighting(one, sigma_px) for one in seen[number]] for number in numbers]
        flat = [in_plane(ones) if planar else (ones, gtsam.Rot3()) for ones in sightings]
        edges = graph.graph.edges
        held = [edge for edge, keep in zip(edges, outcome.kept, strict=True) if keep]
        landmarks = landmarks_of(graph.poses(), held, [ones for ones, _ in flat], inlier_probability)
        checks = {one.tag for one in self._places.surveyed if one.check}
        tags, more = list[MapTag](), 0
        for number, spatials, (_, lean), landmark in zip(numbers, sightings, flat, landmarks, strict=True):
            if landmark is None:
                continue
            tags.append(self._tag(number, spatials, lean, landmark))
            if number not in checks:
                more += len(landmark.edges)
                for edge in landmark.edges:
                    graph.add_edge(edge)
        self.found = MapPlaces(self._places.family, tuple(tags))
        self._tell(finder, numbers, tags, sigma_px)
        graph.graph.begin_with([*outcome.kept, *[True] * more])
        return graph.optimize(inlier_probability)

    def survey(
        self, graph: KeyframeGraph, way: Way, outcome: BatchResult, inlier_probability: float
    ) -> BatchResult:
        """Lay the map where surveyed places and the start say; the old outcome where they do not tell."""
        used = {one: seen for one in self._places.surveyed if (seen := self._seen(one, way)) is not None}
        anchors = [
            Anchor(node, *_place(one.at_m, one.sigma_m**2 + variance), arm_m)
            for one, (node, arm_m, variance) in used.items()
            if not one.check
        ]
        anchors += self._start(way)
        if not anchors:
            return outcome
        outcome, found = anchor(graph, anchors, outcome, inlier_probability, EdgeKind.SURVEY)
        if found is None:
            self.warnings.append(
                "The surveyed places do not tell how the map lies: survey two that are farther apart, or "
                "give the start with its yaw_deg"
            )
            return outcome
        self.found = MapPlaces(self.found.family, self.found.tags, found.T_enu_map)
        return outcome

    def check(self, way: Way, spreads: FloatArray) -> None:
        """Compare the map with surveyed places when it is done.

        Parameters
        ----------
        spreads
            (K, 3, 3) covariance of the nodes' places in the map, along its axes.
        """
        T_survey_map = self.found.T_survey_map
        if T_survey_map is None:
            return
        for one in self._places.surveyed:
            seen = self._seen(one, way)
            name = f"tag {one.tag}" if one.stamp_s is None else f"the place at {one.stamp_s:.1f} s"
            if seen is None:
                self.warnings.append(f"{name} is surveyed, and was not seen")
                continue
            node, arm_m, variance = seen
            base = way.nodes[node]
            spatial_node = base if isinstance(base, gtsam.Pose3) else gtsam.Pose3(base)
            at = np.asarray(T_survey_map.transformFrom(spatial_node.transformFrom(arm_m)))
            axes = len(one.at_m)
            off = at[:axes] - np.array(one.at_m)
            sigma = math.sqrt(one.sigma_m**2 + variance + np.trace(spreads[node][:axes, :axes]) / axes)
            role = "check" if one.check else "used"
            self.notes.append(
                f"survey: {name} ({role}) is {np.linalg.norm(off):.3f} m off its place, "
                f"{np.round(off, 3).tolist()}, sigma {sigma:.3f}"
            )

    def _tag(self, number: int, spatials: Sequence[Sighting], lean: gtsam.Rot3, found: Landmark) -> MapTag:
        """What is saved of a tag."""
        pose, covariance = found.T_node_landmark, found.covariance
        if isinstance(pose, gtsam.Pose2):
            held = [one for one, keep in zip(spatials, found.holds.tolist(), strict=True) if keep]
            heights = np.array([one.T_node_landmark.translation()[2] for one in held])
            turns = np.array([one.T_node_landmark.rotation().matrix()[2] for one in held])
            weights = 1.0 / np.einsum("ki,kij,kj->k", turns, [one.covariance[3:, 3:] for one in held], turns)
            up = np.array([0.0, 0.0, float(np.average(heights, weights=weights))])
            pose = gtsam.Pose3(gtsam.Rot3.Yaw(pose.theta()).compose(lean), [pose.x(), pose.y(), up[2]])
            variance = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 1.0 / float(weights.sum()))
        else:
            variance = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
        side_m = self._places.sizes_m.get(number, self._places.size_m)
        assert side_m is not None
        fit = int(np.count_nonzero(found.holds))
        return MapTag(number, side_m, found.node, pose, math.sqrt(variance), len(spatials), fit)

    def _seen(self, one: SurveyedPlace, way: Way) -> tuple[int, FloatArray, float] | None:
        """Node, (3,) place in its frame and variance of that, of a surveyed place; None where it was not."""
        if one.stamp_s is not None:
            node = int(way.nearest(np.array([one.stamp_s]))[0])
            T_node_base = way.seen_from(node, one.stamp_s)
            return None if T_node_base is None else (node, np.asarray(T_node_base.translation()), 0.0)
        for tag in self.found.tags:
            if tag.number == one.tag:
                return tag.node, np.asarray(tag.T_node_tag.translation()), tag.sigma_m**2
        return None

    def _start(self, way: Way) -> list[Anchor]:
        """The known start as two places, before and behind the base: both together are as sure as it is."""
        start = self._places.start
        T_node_base = way.seen_from(0, float(way.stamps_s[0]))
        if start is None or T_node_base is None:
            return []
        yaw, arm_m = math.radians(start.yaw_deg), start.sigma_m / math.radians(start.sigma_deg)
        anchors = []
        for side in (arm_m, -arm_m):
            at, covariance = _place(start.at_m, 2.0 * start.sigma_m**2)
            at = at + side * np.array([math.cos(yaw), math.sin(yaw), 0.0])
            anchors.append(Anchor(0, at, covariance, np.asarray(T_node_base.transformFrom([side, 0.0, 0.0]))))
        return anchors

    def _tell(
        self, finder: TagFinder, numbers: Sequence[int], tags: Sequence[MapTag], sigma_px: float
    ) -> None:
        """What was seen, and what does not fit."""
        views, fit = sum(tag.views for tag in tags), sum(tag.fit for tag in tags)
        again = sum(tag.fit > 1 for tag in tags)
        self.notes.append(
            f"tags: {len(tags)} in {finder.images} images, {fit} of {views} views fit; {again} were seen "
            f"from several keyframes; corners are {sigma_px:.2f} px off"
        )
        for tag in tags:
            if tag.fit < tag.views:
                self.warnings.append(
                    f"Tag {tag.number} is elsewhere in {tag.views - tag.fit} of {tag.views} views, which "
                    "were left out: it was moved, or there are two of this number"
                )
        repeated = sorted({one.view.number for one in finder.seen} - set(numbers))
        for number in repeated:
            self.warnings.append(f"Tag {number} hangs at several places at once; it is not used")


def _place(at_m: Sequence[float], variance: float) -> tuple[FloatArray, FloatArray]:
    """(3,) and (3, 3) of a place with so much variance; where its height is not known it may be any."""
    covariance = variance * np.eye(3)
    if len(at_m) == 2:
        covariance[2, 2] = NOWHERE_M**2
    return np.array([*at_m, 0.0][:3]), covariance


def _unrepeated(seen: Sequence[SeenTag]) -> dict[int, list[SeenTag]]:
    """Sightings by number, without numbers that were seen at two places of one image."""
    found, images = defaultdict[int, list[SeenTag]](list), Counter[tuple[int, int]]()
    for one in seen:
        found[one.view.number].append(one)
        images[one.view.number, one.image] += 1
    twice = {number for (number, _), count in images.items() if count > 1}
    return {number: ones for number, ones in found.items() if number not in twice}


def _sigma_px(views: Sequence[TagView]) -> float:
    """How far corners are off, by what four of them tell too much; few views count little."""
    misfits = np.array([view.misfit_px2 for view in views])
    # What is no tag fits badly: the median does not mind.
    shown = float(np.median(misfits)) / gate(2, 0.5)
    return math.sqrt((FEWEST * _ROUNDED_PX2 + len(views) * shown) / (FEWEST + len(views)))


def _sighting(one: SeenTag, sigma_px: float) -> Sighting:
    """A view as the node sees it."""
    pose = one.T_node_camera.compose(one.view.T_camera_tag)
    return Sighting(one.node, pose, one.view.covariance(sigma_px))
