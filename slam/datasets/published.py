"""The layouts of public data sets and of phones, in the order in which they are asked.

A reader of one is one file with the name of the layout and a ``FORMAT``.
"""

from __future__ import annotations

from slam.datasets import (
    arkitscenes,
    bonn_rgbd,
    boreas,
    eth3d_slam,
    euroc,
    helipr,
    icl_nuim,
    kitti_raw,
    mulran,
    nclt,
    newer_college,
    open3d_folder,
    oxford_spires,
    polycam,
    record3d,
    replica,
    rtabmap_database,
    scannet,
    scannet_sens,
    stray_scanner,
    tartanair,
)
from slam.datasets.dataset_format import DatasetFormat

PUBLISHED: tuple[DatasetFormat, ...] = tuple(
    layout.FORMAT
    for layout in (
        eth3d_slam,
        icl_nuim,
        bonn_rgbd,
        scannet,
        scannet_sens,
        replica,
        tartanair,
        arkitscenes,
        stray_scanner,
        record3d,
        polycam,
        rtabmap_database,
        kitti_raw,
        nclt,
        mulran,
        helipr,
        boreas,
        newer_college,
        euroc,
    )
)
# Of names that others have, too: asked when nobody else knows a folder.
LOOSE: tuple[DatasetFormat, ...] = (open3d_folder.FORMAT, oxford_spires.FORMAT)
