"""Pure functions on sensor arrays that fuse lidar and depth. Independent of the package slam.

A lidar and a depth camera repair each other, without calibration between them (Xu2024)::

    import fusion

    scan = fusion.LidarCurve(ranges_m, start_angle_rad, step_rad, range_max_m)
    depth = fusion.DepthImage(depth_m, fusion.Intrinsics(fx, fy, cx, cy))
    pair = fusion.register(scan, depth)  # (u, v), height, grade, score map
    repaired = fusion.denoise(scan, depth, pair)  # ranges_m, depth_m, provenance of each sample

A single pair can be ambiguous; a whole drive is not. `Rig` accumulates the pairs of one robot, and its
estimate replaces a single registration::

    rig = fusion.Rig()
    for scan, depth in drive:
        rig.add(fusion.register(scan, depth))
    repaired = fusion.denoise(scan, depth, rig.estimate())
"""

from fusion.curves import DepthImage, Intrinsics, LidarCurve
from fusion.denoise import Denoised, denoise
from fusion.depth_model import RangeNoise
from fusion.height_band import HeightBand
from fusion.registration import Grade, Registration, register
from fusion.repair import Provenance
from fusion.rig import Rig, RigEstimate
from fusion.time_alignment import ClockOffset, clock_offset

__all__ = [
    "ClockOffset",
    "Denoised",
    "DepthImage",
    "Grade",
    "HeightBand",
    "Intrinsics",
    "LidarCurve",
    "Provenance",
    "RangeNoise",
    "Registration",
    "Rig",
    "RigEstimate",
    "clock_offset",
    "denoise",
    "register",
]
