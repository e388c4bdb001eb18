"""Poses of the sensors on the robot, by tf and tf_static."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.decoding import frame_name
from slam.datasets.calibration import pose_from
from slam.datasets.dataset import RecordFault

BAD_TRANSFORM = "invalid transform"
BASE_FRAMES = ("base_footprint", "base_link", "base")

_STILL_M, _STILL_RAD = 0.005, math.radians(0.5)  # two mountings closer than this are the same
_MOST_FRAMES = 2000  # a robot has a few dozen; damaged names must not fill the memory


class FrameTree:
    """Frames and their poses in their parents; for a moving frame, its first pose."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, gtsam.Pose3]] = {}
        self._poses: dict[tuple[str, str], gtsam.Pose3] = {}
        self.moving: set[str] = set()
        self.tilting: set[str] = set()

    def __contains__(self, frame: str) -> bool:
        return any(frame in (parent, child) for parent, child, _ in self._steps())

    def set(self, parent: str, child: str, pose: gtsam.Pose3) -> None:
        """Replace ``T_parent_child``, if the tree contains it."""
        if (self._parents.get(child) or ("",))[0] == parent:
            self._parents[child] = parent, pose
        elif (self._parents.get(parent) or ("",))[0] == child:
            self._parents[parent] = child, pose.inverse()
        else:
            self._poses[parent, child] = pose

    def add_frame(self, parent: str, child: str, pose: gtsam.Pose3) -> None:
        """Add a frame that the tree does not contain, as a tf message would."""
        self._parents[child] = parent, pose

    def _steps(self) -> Iterator[tuple[str, str, gtsam.Pose3]]:
        """Parent, child and pose of all known transforms; those from tf first."""
        yield from ((parent, child, pose) for (parent, child), pose in self._poses.items())
        yield from ((parent, child, pose) for child, (parent, pose) in self._parents.items())

    def add(self, message: Any) -> None:
        """Use a TFMessage; RecordFault if a transform in it is invalid (the others are used)."""
        fault: RecordFault | None = None
        for item in message.transforms:
            try:
                self._add(item)
            except (ValueError, RuntimeError) as error:
                fault = RecordFault(BAD_TRANSFORM, str(error))
        if fault is not None:
            raise fault

    def _add(self, item: Any) -> None:
        """Add one transform."""
        parent, child = frame_name(item.header.frame_id), frame_name(item.child_frame_id)
        pose = pose_of(item.transform.translation, item.transform.rotation)
        if not parent or not child or parent == child:
            raise ValueError(f"from '{parent}' to '{child}'")
        known = self._parents.get(child)
        if known is None:
            if len(self._parents) < _MOST_FRAMES:
                self._parents[child] = parent, pose
        elif known[0] == parent and child not in self.tilting and differs(known[1], pose):
            self.moving.add(child)
            up, before_up = (T.rotation().matrix()[:, 2] for T in (pose, known[1]))
            if up @ before_up < math.cos(_STILL_RAD):
                self.tilting.add(child)

    def between(self, base: str, sensor: str) -> gtsam.Pose3 | None:
        """``T_base_sensor``, None if no chain of transforms connects the two."""
        neighbours: dict[str, list[tuple[str, gtsam.Pose3]]] = {}
        for parent, child, pose in self._steps():
            neighbours.setdefault(parent, []).append((child, pose))
            neighbours.setdefault(child, []).append((parent, pose.inverse()))
        poses = {base: gtsam.Pose3()}
        ahead = deque([base])
        while ahead and sensor not in poses:
            frame = ahead.popleft()
            for other, pose in neighbours.get(frame, []):
                if other not in poses:
                    poses[other] = poses[frame].compose(pose)
                    ahead.append(other)
        return poses.get(sensor)

    def moves_between(self, base: str, sensor: str) -> bool:
        """Whether a joint between the base and a sensor moves in the bag."""
        return bool(self.moving & (set(self._chain(base)) ^ set(self._chain(sensor))))

    def tilts_between(self, base: str, sensor: str) -> bool:
        """Whether such a joint tilts its z axis in the bag."""
        return bool(self.tilting & (set(self._chain(base)) ^ set(self._chain(sensor))))

    def is_attached(self, frame: str, other: str) -> bool:
        """Whether a frame is attached to another, directly or through other frames."""
        return other in self._chain(frame)[1:]

    def _chain(self, frame: str) -> list[str]:
        """A frame and its ancestors, up to the root."""
        chain = [frame]
        while (above := self._parents.get(chain[-1])) and above[0] not in chain:
            chain.append(above[0])
        return chain

    def named(self, names: Iterable[str]) -> list[str]:
        """Frames by the last parts of their names, in the given order: robot1/base_link is a base_link."""
        frames = sorted({frame for parent, child, _ in self._steps() for frame in (parent, child)})
        return [frame for name in names for frame in frames if frame.rpartition("/")[2] == name]

    def root(self) -> str | None:
        """The only frame without parent; None if there is none or more than one."""
        roots = {parent for parent, _ in self._parents.values()} - set(self._parents)
        return roots.pop() if len(roots) == 1 else None

    def parent_of(self, frame: str) -> str | None:
        """The parent of a frame."""
        known = self._parents.get(frame)
        return known[0] if known else None

    def lines(self) -> list[str]:
        """The tree as text for the user, one frame per line."""
        children: dict[str, list[str]] = {}
        for child, (parent, _) in sorted(self._parents.items()):
            children.setdefault(parent, []).append(child)
        roots = sorted(set(children) - set(self._parents))
        lines: list[str] = []
        ahead = [(root, 0) for root in reversed(roots)]
        while ahead:
            frame, depth = ahead.pop()
            moves = " (moves)" if frame in self.moving else ""
            lines.append(f"{'  ' * depth}{frame}{moves}")
            ahead += [(child, depth + 1) for child in reversed(children.get(frame, []))]
        return lines


def pose_of(position: Any, rotation: Any) -> gtsam.Pose3:
    """Return a pose of a Vector3 or Point and a Quaternion; ValueError if they are not finite or no pose."""
    return pose_from([position.x, position.y, position.z], [rotation.x, rotation.y, rotation.z, rotation.w])


def differs(first: gtsam.Pose3, second: gtsam.Pose3) -> bool:
    """Whether two poses differ by more than rounding."""
    step = gtsam.Pose3.Logmap(first.between(second))
    return float(np.linalg.norm(step[3:])) > _STILL_M or float(np.linalg.norm(step[:3])) > _STILL_RAD
