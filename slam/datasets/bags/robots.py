"""Several robots in one bag, each in its own namespace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slam.datasets.bags.topics import CLOUDS, IMAGES, ODOMETRY, SCANS, TRANSFORMS


@dataclass(frozen=True, slots=True)
class Robots:
    """The robots of a bag.

    Attributes
    ----------
    spaces
        Their namespaces; none if the bag has one robot.
    read
        Namespace of the robot that is read.
    """

    spaces: tuple[str, ...] = ()
    read: str = ""

    @classmethod
    def of(cls, kinds: Mapping[str, str], requested: Sequence[str]) -> Robots:
        """Find robots: namespaces with wheels or transforms, and with a lidar or a camera.

        Parameters
        ----------
        kinds
            Message type of each topic.
        requested
            Topics or namespaces named by the user: they select the robot, else it is the first by name.
        """
        found: dict[str, set[str]] = {}
        for topic, kind in kinds.items():
            found.setdefault(_space(topic), set()).add(kind)
        sees, moves = SCANS | CLOUDS | IMAGES, TRANSFORMS | {ODOMETRY}
        spaces = tuple(sorted(space for space, own in found.items() if space and own & sees and own & moves))
        if len(spaces) < 2:
            return cls()
        named = [space for space in spaces if any(_space(f"{name}/") == space for name in requested)]
        return cls(spaces, (named or spaces)[0])

    def of_another(self, topic: str) -> bool:
        """Whether a topic belongs to a robot that is not read."""
        space = _space(topic)
        return space in self.spaces and space != self.read


def _space(topic: str) -> str:
    """The first part of a topic name, if it has several."""
    first, _, rest = topic.strip("/").partition("/")
    return f"/{first}" if rest or topic.endswith("/") else ""
