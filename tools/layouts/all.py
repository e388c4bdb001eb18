"""All writers of samples, in the order of the table."""

from tools.layouts import (
    camera_bags,
    cameras,
    flat_logs,
    foxglove,
    lidar_bags,
    lidar_sets,
    lidars,
    odd_images,
    ouster,
)

__all__ = [
    "camera_bags",
    "cameras",
    "flat_logs",
    "foxglove",
    "lidar_bags",
    "lidar_sets",
    "lidars",
    "odd_images",
    "ouster",
]
