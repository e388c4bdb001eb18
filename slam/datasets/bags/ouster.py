"""Converts packets of Ouster lidars to clouds and IMU readings, by the metadata of the sensor.

After Ouster's Software User Manual (firmware 2.x and 3.x): "Lidar Data Packet Format", "IMU Data Packet
Format". The first return of each pixel is read.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.cloud_messages import as_cloud, header_at
from slam.datasets.bags.ouster_model import FRAMES, OusterModel, metadata_beside
from slam.datasets.bags.records import BagRecord
from slam.datasets.dataset import WARNING, RecordFault
from slam.datasets.point_times import LONGEST_TURN_S
from slam.measurements import GRAVITY_M_S2

NO_METADATA = (
    "packets of an Ouster without its metadata: put its .json, named as the recording, beside it "
    "(http://SENSOR/api/v1/sensor/metadata), or record the driver's topic 'metadata'"
)
DAMAGED = "damaged packet of an Ouster"
LATE = "packet of an earlier revolution of an Ouster"
NO_RETURN = "revolution of an Ouster without a return"
IMU_BYTES = 48
# No packet is recorded so late; a sensor that is not synchronised counts from its start.
_OTHER_CLOCK_S = 60.0


@dataclass(slots=True)
class Ouster:
    """One sensor: assembles its packets to revolutions by the frame number in the packets.

    Attributes
    ----------
    lacking, left_out
        Number of revolutions that lack columns, and of those that lack half of them or more.
    behind_s
        How far its clock is behind the recorder's, if the clocks differ; None before the first packet.
    """

    model: OusterModel
    lacking: int = 0
    left_out: int = 0
    behind_s: float | None = None
    _frame: int | None = None
    _finished: int | None = None
    _first_ns: int = 0
    _stamps_ns: NDArray[Any] = field(default_factory=lambda: np.zeros(0, np.int64))
    _steps: NDArray[Any] = field(default_factory=lambda: np.zeros(0, np.uint32))
    _intensities: NDArray[Any] = field(default_factory=lambda: np.zeros(0, np.uint16))

    def add(self, recorded_s: float, packet: bytes) -> SimpleNamespace | None:
        """The revolution that a packet completes, as a PointCloud2; None if it completes none.

        A revolution is complete with its last column, or when the next starts.

        Raises
        ------
        RecordFault
            The packet is damaged or late.
        """
        model = self.model
        if len(packet) != model.packet.itemsize:
            raise RecordFault(DAMAGED, f"{len(packet)} bytes, not {model.packet.itemsize}")
        (data,) = np.frombuffer(packet, model.packet)
        columns, names = data["columns"], model.packet.names or ()
        columns = columns[columns["status"] & 1 == 1]
        if not columns.size:
            return None
        frame = int(data["frame"] if "frame" in names else columns["frame"][0])
        numbers, stamps_ns = columns["number"].astype(int), columns["stamp_ns"].astype(np.int64)
        first_ns = self._first_ns if frame == self._frame else int(stamps_ns.min())
        damaged = bool((stamps_ns < 0).any() or (np.abs(stamps_ns - first_ns) > LONGEST_TURN_S * 1e9).any())
        damaged |= int(data["kind"]) != 1 if "kind" in names else bool((columns["frame"] != frame).any())
        if damaged or (numbers >= len(model.sent)).any():
            raise RecordFault(DAMAGED, f"frame {frame}, columns {numbers.min()} to {numbers.max()}")
        if frame == self._finished:
            raise RecordFault(LATE, f"frame {frame}")
        before = self.rest() if frame != self._frame else None
        if self.behind_s is None:
            self._set_clock(recorded_s, int(stamps_ns[0]))
        if self._frame is None:
            self._frame, self._first_ns = frame, first_ns
            self._stamps_ns = np.full(len(model.sent), -1, np.int64)
            self._steps = np.zeros(model.ahead.shape[:2], np.uint32)
            self._intensities = np.zeros(model.ahead.shape[:2], np.uint16)
        self._stamps_ns[numbers] = stamps_ns
        self._steps[numbers] = columns["pixels"]["steps"] & model.bits
        self._intensities[numbers] = columns["pixels"]["intensity"]
        return self.rest() if before is None and (self._stamps_ns[model.sent] >= 0).all() else before

    def rest(self) -> SimpleNamespace | None:
        """The revolution so far; None if there is none, or if half of its columns or more are missing."""
        if self._frame is None:
            return None
        self._finished, self._frame = self._frame, None
        received, expected = int((self._stamps_ns[self.model.sent] >= 0).sum()), int(self.model.sent.sum())
        if 2 * received <= expected:
            self.left_out += 1
            return None
        self.lacking += received < expected
        return self._cloud()

    def _cloud(self) -> SimpleNamespace | None:
        """The revolution as a message with the stamp of its first column ("Lidar Range to XYZ")."""
        model = self.model
        at, row = np.nonzero(self._steps)
        if not at.size:
            raise RecordFault(NO_RETURN, f"frame {self._finished}")
        along_m = self._steps[at, row] * model.step_m - model.arm_m
        points = along_m[:, None] * model.ahead[at, row] + model.origins_m[at]
        first_ns = int(self._stamps_ns[self._stamps_ns >= 0].min())
        times_s = (self._stamps_ns[at] - first_ns) * 1e-9
        columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
        columns |= {"time": times_s, "intensity": self._intensities[at, row]}
        return as_cloud(header_at(self._stamp_s(first_ns), FRAMES[1]), columns)

    def imu(self, recorded_s: float, packet: bytes) -> SimpleNamespace:
        """Return an IMU packet as an Imu at the time of its rates; RecordFault if it is damaged."""
        if len(packet) != IMU_BYTES:
            raise RecordFault(DAMAGED, f"{len(packet)} bytes, not {IMU_BYTES}")
        _, _, at_ns, *readings = struct.unpack("<3Q6f", packet)
        if self.behind_s is None:
            self._set_clock(recorded_s, at_ns)
        forces, rates = GRAVITY_M_S2 * np.array(readings[:3]), np.radians(readings[3:])
        halves = [
            SimpleNamespace(**dict(zip("xyz", map(float, vector), strict=True))) for vector in (forces, rates)
        ]
        return SimpleNamespace(
            header=header_at(self._stamp_s(at_ns), FRAMES[2]),
            linear_acceleration=halves[0],
            angular_velocity=halves[1],
            linear_acceleration_covariance=np.zeros(9),
            angular_velocity_covariance=np.zeros(9),
        )

    def _set_clock(self, recorded_s: float, told_ns: int) -> None:
        """Compare the clock of lidar and IMU with the recorder's, once."""
        behind_s = recorded_s - told_ns * 1e-9
        self.behind_s = behind_s if abs(behind_s) > _OTHER_CLOCK_S else 0.0

    def _stamp_s(self, told_ns: int) -> float:
        """A time by the recorder's clock, or by a clock that is synchronous with it."""
        stamp_s = told_ns * 1e-9 + (self.behind_s or 0.0)
        if not 0.0 < stamp_s < 1 << 32:
            raise RecordFault(DAMAGED, f"at {told_ns} ns")
        return stamp_s

    def notes(self) -> list[str]:
        """Notes for the user."""
        notes = []
        if self.lacking:
            notes.append(f"{self.lacking} revolutions of an Ouster lack columns; read as they are")
        if self.left_out:
            notes.append(f"{self.left_out} revolutions of an Ouster lack half their columns or more; ignored")
        if self.behind_s:
            text = f"an Ouster's clock is {self.behind_s:.1f} s behind the recorder's"
            notes.append(f"{WARNING}{text}; corrected by the arrival of its first packet")
        return notes


class Ousters:
    """The sensors of one recording, by the namespace of their topics.

    Parameters
    ----------
    path
        The recording; metadata is searched for next to it.
    """

    def __init__(self, path: Path | None = None, models: Mapping[str, OusterModel] | None = None) -> None:
        self.models = dict(models or {})
        self._path, self._faults = path, dict[str, RecordFault]()
        self._sensors: dict[str, Ouster] = {}

    def learn(self, topic: str, text: str) -> None:
        """Read the metadata of a topic; if it cannot be used, its packets report the reason."""
        space = topic.rpartition("/")[0]
        try:
            self.models[space] = OusterModel.of(text)
        except RecordFault as fault:
            self._faults[space] = fault

    def sensor(self, topic: str) -> Ouster:
        """Return the sensor of a topic of packets; RecordFault if its metadata is missing or unusable."""
        space = topic.rpartition("/")[0]
        if space not in self._sensors:
            if not self.models and not self._faults and self._path is not None:
                metadata = metadata_beside(self._path)
                if metadata is not None:
                    self.learn(topic, metadata)
            only = next(iter(self.models.values())) if len(self.models) == 1 else None
            model = self.models.get(space, only)
            if model is None:
                raise self._faults.get(space) or RecordFault(NO_METADATA, topic)
            self._sensors[space] = Ouster(model)
        return self._sensors[space]

    def read(self, record: BagRecord, *, of_imu: bool) -> SimpleNamespace | None:
        """Return what a PacketMsg completes; RecordFault if it is damaged, or of an unknown sensor."""
        start = 0 if record.channel.wire == "ros1" else 4
        packet = record.content[start + 4 :]
        size = int.from_bytes(record.content[start : start + 4], "little")
        sensor = self.sensor(record.channel.topic)
        return (sensor.imu if of_imu else sensor.add)(record.recorded_s, packet[:size])

    def rest(self, topic: str) -> SimpleNamespace | None:
        """The incomplete last revolution of a topic."""
        space = topic.rpartition("/")[0]
        return self._sensors[space].rest() if space in self._sensors else None

    def notes(self) -> list[str]:
        """Notes for the user."""
        return [text for sensor in self._sensors.values() for text in sensor.notes()]
