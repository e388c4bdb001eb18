"""Readers: one a file format, all behind open_dataset."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from slam.datasets.bags.dataset import open_bag
from slam.datasets.bags.files import looks_like_bag
from slam.datasets.carmen import HEAD_BYTES, looks_like_carmen, open_carmen
from slam.datasets.cloud_folder import looks_like_cloud_folder, open_cloud_folder
from slam.datasets.dataset import Dataset, ReadReport
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.log_file import read_head
from slam.datasets.open_loris import looks_like_open_loris, open_open_loris
from slam.datasets.published import LOOSE, PUBLISHED
from slam.datasets.recorded_folder import looks_like_recorded_folder, open_recorded_folder
from slam.datasets.recording import Recording
from slam.datasets.robot_at_home import looks_like_robot_at_home, open_robot_at_home
from slam.datasets.robot_at_home2 import looks_like_robot_at_home2, open_robot_at_home2
from slam.datasets.seven_scenes import looks_like_seven_scenes, open_seven_scenes
from slam.datasets.tum import looks_like_tum, open_tum
from slam.errors import DatasetError

__all__ = ["FORMATS", "Dataset", "DatasetFormat", "ReadReport", "open_dataset"]


_LOOKED_AT = 64  # names in a folder that is no dataset, to say what it lacks
_LEVELS = 3  # a recording of KITTI lies two folders below what is unpacked


# The one place where a new reader is registered; the first that recognises a path reads it.
FORMATS: tuple[DatasetFormat, ...] = (
    DatasetFormat("CARMEN log (.log, .clf, plain or .gz)", looks_like_carmen, open_carmen),
    *PUBLISHED,
    DatasetFormat("7-Scenes folder", looks_like_seven_scenes, open_seven_scenes),
    DatasetFormat("folder of a CARMEN log and TUM images", looks_like_recorded_folder, open_recorded_folder),
    DatasetFormat("TUM RGB-D folder", looks_like_tum, open_tum),
    DatasetFormat("OpenLORIS-Scene folder", looks_like_open_loris, open_open_loris),
    DatasetFormat("Robot@Home session folder", looks_like_robot_at_home, open_robot_at_home),
    DatasetFormat("ROS bag (.bag, .db3, .mcap, or the folder of one)", looks_like_bag, open_bag),
    DatasetFormat("Robot@Home2 database (rh.db)", looks_like_robot_at_home2, open_robot_at_home2),
    DatasetFormat(
        "folder of point clouds (KITTI odometry; .bin, .pcd or .ply with a list of stamps)",
        looks_like_cloud_folder,
        open_cloud_folder,
    ),
    *LOOSE,
)


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
        Of a ROS bag that holds several topics of a sort: those to read. A sort of which none is named is read
        as without.
    images
        False leaves the images of a folder unread, where nobody will look at them.
    calibration
        Files of lenses and mountings by other tools, which are believed before the log; see
        `slam.datasets.calibration_files`.

    Returns
    -------
    Dataset
        Iterable of measurements; nothing but its beginning has been read yet.

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
    path = Path(path)
    supported = ", ".join(known.description for known in FORMATS)
    if not path.exists():
        # A session in a database has a path, too: DATABASE/SESSION.
        if looks_like_robot_at_home2(path, b""):
            return open_robot_at_home2(path, strict)
        raise DatasetError(f"{path} does not exist; give the path of a log: {supported}")
    if not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is neither a file nor a directory; supported: {supported}")
    head = read_head(path, HEAD_BYTES) if path.is_file() else b""
    if path.is_file() and not head:
        raise DatasetError(
            f"{path} is empty or its compression is damaged from the start; supported: {supported}"
        )
    for known in FORMATS:
        if known.recognises(path, head):
            if known.open is open_bag:
                bag = open_bag(path, strict, tuple(topics))
                bag.read_images, bag.calibration_files = images, tuple(map(Path, calibration))
                return bag
            if topics:
                raise DatasetError(f"{path} is a {known.description} and has no topics; leave out --topics")
            dataset = known.open(path, strict)
            if isinstance(dataset, Recording):
                dataset.read_images, dataset.calibration_files = images, tuple(map(Path, calibration))
            return dataset
    if path.is_dir():
        inside = _recordings(path)
        if len(inside) == 1:
            return open_dataset(inside[0], strict=strict, topics=topics, images=images)
        raise DatasetError(f"{path} {_what_is_wrong(path)}; supported: {supported}")
    raise DatasetError(f"{path} is a file of no known format; supported: {supported}")


def _what_is_wrong(folder: Path) -> str:
    """Why a folder is no dataset, as far as one can tell."""
    names = {entry.name for entry in islice(folder.iterdir(), _LOOKED_AT)}
    if not names:
        return "is an empty folder"
    for color, depths in (("rgb.txt", ("depth.txt",)), ("color.txt", ("aligned_depth.txt", "depth.txt"))):
        if color in names or names.intersection(depths):
            return f"needs both {color} and {depths[0]}"
    inside = [str(found.relative_to(folder)) for found in _recordings(folder)]
    if inside:
        return f"is no log itself but holds some; give one of {', '.join(inside[:8])}"
    return "is a directory of no known format"


def _recordings(folder: Path) -> list[Path]:
    """Recordings in a folder, or else two folders below it, as data sets are unpacked."""
    level = [folder]
    for _ in range(_LEVELS):
        below = [
            one for place in level for one in islice(sorted(place.iterdir()), _LOOKED_AT) if one.is_dir()
        ]
        found = [one for one in below if any(known.recognises(one, b"") for known in FORMATS)]
        if found:
            return found
        level = below[:_LOOKED_AT]
    return []
