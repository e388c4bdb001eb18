"""Corrections of a log's sensors, by sensor name. The user or the doctor provides them."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field, model_validator

from slam.config.files import StrictModel


class PlanarMounting(StrictModel):
    """Pose of a sensor on the robot in the plane: x forward, y left, yaw counter-clockwise."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0


class Mounting(StrictModel):
    """Pose of a sensor on the robot in 3D. For a camera, the angles are those of the camera body.

    The body frame looks along x and its image is upright. It is rotated by yaw about z, then pitch (down)
    about y, then roll about x.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0


class Lens(StrictModel):
    """Intrinsics of a pinhole camera, in pixels of its images."""

    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float


class SensorCorrection(StrictModel):
    """Corrections that apply to any sensor."""

    use: bool = Field(default=True, description="false ignores the sensor")
    drop_repeated: bool = Field(
        default=False,
        description="ignore repeated readings, and clouds that begin within the last revolution",
    )
    clock_offset_s: float = Field(
        default=0.0, ge=-1e4, le=1e4, description="how far its stamps are ahead; it is subtracted"
    )


class WheelCorrection(SensorCorrection):
    """Corrections of wheel odometry: the recorded poses are reinterpreted, then the steps are scaled.

    ``axes`` and ``heading_scale`` define what the three recorded numbers mean. ``turn_scale`` scales the
    rotation of each step; the path is then recomputed from the steps.
    """

    scale: float = Field(default=1.0, gt=0, description="factor on the path: 0.001 if it is in millimetres")
    axes: str = Field(
        default="x y",
        pattern=r"^(-?x -?y|-?y -?x)$",
        description="what stands for x and y: 'x -y' if y has the wrong sign, 'y x' if they are swapped",
    )
    heading_scale: float = Field(
        default=1.0, description="factor on the heading: -1 for a wrong sign, 0.0174533 for degrees"
    )
    heading_offset_deg: float = Field(default=0.0, ge=-360, le=360, description="angle added to the heading")
    mirrored: bool = Field(default=False, description="left is right: y and the heading have the wrong sign")
    turn_scale: float = Field(default=1.0, gt=0, description="factor on rotations; the path is recomputed")


class SpinningCorrection(SensorCorrection):
    """Corrections of any spinning lidar."""

    turn_s: float = Field(
        default=0.0,
        ge=-2,
        le=2,
        description="time per revolution, < 0 clockwise: gives points without times one by their bearing",
    )
    cut_deg: float = Field(default=180.0, ge=-360, le=360, description="bearing at which a revolution begins")


class FloorLine(StrictModel):
    """A straight line where beams hit the floor, with bearings as recorded in the log."""

    from_m: float = Field(gt=0, description="readings this far along bearing_deg, and beyond, are ignored")
    bearing_deg: float = Field(ge=-360, le=360, description="bearing of its nearest point")


class LidarCorrection(SpinningCorrection):
    """Corrections of a 2D lidar; a field that is not given keeps the value in the log."""

    T_base_laser: PlanarMounting | None = Field(default=None, description="pose on the robot")
    upside_down: bool = Field(default=False, description="beams run the other way round")
    range_scale: float = Field(default=1.0, gt=0, description="factor on the ranges: 0.3048 if in feet")
    start_angle_deg: float | None = Field(default=None, ge=-720, le=720, description="bearing of beam 0")
    step_deg: float | None = Field(default=None, ge=-90, le=90, description="angle between beams")
    blocked_beams: tuple[tuple[int, int], ...] = Field(
        default=(), description="first and last beam, from 0, of each group that sees the robot itself"
    )
    floor: FloorLine | None = Field(default=None, description="where it sees the floor; ignored")

    @model_validator(mode="after")
    def _beams_in_order(self) -> LidarCorrection:
        """Check that each range of beams begins before it ends."""
        for first, last in self.blocked_beams:
            if not 0 <= first <= last:
                raise ValueError(f"beams {first} to {last} are no stretch of beams")
        return self


class CameraCorrection(SensorCorrection):
    """Corrections of an RGB-D camera."""

    T_base_camera: Mounting | None = Field(default=None, description="pose on the robot")
    depth_scale: float = Field(default=1.0, gt=0, description="factor on depth: 0.001 for millimetres")
    depth_clock_offset_s: float = Field(
        default=0.0, ge=-1, le=1, description="how far stamps of depth images are ahead of those of colour"
    )
    intrinsics: Lens | None = Field(default=None, description="camera intrinsics")
    mirrored: bool = Field(default=False, description="left is right in its images")


class CloudCorrection(SpinningCorrection):
    """Corrections of a 3D lidar."""

    T_base_lidar: Mounting | None = Field(default=None, description="pose on the robot")
    range_scale: float = Field(default=1.0, gt=0, description="factor on the points: 0.3048 if in feet")
    range_min_m: float = Field(default=0.0, ge=0, description="nearer points are the robot itself: ignored")
    times_scale: float = Field(default=1.0, description="factor on points' times: -1 if they run backward")
    clock_sigma_s: float = Field(default=0.0, ge=0, description="standard deviation of all its stamps")
    elevation_deg: float = Field(
        default=0.0, ge=-10, le=10, description="beams look too low by this angle: 0.205 for KITTI odometry"
    )


class ImuCorrection(SensorCorrection):
    """Corrections of an inertial measurement unit."""

    T_base_imu: Mounting | None = Field(default=None, description="pose on the robot")
    gyro_scale: float = Field(
        default=1.0, description="factor on the angular rates: -1 for a wrong sign, 0.0174533 for degrees"
    )
    force_scale: float = Field(
        default=1.0, description="factor on the accelerations; 0 ignores them: the gyroscope is used alone"
    )


class GnssCorrection(SensorCorrection):
    """Corrections of a GNSS receiver."""

    antenna_m: tuple[float, float, float] | None = Field(
        default=None, description="x, y, z of its antenna on the robot"
    )


class Calibration(StrictModel):
    """Corrections by sensor name, as 'scanweave inspect' lists the names."""

    wheels: dict[str, WheelCorrection] = Field(default={}, description="corrections of odometry, by name")
    lidars: dict[str, LidarCorrection] = Field(default={}, description="corrections of 2D lidars, by name")
    cameras: dict[str, CameraCorrection] = Field(default={}, description="corrections of cameras, by name")
    lidars_3d: dict[str, CloudCorrection] = Field(default={}, description="corrections of 3D lidars, by name")
    imus: dict[str, ImuCorrection] = Field(default={}, description="corrections of IMUs, by name")
    gnss: dict[str, GnssCorrection] = Field(default={}, description="corrections of GNSS receivers, by name")

    @property
    def cloud_sigma_s(self) -> float:
        """Return the standard deviation of all stamps of clouds; 0 if they are exact."""
        return max((lidar.clock_sigma_s for lidar in self.lidars_3d.values()), default=0.0)

    def merged(self, entries: Mapping[str, Mapping[str, Mapping[str, object]]]) -> Calibration:
        """Return it with more entries, by kind and name of the sensor; existing values are kept."""
        tree = self.plain()
        for kind, sensors in entries.items():
            for name, fields in sensors.items():
                of_kind = tree.setdefault(kind, {})
                of_kind[name] = {**fields, **of_kind.get(name, {})}
        return Calibration.model_validate(tree, strict=False)

    def plain(self) -> dict[str, dict[str, dict[str, object]]]:
        """Return plain values, without fields that have their default."""
        return self.model_dump(mode="json", exclude_defaults=True)
