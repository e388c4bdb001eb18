"""The beginning of a bag: what its topics hold, where the sensors sit, which lenses they have."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from slam.datasets.account import Account
from slam.datasets.bags.clouds import CloudView, cloud_view
from slam.datasets.bags.decoding import Decoder, frame_name, stamp_of
from slam.datasets.bags.files import Bag
from slam.datasets.bags.images import is_depth
from slam.datasets.bags.records import BagRecord, Channel
from slam.datasets.bags.topics import (
    CAMERA_INFO,
    CLOUD,
    IMAGES,
    ODOMETRY,
    SENSORS,
    TRANSFORMS,
    camera_info_topics,
)
from slam.datasets.bags.transforms import BASE_FRAMES, FrameTree
from slam.datasets.dataset import ReadReport, RecordFault

LOOK_S = 10.0  # of the bag's time, at most
_LEAST_S = 2.0  # of the bag's time, for stamps of images and for transforms that come once a second
_STAMPS_KEPT = 200


@dataclass(slots=True)
class Survey:
    """What the beginning of a bag tells.

    Attributes
    ----------
    channels
        All topics, by name; announced by the index, or seen where there is none.
    seen
        Sensor topics that have had a message, also if it is damaged.
    frames
        Frame of each sensor topic that has had a sound message.
    bases
        What odometry messages say to be moving: their child frames.
    lenses
        First usable CameraInfo message of each topic.
    depths
        For each image topic whether it holds depth.
    stamps_s
        First stamps of each image topic.
    clouds
        What the first sound cloud of each topic looks like.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)
    frames: dict[str, str] = field(default_factory=dict)
    bases: list[str] = field(default_factory=list)
    lenses: dict[str, Any] = field(default_factory=dict)
    depths: dict[str, bool] = field(default_factory=dict)
    stamps_s: dict[str, list[float]] = field(default_factory=dict)
    clouds: dict[str, CloudView] = field(default_factory=dict)
    tree: FrameTree = field(default_factory=FrameTree)

    def base_frame(self) -> str | None:
        """The robot's frame: what the wheels move, else by its usual names, else the root of all."""
        for frame in [*self.bases, *BASE_FRAMES]:
            if frame in self.tree:
                return frame
        return self.tree.root()

    def is_enough(self, seconds: float) -> bool:
        """Whether all that the choice depends on is known."""
        if seconds < _LEAST_S:
            return False
        sensors = {topic for topic, channel in self.channels.items() if channel.kind in SENSORS}
        if not sensors <= set(self.frames):
            return False
        infos = {topic for topic, channel in self.channels.items() if channel.kind == CAMERA_INFO}
        if not infos <= set(self.lenses):
            return False
        base = self.base_frame()
        reported = any(channel.kind in TRANSFORMS for channel in self.channels.values())
        mounted = [self.frames[topic] for topic in sensors if self.channels[topic].kind != ODOMETRY]
        return not reported or (
            base is not None and all(self.tree.between(base, frame) is not None for frame in mounted)
        )

    def lens_topic(self, image_topic: str) -> str | None:
        """The CameraInfo topic of an image topic: beside it, else the first of its frame."""
        for topic in camera_info_topics(image_topic):
            if topic in self.lenses:
                return topic
        frame = self.frames.get(image_topic)
        same = [topic for topic, lens in self.lenses.items() if frame_name(lens.header.frame_id) == frame]
        return same[0] if frame and same else None


def survey_bag(bag: Bag) -> Survey:
    """Look at the beginning of a bag, at all of it where its index is missing.

    Raises
    ------
    DatasetError
        A file cannot be read at all.
    """
    survey = Survey()
    announced = bag.announced()
    for channel in announced or []:
        survey.channels.setdefault(channel.topic, channel)
    budget = bag.budget()
    decoder, quiet = Decoder(budget), Account(bag.path.name, ReadReport(), strict=False)
    first_s: float | None = None
    looking = True
    for record in bag.records(quiet, budget):
        first_s = record.recorded_s if first_s is None else first_s
        survey.channels.setdefault(record.channel.topic, record.channel)
        seconds = record.recorded_s - first_s
        if looking:
            _look(survey, record, decoder)
            looking = seconds < LOOK_S and not survey.is_enough(seconds)
        elif announced is not None:
            break
    return survey


def count_messages(bag: Bag) -> Counter[str]:
    """Messages on each topic, by reading all of the bag."""
    quiet = Account(bag.path.name, ReadReport(), strict=False)
    return Counter(record.channel.topic for record in bag.records(quiet, bag.budget()))


def _look(survey: Survey, record: BagRecord, decoder: Decoder) -> None:
    """Take in one message; damaged ones tell nothing here and are counted when the bag is read."""
    kind, topic = record.channel.kind, record.channel.topic
    if kind in SENSORS:
        survey.seen.add(topic)
    wanted = kind in SENSORS | TRANSFORMS or kind == CAMERA_INFO
    known = survey.clouds if kind == CLOUD else survey.frames
    if not wanted or (topic in known and kind not in IMAGES) or topic in survey.lenses:
        return
    try:
        message = decoder.decode(record)
        if kind in TRANSFORMS:
            survey.tree.add(message)
            return
        frame = frame_name(message.header.frame_id)
        if kind == CAMERA_INFO:
            survey.lenses[topic] = message
            return
        survey.frames[topic] = frame
        if kind == CLOUD:
            survey.clouds[topic] = cloud_view(message)
        if kind == ODOMETRY and (child := frame_name(message.child_frame_id)) not in survey.bases:
            survey.bases.append(child)
        if kind in IMAGES:
            survey.depths.setdefault(topic, is_depth(message))
            stamps = survey.stamps_s.setdefault(topic, [])
            if len(stamps) < _STAMPS_KEPT:
                stamps.append(stamp_of(message.header))
    except (RecordFault, AttributeError, TypeError, ValueError):
        return
