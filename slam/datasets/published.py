"""All formats except CARMEN, in the order in which they are tried; CARMEN logs load no other reader.

The reader of a public data set or a phone app is one file, named after its layout, with a ``FORMAT``.
"""

from __future__ import annotations

from importlib import import_module

from slam.datasets.bags.dataset import BagDataset
from slam.datasets.bags.files import looks_like_bag
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.robot_at_home import looks_like_robot_at_home, open_robot_at_home
from slam.datasets.robot_at_home2 import looks_like_robot_at_home2, open_robot_at_home2

_LAYOUTS = (
    "icl_nuim scannet_sens replica tartanair arkitscenes stray_scanner record3d polycam rtabmap_database "
    "nyu_dumps player rawseeds captures nuscenes kitti_raw nclt mulran helipr boreas newer_college euroc "
    "seven_scenes recorded_folder tum open_loris"
)
# These use common file names, so they are tried last.
_LOOSE = "cloud_folder open3d_folder oxford_spires"


def _formats_of(layouts: str) -> list[DatasetFormat]:
    """The formats of these layouts."""
    return [import_module(f"slam.datasets.{name}").FORMAT for name in layouts.split()]


# The one place where a new reader is registered; the first that recognises a path reads it.
OTHERS: tuple[DatasetFormat, ...] = (
    *_formats_of(_LAYOUTS),
    DatasetFormat("Robot@Home session folder", looks_like_robot_at_home, open_robot_at_home),
    DatasetFormat("ROS bag (.bag, .db3, .mcap, or the folder of one)", looks_like_bag, BagDataset),
    DatasetFormat("Robot@Home2 database (rh.db)", looks_like_robot_at_home2, open_robot_at_home2),
    *_formats_of(_LOOSE),
)
