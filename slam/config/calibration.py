"""What a person, or the doctor, knows better than a log: corrections of its sensors, by their names."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field, model_validator

from slam.config.strict import StrictModel


class PlanarMounting(StrictModel):
    """Where a sensor sits on the robot: x forward, y left, turned counter-clockwise."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0


class Mounting(StrictModel):
    """Where a sensor sits on the robot, in space; the angles of a camera are those of its body.

    The body looks along x, its image upright; turned by yaw about the robot's z, then pitch (down) about y,
    then roll about x.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0


class Lens(StrictModel):
    """A pin-hole camera, in pixels of its images."""

    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float


class SensorCorrection(StrictModel):
    """What any sensor may need."""

    use: bool = Field(default=True, description="false leaves the sensor out")
    drop_repeated: bool = Field(
        default=False,
        description="leave out readings that equal the one before, clouds that begin in its turn",
    )
    clock_offset_s: float = Field(
        default=0.0, ge=-1e4, le=1e4, description="by how much its stamps are ahead; taken off"
    )


class WheelCorrection(SensorCorrection):
    """Wheel odometry: first what is written is read anew, then the steps are scaled.

    ``axes`` and ``heading_scale`` say what the three written numbers mean, ``turn_scale`` what a turn of the
    wheels is worth: the way is then put together anew.
    """

    scale: float = Field(default=1.0, gt=0, description="of the way: 0.001 where it is in millimetres")
    axes: str = Field(
        default="x y",
        pattern=r"^(-?x -?y|-?y -?x)$",
        description="what stands where x and y should: 'x -y' where y has the wrong sign, 'y x' swapped",
    )
    heading_scale: float = Field(
        default=1.0, description="of the written heading: -1 lost its sign, 0.0174533 is in degrees"
    )
    heading_offset_deg: float = Field(default=0.0, ge=-360, le=360, description="added to the heading")
    mirrored: bool = Field(default=False, description="left is right: y and the heading have the wrong sign")
    turn_scale: float = Field(default=1.0, gt=0, description="of every turn, the way put together anew")


class SpinningCorrection(SensorCorrection):
    """Any lidar that spins."""

    turn_s: float = Field(
        default=0.0,
        ge=-2,
        le=2,
        description="how long a turn takes, < 0 clockwise: times of points that tell none, by their bearings",
    )
    cut_deg: float = Field(
        default=180.0, ge=-360, le=360, description="bearing at which a turn begins and ends"
    )


class FloorLine(StrictModel):
    """A straight line on the floor, as the log's own beams see it."""

    from_m: float = Field(gt=0, description="readings on the line and behind begin here")
    bearing_deg: float = Field(ge=-360, le=360, description="of its nearest point")


class LidarCorrection(SpinningCorrection):
    """A 2D lidar; what is not given stays as the log tells it."""

    T_base_laser: PlanarMounting | None = Field(default=None, description="where it sits")
    upside_down: bool = Field(default=False, description="beams run the other way round")
    range_scale: float = Field(default=1.0, gt=0, description="of the ranges: 0.3048 where they are in feet")
    start_angle_deg: float | None = Field(default=None, ge=-720, le=720, description="bearing of beam 0")
    step_deg: float | None = Field(default=None, ge=-90, le=90, description="from beam to beam")
    blocked_beams: tuple[tuple[int, int], ...] = Field(
        default=(), description="first and last beam, from 0, of those that see the robot itself"
    )
    floor: FloorLine | None = Field(default=None, description="where it sees the floor: left out")

    @model_validator(mode="after")
    def _beams_in_order(self) -> LidarCorrection:
        """A stretch of beams begins before it ends."""
        for first, last in self.blocked_beams:
            if not 0 <= first <= last:
                raise ValueError(f"beams {first} to {last} are no stretch of beams")
        return self


class CameraCorrection(SensorCorrection):
    """An RGB-D camera."""

    T_base_camera: Mounting | None = Field(default=None, description="where it sits")
    depth_scale: float = Field(default=1.0, gt=0, description="of depth: 0.001 for millimetres")
    intrinsics: Lens | None = Field(default=None, description="the lens")
    mirrored: bool = Field(default=False, description="left is right in its images")


class CloudCorrection(SpinningCorrection):
    """A 3D lidar."""

    T_base_lidar: Mounting | None = Field(default=None, description="where it sits")
    range_scale: float = Field(default=1.0, gt=0, description="of the points: 0.3048 where they are in feet")
    times_scale: float = Field(default=1.0, description="of the points' times: -1 where they run backward")
    elevation_deg: float = Field(
        default=0.0, ge=-10, le=10, description="by how much all beams look too low: 0.205 for KITTI odometry"
    )


class ImuCorrection(SensorCorrection):
    """An inertial measurement unit."""

    T_base_imu: Mounting | None = Field(default=None, description="where it sits")
    gyro_scale: float = Field(
        default=1.0, description="of the turn rates: -1 for a wrong sign, 0.0174533 where they are in degrees"
    )


class GnssCorrection(SensorCorrection):
    """A satellite receiver."""

    antenna_m: tuple[float, float, float] | None = Field(
        default=None, description="x, y, z where its antenna sits"
    )


class Calibration(StrictModel):
    """Corrections by the sensors' names, as 'scanweave inspect' lists them."""

    wheels: dict[str, WheelCorrection] = Field(default={}, description="corrections of wheels, by name")
    lidars: dict[str, LidarCorrection] = Field(default={}, description="corrections of 2D lidars, by name")
    cameras: dict[str, CameraCorrection] = Field(default={}, description="corrections of cameras, by name")
    lidars_3d: dict[str, CloudCorrection] = Field(default={}, description="corrections of 3D lidars, by name")
    imus: dict[str, ImuCorrection] = Field(default={}, description="corrections of IMUs, by name")
    gnss: dict[str, GnssCorrection] = Field(
        default={}, description="corrections of satellite receivers, by name"
    )

    def merged(self, entries: Mapping[str, Mapping[str, Mapping[str, object]]]) -> Calibration:
        """With more entries, by kind and name of the sensor; what is there already stays as it is."""
        tree = self.plain()
        for kind, sensors in entries.items():
            for name, fields in sensors.items():
                of_kind = tree.setdefault(kind, {})
                of_kind[name] = {**fields, **of_kind.get(name, {})}
        return Calibration.model_validate(tree, strict=False)

    def plain(self) -> dict[str, dict[str, dict[str, object]]]:
        """As plain values, without what is as the log tells it."""
        return self.model_dump(mode="json", exclude_defaults=True)
