"""The true trajectory in a bag, from motion capture, a survey or a simulator, found by topic name."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import gtsam

from slam.datasets.account import Account
from slam.datasets.bags.decoding import Decoder, stamp_of
from slam.datasets.bags.files import Bag
from slam.datasets.bags.topics import ODOMETRY
from slam.datasets.bags.transforms import pose_of
from slam.datasets.pose_files import trajectory_of
from slam.estimates import Trajectory

PATH = "nav_msgs/msg/Path"
_POSE, _POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRUTHS = frozenset({PATH, _POSE, _POSE_COVARIANCE, _TRANSFORM, ODOMETRY})
_NAME = re.compile(
    r"ground_?truth|(^|[/_])(gt|truth|vicon|vrpn\w*|mocap|optitrack|qualisys|leica)([/_]|$)", re.IGNORECASE
)
IS_TRUTH = "by its name it is ground truth, used only for comparison"


def is_truth(topic: str, kind: str) -> bool:
    """Whether a topic is ground truth, by its type and name."""
    return kind in TRUTHS and bool(_NAME.search(topic))


def truth_topic(kinds: Mapping[str, str], requested: Sequence[str]) -> str | None:
    """The ground truth topic: named by the user, else found by name; the first of several."""
    named = [topic for topic in requested if kinds.get(topic) in TRUTHS - {ODOMETRY}]
    return next(
        iter([*named, *sorted(topic for topic, kind in kinds.items() if is_truth(topic, kind))]), None
    )


def read_truth(bag: Bag, topic: str, account: Account) -> Trajectory | None:
    """The poses of a topic in the order of the bag; for a Path, those of its longest message."""
    budget = bag.budget()
    decoder = Decoder(budget)
    poses: list[tuple[float, gtsam.Pose3]] = []
    for record in bag.records(account, budget):
        if record.channel.topic != topic:
            continue
        damages = (AttributeError, TypeError, ValueError, OverflowError, RuntimeError)
        with account.refusing(topic, record.number, "invalid pose", *damages):
            message = decoder.decode(record)
            if record.channel.kind == PATH:
                poses = max(poses, [_stamped(pose) for pose in message.poses], key=len)
            else:
                poses.append(_stamped(message))
    return trajectory_of(poses)


def _stamped(message: Any) -> tuple[float, gtsam.Pose3]:
    """Stamp and pose of a message of any supported type."""
    if hasattr(message, "transform"):
        pose = pose_of(message.transform.translation, message.transform.rotation)
    else:
        inner = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        pose = pose_of(inner.position, inner.orientation)
    return stamp_of(message.header), pose
