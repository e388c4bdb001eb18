"""Ranks the topics of a bag by tf, names and the messages at the start of the bag."""

from __future__ import annotations

import math
import re
from functools import partial
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.clouds import LEAST_POINTS
from slam.datasets.bags.decoding import frame_name
from slam.datasets.bags.laser import LaserMount
from slam.datasets.bags.survey import Survey
from slam.datasets.bags.topics import CLOUDS, IMAGES, ODOMETRY, POINT_CLOUD, SCANS, Evidence
from slam.datasets.bags.transforms import BASE_FRAMES
from slam.datasets.bags.truth import IS_TRUTH, is_truth
from slam.datasets.dataset import RecordFault

ODOM_FRAMES = ("odom", "odom_combined")
_FUSED = re.compile(r"filter|ekf|ukf|fus(ed|ion)|estimat|combined|local|global|correct|optimi", re.IGNORECASE)
_NO_WHEELS = re.compile(
    r"(^|[/_])(camera|zed\w*|t265|vins\w*|vio|lio|visual|orb\w*|rtabmap|icp|\w*loam\w*|slam|lidar|laser|scan|kiss|rf2o"
    r"|gps|gnss|utm|amcl|map\w*)\d*([/_]|$)",
    re.IGNORECASE,
)
_WHEELS = re.compile(r"wheel|encoder|diff|drive|raw|chassis|base", re.IGNORECASE)
_MADE = re.compile(
    r"filter|regist|ground|obstacle|segment|cluster|down_?sampl|deskew|voxel|map|local|global|effect|surround"
    r"|corner|surf|feature|crop|second|aggregat|concat|object|undistort|colou?r",
    re.IGNORECASE,
)
_OF_LIDAR = re.compile(r"(range|signal|near_?ir|reflec\w*|ambient|intensity)_image", re.IGNORECASE)
_WORLDS = {"map", "world", "earth", "camera_init", "global", *ODOM_FRAMES}
_APART_M, _APART_RAD = 0.01, math.radians(1.0)


def evidence_of(survey: Survey) -> Evidence:
    """Criteria to choose between several topics of one type."""
    return Evidence(
        scan=partial(_scan_rank, survey),
        cloud=partial(_cloud_rank, survey),
        odometry=partial(_odometry_rank, survey),
        frame=lambda topic: survey.frames.get(topic, ""),
        apart=partial(_apart, survey),
    )


def never_read(survey: Survey) -> dict[str, str]:
    """Sensor topics that are read only if the user names them, with the reason."""
    reasons: dict[str, str] = {}
    kinds = {topic: survey.channels[topic].kind for topic in sorted(survey.seen)}
    for topic, kind in kinds.items():
        frame = survey.frames.get(topic, "")
        if survey.robots.of_another(topic):
            reasons[topic] = f"it is of another robot than {survey.robots.read}"
        elif is_truth(topic, kind):
            reasons[topic] = IS_TRUTH
        elif kind == ODOMETRY and (estimate := _no_wheels(survey, topic)):
            reasons[topic] = estimate
        elif kind in SCANS and (cloud := _made_of(survey, topic)):
            reasons[topic] = f"it is made of {cloud}, which has the same frame and stamps, and more data"
        elif kind in SCANS and (unfit := _not_in_plane(survey, frame)):
            reasons[topic] = unfit
        elif kind in IMAGES and _OF_LIDAR.search(topic) and (cloud := _beside(survey, topic)):
            reasons[topic] = f"it is an image of the lidar data in {cloud}"
        elif kind in CLOUDS and _last(frame) in _WORLDS:
            reasons[topic] = f"it stands in {frame}, already transformed by an estimated pose"
        elif kind == POINT_CLOUD and (view := survey.clouds.get(topic)) and view.points < LEAST_POINTS:
            reasons[topic] = f"its {view.points} points are from a sonar or a bumper, not from a lidar"
    made = _camera_clouds(survey)
    rest = {topic for topic in kinds if topic not in reasons and topic not in made}
    cameras = {topic for topic in rest & set(survey.depths) if survey.depths[topic]}
    if cameras or any(kinds[topic] in SCANS | CLOUDS for topic in rest):
        # If there is no other sensor, such a cloud is better than none.
        reasons |= {
            topic: f"it is the cloud of a depth camera, not of a lidar ({why})"
            for topic, why in made.items()
            if topic not in reasons
        }
    return reasons


def _camera_clouds(survey: Survey) -> dict[str, str]:
    """Clouds that come from a depth camera: they repeat its images and are no lidar's; with the reason.

    Their frame is a camera's and their points have no timestamps; or all points are in a camera's field of
    view, and their axes, frame, order or stamps are a camera's. A spinning lidar sees in all directions; a
    solid-state lidar has a frame and stamps of its own.
    """
    frames = {frame_name(lens.header.frame_id): topic for topic, lens in survey.lenses.items()}
    frames |= {survey.frames[topic]: topic for topic in survey.stamps_s if topic in survey.frames}
    stamps_s = {stamp_s: topic for topic, stamps in survey.stamps_s.items() for stamp_s in stamps}
    found = {}
    for topic, view in survey.clouds.items():
        frame = survey.frames[topic]
        in_camera = "optical" in frame or (frame and frame in frames)
        if not view.along and (view.timed or not in_camera):
            continue
        if "optical" in frame:
            found[topic] = f"its frame is {frame}"
        elif frame and frame in frames:
            found[topic] = f"it is in the frame of {frames[frame]}"
        elif view.stamp_s in stamps_s:
            found[topic] = f"its stamps are those of {stamps_s[view.stamp_s]}"
        elif view.along == "z" and survey.stamps_s:
            found[topic] = "its view is along z, the optical axis"
        elif view.rows > 1 and survey.stamps_s:
            found[topic] = "its points are in the order of an image"
    return found


def _not_in_plane(survey: Survey, frame: str) -> str:
    """Why a scanner does not scan in the robot's plane, by tf; empty if it may do so."""
    base = survey.base_frame()
    mount = survey.tree.between(base, frame) if base else None
    try:
        if mount is not None:
            LaserMount.of(mount)
    except RecordFault as fault:
        return str(fault)
    tilts = base is not None and survey.tree.tilts_between(base, frame)
    return f"{frame} tilts on the robot" if tilts else ""


def _no_wheels(survey: Survey, topic: str) -> str:
    """Why a topic is not wheel odometry; empty if it may be."""
    parent = _last(survey.odometry.get(topic, ("", ""))[0])
    if parent in _WORLDS.difference(ODOM_FRAMES):
        return f"it is an estimate in {parent}, not wheel odometry"
    return "by its name it is not wheel odometry" if _NO_WHEELS.search(topic) else ""


def _beside(survey: Survey, image: str) -> str | None:
    """The cloud with an image's frame or namespace."""
    space, frame = image.rpartition("/")[0], survey.frames.get(image)
    clouds = ((topic, survey.frames.get(topic)) for topic in sorted(survey.clouds))
    return next((topic for topic, own in clouds if own == frame or topic.rpartition("/")[0] == space), None)


def _made_of(survey: Survey, scan: str) -> str | None:
    """The lidar cloud from which a scan was extracted, as a ring or a slice."""
    return next(
        (
            topic
            for topic, view in sorted(survey.clouds.items())
            if not view.along
            and view.stamp_s in survey.scan_stamps_s.get(scan, ())
            and survey.frames.get(topic) == survey.frames.get(scan)
        ),
        None,
    )


def _scan_rank(survey: Survey, topic: str) -> tuple[Any, ...]:
    """Scanners with a pose in tf first, then the wider view, then the longer range."""
    base, frame = survey.base_frame(), survey.frames.get(topic, "")
    lost = base is not None and survey.tree.between(base, frame) is None and frame != base
    scan = survey.scans.get(topic)
    view = (float(abs(scan.angle_max - scan.angle_min)), float(scan.range_max)) if scan else (0.0, 0.0)
    span_rad, range_m = view if all(map(math.isfinite, view)) else (0.0, 0.0)
    return lost, -round(math.degrees(span_rad)), -range_m, topic


def _cloud_rank(survey: Survey, topic: str) -> tuple[Any, ...]:
    """Raw lidar clouds before processed ones, then those with times, a full view, many points."""
    view = survey.clouds.get(topic)
    if view is None:
        return True, True, 0.0, 0, topic
    return bool(_MADE.search(topic)), not view.timed, -view.around, -view.points, topic


def _odometry_rank(survey: Survey, topic: str) -> tuple[Any, ...]:
    """Wheels before estimates; then the odometry that moves the base in tf."""
    parent, child = survey.odometry.get(topic, ("", ""))
    return (
        bool(_FUSED.search(topic)),
        _last(child) not in BASE_FRAMES,
        not _WHEELS.search(topic),
        survey.tree.parent_of(child) != parent,
        topic,
    )


def _apart(survey: Survey, first: str, second: str) -> bool:
    """Whether tf contains the positions of two scanners, and they differ."""
    base = survey.base_frame()
    frames = [survey.frames.get(topic, "") for topic in (first, second)]
    if base is None or frames[0] == frames[1]:
        return False
    poses = [survey.tree.between(base, frame) for frame in frames]
    if poses[0] is None or poses[1] is None:
        return False
    step = poses[0].between(poses[1])
    turned_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
    return float(np.linalg.norm(step.translation())) > _APART_M or turned_rad > _APART_RAD


def _last(frame: str) -> str:
    """A frame name without the name of the robot."""
    return frame.rpartition("/")[2]
