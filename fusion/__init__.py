"""Pure functions on sensor arrays: fusion of lidar and depth. Knows nothing of slam."""

from fusion.curves import DepthImage, Intrinsics, LidarCurve
from fusion.denoise import Denoised, denoise
from fusion.registration import Registration, register
from fusion.repair import Provenance
from fusion.rig import Rig, RigEstimate
from fusion.similarity import Grade

__all__ = [
    "Denoised",
    "DepthImage",
    "Grade",
    "Intrinsics",
    "LidarCurve",
    "Provenance",
    "Registration",
    "Rig",
    "RigEstimate",
    "denoise",
    "register",
]
