"""A simulated drive: the robot tours a home, and each sensor fires at its own rate, by its own clock.

Readings are returned one by one in the order of true time, so memory is constant. Every reading has its own
random numbers: equal seeds give equal bits, and a sensor that is switched off, or loses frames, does not
change the others.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.errors import ConfigError
from slam.measurements import FloatArray, LaserScan, RgbdFrame, WheelOdometry, planar, pose2_from_row
from slam.simulation.drive_faults import LIDAR, LIDAR_3D, DriveFaults
from slam.simulation.events import CloudEvent, DriveEvent, ImageEvent, OdometryEvent, ScanEvent, TruthEvent
from slam.simulation.home_model import Home
from slam.simulation.imu import ImuRecord, record_imu
from slam.simulation.person import Walk, plan_walk
from slam.simulation.rigs import MountedCamera, Rig
from slam.simulation.scene import Scene
from slam.simulation.sensor_clock import Schedule, generator, schedule
from slam.simulation.sensors import render_rgbd, scan_lidar, scan_lidar_3d
from slam.simulation.tour import Tour, plan_tour
from slam.simulation.wheel_odometry import WheelReadings, wheel_readings
from slam.vision.prefetch import prefetched

FIRST_STAMP_S = 1000.0  # true time at the start of a drive
TRUTH_RATE_HZ = 50.0

# Threads of sensors, and readings computed ahead: about 10 MB of 320 x 240 frames.
_THREADS, _WAITING = 2, 24

_TRUTH, _ODOMETRY, _READINGS = range(3)  # order of simultaneous events
_NOISE = 1  # stream of a sensor's random generator; 0 is its schedule


@dataclass(frozen=True)
class Drive:
    """A planned drive, which can be simulated any number of times.

    Attributes
    ----------
    home, rig, seed, faults
        Inputs of the planning.
    tour
        True trajectory.
    schedules
        Schedules of lidars and cameras, by sensor name.
    odometry_s
        (N,) time of each wheel reading since the start, seconds.
    wheels
        Wheel odometry.
    walk
        The person, if there is one.
    imu
        IMU readings, if there is an IMU.
    """

    home: Home
    rig: Rig
    seed: int
    faults: DriveFaults
    tour: Tour
    schedules: dict[str, Schedule]
    odometry_s: FloatArray
    wheels: WheelReadings
    walk: Walk | None
    imu: ImuRecord | None = None

    def base_at(self, time_s: float) -> gtsam.Pose2:
        """Return ``T_map_base`` at a time since the start, seconds."""
        return gtsam.Pose2(*self.tour.pose_at(time_s))

    def odometry_at(self, stamp_s: float) -> gtsam.Pose2:
        """Return ``T_odom_base`` by the wheels at a stamp of their clock, interpolated between readings."""
        at = (stamp_s - FIRST_STAMP_S) * self.faults.wheels.rate_hz
        last = len(self.odometry_s) - 1
        index = min(max(int(at), 0), max(last - 1, 0))
        rows = self.wheels.poses_xyt
        before, after = pose2_from_row(rows[index]), pose2_from_row(rows[min(index + 1, last)])
        share = min(max(at - index, 0.0), 1.0)
        return before.compose(gtsam.Pose2.Expmap(share * gtsam.Pose2.Logmap(before.between(after))))

    def events(self, threads: int = _THREADS) -> Iterator[DriveEvent]:
        """Yield all readings in the order of true time; bit-identical for any number of threads."""
        scene = Scene(self.home)
        streams: list[Iterator[tuple[float, int, int]]] = [
            _ticks(np.arange(int(self.tour.duration_s * TRUTH_RATE_HZ) + 1) / TRUTH_RATE_HZ, _TRUTH),
            _ticks(self.odometry_s, _ODOMETRY),
        ]
        sensors = list(self.schedules.values())
        for place, readings in enumerate(sensors):
            streams.append(_ticks(readings.true_s, _READINGS + place))
        cameras = {camera.name: camera for camera in self.rig.cameras}

        def event(tick: tuple[float, int, int]) -> DriveEvent:
            time_s, place, index = tick
            if place == _TRUTH:
                return TruthEvent(FIRST_STAMP_S + time_s, self.base_at(time_s))
            if place == _ODOMETRY:
                return self._odometry(index)
            readings = sensors[place - _READINGS]
            if readings.sensor in cameras:
                return self._image(scene, cameras[readings.sensor], readings, index)
            if readings.sensor == LIDAR_3D:
                return self._cloud(scene, readings, index)
            return self._scan(scene, readings, index)

        happening = (
            tick
            for tick in heapq.merge(*streams)
            if tick[1] < _READINGS or sensors[tick[1] - _READINGS].kept[tick[2]]
        )
        yield from prefetched(happening, event, _WAITING, threads)

    def _odometry(self, index: int) -> OdometryEvent:
        """Return a wheel reading; its clock has no error."""
        stamp_s = FIRST_STAMP_S + float(self.odometry_s[index])
        reading = WheelOdometry(round(stamp_s, 6), pose2_from_row(self.wheels.poses_xyt[index]))
        speed, turn = map(float, self.wheels.twists[index])
        return OdometryEvent(stamp_s, reading, (speed, turn), self.wheels.slipping[index])

    def _scan(self, scene: Scene, readings: Schedule, index: int) -> ScanEvent:
        """Return one scan, taken at an instant."""
        lidar = self.rig.lidar
        if lidar is None:
            raise ConfigError(f"rig {self.rig.name} has no lidar")
        model = lidar.model
        time_s, base, noise, person = self._instant(readings, index)
        measured = scan_lidar(scene, gtsam.Pose3(base).compose(lidar.T_base_laser), model, noise, person)
        scan = LaserScan(
            stamp_s=float(readings.stamps_s[index]),
            ranges_m=measured.ranges_m,
            start_angle_rad=model.start_angle_rad,
            step_rad=model.step_rad,
            range_max_m=model.range_max_m,
            T_base_laser=planar(lidar.T_base_laser),
            sensor=readings.sensor,
        )
        return ScanEvent(FIRST_STAMP_S + time_s, base, scan, measured.true_ranges_m, measured.fault)

    def _instant(
        self, readings: Schedule, index: int
    ) -> tuple[float, gtsam.Pose2, np.random.Generator, tuple[float, float] | None]:
        """Return the time of a reading, seconds, the base pose, its noise generator, and the person."""
        time_s = float(readings.true_s[index])
        person = None if self.walk is None else self.walk.at(time_s)
        return time_s, self.base_at(time_s), generator(self.seed, readings.sensor, _NOISE, index), person

    def _cloud(self, scene: Scene, readings: Schedule, index: int) -> CloudEvent:
        """Return one revolution of the 3D lidar, taken at an instant."""
        lidar = self.rig.lidar_3d
        if lidar is None:
            raise ConfigError(f"rig {self.rig.name} has no 3D lidar")
        time_s, base, noise, person = self._instant(readings, index)
        hits = scan_lidar_3d(scene, gtsam.Pose3(base).compose(lidar.T_base_laser), lidar.model, noise, person)
        return CloudEvent(
            true_stamp_s=FIRST_STAMP_S + time_s,
            T_map_base=base,
            stamp_s=float(readings.stamps_s[index]),
            sensor=readings.sensor,
            points_laser=hits.points_laser,
            ring=hits.ring,
            true_ranges_m=hits.true_ranges_m,
            fault=hits.fault,
        )

    def _image(self, scene: Scene, camera: MountedCamera, readings: Schedule, index: int) -> ImageEvent:
        """Return one pair of images, taken at an instant."""
        time_s, base, noise, person = self._instant(readings, index)
        image = render_rgbd(
            scene, gtsam.Pose3(base).compose(camera.T_base_camera), camera.model, noise, person
        )
        frame = RgbdFrame(
            stamp_s=float(readings.stamps_s[index]),
            color=image.color,
            depth_m=image.depth_m,
            intrinsics=camera.model.intrinsics,
            T_base_camera=camera.T_base_camera,
            sensor=readings.sensor,
        )
        return ImageEvent(FIRST_STAMP_S + time_s, base, frame, image.true_depth_m, image.fault)


def prepare_drive(
    home: Home, rig: Rig, seed: int, faults: DriveFaults | None = None, duration_s: float | None = None
) -> Drive:
    """Plan the tour, wheel odometry, clocks and person of a drive.

    Parameters
    ----------
    seed
        Seed of the tour's order, all noise and all faults.
    faults
        None: only the usual wheel slip.
    duration_s
        None: one tour through all rooms.

    Raises
    ------
    ConfigError
        If the robot does not fit through the home, or the sensor that should fail is not on the rig.
    """
    faults = faults or DriveFaults()
    tour = plan_tour(home, rig.robot_radius_m, rig.robot_height_m, seed, duration_s)
    odometry_s = np.arange(int(tour.duration_s * faults.wheels.rate_hz + 1e-9) + 1) / faults.wheels.rate_hz
    schedules = _schedules(rig, faults, tour.duration_s, seed)
    if faults.dying_sensor and faults.dying_sensor not in schedules:
        names = ", ".join(schedules)
        raise ConfigError(f"dying_sensor is {faults.dying_sensor!r}; rig {rig.name} has {names}")
    return Drive(
        home=home,
        rig=rig,
        seed=seed,
        faults=faults,
        tour=tour,
        schedules=schedules,
        odometry_s=odometry_s,
        wheels=wheel_readings(faults.wheels, tour.poses_at(odometry_s), generator(seed, "wheels")),
        walk=plan_walk(home, tour, seed + 1) if faults.person else None,
        imu=None
        if rig.imu is None
        else record_imu(rig.imu, tour.smooth_poses, faults.imu, tour.duration_s, FIRST_STAMP_S, seed),
    )


def simulate_drive(
    home: Home, rig: Rig, seed: int, faults: DriveFaults | None = None, duration_s: float | None = None
) -> Iterator[DriveEvent]:
    """Yield all readings of a drive in the order of true time; see `prepare_drive` for the arguments.

    Raises
    ------
    ConfigError
        As `prepare_drive`.
    """
    return prepare_drive(home, rig, seed, faults, duration_s).events()


def leading_sensor(rig: Rig) -> str:
    """Return the leading sensor of a rig: its 2D lidar, else the 3D lidar, else a camera."""
    return next(iter(_schedules(rig, DriveFaults(), 1.0, 0)))


def _schedules(rig: Rig, faults: DriveFaults, duration_s: float, seed: int) -> dict[str, Schedule]:
    """Return the schedule of each sensor."""
    dead_s = (faults.dies_at_share * duration_s, np.inf)
    if faults.returns_at_share is not None:
        dead_s = (dead_s[0], faults.returns_at_share * duration_s)

    def runs(name: str, rate_hz: float, offset_s: float, dropped_share: float) -> Schedule:
        return schedule(
            name,
            rate_hz,
            duration_s,
            FIRST_STAMP_S,
            seed,
            clock_offset_s=offset_s,
            period_jitter_s=faults.period_jitter_s,
            stamp_jitter_s=faults.stamp_jitter_s,
            dropped_share=dropped_share,
            dead_s=dead_s if faults.dying_sensor == name else None,
        )

    schedules: dict[str, Schedule] = {}
    for name, lidar in ((LIDAR, rig.lidar), (LIDAR_3D, rig.lidar_3d)):
        if lidar is not None:
            rate_hz, offset_s = lidar.model.rate_hz, faults.lidar_clock_offset_s
            schedules[name] = runs(name, rate_hz, offset_s, faults.dropped_scan_share)
    for camera in rig.cameras:
        own_s = faults.camera_clock_spread_s * float(generator(seed, camera.name, 2).standard_normal())
        offset_s = faults.camera_clock_offset_s + own_s
        schedules[camera.name] = runs(camera.name, camera.model.rate_hz, offset_s, faults.dropped_frame_share)
    return schedules


def _ticks(times_s: FloatArray, place: int) -> Iterator[tuple[float, int, int]]:
    """Yield time, order and index of events."""
    return ((float(time_s), place, index) for index, time_s in enumerate(times_s))
