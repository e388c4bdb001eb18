"""Where the sensors sit on the robot, by tf and tf_static."""

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

_STILL_M, _STILL_RAD = 0.005, math.radians(0.5)  # nearer than that two mountings are the same
_MOST_FRAMES = 2000  # a robot has some dozens; damaged names must not fill the memory


class FrameTree:
    """Frames and how they sit in one another; of a frame that moves, where it was first."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, gtsam.Pose3]] = {}
        self._told: dict[tuple[str, str], gtsam.Pose3] = {}
        self.moving: set[str] = set()
        self.tilting: set[str] = set()

    def __contains__(self, frame: str) -> bool:
        return any(frame in (parent, child) for parent, child, _ in self._steps())

    def set(self, parent: str, child: str, pose: gtsam.Pose3) -> None:
        """Put ``T_parent_child`` in place of what the tree says, where it says anything."""
        if (self._parents.get(child) or ("",))[0] == parent:
            self._parents[child] = parent, pose
        elif (self._parents.get(parent) or ("",))[0] == child:
            self._parents[parent] = child, pose.inverse()
        else:
            self._told[parent, child] = pose

    def sits(self, parent: str, child: str, pose: gtsam.Pose3) -> None:
        """Put a frame that the tree does not have into a parent, as a message of tf would."""
        self._parents[child] = parent, pose

    def _steps(self) -> Iterator[tuple[str, str, gtsam.Pose3]]:
        """Parent, child and pose of all that is known; what was told comes first."""
        yield from ((parent, child, pose) for (parent, child), pose in self._told.items())
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
        """Take in one transform."""
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
            up, before_up = (one.rotation().matrix()[:, 2] for one in (pose, known[1]))
            if up @ before_up < math.cos(_STILL_RAD):
                self.tilting.add(child)

    def between(self, base: str, sensor: str) -> gtsam.Pose3 | None:
        """``T_base_sensor``, None where no chain of transforms connects the two."""
        neighbours: dict[str, list[tuple[str, gtsam.Pose3]]] = {}
        for parent, child, pose in self._steps():
            neighbours.setdefault(parent, []).append((child, pose))
            neighbours.setdefault(child, []).append((parent, pose.inverse()))
        found = {base: gtsam.Pose3()}
        ahead = deque([base])
        while ahead and sensor not in found:
            frame = ahead.popleft()
            for other, pose in neighbours.get(frame, []):
                if other not in found:
                    found[other] = found[frame].compose(pose)
                    ahead.append(other)
        return found.get(sensor)

    def moves_between(self, base: str, sensor: str) -> bool:
        """Whether a joint on the way from the base to a sensor has been seen to move."""
        return bool(self.moving & (set(self._chain(base)) ^ set(self._chain(sensor))))

    def tilts_between(self, base: str, sensor: str) -> bool:
        """Whether such a joint has been seen to turn its z axis."""
        return bool(self.tilting & (set(self._chain(base)) ^ set(self._chain(sensor))))

    def sits_on(self, frame: str, other: str) -> bool:
        """Whether a frame sits on another, by whatever is between."""
        return other in self._chain(frame)[1:]

    def _chain(self, frame: str) -> list[str]:
        """A frame and what it sits on, up to the root."""
        chain = [frame]
        while (above := self._parents.get(chain[-1])) and above[0] not in chain:
            chain.append(above[0])
        return chain

    def named(self, names: Iterable[str]) -> list[str]:
        """Frames by their last names, in the order of the names: robot1/base_link is a base_link, too."""
        frames = sorted({frame for parent, child, _ in self._steps() for frame in (parent, child)})
        return [frame for name in names for frame in frames if frame.rpartition("/")[2] == name]

    def root(self) -> str | None:
        """The only frame that sits in no other; None where there is none or more than one."""
        roots = {parent for parent, _ in self._parents.values()} - set(self._parents)
        return roots.pop() if len(roots) == 1 else None

    def parent_of(self, frame: str) -> str | None:
        """The frame that a frame sits in."""
        known = self._parents.get(frame)
        return known[0] if known else None

    def lines(self) -> list[str]:
        """The tree for people, a frame a line."""
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
    """Whether two poses are farther apart than rounding."""
    step = gtsam.Pose3.Logmap(first.between(second))
    return float(np.linalg.norm(step[3:])) > _STILL_M or float(np.linalg.norm(step[:3])) > _STILL_RAD
