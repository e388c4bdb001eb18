"""Faults of a simulated drive, in addition to the physics of each sensor."""

from __future__ import annotations

from dataclasses import dataclass, field

from slam.errors import ConfigError
from slam.simulation.imu import ImuFaults
from slam.simulation.wheel_odometry import WheelModel

# Names of the lidars of a rig; cameras have individual names.
LIDAR, LIDAR_3D = "lidar", "lidar_3d"


@dataclass(frozen=True, slots=True)
class DriveFaults:
    """Faults of clocks, transport and the world; by default, there is only wheel slip.

    Attributes
    ----------
    lidar_clock_offset_s, camera_clock_offset_s
        Offset of the sensor's clock from the true time; the wheels' clock is correct.
    camera_clock_spread_s
        Standard deviation of an additional offset of each camera, drawn once.
    period_jitter_s
        Standard deviation of the firing time around its regular period. The stamp is that time.
    stamp_jitter_s
        Standard deviation of the stamp from the firing time.
    dropped_scan_share, dropped_frame_share
        Fraction of lost readings, 0 to 1.
    person
        A person walks through the rooms, and avoids the robot.
    dying_sensor
        Name of a sensor that fails: "lidar", "lidar_3d" or a camera's name; empty for none.
    dies_at_share, returns_at_share
        When it fails and when it recovers, as shares of the drive; None: never.
    wheels
        The encoders and their slip.
    imu
        Errors of the IMU.
    """

    lidar_clock_offset_s: float = 0.0
    camera_clock_offset_s: float = 0.0
    camera_clock_spread_s: float = 0.0
    period_jitter_s: float = 0.0
    stamp_jitter_s: float = 0.0
    dropped_scan_share: float = 0.0
    dropped_frame_share: float = 0.0
    person: bool = False
    dying_sensor: str = ""
    dies_at_share: float = 0.5
    returns_at_share: float | None = None
    wheels: WheelModel = field(default_factory=WheelModel)
    imu: ImuFaults = field(default_factory=ImuFaults)

    def __post_init__(self) -> None:
        """Raise an error for invalid values."""
        shares = {
            "dropped_scan_share": self.dropped_scan_share,
            "dropped_frame_share": self.dropped_frame_share,
            "dies_at_share": self.dies_at_share,
            "returns_at_share": 1.0 if self.returns_at_share is None else self.returns_at_share,
        }
        for name, share in shares.items():
            if not 0.0 <= share <= 1.0:
                raise ConfigError(f"{name} is {share}; give a share from 0 to 1")
        for name in ("camera_clock_spread_s", "period_jitter_s", "stamp_jitter_s"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)}; give seconds from 0 to below 1")
        for name in ("lidar_clock_offset_s", "camera_clock_offset_s"):
            if not abs(getattr(self, name)) <= 100.0:
                raise ConfigError(f"{name} is {getattr(self, name)}; give at most 100 s either way")
        if self.returns_at_share is not None and self.returns_at_share < self.dies_at_share:
            raise ConfigError(
                f"returns_at_share is {self.returns_at_share}, before dies_at_share {self.dies_at_share}"
            )


# By name, for the command line. "usual" is typical for cheap sensors with separate clocks.
FAULT_PRESETS: dict[str, DriveFaults] = {
    "none": DriveFaults(),
    "usual": DriveFaults(
        camera_clock_offset_s=0.03,
        camera_clock_spread_s=0.01,
        period_jitter_s=0.003,
        stamp_jitter_s=0.001,
        dropped_frame_share=0.01,
        person=True,
        imu=ImuFaults(0.002, 0.07, 0.002, 0.005),
    ),
    "harsh": DriveFaults(
        lidar_clock_offset_s=-0.02,
        camera_clock_offset_s=0.08,
        camera_clock_spread_s=0.02,
        period_jitter_s=0.008,
        stamp_jitter_s=0.004,
        dropped_scan_share=0.03,
        dropped_frame_share=0.08,
        person=True,
        dying_sensor=LIDAR,
        dies_at_share=0.5,
        returns_at_share=0.65,
        wheels=WheelModel(scale_sigma=0.015, slips_per_s=0.1, slip_share=0.5),
        imu=ImuFaults(0.017, 0.2, 0.02, 0.02),
    ),
}
