"""Network captures (``.pcap``, ``.pcapng``) of lidar packets, decoded as in bags.

Packets are those of an Ouster if its metadata is next to the capture, else of a Velodyne. dpkt (part of the
extra 'velodyne') reads the containers; packets are parsed here because lidars often send fragments (RFC 791).
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam

from slam.datasets.account import Account
from slam.datasets.bags.clouds import CloudReader
from slam.datasets.bags.imu import ImuReader
from slam.datasets.bags.ouster import IMU_BYTES, NO_METADATA, Ouster
from slam.datasets.bags.ouster_model import OusterModel, metadata_beside, packet_sizes
from slam.datasets.bags.velodyne import NO_DECODER, VelodyneStream
from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.recording import Contents, Numbered
from slam.errors import DatasetError
from slam.measurements import PointCloud

DAMAGED = "damaged record of the capture"
_MAGICS = (
    b"\xd4\xc3\xb2\xa1",
    b"\xa1\xb2\xc3\xd4",
    b"\x4d\x3c\xb2\xa1",
    b"\xa1\xb2\x3c\x4d",
    b"\x0a\x0d\x0d\x0a",
)
# Bytes before the IP packet, by link type (tcpdump.org/linktypes.html).
_BEFORE = {0: 4, 1: 14, 12: 0, 101: 0, 113: 16, 228: 0, 276: 20}
_VLAN, _VLAN_BYTES, _TYPE_AT = b"\x81\x00", 4, 12
_UDP, _UDP_BYTES, _LEAST_BYTES = 17, 8, 28
_MORE, _OFFSET = 0x2000, 0x1FFF  # of the fragment field
_LARGEST_RECORD = 1 << 20
_MOST_WAITING = 64  # packets with missing fragments


class _File(io.BufferedReader):
    """The file of a capture; refuses to read records of an impossible size."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read ``size`` bytes; ValueError if a record cannot be as large."""
        if size is not None and size > _LARGEST_RECORD:
            raise ValueError(f"a record of {size} bytes")
        return super().read(size)


def _load(path: Path, account: Account) -> Contents:
    """The clouds of one lidar, whose frame is the robot's; of an Ouster also its IMU, in the sensor frame."""
    try:
        import dpkt
    except ImportError as error:
        raise DatasetError(f"{path} holds {NO_DECODER}") from error
    if (metadata := metadata_beside(path)) is None:
        return Contents(log=_clouds(path, account, dpkt))
    try:
        model = OusterModel.of(metadata)
    except RecordFault as fault:
        raise DatasetError(f"{path}: {fault}; give the metadata of the sensor that sent this") from fault
    return Contents(log=_of_ouster(path, account, dpkt, model))


def _of_ouster(path: Path, account: Account, dpkt: Any, model: OusterModel) -> Iterator[Numbered]:
    """Revolutions, with the numbers of the packets that completed them, and IMU readings."""
    lidar, imu = CloudReader("lidar", model.T_sensor_lidar), ImuReader("imu", model.T_sensor_imu)
    sensor, number = Ouster(model), 0
    for number, stamp_s, payload in payloads(path, account, dpkt):
        account.report.line_count += 1
        with account.refusing(path.name, number):
            if len(payload) == IMU_BYTES:
                reading = imu.read(sensor.imu(stamp_s, payload))
                account.report.accept("imu")
                yield number, reading
            elif len(payload) in packet_sizes() | {model.packet.itemsize}:
                yield from _read(lidar, number, sensor.add(stamp_s, payload), account)
    with account.refusing(path.name, number):
        yield from _read(lidar, number, sensor.rest(), account)
    for line, text in enumerate(sensor.notes(), 1):
        account.report.note(text, line)


def _clouds(path: Path, account: Account, dpkt: Any) -> Iterator[Numbered]:
    """Revolutions with the numbers of the packets that completed them."""
    reader, decoder = CloudReader("lidar", gtsam.Pose3()), VelodyneStream()
    number = 0
    for number, stamp_s, payload in payloads(path, account, dpkt):
        account.report.line_count += 1
        with account.refusing(path.name, number):
            if len(payload) in packet_sizes():
                raise RecordFault(NO_METADATA, f"{len(payload)} bytes")
            yield from _read(reader, number, decoder.add(stamp_s, payload), account)
    with account.refusing(path.name, number):
        yield from _read(reader, number, decoder.rest(), account)


def _read(
    reader: CloudReader, number: int, message: SimpleNamespace | None, account: Account
) -> Iterator[tuple[int, PointCloud]]:
    """The cloud of a message, if it has one."""
    if message is not None:
        cloud = reader.read(message)
        account.report.accept("cloud")
        yield number, cloud


def payloads(path: Path, account: Account, dpkt: Any) -> Iterator[tuple[int, float, bytes]]:
    """Numbers, stamps and payloads of the datagrams in a capture."""
    size = path.stat().st_size
    budget, number = Budget(size), 0
    waiting: dict[bytes, dict[int, tuple[bytes, bool]]] = {}
    with _File(path.open("rb", buffering=0)) as file:
        try:
            records = dpkt.pcap.UniversalReader(file)
            before = _BEFORE.get(records.datalink())
            if before is None:
                raise ValueError(f"link of sort {records.datalink()}")
            for number, (stamp_s, content) in enumerate(records, 1):
                budget.take(len(content))
                account.report.note_share(min(1.0, file.tell() / size))
                if (payload := _payload(bytes(content), before, waiting)) is not None:
                    yield number, float(stamp_s), payload
        except (dpkt.Error, ValueError, struct.error, IndexError, OSError, ArithmeticError) as error:
            account.refuse(RecordFault(DAMAGED, str(error)), path.name, number + 1)
        except RecordFault as fault:
            account.refuse(fault, path.name, number + 1)


def _payload(frame: bytes, before: int, waiting: dict[bytes, dict[int, tuple[bytes, bool]]]) -> bytes | None:
    """The payload of the datagram that a frame completes; None if it is no datagram or still incomplete."""
    packet = frame[before + _VLAN_BYTES * (before == 14 and frame[_TYPE_AT:][:2] == _VLAN) :]
    if len(packet) < _LEAST_BYTES or packet[0] >> 4 != 4 or packet[9] != _UDP:
        return None
    length, _, fragment = struct.unpack_from(">HHH", packet, 2)
    part = packet[4 * (packet[0] & 15) : length or None]
    offset = 8 * (fragment & _OFFSET)
    if not fragment & (_MORE | _OFFSET):
        return part[_UDP_BYTES:]
    key = packet[4:6] + packet[12:20]
    parts = waiting.setdefault(key, {})
    parts[offset] = part, not fragment & _MORE
    if len(waiting) > _MOST_WAITING:
        del waiting[next(iter(waiting))]
    datagram, ended = b"", False
    while not ended and len(datagram) in parts:
        more, ended = parts[len(datagram)]
        datagram += more
        if not more:
            return None
    if not ended:
        return None
    waiting.pop(key, None)
    return datagram[_UDP_BYTES:]


FORMAT = recorded(
    "capture of a Velodyne's or an Ouster's packets (.pcap)",
    lambda path, head: path.is_file() and head[:4] in _MAGICS,
    _load,
    lambda path, account: None,
)
