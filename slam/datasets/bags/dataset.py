"""A ROS bag as a stream of measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam.datasets.account import Account
from slam.datasets.bags.camera import BagCamera
from slam.datasets.bags.cloud_messages import header_at
from slam.datasets.bags.decoding import Decoder, stamp_of
from slam.datasets.bags.figures import BagFigures
from slam.datasets.bags.files import Bag, find_bag
from slam.datasets.bags.imu import JoinedImu
from slam.datasets.bags.layout import Layout, frames_of, layout_of
from slam.datasets.bags.ouster import Ousters
from slam.datasets.bags.pairing import ImagePair, PairStream, StampedImage
from slam.datasets.bags.records import BagRecord
from slam.datasets.bags.survey import Survey, survey_bag
from slam.datasets.bags.time_merge import TimeMerge
from slam.datasets.bags.topics import IMAGES, OUSTER, TRANSFORMS, advice
from slam.datasets.bags.truth import read_truth, truth_topic
from slam.datasets.budget import Budget
from slam.datasets.calibration_files import known_beside
from slam.datasets.dataset import ReadReport, RecordFault
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.foreign import plain
from slam.measurements import Measurement, RgbdFrame
from slam.vision.prefetch import prefetched

NO_FIELD = "a field of the message is missing or has an impossible value"


@dataclass(frozen=True, slots=True, eq=False)
class _FrameToDo:
    """A pair of images that are not decoded yet."""

    camera: BagCamera
    pair: ImagePair


@dataclass(frozen=True, slots=True, eq=False)
class _Done:
    """A measurement with its index in the bag, or the reason why there is none."""

    number: int
    measurement: Measurement | None
    where: str = ""
    fault: RecordFault | None = None


class BagDataset:
    """A bag; see `slam.datasets.dataset.Dataset`.

    Stamps are those of the headers. Readings come in the order of the bag, a frame after the first reading
    at or after its own stamp. Each scan is preceded by the wheel odometry at its stamp, interpolated between
    two readings, as tf would do. Only what is about to be returned is kept in memory.

    Parameters
    ----------
    path
        A bag file, or the folder of a recording.
    strict
        Stop at the first damaged record instead of counting and skipping it.
    topics
        Topics to read if there are several of one type.

    Attributes
    ----------
    figures
        Statistics of the latest pass: topics, clocks and frames.
    calibration_files
        Calibration files that have priority over the bag.
    read_images
        Whether to read frames; without them, reading the other sensors is many times faster.
    """

    def __init__(self, path: Path, strict: bool = False, topics: tuple[str, ...] = ()) -> None:
        self.path = path
        self.name = plain(path.resolve().name)
        self.report = ReadReport()
        self.figures = BagFigures()
        self.read_images = True
        self.calibration_files: tuple[Path, ...] = ()
        self._strict, self._topics = strict, topics
        self._opened: tuple[Bag, Survey, Layout] | None = None

    def __iter__(self) -> Iterator[Measurement]:
        """Read the bag from the start, with a new report.

        Raises
        ------
        BadRecordError
            A damaged record, under ``strict``.
        DatasetError
            The bag cannot be read, contains nothing usable, or the user must choose topics.
        """
        bag, survey, layout = self._open()
        report = self.report = ReadReport()
        self.figures = BagFigures(survey.tree, layout.base, survey.robots, survey.frames)
        account = Account(self.name, report, self._strict)
        for note in layout.notes:
            report.note(note, 1)
        for imu in layout.imus:
            if isinstance(imu, JoinedImu):
                imu.restart()
        budget = bag.budget()
        for done in prefetched(
            _stream(bag, layout, account, budget, self.figures, images=self.read_images),
            lambda item: _decoded(item, budget),
        ):
            if done.fault is not None:
                account.refuse(done.fault, done.where, done.number)
            elif done.measurement is not None:
                if isinstance(done.measurement, RgbdFrame):
                    report.accept(frames_of(done.measurement.sensor))
                report.observe(done.measurement, done.number)
                yield done.measurement
        self._note_topics(survey, layout)
        notes = [note for cloud in layout.clouds for note in cloud.times.notes(cloud.topic)]
        for note in [*notes, *(note for imu in layout.imus for note in imu.notes())]:
            report.note(note, 1)
        if report.measurement_count == 0 and self.read_images:
            raise DatasetError(_nothing_usable(self.path, report, survey, layout))

    def groundtruth(self) -> Trajectory | None:
        """The poses of a topic whose name says ground truth, or that the user named; else None.

        All other poses in a bag are the robot's own estimates.
        """
        bag, survey, _ = self._open()
        kinds = {topic: channel.kind for topic, channel in survey.channels.items()}
        topic = truth_topic(kinds, self._topics)
        return read_truth(bag, topic, Account(self.name, ReadReport(), self._strict)) if topic else None

    def _note_topics(self, survey: Survey, layout: Layout) -> None:
        """Report the purpose of each topic without measurements, or why it is not read."""
        counts = {topic: (channel.kind, 0) for topic, channel in survey.channels.items()}
        counts |= {topic: (figures.kind, figures.count) for topic, figures in self.figures.topics.items()}
        for topic, (kind, count) in counts.items():
            name, made = f"{topic} ({kind})", layout.makes(topic, kind)
            if why_not := layout.why_not(topic, kind, count):
                self.report.ignore(name, why_not, count)
            elif made and not self.report.records[made]:
                self.report.ignore(name, "none of its messages could be read", count)
            elif topic in layout.joined or topic not in layout.readers:
                self.report.beside[name] = count
                self.report.part_of[name] = layout.joined.get(topic, "")

    def _open(self) -> tuple[Bag, Survey, Layout]:
        """Files, topics and sensor poses: found once, so that each pass reads the same."""
        if self._opened is None:
            bag = find_bag(self.path)
            known = known_beside(self.path, self.calibration_files)
            survey = survey_bag(bag, self._topics)
            self._opened = bag, survey, layout_of(bag, survey, self._topics, known)
        return self._opened


def _stream(
    bag: Bag, layout: Layout, account: Account, budget: Budget, figures: BagFigures, *, images: bool
) -> Iterator[tuple[int, Measurement] | _FrameToDo]:
    """The contents of the bag in order, images not decoded yet."""
    time_merge: TimeMerge[_FrameToDo] = TimeMerge()
    pairs = [PairStream(camera.sensor, camera.tolerance_s, account) for camera in layout.cameras]
    decoder = Decoder(budget, Ousters(bag.path, layout.ousters))
    reader = _Reader(layout, decoder, account, figures)
    last: dict[str, BagRecord] = {}
    for record in bag.records(account, budget):
        now_s = record.recorded_s
        if record.channel.kind in OUSTER:
            last[record.channel.topic] = record
        if not images and record.channel.topic in layout.images:
            continue
        for item in reader.read(record):
            if isinstance(item, StampedImage):
                place, is_depth = layout.images[record.channel.topic]
                _add_frames(time_merge, layout, place, pairs[place].add(item, is_depth=is_depth))
            else:
                time_merge.add_reading(record.number, item, now_s)
        for place, pair_stream in enumerate(pairs):
            _add_frames(time_merge, layout, place, pair_stream.settle(now_s))
        yield from time_merge.due(now_s)
    for record in last.values():
        for item in reader.rest(record):
            time_merge.add_reading(record.number, item, record.recorded_s)
    for number, text in enumerate(decoder.ousters.notes(), 1):
        account.report.note(text, number)
    for place, pair_stream in enumerate(pairs):
        _add_frames(time_merge, layout, place, pair_stream.rest())
    yield from time_merge.rest()
    for pair_stream in pairs:
        pair_stream.note_offsets()


def _add_frames(
    time_merge: TimeMerge[_FrameToDo], layout: Layout, place: int, pairs: Iterator[ImagePair]
) -> None:
    """Add the pairs of a camera as frames to decode."""
    for pair in pairs:
        size, later_s = pair.color.size + pair.depth.size, max(pair.color.recorded_s, pair.depth.recorded_s)
        time_merge.add_frame(
            place, pair.color.stamp_s, _FrameToDo(layout.cameras[place], pair), size, later_s
        )


def _decoded(item: tuple[int, Measurement] | _FrameToDo, budget: Budget) -> _Done:
    """Decode the images of a frame; runs on the prefetching thread."""
    if not isinstance(item, _FrameToDo):
        return _Done(*item)
    number, where = item.pair.color.number, item.camera.sensor
    try:
        return _Done(number, item.camera.frame(item.pair, budget))
    except RecordFault as fault:
        return _Done(number, None, where, fault)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        return _Done(number, None, where, RecordFault(NO_FIELD, str(error)))


class _Reader:
    """Converts messages to readings and images."""

    def __init__(self, layout: Layout, decoder: Decoder, account: Account, figures: BagFigures) -> None:
        self._layout, self._decoder, self._account, self._figures = layout, decoder, account, figures

    def read(self, record: BagRecord) -> list[Measurement | StampedImage]:
        """The contents of a message; nothing if it is not read or is damaged."""
        topic, kind = record.channel.topic, record.channel.kind
        self._figures.add(record)
        if not self._layout.reads(topic, kind):
            return []
        return self._made(record, lambda: self._decoder.decode(record))

    def rest(self, record: BagRecord) -> list[Measurement]:
        """The incomplete last revolution of an Ouster, from the last packet of its topic."""
        topic = record.channel.topic
        if not self._layout.reads(topic, record.channel.kind):
            return []
        made = self._made(record, lambda: self._decoder.ousters.rest(topic))
        return [item for item in made if not isinstance(item, StampedImage)]

    def _made(self, record: BagRecord, decode: Callable[[], Any]) -> list[Measurement | StampedImage]:
        """The contents of a message after decoding; nothing if it is damaged."""
        topic = record.channel.topic
        damages = (AttributeError, TypeError, ValueError, OverflowError, IndexError, RuntimeError)
        with self._account.refusing(topic, record.number, NO_FIELD, *damages):
            message = decode()
            return [] if message is None else self._converted(record, message)
        return []

    def _converted(self, record: BagRecord, message: Any) -> list[Measurement | StampedImage]:
        """The readings of a decoded message."""
        topic, layout = record.channel.topic, self._layout
        if record.channel.kind in TRANSFORMS:
            self._figures.tree.add(message)
            return list(layout.wheels_from(message)) if layout.wheels_from else []
        if shift_s := layout.shifts_s.get(topic):
            at_s = record.recorded_s if math.isinf(shift_s) else stamp_of(message.header) - shift_s
            message.header.stamp = header_at(at_s, "").stamp
        stamp_s = stamp_of(message.header)
        self._figures.stamped(record, stamp_s)
        if topic in layout.images:
            size = int(message.data.nbytes)
            return [StampedImage(stamp_s, record.number, record.recorded_s, message, size)]
        made = layout.readers[topic](message)
        readings = made if isinstance(made, list) else [made]
        for _ in readings:
            self._account.report.accept(layout.makes(topic, record.channel.kind))
        return [*readings]


def _nothing_usable(path: Path, report: ReadReport, survey: Survey, layout: Layout) -> str:
    """The message for a bag without a single measurement."""
    reasons = report.refusals
    shown = list(survey.channels.items())[:8]
    why = {topic: f"; {reason}" for topic, reason in layout.left_out.items()}
    topics = ", ".join(f"{topic} ({info.kind}{why.get(topic, advice(info.kind))})" for topic, info in shown)
    if any(channel.kind in IMAGES for channel in survey.channels.values()) and not any(
        survey.depths.values()
    ):
        reasons += f"{'; ' if reasons else ''}its images have no depth beside them: record that as well"
    return (
        f"{path} holds no usable scan, cloud, RGB-D pair or odometry{f' ({reasons})' if reasons else ''}; "
        f"its topics: {topics or 'none'}"
    )
