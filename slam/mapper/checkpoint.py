"""Checkpoint of a run: stores every result that took time, so that an interrupted run can resume.

A mapper is deterministic. If it gets the same log and the stored results again, it reaches the same state,
without the time for computing the results.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

from slam.doctor.finding import Finding
from slam.errors import MapFileError
from slam.mapper.mount_learner import LearnedMounting
from slam.odometry.rgbd_tracker import FRAME
from slam.storage.map_clouds import MapClouds
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_tables import CHECKPOINT, CLOUDS, FRAMES, IMAGES
from slam.storage.packing import pack, unpack
from slam.vision.color_registration import ColorRegistration

T = TypeVar("T")

_LENGTH = struct.Struct("<I")
_FINDINGS, _REGISTRATIONS, _MOUNTINGS = "findings", "registrations", "mountings"
# Questions of a run with cameras that another process may answer.
_FORETOLD = frozenset({_REGISTRATIONS, FRAME})


class Checkpoint:
    """Stored results of a run, in the order of its queries; see `slam.result_cache.ResultCache`.

    Parameters
    ----------
    file
        File of the results, with those of an interrupted run; None stores nothing.
    """

    def __init__(self, file: MapFile | None = None) -> None:
        # Called after each computed result, as a sign of life.
        self.on_answer: Callable[[], None] = lambda: None
        # Source of results that another process may have computed already, as `sending` sends them.
        self.ahead: Callable[[], bytes | None] | None = None
        self._file = file
        self._count = 0
        self._waiting = bytearray()
        self._first_waiting = 0
        self._known: Iterator[tuple[str, float, Any]] = iter(())
        if file is not None:
            file.before_commit(self._flush)
            self._known = self._read(file, file.count(CHECKPOINT))
        self._next = next(self._known, None)

    @property
    def is_kept(self) -> bool:
        """Return whether results are stored in a file."""
        return self._file is not None

    @property
    def replaying(self) -> bool:
        """Return whether the next result is stored."""
        return self._next is not None

    @property
    def knows_more(self) -> bool:
        """Return whether the next result is stored, or computed by another process."""
        return self.replaying or self.ahead is not None

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Return the stored result of a query, or compute and store it.

        Raises
        ------
        MapFileError
            If the interrupted run made another query at this point.
        """
        if self._next is not None:
            return cast(T, self._replayed(question, key))
        content = None
        if self.ahead is not None and question in _FORETOLD:
            content, answer = self._found_ahead(question, key)
        if content is None:
            answer = compute()
            content = b"" if self._file is None else pack((question, float(key), answer))
        self.keep(content)
        return cast(T, answer)

    def keep(self, content: bytes) -> None:
        """Store a result, packed with its query; another process may have computed it."""
        if self._file is not None:
            self._remember(content)
            self._file.commit_if_due()
        self.on_answer()

    def sending(self, send: Callable[[bytes], None]) -> Checkpoint:
        """Create one that sends its results to another run of the same log, and stores nothing."""
        return _Sending(self._file, send)

    def findings(self, compute: Callable[[], list[Finding]]) -> list[Finding]:
        """Return the findings about the sensors: the first query of a run."""
        texts: list[str] = self.cached(_FINDINGS, 0.0, lambda: _texts(compute()))
        return [Finding.from_plain(json.loads(row)) for row in texts]

    def registrations(
        self, compute: Callable[[], dict[str, ColorRegistration]]
    ) -> dict[str, ColorRegistration]:
        """Return the poses of colour cameras that are not registered to depth: the second query."""
        return dict(self.cached(_REGISTRATIONS, 0.0, lambda: list(compute().items())))

    def mountings(self) -> dict[str, LearnedMounting]:
        """Return camera mountings estimated by a first pass over the log: the third query."""
        rows: list[tuple[str, Any, str]] = self.cached(_MOUNTINGS, 0.0, list)
        return {name: LearnedMounting(pose, note) for name, pose, note in rows}

    def begin_again(
        self,
        findings: Sequence[Finding],
        registrations: Mapping[str, ColorRegistration],
        mountings: Mapping[str, LearnedMounting],
    ) -> None:
        """Discard everything except what a first pass over the log has estimated."""
        if self._file is None:
            return
        self._waiting.clear()
        self._count = self._first_waiting = 0
        for table in (CHECKPOINT, CLOUDS, FRAMES, IMAGES):
            self._file.clear(table)
        self._remember(pack((_FINDINGS, 0.0, _texts(findings))))
        self._remember(pack((_REGISTRATIONS, 0.0, list(registrations.items()))))
        rows = [(name, mounting.T_base_camera, mounting.note) for name, mounting in mountings.items()]
        self._remember(pack((_MOUNTINGS, 0.0, rows)))
        self._file.commit()

    def spool(self) -> MapFrames:
        """Return the store of a pass's camera keyframes; a temporary map if nothing is stored."""
        return MapFrames(self._file or MapFile.temporary(), begun=True)

    def cloud_spool(self) -> MapClouds:
        """Return the store of the clouds of keyframes; a temporary map if nothing is stored."""
        return MapClouds(self._file or MapFile.temporary(), begun=True)

    def _replayed(self, question: str, key: float) -> Any:
        """Return the next stored result, if it is for this query."""
        assert self._next is not None and self._file is not None
        asked, about, answer = self._next
        if asked != question or (about != key and about == about):
            raise MapFileError(
                f"{self._file.path} cannot be resumed: its answer {self._count} is to "
                f"'{asked}' about {about!r}, asked is '{question}' about {key!r}; "
                "map anew, without --resume"
            )
        self._count += 1
        self._first_waiting = self._count
        self._next = next(self._known, None)
        return answer

    def _found_ahead(self, question: str, key: float) -> tuple[bytes | None, Any]:
        """Return a result, packed and as object; None if the other process has none for this query."""
        assert self.ahead is not None
        content = self.ahead()
        asked, about, answer = (None, None, None) if content is None else unpack(content)
        if (asked, about) == (question, key):
            return content, answer
        self.ahead = None
        return None, None

    def _remember(self, content: bytes) -> None:
        """Add a result to the next row."""
        self._waiting += _LENGTH.pack(len(content)) + content
        self._count += 1

    def _flush(self) -> None:
        """Write the pending results as one row."""
        if self._file is not None and self._waiting:
            self._file.append(CHECKPOINT, self._first_waiting, bytes(self._waiting))
            self._waiting.clear()
            self._first_waiting = self._count

    @staticmethod
    def _read(file: MapFile, rows: int) -> Iterator[tuple[str, float, Any]]:
        """Yield the results of the first rows, with one row in memory at a time."""
        for number in range(rows):
            content = cast(bytes, file.row(CHECKPOINT, number)[1])
            at = 0
            while at < len(content):
                with file.naming_row(CHECKPOINT, number):
                    (length,) = _LENGTH.unpack_from(content, at)
                    question, key, answer = unpack(content[at + 4 : at + 4 + length])
                at += 4 + length
                yield question, key, answer


class _Sending(Checkpoint):
    """See `Checkpoint.sending`."""

    def __init__(self, file: MapFile | None, send: Callable[[bytes], None]) -> None:
        super().__init__()
        self._file, self._send = file, send

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Compute the result, and send it."""
        answer = compute()
        if question in _FORETOLD:
            self._send(pack((question, float(key), answer)))
        return answer


def _texts(findings: Sequence[Finding]) -> list[str]:
    """Return findings as rows of text."""
    return [json.dumps(finding.plain()) for finding in findings]
