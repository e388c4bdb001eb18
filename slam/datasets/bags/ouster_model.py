"""The metadata of an Ouster lidar: the layout of its packets, the directions of its rays, its mounting.

After Ouster's Software User Manual (firmware 2.x and 3.x): "Lidar Data Packet Format", "Lidar Range to XYZ".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.dataset import RecordFault
from slam.measurements import FloatArray

NOT_READ = "packets of an Ouster whose metadata cannot be used"
FRAMES = "os_sensor", "os_lidar", "os_imu"  # names that its driver uses

# A pixel: its size in bytes, type of the range at its start, bits that are range, metres per step; type and
# offset of the intensity: photons, or the reflectivity if they are not sent.
_PIXELS = {
    "LEGACY": (12, "<u4", 0xFFFFF, 0.001, "<u2", 6),
    "RNG19_RFL8_SIG16_NIR16": (12, "<u4", 0x7FFFF, 0.001, "<u2", 6),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (16, "<u4", 0x7FFFF, 0.001, "<u2", 8),
    "RNG15_RFL8_NIR8": (4, "<u2", 0x7FFF, 0.008, "u1", 2),
}
_LARGEST_PACKET, _MOST_COLUMNS = 65_507, 4096  # limit of UDP; the mode with the most columns
_MOST_FILES, _MOST_BYTES = 64, 1 << 22
_SECTIONS = "config_params beam_intrinsics lidar_intrinsics imu_intrinsics data_format lidar_data_format"


@dataclass(frozen=True, slots=True, eq=False)
class OusterModel:
    """The metadata of a sensor.

    Attributes
    ----------
    packet
        The structured type of a packet; with ``frame`` if its header contains it.
    step_m, bits
        Metres per range step, and the bits of a pixel's first number that are range.
    ahead
        (W, R, 3) unit rays of all pixels in the lidar's frame.
    origins_m, arm_m
        (W, 3) origins of the rays of a column, and their distance from the lidar's axis.
    sent
        (W,) whether a column is in the azimuth window that is sent.
    T_sensor_lidar, T_sensor_imu
        Poses of the lidar frame and the IMU frame in the sensor frame.
    """

    packet: np.dtype[Any]
    step_m: float
    bits: int
    ahead: FloatArray
    origins_m: FloatArray
    arm_m: float
    sent: NDArray[np.bool_]
    T_sensor_lidar: gtsam.Pose3
    T_sensor_imu: gtsam.Pose3 | None

    @staticmethod
    def of(text: str) -> OusterModel:
        """Parse the metadata of a sensor (flat, with a format, or in sections); RecordFault if unreadable."""
        try:
            content = json.loads(text)
            fields = dict(content)
            for name in _SECTIONS.split():
                fields |= content.get(name) or {}
            return _model(fields)
        except KeyError as error:
            raise RecordFault(f"{NOT_READ}: it lacks {error}", "") from error
        except (ValueError, TypeError, AttributeError, RuntimeError, RecursionError) as error:
            raise RecordFault(NOT_READ, str(error)) from error

    def mountings(self) -> dict[str, gtsam.Pose3]:
        """Poses of its frames in the sensor frame."""
        _, lidar, imu = FRAMES
        return {lidar: self.T_sensor_lidar} | ({imu: self.T_sensor_imu} if self.T_sensor_imu else {})


def _model(meta: dict[str, Any]) -> OusterModel:
    """A model from parsed metadata."""
    profile = str(meta.get("udp_profile_lidar") or "LEGACY")
    if profile not in _PIXELS:
        raise RecordFault(f"{NOT_READ}: profile {profile[:40]}, of those read {', '.join(_PIXELS)}", profile)
    up_rad, side_rad = (
        np.radians(np.asarray(meta[f"beam_{name}_angles"], np.float64)) for name in ("altitude", "azimuth")
    )
    columns = int(meta.get("columns_per_frame") or str(meta["lidar_mode"]).partition("x")[0])
    rows, each = int(meta.get("pixels_per_column", len(up_rad))), int(meta.get("columns_per_packet", 16))
    if up_rad.shape != (rows,) or side_rad.shape != (rows,) or not 0 < columns <= _MOST_COLUMNS or each < 1:
        raise ValueError(f"{columns} columns of {rows} pixels with {up_rad.size} and {side_rad.size} angles")
    size, _, bits, step_m, _, _ = _PIXELS[profile]
    if rows * each * size > _LARGEST_PACKET:
        raise ValueError(f"{each} columns of {rows} pixels in a packet")
    packet = _packet(profile, rows, each)
    across_m, above_m = _beams_m(meta)
    encoder = 2.0 * np.pi * (1.0 - np.arange(columns) / columns)
    bearing, flat = encoder[:, None] - side_rad, np.cos(up_rad)
    height = np.broadcast_to(np.sin(up_rad), bearing.shape)
    origins = [across_m * np.cos(encoder), across_m * np.sin(encoder), np.full(columns, above_m)]
    ahead = np.stack([flat * np.cos(bearing), flat * np.sin(bearing), height], axis=-1)
    first, last = meta.get("column_window") or (0, columns - 1)
    sent = (np.arange(columns) - int(first)) % columns <= (int(last) - int(first)) % columns
    imu = meta.get("imu_to_sensor_transform")
    arm_m = float(np.hypot(across_m, above_m))
    if not np.isfinite([ahead.sum(), arm_m]).all():
        raise ValueError("angles that are no numbers")
    mount = _pose(meta["lidar_to_sensor_transform"])
    return OusterModel(
        packet, step_m, bits, ahead, np.stack(origins, 1), arm_m, sent, mount, _pose(imu) if imu else None
    )


def _packet(profile: str, rows: int, each: int) -> np.dtype[Any]:
    """The structured type of a packet with ``each`` columns."""
    size, form, _, _, intensities, at = _PIXELS[profile]
    pixel = np.dtype(
        {
            "names": ["steps", "intensity"],
            "formats": [form, intensities],
            "offsets": [0, at],
            "itemsize": size,
        }
    )
    column: list[Any] = [("stamp_ns", "<u8"), ("number", "<u2")]
    if profile == "LEGACY":
        column += [("frame", "<u2"), ("encoder", "<u4"), ("pixels", pixel, (rows,)), ("status", "<u4")]
        return np.dtype([("columns", column, (each,))])
    column += [("status", "<u2"), ("pixels", pixel, (rows,))]
    head, foot = [("kind", "<u2"), ("frame", "<u2"), ("head", "V28")], [("foot", "V32")]
    return np.dtype([*head, ("columns", column, (each,)), *foot])


@cache
def packet_sizes() -> frozenset[int]:
    """Packet sizes in bytes of all Ouster models, to recognise packets without metadata."""
    return frozenset(_packet(profile, rows, 16).itemsize for profile in _PIXELS for rows in (16, 32, 64, 128))


def _beams_m(fields: Mapping[str, Any]) -> tuple[float, float]:
    """Distance of the beam origins from the lidar's axis, and their height above its origin."""
    if (transform := fields.get("beam_to_lidar_transform")) is not None:
        matrix = np.asarray(transform, np.float64).reshape(4, 4)
        return float(matrix[0, 3]) / 1000.0, float(matrix[2, 3]) / 1000.0
    return float(fields["lidar_origin_to_beam_origin_mm"]) / 1000.0, 0.0


def _pose(numbers: Any) -> gtsam.Pose3:
    """A transform in the metadata: 16 numbers in row-major order, millimetres."""
    matrix = np.asarray(numbers, np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3]) - 1.0) > 0.01:
        raise ValueError("an invalid transform")
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3] / 1000.0)


def metadata_beside(path: Path) -> str | None:
    """The metadata next to or in a recording: with its name, else the only one, else None."""
    places = [path, path.parent] if path.is_dir() else [path.parent]
    for place in places:
        texts = {}
        for file in islice(sorted(place.glob("*.json")), _MOST_FILES):
            try:
                text = file.read_text("utf-8") if file.stat().st_size < _MOST_BYTES else ""
            except (OSError, ValueError):
                continue
            if "beam_altitude_angles" in text:
                texts[file.stem] = text
        named = [text for stem, text in texts.items() if stem in (path.name, path.stem)]
        if named or len(texts) == 1:
            return (named or list(texts.values()))[0]
    return None
