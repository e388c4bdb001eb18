"""ScanNet's ``.sens``: one file per scan, with lenses, then frames of JPEG colour and compressed depth.

The format is documented with ScanNet's own reader (SensReader, MIT).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.budget import LARGEST_BYTES, MOST_PIXELS, Budget
from slam.datasets.calibration import Calibration, pose_from_matrix
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import FramePair
from slam.datasets.image_files import DAMAGED, color_of, metres_of
from slam.datasets.lens_files import checked, plain_lens
from slam.datasets.numbered_frames import NO_STAMPS, RATE_HZ
from slam.datasets.pose_files import trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import ColorImage, Float32Array, FloatArray

CUT_OFF = "frame cut off"

_VERSION = 4
_LONGEST_NAME = 4096
_MATRICES, _REST, _FRAME = struct.Struct("<64f"), struct.Struct("<iiIIIIfQ"), struct.Struct("<16fQQQQ")
_JPEG_AND_PNG, _PLAIN, _ZLIB = (1, 2), 0, 1


@dataclass(frozen=True, slots=True)
class _Head:
    """The header before the frames."""

    color_lens: FloatArray
    depth_lens: FloatArray
    depth_packing: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_steps_per_m: float
    begin: int


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame with the offsets of its images in the file."""

    number: int
    T_world_camera: FloatArray
    stamp_us: int
    color_at: int
    color_bytes: int
    depth_bytes: int


class _Scan:
    """The frames of a file as the images of a camera; see `slam.datasets.image_files.ImageSource`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.head = _read_head(path)

    @cached_property
    def frames(self) -> dict[int, _Frame]:
        """Frames by number, up to the last complete one."""
        return {frame.number: frame for frame in _frames(self.path, self.head)}

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `slam.datasets.image_files.ImageSource`."""
        frame = self.frames[file.number]
        return color_of(
            self._bytes(frame.color_at, frame.color_bytes, budget), f"frame {file.number}", budget
        )

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`."""
        frame, (width, height) = self.frames[file.number], self.head.depth_size
        content = self._bytes(frame.color_at + frame.color_bytes, frame.depth_bytes, budget)
        expected = 2 * width * height
        budget.take(expected, 0)
        try:
            if self.head.depth_packing == _ZLIB:
                content = zlib.decompressobj().decompress(content, expected)
        except zlib.error as error:
            raise RecordFault(DAMAGED, f"frame {file.number}: {error}") from error
        if len(content) != expected:
            raise RecordFault(DAMAGED, f"frame {file.number}: {len(content)} of {expected} bytes of depth")
        return metres_of(np.frombuffer(content, "<u2").reshape(height, width).copy(), calibration)

    def _bytes(self, at: int, count: int, budget: Budget) -> bytes:
        """A part of the file."""
        if count > LARGEST_BYTES:
            raise RecordFault(DAMAGED, f"an image of {count} bytes")
        budget.add_file(self.path, self.path.stat().st_size)
        with self.path.open("rb") as stream:
            stream.seek(at)
            return stream.read(count)


def _load(path: Path, account: Account) -> Contents:
    """One scan; colour is warped to the depth camera's lens."""
    scan = _Scan(_file(path))
    file, head, stamps_s = scan.path, scan.head, _stamps(scan.frames, account)
    for _ in range(_announced(file, head) - len(scan.frames)):
        account.refuse(RecordFault(CUT_OFF, file.name), file.name, len(scan.frames) + 1)
    depth = checked(file, head.depth_lens, *head.depth_size)
    color = plain_lens(checked(file, head.color_lens, *head.color_size))
    calibration = Calibration(depth, head.depth_steps_per_m, color_lens=color)
    images = [StampedFile(stamp_s, file, number) for number, stamp_s in stamps_s.items()]
    pairs = [FramePair(image.stamp_s, image, image) for image in images]
    return Contents([Camera("camera", pairs, calibration, source=scan)])


def _file(path: Path) -> Path:
    """The only such file in a folder, else the path."""
    files = list(path.glob("*.sens")) if path.is_dir() else []
    return files[0] if len(files) == 1 else path


def _read_head(path: Path) -> _Head:
    """Everything before the first frame."""
    try:
        with path.open("rb") as stream:
            version, name_bytes = struct.unpack("<IQ", stream.read(12))
            if version != _VERSION or name_bytes > _LONGEST_NAME:
                raise ValueError(f"version {version} with a name of {name_bytes} letters")
            stream.seek(name_bytes, 1)
            matrices = np.array(_MATRICES.unpack(stream.read(_MATRICES.size)), np.float64).reshape(4, 4, 4)
            values = _REST.unpack(stream.read(_REST.size))
            color_packing, depth_packing, *sizes, depth_shift, _ = values
            head = _Head(
                matrices[0], matrices[2], depth_packing, (sizes[0], sizes[1]), (sizes[2], sizes[3]),
                depth_shift, stream.tell(),
            )  # fmt: skip
    except (OSError, struct.error, ValueError) as error:
        raise DatasetError(
            f"{path} is no whole .sens file of version 4 ({error}); download it again"
        ) from error
    if color_packing not in _JPEG_AND_PNG or depth_packing not in (_PLAIN, _ZLIB):
        raise DatasetError(
            f"{path} packs colour by {color_packing} and depth by {depth_packing}, which is not read; "
            "extract it with ScanNet's SensReader and give the folder"
        )
    sound = 0 < np.prod(head.depth_size, dtype=float) <= MOST_PIXELS and 0.0 < depth_shift < np.inf
    if not sound:
        raise DatasetError(
            f"{path}: depth of {head.depth_size}, {depth_shift} a metre; download the file again"
        )
    checked(path, head.depth_lens, *head.depth_size)
    checked(path, head.color_lens, *head.color_size)
    return head


def _announced(path: Path, head: _Head) -> int:
    """Number of frames in the header, limited by the file size."""
    with path.open("rb") as stream:
        stream.seek(head.begin - 8)
        (count,) = struct.unpack("<Q", stream.read(8))
    return int(min(count, path.stat().st_size // _FRAME.size))


def _frames(path: Path, head: _Head) -> Iterator[_Frame]:
    """The complete frames."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(head.begin)
        for number in range(_announced(path, head)):
            frame = _frame(stream, number)
            if frame is None or frame.color_at + frame.color_bytes + frame.depth_bytes > size:
                return
            stream.seek(frame.color_at + frame.color_bytes + frame.depth_bytes)
            yield frame


def _frame(stream: BinaryIO, number: int) -> _Frame | None:
    """The next frame; None at the end of the file."""
    content = stream.read(_FRAME.size)
    if len(content) < _FRAME.size:
        return None
    *pose, stamp_us, _, color_bytes, depth_bytes = _FRAME.unpack(content)
    return _Frame(number, np.array(pose).reshape(4, 4), stamp_us, stream.tell(), color_bytes, depth_bytes)


def _stamps(frames: dict[int, _Frame], account: Account) -> dict[int, float]:
    """Stamps from the colour camera's microseconds if they increase, else N / 30 s for frame N."""
    ticks = [frame.stamp_us for frame in frames.values()]
    if ticks and all(before < after < 1 << 53 for before, after in pairwise(ticks)):
        return {number: frame.stamp_us * 1e-6 for number, frame in frames.items()}
    account.report.note(NO_STAMPS.format(rate=RATE_HZ), 1)
    return {number: number / RATE_HZ for number in frames}


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Camera to world, of the frames with a pose."""

    def placed() -> Iterator[tuple[float, gtsam.Pose3]]:
        frames = _Scan(_file(path)).frames
        for number, stamp_s in _stamps(frames, account).items():
            try:
                yield stamp_s, pose_from_matrix(frames[number].T_world_camera)
            except ValueError:
                continue  # lost frames have infinite poses

    return trajectory_of(placed())


FORMAT = recorded(
    "ScanNet .sens",
    lambda path, head: _file(path).suffix == ".sens" and _file(path).is_file(),
    _load,
    _groundtruth,
    lambda path: _read_head(_file(path)),
)
