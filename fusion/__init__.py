"""Pure functions on sensor arrays: fusion of lidar and depth. Knows nothing of slam."""

from fusion.curves import DepthImage, Intrinsics, LidarCurve

__all__ = ["DepthImage", "Intrinsics", "LidarCurve"]
