"""Convert positions on the earth to a tangent plane: WGS 84 to east, north, up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.measurements import FloatArray

# Of WGS 84: half the greater axis in metres, and the flattening.
_AXIS_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)


@dataclass(frozen=True, slots=True)
class TangentPlane:
    """East, north, up at a place on the ellipsoid.

    Attributes
    ----------
    latitude_deg, longitude_deg, altitude_m
        Of its origin.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def enu_m(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> FloatArray:
        """(3,) east, north, up of a place."""
        there, here = (
            _from_centre(*place) for place in ((latitude_deg, longitude_deg, altitude_m), self._origin)
        )
        return self._axes() @ (there - here)

    def geodetic(self, enu_m: FloatArray | list[float]) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and altitude, of (3,) east, north, up."""
        x, y, z = _from_centre(*self._origin) + self._axes().T @ np.asarray(enu_m)
        across_m = math.hypot(x, y)
        latitude = math.atan2(z, across_m * (1.0 - _ECCENTRICITY_2))
        # Each round is a few hundred times as exact.
        for _ in range(5):
            radius_m = _AXIS_M / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(latitude) ** 2)
            latitude = math.atan2(z + _ECCENTRICITY_2 * radius_m * math.sin(latitude), across_m)
        radius_m = _AXIS_M / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(latitude) ** 2)
        # By either axis, and both together hold at the poles, too.
        up_m = across_m * math.cos(latitude) + z * math.sin(latitude) - _AXIS_M**2 / radius_m
        return math.degrees(latitude), math.degrees(math.atan2(y, x)), float(up_m)

    @property
    def _origin(self) -> tuple[float, float, float]:
        return self.latitude_deg, self.longitude_deg, self.altitude_m

    def _axes(self) -> FloatArray:
        """(3, 3) rows east, north, up in the earth's own axes."""
        lat, lon = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
        east = np.array([-math.sin(lon), math.cos(lon), 0.0])
        return np.array([east, np.cross(up, east), up])


def _from_centre(latitude_deg: float, longitude_deg: float, altitude_m: float) -> FloatArray:
    """(3,) of a place in the earth's own axes, from its centre."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    radius_m = _AXIS_M / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(lat) ** 2)
    across_m = (radius_m + altitude_m) * math.cos(lat)
    up_m = (radius_m * (1.0 - _ECCENTRICITY_2) + altitude_m) * math.sin(lat)
    return np.array([across_m * math.cos(lon), across_m * math.sin(lon), up_m])


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where a map lies on the earth.

    Attributes
    ----------
    plane
        East, north, up at the first fix.
    """

    plane: TangentPlane
    T_enu_map: gtsam.Pose3

    def geodetic(self, point_map_m: FloatArray) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and altitude, of a point (3,) of the map."""
        return self.plane.geodetic(np.asarray(self.T_enu_map.transformFrom(point_map_m)))

    @property
    def heading_deg(self) -> float:
        """Of the map's x axis, from north over east."""
        ahead = np.asarray(self.T_enu_map.rotation().matrix())[:, 0]
        return math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
