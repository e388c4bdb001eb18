"""A robot's folder: a CARMEN log with cameras in TUM layout and clouds. The simulator writes this format."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.carmen import HEAD_BYTES, looks_like_carmen, read_carmen
from slam.datasets.cloud_folder import has_clouds, read_clouds
from slam.datasets.clouds_over_time import merged
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import beside_imu, imu_file
from slam.datasets.log_file import read_head
from slam.datasets.recording import Contents, Numbered
from slam.datasets.tum import has_tum_layout, read_groundtruth, tum_camera
from slam.errors import DatasetError
from slam.foreign import plain

_CAMERA_FOLDERS = "rgbd_*"
_NO_LOGS = frozenset(
    {".png", ".jpg", ".jpeg", ".yaml", ".yml", ".json", ".mcap", ".npz", ".db", ".db3", ".bag"}
)


def _check(path: Path) -> None:
    """Reject several logs, because it is unknown which one belongs to the images."""
    if len(logs := _carmen_logs(path)) > 1:
        names = ", ".join(log.name for log in logs[:4])
        raise DatasetError(
            f"{path} holds {len(logs)} CARMEN logs ({names}); give one of them, or leave only one"
        )


def _load(path: Path, account: Account) -> Contents:
    """A folder of wheels, lidar and cameras."""
    cameras = [tum_camera(folder, name, account) for name, folder in _cameras(path).items()]
    log: Iterable[Numbered] = ()
    for carmen_log in _carmen_logs(path):
        log = read_carmen(carmen_log, account)
    if has_clouds(path):
        log = merged(log, read_clouds(path, account).numbered(account))
    return Contents(cameras, beside_imu(log, imu_file(path), account))


def _cameras(path: Path) -> dict[str, Path]:
    """Folders of cameras by camera name: RGBD_1 for ``rgbd_1``, left for ``rgbd_left``."""
    if has_tum_layout(path):
        return {"camera": path}
    folders = {}
    for folder in _camera_folders(path):
        name = plain(folder.name.removeprefix("rgbd_"))
        folders[f"RGBD_{name}" if name.isdecimal() else name] = folder
    return folders


def _camera_folders(path: Path) -> list[Path]:
    """Folders of one camera each."""
    return sorted(folder for folder in path.glob(_CAMERA_FOLDERS) if has_tum_layout(folder))


def _carmen_logs(path: Path) -> list[Path]:
    """Files directly in a folder that contain CARMEN messages."""
    return sorted(
        file
        for file in path.iterdir()
        if file.suffix.lower() not in _NO_LOGS
        and file.is_file()
        and (head := read_head(file, HEAD_BYTES))
        and looks_like_carmen(file, head)
    )


FORMAT = recorded(
    "folder of a CARMEN log and TUM images",
    lambda path, head: path.is_dir() and bool(_carmen_logs(path) or _camera_folders(path)),
    _load,
    read_groundtruth,
    _check,
)
