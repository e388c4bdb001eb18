"""Georeference of a map, and the path of the robot on the earth, as files for GIS programs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slam.earth import Georeference
from slam.estimates import Trajectory
from slam.storage.files import write_lines

# Stamps before 2001 are not Unix time.
_WORLD_S = 978_307_200.0


def write_georeference(path: Path, earth: Georeference) -> None:
    """Write yaml: position of the map's origin on WGS 84, heading of its x axis, and matrix to ENU.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    plane, (latitude, longitude, altitude) = earth.plane, earth.geodetic(np.zeros(3))
    rows = np.asarray(earth.T_enu_map.matrix())[:3]
    lines = [
        "# The origin of the map on WGS 84, degrees and metres above the ellipsoid.",
        f"latitude_deg: {latitude:.9f}",
        f"longitude_deg: {longitude:.9f}",
        f"altitude_m: {altitude:.3f}",
        "# Of the map's x axis, from north over east.",
        f"heading_deg: {earth.heading_deg:.4f}",
        "# From the map to east, north, up about a place, row by row.",
        f"enu_origin: [{plane.latitude_deg:.9f}, {plane.longitude_deg:.9f}, {plane.altitude_m:.3f}]",
        "T_enu_map:",
        *("  - [" + ", ".join(f"{value:.9f}" for value in row) + "]" for row in rows.tolist()),
    ]
    write_lines(path, lines)


def write_gpx(path: Path, trajectory: Trajectory, earth: Georeference) -> None:
    """Write the path as a GPX 1.1 track; with times if the stamps are Unix time.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="Scanweave" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>',
    ]
    for stamp_s, place in zip(trajectory.stamps_s.tolist(), trajectory.positions_m, strict=True):
        latitude, longitude, altitude = earth.geodetic(place)
        time = ""
        if stamp_s > _WORLD_S:
            time = f"<time>{datetime.fromtimestamp(stamp_s, UTC).isoformat(timespec='milliseconds')}</time>"
        lines.append(
            f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{altitude:.3f}</ele>{time}</trkpt>'
        )
    write_lines(path, [*lines, "</trkseg></trk></gpx>"])
