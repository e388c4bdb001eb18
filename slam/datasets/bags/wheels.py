"""Wheel odometry from Odometry messages or tf."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import gtsam

from slam.datasets.bags.decoding import frame_name, stamp_of
from slam.datasets.bags.evidence import ODOM_FRAMES
from slam.datasets.bags.survey import Survey
from slam.datasets.bags.transforms import pose_of
from slam.measurements import Measurement, WheelOdometry


def wheel_reader(survey: Survey, base: str, topic: str, notes: list[str]) -> Callable[[Any], Measurement]:
    """A function that reads Odometry messages of a topic as planar motion of the robot's frame."""
    child = survey.odometry.get(topic, ("", ""))[1]
    between = survey.tree.between(child, base) if child != base and base else gtsam.Pose3()
    if between is None:
        notes.append(f"{topic}: tf does not connect {child or 'its frame'} with {base}; assumed identical")
    T_child_base = between or gtsam.Pose3()

    def read(message: Any) -> Measurement:
        pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
        return WheelOdometry(stamp_of(message.header), _planar(pose.compose(T_child_base)), topic)

    return read


def wheels_from_tf(
    survey: Survey, base: str, notes: list[str]
) -> Callable[[Any], Iterator[WheelOdometry]] | None:
    """A function that reads wheel odometry from tf messages; None if tf has no odom frame, or if that frame
    belongs to an odometry that does not come from wheels.
    """
    child, parent = base, survey.tree.parent_of(base)
    while parent is not None and parent.rpartition("/")[2] not in ODOM_FRAMES:
        child, parent = parent, survey.tree.parent_of(parent)
    if parent is None or (parent, child) in survey.odometry.values():
        return None
    T_child_base = survey.tree.between(child, base) or gtsam.Pose3()
    notes.append(f"no odometry topic: wheels from tf, {parent} to {child}")

    def read(message: Any) -> Iterator[WheelOdometry]:
        for item in message.transforms:
            if frame_name(item.header.frame_id) == parent and frame_name(item.child_frame_id) == child:
                pose = pose_of(item.transform.translation, item.transform.rotation).compose(T_child_base)
                yield WheelOdometry(stamp_of(item.header), _planar(pose), "tf")

    return read


def _planar(pose: gtsam.Pose3) -> gtsam.Pose2:
    """x, y and the heading of the x axis."""
    axes = pose.rotation().matrix()
    return gtsam.Pose2(pose.x(), pose.y(), math.atan2(axes[1, 0], axes[0, 0]))
