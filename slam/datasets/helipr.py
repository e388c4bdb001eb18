"""HeLiPR: the streets of MulRan recorded with four lidars, of which one is read.

Jung et al. 2024, "HeLiPR: Heterogeneous LiDAR Dataset for inter-LiDAR Place Recognition under Spatiotemporal
Variations".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.cloud_files import Rows, row_of
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import beside_imu
from slam.datasets.log_file import first_file
from slam.datasets.mulran import xsens
from slam.datasets.pose_files import PoseTable
from slam.datasets.recording import Contents
from slam.estimates import Trajectory

# From the publishers' file player; the spinning lidar comes first.
_LIDARS = {
    "Ouster": ("x f4, y f4, z f4, intensity f4, t u4, reflectivity u2, ring u2, ambient u2",),
    "Velodyne": ("x f4, y f4, z f4, intensity f4, ring u2, time f4",),
    # The first recordings have no intensity.
    "Aeva": (
        "x f4, y f4, z f4, reflectivity f4, velocity f4, time_offset i4, line u1, intensity f4",
        "x f4, y f4, z f4, reflectivity f4, velocity f4, time_offset i4, line u1",
    ),
    "Avia": ("x f4, y f4, z f4, reflectivity u1, tag u1, line u1, offset_time u4",),
}
_POSES = PoseTable(stamp_units_s=(0.0,))
_PROBED = 8


def _load(path: Path, account: Account) -> Contents:
    """The folder of one sequence; reads the first lidar of Ouster, Velodyne, Aeva, Avia."""
    places = _lidars(path)
    name, folder = next(iter(places.items()))
    for other in list(places)[1:]:
        account.report.ignore(other, f"one lidar of several is read; give {places[other]} for it")
    files = clouds_by_name(folder, account)
    clouds = CloudFolder(tuple(files), parse=_row(name, folder)).numbered(account)
    imu = xsens(place / "Inertial_data" for place in _above(path, folder))
    return Contents(log=beside_imu(clouds, imu, account))


def _lidars(path: Path) -> dict[str, Path]:
    """Folders of lidars, by name, whose files have the row format of that lidar."""
    own = path.resolve().name
    places = {name: top / name for name in _LIDARS for top in (path, path / "LiDAR") if (top / name).is_dir()}
    places |= {own: path} if own in _LIDARS else {}
    return {name: folder for name, folder in places.items() if _row(name, folder)}


def _above(path: Path, folder: Path) -> tuple[Path, ...]:
    """The given folder, and the folders above that of a lidar."""
    return path, folder.resolve().parent, folder.resolve().parent.parent


def _row(name: str, folder: Path) -> Rows | None:
    """The row format that fits the first files, None if none does."""
    sizes = [
        file.stat().st_size for _, file in zip(range(_PROBED), sorted(folder.glob("*.bin")), strict=False)
    ]
    kinds = (Rows(row_of(fields)) for fields in _LIDARS[name])
    return next(
        (rows for rows in kinds if sizes and not any(size % rows.row.itemsize for size in sizes)), None
    )


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """The poses of the lidar that is read."""
    name, folder = next(iter(_lidars(path).items()))
    file = first_file(
        place / inside / f"{name}_gt.txt" for place in _above(path, folder) for inside in ("", "LiDAR_GT")
    )
    return _POSES.read(file, account) if file else None


FORMAT = recorded(
    "HeLiPR sequence", lambda path, head: path.is_dir() and bool(_lidars(path)), _load, _groundtruth
)
