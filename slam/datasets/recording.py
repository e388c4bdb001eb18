"""Reads a recording of several files as one stream: a log of readings, with cameras merged by time."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any, TypeAlias

from fusion.showing import one_line
from slam.datasets.account import Account
from slam.datasets.calibration_files import by_files, known_beside
from slam.datasets.camera_frames import Camera, read_frames
from slam.datasets.dataset import ReadReport
from slam.datasets.frame_pairs import FramePair
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.foreign import plain
from slam.measurements import LaserScan, Measurement, PointCloud, RgbdFrame

Numbered: TypeAlias = tuple[int, Measurement]


# Ranges of a log kept in memory: 11,000 scans of 360 beams; their other data take as much again.
_MOST_KEPT_BYTES = 1 << 24

# Chooses by stamp which of a camera's next frames are read.
FrameChoice: TypeAlias = Callable[[str, Sequence[float]], Sequence[bool]]


@contextmanager
def fewer_frames(log: Any, choose: FrameChoice | None) -> Iterator[None]:
    """While active, a log (corrected or not) reads only some frames, or all if None, if it supports this."""
    while hasattr(log, "log"):
        log = log.log
    name, value = ("read_images", False) if choose is None else ("choose_frames", choose)
    before = getattr(log, name, value)
    if before is not value:
        setattr(log, name, value)
    try:
        yield
    finally:
        if before is not value:
            setattr(log, name, before)


@contextmanager
def read_once(log: Any, then: Callable[[], None] | None = None) -> Iterator[None]:
    """While active, a log of scans and odometry is decoded only once; further passes read it from memory.

    So does the first pass afterwards, which frees the memory. Logs with cameras or clouds, logs larger than
    `_MOST_KEPT_BYTES` and logs of other readers are read again. ``then`` is called when the log is in memory.
    """
    while hasattr(log, "log"):
        log = log.log
    if not isinstance(log, Recording):
        yield
        return
    log.keeps, log.when_kept = True, then
    try:
        yield
    except BaseException:
        log.kept = None
        raise
    finally:
        log.keeps, log.when_kept = False, None


@dataclass(frozen=True, slots=True)
class Contents:
    """The contents of a recording.

    Attributes
    ----------
    cameras
        Cameras with their image lists; their names are distinct.
    log
        Scans and odometry with line numbers, in file order.
    """

    cameras: list[Camera] = field(default_factory=list)
    log: Iterable[Numbered] = ()


class Recording:
    """A folder as a dataset; see `slam.datasets.dataset.Dataset`.

    The log keeps its order. A frame follows the first reading of the log at or after its own stamp, so that
    the readings around a frame are known when it is returned; frames of several cameras are in time order,
    those of one camera in the order of its list.

    Parameters
    ----------
    load
        Lists the contents, again for each pass; rejected records go to the account.
    truth
        Reads the ground truth trajectory, None if there is none.
    strict
        Stop at the first damaged record instead of counting and skipping it.
    remedy
        Advice if nothing usable is found.

    Attributes
    ----------
    read_images
        Whether to read frames; without them, reading the log is many times faster.
    choose_frames
        Called once per camera to choose its frames; None for all.
    keeps, kept, when_kept
        Whether a complete pass is kept, its measurements, and a callback afterwards; see `read_once`.
    """

    __repr__ = one_line

    def __init__(
        self,
        path: Path,
        load: Callable[[Account], Contents],
        truth: Callable[[Account], Trajectory | None],
        *,
        strict: bool = False,
        remedy: str = "give a folder with its images or clouds in place",
    ) -> None:
        self.path = path
        self.name = plain(path.resolve().name)
        self.report = ReadReport()
        self.read_images = True
        self.calibration_files: tuple[Path, ...] = ()
        self.choose_frames: FrameChoice | None = None
        self.keeps = False
        self.when_kept: Callable[[], None] | None = None
        self.kept: tuple[list[Measurement], ReadReport] | None = None
        self._load, self._truth, self._strict, self._remedy = load, truth, strict, remedy

    def __iter__(self) -> Iterator[Measurement]:
        """Read the recording from its start, with a new report.

        Raises
        ------
        BadRecordError
            A damaged record, under ``strict``.
        DatasetError
            An essential file cannot be read, or nothing usable is found.
        """
        if self.kept is not None:
            yield from self._again(*self.kept, free=not self.keeps)
            return
        report = self.report = ReadReport()
        account = Account(self.name, report, self._strict)
        contents = self._load(account)
        kept: list[Measurement] | None = [] if self.keeps and not contents.cameras else None
        kept_bytes = 0
        cameras = self._chosen(contents.cameras if self.read_images else [], account)
        # With frames, progress is counted in frames, which take most of the time; else by the log.
        frames_in_all, frames_read = sum(len(camera.pairs) for camera in cameras), 0
        with closing(read_frames(_by_time(cameras), account)) as frames:
            for number, measurement in _frames_after_log(contents.log, frames):
                report.observe(measurement, number)
                if isinstance(measurement, RgbdFrame):
                    frames_read += 1
                if frames_in_all:
                    report.note_share(min(1.0, frames_read / frames_in_all))
                if kept is not None:
                    kept_bytes += measurement.ranges_m.nbytes if isinstance(measurement, LaserScan) else 0
                    fits = kept_bytes <= _MOST_KEPT_BYTES and not isinstance(measurement, PointCloud)
                    kept.append(measurement)
                    kept = kept if fits else None
                yield measurement
        if report.measurement_count == 0 and cameras and (choice := self.choose_frames):
            self.choose_frames = None  # the chosen frames are damaged, others may not be
            try:
                yield from self
            finally:
                self.choose_frames = choice
        elif report.measurement_count == 0 and (self.read_images or not contents.cameras):
            raise DatasetError(_nothing_usable(self.path, report, self._remedy))
        if kept is not None:
            self.kept = kept, report
            if self.when_kept is not None:
                self.when_kept()

    def _chosen(self, cameras: list[Camera], account: Account) -> list[Camera]:
        """The cameras corrected by calibration files, with their chosen frames."""
        if cameras or self.calibration_files:
            known = known_beside(self.path, self.calibration_files)
            cameras = [by_files(camera, known, account) for camera in cameras]
            for note in known.notes:
                account.report.note(note, 1)
        if (choose := self.choose_frames) is None:
            return cameras
        chosen = []
        for camera in cameras:
            comes = choose(camera.sensor, [pair.stamp_s for pair in camera.pairs])
            chosen.append(replace(camera, pairs=list(compress(camera.pairs, comes))))
        return chosen

    def _again(self, kept: list[Any], report: ReadReport, *, free: bool) -> Iterator[Measurement]:
        """A pass from memory."""
        report = self.report = copy(report)
        self.kept = None if free else self.kept
        for number, measurement in enumerate(kept):
            kept[number] = None if free else measurement
            report.share = (number + 1) / len(kept)
            yield measurement

    def groundtruth(self) -> Trajectory | None:
        """The ground truth trajectory next to the readings, without damaged lines."""
        return self._truth(Account(self.name, ReadReport(), self._strict))


def _by_time(cameras: list[Camera]) -> Iterator[tuple[Camera, FramePair]]:
    """Pairs of all cameras by time; a stamp that runs backward counts as the previous one."""

    def keyed(place: int, camera: Camera) -> Iterator[tuple[float, int, FramePair]]:
        newest_s = -math.inf
        for pair in camera.pairs:
            newest_s = max(newest_s, pair.stamp_s)
            yield newest_s, place, pair

    streams = [keyed(place, camera) for place, camera in enumerate(cameras)]
    for _, place, pair in heapq.merge(*streams, key=lambda item: item[:2]):
        yield cameras[place], pair


def _frames_after_log(log: Iterable[Numbered], frames: Iterator[tuple[int, RgbdFrame]]) -> Iterator[Numbered]:
    """The log in its order; each frame follows when the newest stamp of the log has reached it."""
    newest_s = -math.inf
    waiting = next(frames, None)
    for number, reading in log:
        yield number, reading
        newest_s = max(newest_s, reading.stamp_s)
        while waiting is not None and waiting[1].stamp_s <= newest_s:
            yield waiting
            waiting = next(frames, None)
    if waiting is not None:
        yield waiting
        yield from frames


def _nothing_usable(path: Path, report: ReadReport, remedy: str) -> str:
    """The message for a recording without a single measurement."""
    reasons = report.refusals
    if report.ignored:
        reasons += f"{'; ' if reasons else ''}ignored: {', '.join(list(report.ignored)[:5])}"
    return f"{path} holds no usable frame, scan or odometry{f' ({reasons})' if reasons else ''}; {remedy}"
