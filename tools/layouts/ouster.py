"""Packets of an Ouster as in its Software User Manual, with the metadata of the sensor."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.layouts import messages as ros
from tools.layouts.lidar_bags import STAMPS, captured
from tools.layouts.lidars import TURN_S, still
from tools.layouts.messages import Sent
from tools.layouts.samples import CloudTruth, Sample, layout
from tools.layouts.world import hits, placed, way
from tools.pack_layouts import put

COLUMNS, ROWS, IN_PACKET = 512, 32, 16
ARM_M = 0.015806  # of an OS1: beams begin so far from the axis
UP_DEG = np.linspace(21.0, -22.0, ROWS)
ASIDE_DEG = np.tile([4.2, 1.4, -1.4, -4.2], ROWS // 4)
SITS = placed(0.0, 0.0, 0.038195, yaw=np.pi)  # the lidar's frame in the sensor's
IMU_SITS = placed(0.006253, -0.011775, 0.007645)
SENSOR = placed(0.1, 0.0, 1.0)
# Bytes of a pixel, and how a range of metres is written in front of it.
PROFILES: dict[str, tuple[int, str, float]] = {
    "LEGACY": (12, "<I", 0.001),
    "RNG19_RFL8_SIG16_NIR16": (12, "<I", 0.001),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (16, "<I", 0.001),
    "RNG15_RFL8_NIR8": (4, "<H", 0.008),
}
# Where photons stand, or the reflectivity, by the bytes of a pixel, and whether the profile is LEGACY.
SIGNAL_AT = {(12, True): 6, (12, False): 6, (16, False): 8, (4, False): 2}


def metadata(profile: str, *, sections: bool = True) -> str:
    """What the sensor answers, by sections as firmware 3 does or flat as older ones."""

    def in_mm(pose: Any) -> list[float]:
        scaled = pose.copy()
        scaled[:3, 3] *= 1000.0
        return [float(value) for value in scaled.ravel()]

    form = {
        "pixels_per_column": ROWS,
        "columns_per_packet": IN_PACKET,
        "columns_per_frame": COLUMNS,
        "column_window": [0, COLUMNS - 1],
        "pixel_shift_by_row": [0] * ROWS,
        "udp_profile_lidar": profile,
        "udp_profile_imu": "LEGACY",
    }
    beams = {
        "beam_altitude_angles": UP_DEG.tolist(),
        "beam_azimuth_angles": ASIDE_DEG.tolist(),
        "lidar_origin_to_beam_origin_mm": 1000.0 * ARM_M,
    }
    lidar, imu = {"lidar_to_sensor_transform": in_mm(SITS)}, {"imu_to_sensor_transform": in_mm(IMU_SITS)}
    mode = {"lidar_mode": f"{COLUMNS}x10"}
    if not sections:
        return json.dumps(mode | {"data_format": form} | beams | lidar | imu)
    matrix = placed(ARM_M)
    return json.dumps(
        {
            "config_params": mode
            | {"udp_profile_lidar": profile, "timestamp_mode": "TIME_FROM_INTERNAL_OSC"},
            "beam_intrinsics": beams | {"beam_to_lidar_transform": in_mm(matrix)},
            "lidar_data_format": form,
            "lidar_intrinsics": lidar,
            "imu_intrinsics": imu,
            "sensor_info": {"prod_line": "OS-1-32"},
        }
    )


def looked(pose: Any) -> tuple[Any, Any, Any]:
    """A turn of the lidar at a pose: (W, R) metres that it reports, (W * R, 3) points in it, and when."""
    encoder = 2.0 * np.pi * (1.0 - np.arange(COLUMNS) / COLUMNS)
    bearing = (encoder[:, None] - np.radians(ASIDE_DEG)).ravel()
    up = np.tile(np.radians(UP_DEG), COLUMNS)
    rays = np.column_stack([np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)])
    begins = np.repeat(
        ARM_M * np.column_stack([np.cos(encoder), np.sin(encoder), np.zeros(COLUMNS)]), ROWS, axis=0
    )
    ranges = hits(pose[:3, 3] + begins @ pose[:3, :3].T, rays @ pose[:3, :3].T)
    part = np.repeat(np.arange(COLUMNS) / COLUMNS, ROWS)
    ranges_m = (ranges + ARM_M).reshape(COLUMNS, ROWS)
    return ranges_m, (begins + ranges[:, None] * rays).astype(np.float32), part


def packets(told_m: Any, clock_s: float, frame: int, profile: str) -> Iterator[tuple[float, bytes]]:
    """The packets of a turn, each with the part of the turn after which it is sent."""
    size, form, step_m = PROFILES[profile]
    legacy = profile == "LEGACY"
    for first in range(0, COLUMNS, IN_PACKET):
        data = b"" if legacy else struct.pack("<HHI24x", 1, frame, 7)
        for number in range(first, first + IN_PACKET):
            at_ns = round(1e9 * (clock_s + TURN_S * number / COLUMNS))
            data += struct.pack("<QH", at_ns, number)
            data += struct.pack("<HI", frame, 90112 * number // COLUMNS) if legacy else struct.pack("<H", 1)
            for bright, away_m in enumerate(told_m[number], 1):
                steps = round(float(away_m) / step_m)
                # What stands above the bits of the range is flags, or how bright it was.
                flags = 0xA << 28 if legacy else 0x53 << 24 if form == "<I" else 0x8000
                pixel = bytearray(struct.pack(form, steps | flags).ljust(size, b"\x2a"))
                struct.pack_into("<H" if size > 4 else "<B", pixel, SIGNAL_AT[size, legacy], bright)
                data += pixel
            data += struct.pack("<I", 0xFFFFFFFF) if legacy else b""
        data += b"" if legacy else bytes(32)
        yield (first + IN_PACKET) / COLUMNS, data


def imu_packets(clock_s: float) -> Iterator[tuple[float, bytes]]:
    """Of an IMU that stands still: g and degrees a second."""
    for row in still(0.0, TURN_S * len(STAMPS)):
        at_ns = round(1e9 * (clock_s + row[0]))
        yield (
            float(row[0]),
            struct.pack("<3Q6f", at_ns, at_ns, at_ns, 0.0, 0.0, 9.81 / 9.80665, 0.0, 0.0, 0.0),
        )


def drive(profile: str, clock_s: float) -> tuple[list[tuple[float, bytes]], CloudTruth]:
    """What a lidar on a robot sends, with when it came, and what is true of it; ``clock_s`` at its start."""
    poses = [base @ SENSOR @ SITS for base in way(len(STAMPS))]
    turns = [looked(pose) for pose in poses]
    sent = [
        (stamp + TURN_S * part, data)
        for frame, (stamp, turn) in enumerate(zip(STAMPS, turns, strict=True), 65_530)
        for part, data in packets(turn[0], clock_s + stamp - STAMPS[0], frame % 65_536, profile)
    ]
    times, step_m = [TURN_S * turn[2] for turn in turns], PROFILES[profile][2]
    points = [turn[1] for turn in turns]
    return sent, CloudTruth(STAMPS, points, times, poses, SENSOR @ SITS, apart_m=max(1e-3, step_m))


def bag(folder: Path, profile: str, *, inside: bool = True) -> Sample:
    """As the driver records ``lidar_packets`` and ``imu_packets``; metadata as its topic or beside."""
    heard, cloud = drive(profile, STAMPS[0])
    kind = "ouster_sensor_msgs/msg/PacketMsg"
    said = [ros.tf("base_link", {"os_sensor": SENSOR})]
    if inside:
        text = {"data": metadata(profile)}
        said.append(Sent("/ouster/metadata", "std_msgs/msg/String", STAMPS[0], text))
    else:
        put(folder / "os.json", metadata(profile).encode())
    for topic, sent in (
        ("/ouster/lidar_packets", heard),
        ("/ouster/imu_packets", [(STAMPS[0] + at_s, data) for at_s, data in imu_packets(STAMPS[0])]),
    ):
        said += [Sent(topic, kind, at_s, {"buf": np.frombuffer(data, np.uint8)}) for at_s, data in sent]
    return Sample(ros.ros2(folder / "os", said), cloud=cloud, imu=80)


@layout("Ouster packets", "lidar bags", "Ouster Software User Manual; ouster-ros PacketMsg.msg, metadata")
def _ouster_packets(folder: Path) -> Sample:
    return bag(folder, "RNG19_RFL8_SIG16_NIR16")


@layout("Ouster packets, .pcap", "new formats", "Ouster Software User Manual; libpcap file format")
def _ouster_pcap(folder: Path) -> Sample:
    """By a sensor whose clock counts from its start; its metadata beside, flat as of firmware 2."""
    heard, cloud = drive("LEGACY", 12.5)
    sent = [(at_s, data, 7502) for at_s, data in heard]
    sent += [(STAMPS[0] + at_s, data, 7503) for at_s, data in imu_packets(12.5)]
    put(folder / "drive.json", metadata("LEGACY", sections=False).encode())
    path = put(folder / "drive.pcap", captured(sorted(sent)))
    return Sample(path, cloud=CloudTruth(STAMPS, cloud.points, cloud.times_s, cloud.poses, SITS), imu=80)
