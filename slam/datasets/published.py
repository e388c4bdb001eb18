"""Every format but CARMEN's, in the order in which they are asked: a log of that waits for no other reader.

A reader of a public data set or of a phone is one file with the name of the layout and a ``FORMAT``.
"""

from __future__ import annotations

from importlib import import_module

from slam.datasets.bags.dataset import open_bag
from slam.datasets.bags.files import looks_like_bag
from slam.datasets.cloud_folder import looks_like_cloud_folder, open_cloud_folder
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.open_loris import looks_like_open_loris, open_open_loris
from slam.datasets.recorded_folder import looks_like_recorded_folder, open_recorded_folder
from slam.datasets.robot_at_home import looks_like_robot_at_home, open_robot_at_home
from slam.datasets.robot_at_home2 import looks_like_robot_at_home2, open_robot_at_home2
from slam.datasets.seven_scenes import looks_like_seven_scenes, open_seven_scenes
from slam.datasets.tum import looks_like_tum, open_tum

_LAYOUTS = (
    "icl_nuim scannet_sens replica tartanair arkitscenes stray_scanner record3d "
    "polycam rtabmap_database kitti_raw nclt mulran helipr boreas newer_college euroc"
)
# Of names that others have, too: asked when nobody else knows a folder.
_LOOSE = "open3d_folder oxford_spires"


def _formats_of(layouts: str) -> list[DatasetFormat]:
    """What their files tell."""
    return [import_module(f"slam.datasets.{name}").FORMAT for name in layouts.split()]


# The one place where a new reader is registered; the first that recognises a path reads it.
OTHERS: tuple[DatasetFormat, ...] = (
    *_formats_of(_LAYOUTS),
    DatasetFormat("7-Scenes folder", looks_like_seven_scenes, open_seven_scenes),
    DatasetFormat("folder of a CARMEN log and TUM images", looks_like_recorded_folder, open_recorded_folder),
    DatasetFormat("TUM RGB-D folder (ETH3D SLAM, Bonn)", looks_like_tum, open_tum),
    DatasetFormat("OpenLORIS-Scene folder", looks_like_open_loris, open_open_loris),
    DatasetFormat("Robot@Home session folder", looks_like_robot_at_home, open_robot_at_home),
    DatasetFormat("ROS bag (.bag, .db3, .mcap, or the folder of one)", looks_like_bag, open_bag),
    DatasetFormat("Robot@Home2 database (rh.db)", looks_like_robot_at_home2, open_robot_at_home2),
    DatasetFormat(
        "folder of point clouds (KITTI odometry; .bin, .pcd or .ply with a list of stamps)",
        looks_like_cloud_folder,
        open_cloud_folder,
    ),
    *_formats_of(_LOOSE),
)
