"""Lists all readers, and chooses one for a log."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import cast

from slam.config.stages import SensorsConfig
from slam.datasets.carmen import HEAD_BYTES, looks_like_carmen, open_carmen
from slam.datasets.dataset import Dataset
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.log_file import read_head
from slam.errors import DatasetError, path_of

_LOOKED_AT = 64  # names examined in a folder that is no dataset, to say what is missing
_LEVELS = 3  # a KITTI recording is two folders below the unpacked archive
# Suffixes of files that are no log or not supported: what they are, and how to convert them.
_UNREAD = (
    (r"zip|7z|rar|tar|tgz|gz|bz2|xz|zstd?", "is an archive; unpack it, and give the folder or file in it"),
    (
        r"mkv",
        "is a video, as of an Azure Kinect; Open3D's tool makes a folder of it that is read: "
        "python azure_kinect_mkv_reader.py --input {path} --output FOLDER",
    ),
    (r"mp4|mov|avi|h26[45]", "is a video, without depth; give the folder of the recording that it is of"),
    (r"svo2?", "is a ZED's; play it by its ROS driver (svo_path:={path}), and record a bag"),
    (r"oni", "is of OpenNI; play it by openni2_launch, and record a bag"),
    (r"rawlog", "is a log of MRPT; play it by mrpt_rawlog's rawlog_play_node, and record a bag"),
    (
        r"pcd|ply|la[sz]|e57|obj|bin|glb|gltf|stl|usd[az]?|usdz",
        "is a single cloud or mesh; give a folder of clouds with their stamps in times.txt",
    ),
    (
        r"posegraph|pbstream|g2o|graph|toro|pgm|ya?ml",
        "is a map or a setting; give the recording that it was made from, the bag",
    ),
)
_CARMEN = DatasetFormat("CARMEN log (.log, .clf, plain or .gz)", looks_like_carmen, open_carmen)


def _formats() -> Iterator[DatasetFormat]:
    """All formats, in the order in which they are tried."""
    yield _CARMEN
    from slam.datasets.published import OTHERS

    yield from OTHERS


def _supported() -> str:
    """Which formats are supported, in short, for the error message."""
    others = sum(1 for _ in _formats()) - 4
    return f"supported: CARMEN logs, ROS bags, TUM and KITTI folders, and {others} others in docs/formats.md"


def open_dataset(
    path: Path | str,
    *,
    strict: bool = False,
    topics: Sequence[str] = (),
    images: bool = True,
    calibration: Sequence[Path | str] = (),
) -> Dataset:
    """Open a log by its content, whatever its name.

    Parameters
    ----------
    path
        A log file, or a folder of one recording.
    strict
        Stop at the first damaged record instead of counting and skipping it.
    topics
        Topics to read, for a ROS bag with several topics of one type. Other types are read as usual.
    images
        False skips the images of a folder, if they are not needed.
    calibration
        Calibration files of other tools, which have priority over the log; see
        `slam.datasets.calibration_files`.

    Returns
    -------
    Dataset
        Iterable of measurements; only its start has been read yet.

    Raises
    ------
    DatasetError
        No such file, an empty one, or a format that no reader recognises.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> log = slam.open_dataset(write_synthetic_log("monday", duration_s=10.0).log_path)
    >>> sorted({measurement.sensor for measurement in log}), log.report.dropped_count
    (['FLASER', 'odometry'], 0)
    """
    path = path_of(path, "the log", DatasetError)
    if not path.exists():
        from slam.datasets.robot_at_home2 import looks_like_robot_at_home2, open_robot_at_home2

        # A session in a database also has a path: DATABASE/SESSION.
        if looks_like_robot_at_home2(path, b""):
            return open_robot_at_home2(path, strict)
        raise DatasetError(f"{path} does not exist; {_suggestion(path)}")
    if not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is neither a file nor a directory")
    head = read_head(path, HEAD_BYTES) if path.is_file() else b""
    if path.is_file() and not head:
        raise DatasetError(f"{path} is empty or its compression is damaged from the start; copy it again")
    for known in _formats():
        if known.recognises(path, head):
            dataset = _opened(known, path, strict, tuple(topics))
            options = {"read_images": images, "calibration_files": tuple(map(Path, calibration))}
            for name, value in options.items():
                if hasattr(dataset, name):
                    setattr(dataset, name, value)
            return dataset
    if path.is_dir():
        inside = _recordings(path)
        if len(inside) == 1:
            return open_dataset(
                inside[0], strict=strict, topics=topics, images=images, calibration=calibration
            )
        raise DatasetError(f"{path} {_problem_of(path)}")
    suffix = path.suffix[1:].lower()
    what = next((words for suffixes, words in _UNREAD if re.fullmatch(suffixes, suffix)), None)
    raise DatasetError(
        f"{path} {what.format(path=path) if what else f'is a file of no known format; {_supported()}'}"
    )


def opened_by(sensors: SensorsConfig, log: Path | str | Dataset, *, strict: bool) -> Dataset:
    """Open a log according to the settings, if it is a path; errors as in `open_dataset`."""
    if not isinstance(log, str | Path) and hasattr(log, "groundtruth"):
        return log
    files = sensors.calibration_files
    return open_dataset(
        cast(Path, log), strict=strict, topics=sensors.topics, images=sensors.rgbd, calibration=files
    )


def _opened(known: DatasetFormat, path: Path, strict: bool, topics: tuple[str, ...]) -> Dataset:
    """A log of a known format."""
    if known is not _CARMEN:
        from slam.datasets.bags.dataset import BagDataset

        if known.open is BagDataset:
            return BagDataset(path, strict, topics)
    if topics:
        raise DatasetError(f"{path} is a {known.description} and has no topics; leave out --topics")
    return known.open(path, strict)


def _suggestion(path: Path) -> str:
    """Suggestions for a path that does not exist."""
    folder = path.parent
    names = [entry.name for entry in islice(folder.iterdir(), _LOOKED_AT)] if folder.is_dir() else []
    similar = [str(folder / name) for name in get_close_matches(path.name, names)]
    return f"did you mean {' or '.join(similar)}?" if similar else "give the path of a log"


def _problem_of(folder: Path) -> str:
    """Why a folder is no dataset, as far as known."""
    names = {entry.name for entry in islice(folder.iterdir(), _LOOKED_AT)}
    if not names:
        return "is an empty folder"
    for color, depths in (("rgb.txt", ("depth.txt",)), ("color.txt", ("aligned_depth.txt", "depth.txt"))):
        if color in names or names.intersection(depths):
            return f"needs both {color} and {depths[0]}"
    if any(name.lower().endswith(".e57") for name in names):
        return "holds E57; convert each to .ply (pye57, CloudCompare), and list the stamps in times.txt"
    inside = [str(recording.relative_to(folder)) for recording in _recordings(folder)]
    if inside:
        return f"is no log itself but holds some; give one of {', '.join(inside[:8])}"
    listed = "list images in rgb.txt and depth.txt, clouds in times.txt, or write a bag"
    return f"is a directory of no known format: {listed}; {_supported()}"


def _recordings(folder: Path) -> list[Path]:
    """Recordings in a folder, or up to two folders below it, as in unpacked archives."""
    level = [folder]
    for _ in range(_LEVELS):
        below = [
            sub for place in level for sub in islice(sorted(place.iterdir()), _LOOKED_AT) if sub.is_dir()
        ]
        recordings = [sub for sub in below if any(known.recognises(sub, b"") for known in _formats())]
        if recordings:
            return recordings
        level = below[:_LOOKED_AT]
    return []
