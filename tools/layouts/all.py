"""All writers of samples, in the order of the table."""

from tools.layouts import camera_bags, cameras, flat_logs, lidar_bags, lidars

__all__ = ["camera_bags", "cameras", "flat_logs", "lidar_bags", "lidars"]
