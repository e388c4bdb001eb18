"""Converts packets of Velodyne lidars to clouds with an external decoder (the extra 'velodyne')."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from slam.datasets.bags.cloud_messages import as_cloud, header_at
from slam.datasets.dataset import RecordFault

NO_DECODER = "packets of a lidar; to read them: pip install 'scanweave[velodyne]'"
NOT_DECODED = "packets of a Velodyne without a cloud"
_FIELDS = ("x", "y", "z", "intensity", "time")


class VelodyneDecoder:
    """Decodes scans of one lidar; its packets identify the model."""

    def __init__(self) -> None:
        self._decoder: Any = None

    def cloud(self, message: Any) -> SimpleNamespace:
        """Return a VelodyneScan as a PointCloud2 stamped with its first packet; RecordFault if damaged."""
        velodyne_decoder, config = _library()
        if self._decoder is None:
            self._decoder = velodyne_decoder.ScanDecoder(config)
        packets = velodyne_decoder.PacketVector()
        for packet in message.packets:
            stamp_s = packet.stamp.sec + packet.stamp.nanosec * 1e-9
            packets.append(velodyne_decoder.VelodynePacket(stamp_s, bytes(packet.data)))
        try:
            stamp, points = self._decoder.decode(packets, as_pcl_structs=True)
        except (RuntimeError, ValueError, IndexError) as error:
            raise RecordFault(NOT_DECODED, str(error)) from error
        return _as_cloud(stamp.host, points, message.header.frame_id)


class VelodyneStream:
    """Assembles packets of one lidar to revolutions."""

    def __init__(self) -> None:
        self._decoder: Any = None

    def add(self, stamp_s: float, packet: bytes) -> SimpleNamespace | None:
        """Return the revolution that a packet completes, or None; RecordFault if the packet is damaged."""
        velodyne_decoder, config = _library()
        if len(packet) != velodyne_decoder.PACKET_SIZE:
            return None
        if self._decoder is None:
            self._decoder = velodyne_decoder.StreamDecoder(config)
        try:
            return self._turn(self._decoder.decode(stamp_s, packet, True))
        except (RuntimeError, ValueError, IndexError) as error:
            raise RecordFault(NOT_DECODED, str(error)) from error

    def rest(self) -> SimpleNamespace | None:
        """The rest at the end; RecordFault if it is damaged."""
        try:
            return self._turn(self._decoder.finish(True)) if self._decoder is not None else None
        except (RuntimeError, ValueError, IndexError) as error:
            raise RecordFault(NOT_DECODED, str(error)) from error

    def _turn(self, turn: Any) -> SimpleNamespace | None:
        """A revolution with points as a message."""
        return None if turn is None or not len(turn[1]) else _as_cloud(turn[0].host, turn[1], "velodyne")


def _library() -> tuple[Any, Any]:
    """The decoder package, and its option for the stamps of revolutions."""
    try:
        import velodyne_decoder
    except ImportError as error:
        raise RecordFault(NO_DECODER, "not installed") from error
    config = velodyne_decoder.Config()
    config.timestamp_first_packet = True
    return velodyne_decoder, config


def _as_cloud(stamp_s: float, points: Any, frame: str) -> SimpleNamespace:
    """Structured points as a message."""
    columns = {name: np.asarray(points[name]).ravel() for name in _FIELDS}
    if not columns["x"].size:
        raise RecordFault(NOT_DECODED, "no point")
    return as_cloud(header_at(stamp_s, frame), columns)
