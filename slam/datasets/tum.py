"""The layout of the TUM RGB-D benchmark: lists of colour and depth images, and a trajectory, in a folder.

Sturm et al. 2012, "A Benchmark for the Evaluation of RGB-D SLAM Systems". Bonn RGB-D Dynamic (Palazzolo et
al. 2019, "ReFusion") and ETH3D SLAM (Schöps et al. 2019, "BAD SLAM"), with its lens in a file, use it, too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import FILE_NAME, KINECT, Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import pair_images
from slam.datasets.lens_files import four_numbers
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile, read_associations, read_image_list, read_poses
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_LISTS = ("rgb.txt", "depth.txt")
_ASSOCIATIONS = ("associations.txt", "associate.txt", "association.txt", "associated.txt")
_GROUNDTRUTH, _LENS_FILE = "groundtruth.txt", "calibration.txt"
DEPTH_STEPS_PER_M = 5000.0

# By words in a folder name: the published calibrations of the colour image, to which depth is already
# registered, without distortion.
_PUBLISHED = {
    "freiburg1": CameraIntrinsics(517.3, 516.5, 318.6, 255.3, 640, 480),
    "freiburg2": CameraIntrinsics(520.9, 521.0, 325.1, 249.7, 640, 480),
    "freiburg3": CameraIntrinsics(535.4, 539.2, 320.1, 247.6, 640, 480),
    "rgbd_bonn": CameraIntrinsics(542.822841, 542.576870, 315.593520, 237.756098, 640, 480),
}
ASSUMED = (
    "intrinsics assumed (525 525 319.5 239.5 at 640 x 480), and 5000 depth steps per metre; give a "
    "calibration.yaml, or --calibration FILE"
)

BY_NAME = (
    "{lens.fx:g} {lens.fy:g} {lens.cx:g} {lens.cy:g} is the lens that is published for {name}, by its name"
)


def has_tum_layout(folder: Path) -> bool:
    """Whether a folder contains both image lists, or one that associates them."""
    if all((folder / name).is_file() for name in _LISTS):
        return True
    return any((folder / name).is_file() for name in _ASSOCIATIONS)


def tum_camera(folder: Path, sensor: str, account: Account) -> Camera:
    """The camera whose image lists are in a folder.

    Without ``calibration.yaml`` the intrinsics are those of ``calibration.txt`` (fx fy cx cy), else those
    that are published for folders with such a name (freiburg1 to 3, rgbd_bonn), else assumed.
    """
    known = [lens for name, lens in _PUBLISHED.items() if name in folder.resolve().name.lower()]
    if (folder / _LENS_FILE).is_file():
        known = [four_numbers(folder / _LENS_FILE)]
    elif known and not (folder / FILE_NAME).is_file():
        account.report.note(BY_NAME.format(name=folder.resolve().name, lens=known[0]), 1)
    default = Calibration(known[0] if known else KINECT, DEPTH_STEPS_PER_M, assumed="" if known else ASSUMED)
    return listed_camera(folder, sensor, default, account)


def listed_camera(
    folder: Path, sensor: str, default: Calibration, account: Account, rate_hz: float = 1.0
) -> Camera:
    """The camera whose image lists are in a folder; a calibration file there overrides its calibration.

    Parameters
    ----------
    rate_hz
        Divisor of the stamps, if the lists contain frame numbers.
    """
    colors, depths = (
        [replace(image, stamp_s=image.stamp_s / rate_hz) for image in images]
        for images in _image_lists(folder, account)
    )
    return Camera(sensor, pair_images(colors, depths, account, sensor), read_calibration(folder, default))


def read_groundtruth(folder: Path, account: Account) -> Trajectory | None:
    """The trajectory next to the lists, None if there is none."""
    path = folder / _GROUNDTRUTH
    return read_poses(path, account) if path.is_file() else None


def _image_lists(folder: Path, account: Account) -> tuple[list[StampedFile], list[StampedFile]]:
    """Colour and depth images from the two lists, or from the one that associates them."""
    paths = [folder / name for name in _LISTS]
    if all(path.is_file() for path in paths):
        return read_image_list(paths[0], account), read_image_list(paths[1], account)
    associated = next(folder / name for name in _ASSOCIATIONS if (folder / name).is_file())
    return read_associations(associated, account)


FORMAT = recorded(
    "TUM RGB-D folder (ETH3D SLAM, Bonn)",
    lambda path, head: path.is_dir() and has_tum_layout(path),
    lambda path, account: Contents([tum_camera(path, "camera", account)]),
    read_groundtruth,
)
