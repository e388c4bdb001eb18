"""Record3D, an app for iPhones and iPads: a ``.r3d`` file, which is a ZIP archive, or its contents.

Depth is compressed with Apple's LZFSE, which the extra ``phones`` decompresses.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.account import Account
from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.calibration import Calibration, pose_from, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import FramePair
from slam.datasets.image_files import DAMAGED, MISSING, OTHER_CONFIDENCE, color_of, usable_metres
from slam.datasets.lens_files import checked, median_lens
from slam.datasets.pose_files import COMPARED, T_ARKIT_OPTICAL, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import BAD_POSE, StampedFile, stamp_of
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.foreign import from_json
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array

_METADATA, _IMAGES = "metadata", "rgbd"
_ZIP_MAGIC = b"PK\x03\x04"
# LZFSE blocks start with a type and their decompressed size: uncompressed, LZVN, LZFSE, end.
_PLAIN, _LZVN, _LZFSE, _END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"


class _Archive:
    """The files of a recording, archived or not; see `slam.datasets.image_files.ImageSource`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._zip = None if path.is_dir() else zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise DatasetError(f"{path} is no whole .r3d file ({error}); export it again") from error
        self.depth_size = (0, 0)

    def content(self, name: str) -> bytes:
        """Return a file's bytes; RecordFault if it is missing, damaged or too large."""
        try:
            if self._zip is None:
                file = self._path / name
                if file.stat().st_size > LARGEST_BYTES:
                    raise RecordFault(DAMAGED, f"{name}: {file.stat().st_size} bytes")
                return file.read_bytes()
            if self._zip.getinfo(name).file_size > LARGEST_BYTES:
                raise RecordFault(DAMAGED, f"{name}: {self._zip.getinfo(name).file_size} bytes")
            return self._zip.read(name)
        except (KeyError, FileNotFoundError) as error:
            raise RecordFault(MISSING, name) from error
        except (
            OSError,
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            RuntimeError,
            NotImplementedError,
        ) as error:
            raise RecordFault(DAMAGED, f"{name}: {error}") from error

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `slam.datasets.image_files.ImageSource`."""
        return color_of(self._paid(f"{_IMAGES}/{file.number}.jpg", budget), f"{file.number}.jpg", budget)

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`; depth without confidence is omitted."""
        name = f"{_IMAGES}/{file.number}.depth"
        metres = self._unpacked(name, "<f4", budget)
        depth_m = usable_metres(metres, name, budget)
        try:
            trust = self._unpacked(f"{_IMAGES}/{file.number}.conf", "u1", budget)
        except RecordFault as fault:
            if fault.reason == MISSING:  # cameras without lidar have no confidence
                return depth_m
            raise
        if trust.shape != depth_m.shape:
            raise RecordFault(OTHER_CONFIDENCE, f"frame {file.number}: {trust.shape}, {depth_m.shape}")
        depth_m[trust == 0] = 0.0
        return depth_m

    def _unpacked(self, name: str, kind: str, budget: Budget) -> NDArray[Any]:
        """A depth image or a confidence image."""
        import liblzfse

        packed = self._paid(name, budget)
        width, height = self.depth_size
        expected = width * height * np.dtype(kind).itemsize
        budget.take(expected, 0)
        try:
            if unpacked_bytes(packed) != expected:
                raise ValueError(f"not {expected} bytes for {width} x {height}")
            content = liblzfse.decompress(packed)
        except (liblzfse.error, MemoryError, ValueError, struct.error) as error:
            raise RecordFault(DAMAGED, f"{name}: {error}") from error
        if len(content) != expected:
            raise RecordFault(DAMAGED, f"{name}: {len(content)} bytes for {width} x {height}")
        return np.frombuffer(content, kind).reshape(height, width)

    def _paid(self, name: str, budget: Budget) -> bytes:
        """A file's bytes, charged to the budget."""
        content = self.content(name)
        budget.add_file(self._path / name, len(content))
        return content


def unpacked_bytes(packed: bytes) -> int:
    """Decompressed size of LZFSE blocks, because a few bytes could decompress to gigabytes.

    Raises
    ------
    ValueError, struct.error
        They are damaged, or of an unknown type.
    """
    at, total = 0, 0
    while (magic := packed[at : at + 4]) != _END:
        (count,) = struct.unpack_from("<I", packed, at + 4)
        total += count
        if magic == _PLAIN:
            at += 8 + count
        elif magic == _LZVN:
            at += 12 + struct.unpack_from("<I", packed, at + 8)[0]
        elif magic == _LZFSE:
            # Sizes of literals and of matches, 20 bits each, and of the header.
            first, second, third = struct.unpack_from("<3Q", packed, at + 8)
            at += max(32, third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
        else:
            raise ValueError(f"a block {magic!r} of LZFSE")
    return total


def looks_like_record3d(path: Path, head: bytes) -> bool:
    """Whether a path is such an archive or its contents."""
    if path.is_dir():
        return (path / _METADATA).is_file() and (path / _IMAGES).is_dir()
    return path.suffix.lower() == ".r3d" and head.startswith(_ZIP_MAGIC)


def _check(path: Path) -> None:
    """Fail if the package that decompresses depth is not installed."""
    try:
        import liblzfse  # noqa: F401
    except ImportError as error:
        raise DatasetError(
            f"{path} packs its depth by LZFSE; install pyliblzfse, or pip install 'scanweave[phones]'"
        ) from error


def _load(path: Path, account: Account) -> Contents:
    """One recording, without depth in which the phone has no confidence."""
    account.report.note(COMPARED, 1)
    archive = _Archive(path)
    metadata = _metadata(path, archive)
    lens = _lens(path, metadata, account)
    archive.depth_size = _depth_size(path, metadata)
    folder = path if path.is_dir() else path.parent
    calibration = read_calibration(folder, Calibration(lens, 1.0))
    images = [StampedFile(stamp_s, path, number) for number, stamp_s in _stamps(metadata, account)]
    pairs = [FramePair(image.stamp_s, image, image) for image in images]
    return Contents([Camera("camera", pairs, calibration, source=archive)])


def _metadata(path: Path, archive: _Archive) -> dict[str, Any]:
    """The app's metadata of a recording."""
    try:
        content = from_json(archive.content(_METADATA))
    except (RecordFault, ValueError) as error:
        raise DatasetError(f"{path}: its metadata cannot be read ({error}); export it again") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: its metadata holds no named values; export it again")
    return content


def _lens(path: Path, metadata: dict[str, Any], account: Account) -> CameraIntrinsics:
    """Lens of the colour image: the median over the frames if they have lenses, else the single matrix."""
    try:
        size = int(metadata["w"]), int(metadata["h"])
        frames = metadata.get("perFrameIntrinsicCoeffs") or []
        numbers = [[float(value) for value in frame[:4]] for frame in frames]
        if not numbers:
            k = np.array(metadata["K"], dtype=np.float64).reshape(3, 3).T
            numbers = [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]]]
        matrices = [np.array([[fx, 0.0, cx], [0.0, fy, cy]]) for fx, fy, cx, cy in numbers]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path}: its metadata gives no lens ({error}); export it again") from error
    return median_lens([checked(path, matrix, *size) for matrix in matrices], account)


def _depth_size(path: Path, metadata: dict[str, Any]) -> tuple[int, int]:
    """Width and height of the depth images; older recordings without them have the lidar's size."""
    try:
        across = int(metadata["w"]) >= int(metadata["h"])
        usual = (256, 192) if across else (192, 256)
        width, height = int(metadata.get("dw", usual[0])), int(metadata.get("dh", usual[1]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path}: its metadata gives no size ({error}); export it again") from error
    if min(width, height) < 1 or width * height > LARGEST_BYTES:
        raise DatasetError(f"{path}: depth of {width} x {height}; export it again")
    return width, height


def _stamps(metadata: dict[str, Any], account: Account) -> Iterator[tuple[int, float]]:
    """Frames with their stamps; without stamps, from the frame rate of the recording."""
    stamps = metadata.get("frameTimestamps")
    if not isinstance(stamps, list) or not stamps:
        poses, rate = metadata.get("poses"), metadata.get("fps")
        rate_hz = float(rate) if isinstance(rate, (int, float)) and 0 < rate < 1000 else 60.0
        account.report.note(f"no stamps: frame N taken as N / {rate_hz:g} s old", 1)
        stamps = [number / rate_hz for number in range(len(poses) if isinstance(poses, list) else 0)]
    for number, stamp in enumerate(stamps):
        with account.refusing(_METADATA, number):
            yield number, stamp_of(str(stamp).encode("ascii", "replace"))


def _truth(path: Path, account: Account) -> Trajectory | None:
    """ARKit's poses: quaternion and position of each frame."""
    metadata = _metadata(path, _Archive(path))
    poses = metadata.get("poses")

    def good() -> Iterator[tuple[float, gtsam.Pose3]]:
        if not isinstance(poses, list):
            return
        for number, stamp_s in _stamps(metadata, account):
            with account.refusing(_METADATA, number, BAD_POSE, IndexError, TypeError, ValueError):
                pose = pose_from(poses[number][4:7], poses[number][:4])
                yield stamp_s, pose.compose(T_ARKIT_OPTICAL)

    return trajectory_of(good())


FORMAT = recorded("Record3D recording (.r3d)", looks_like_record3d, _load, _truth, _check)
