"""Localise in a known map, one measurement at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fusion.estimation import FEWEST
from slam.config import Config, config_of
from slam.config.localization import LocalizationConfig
from slam.errors import MapFileError
from slam.localization.camera_sensor import CameraSensor
from slam.localization.cloud_sensor import CloudSensor
from slam.localization.global_search import at_once, search_map
from slam.localization.known_map import Walls, has_walls
from slam.localization.machine import StateMachine
from slam.localization.output import LocalizerOutput
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.poses import Measured, same_place
from slam.localization.scan_view import first_in_cells
from slam.localization.visual_locator import VisualLocator
from slam.mapper.protocol import SENSORS
from slam.measurements import Measurement, RgbdFrame, pose2_from_row
from slam.odometry.cloud_velocity import LONGEST_STEP_S
from slam.outputs.finished_map import Map
from slam.outputs.grid_map import GridMap, opened
from slam.storage.map_contents import MapContents
from slam.storage.measurement_soundness import checked
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame


class Localizer:
    """Localise a robot in a map: add the measurements of a log, or of a running robot, one by one.

    Scans are matched to the walls of the map, frames to its camera keyframes. If the map has walls and there
    are scans, frames of the map's camera support them; without scans only frames are used. In the map of a
    3D lidar only clouds are used.

    Parameters
    ----------
    known_map
        A map, or the path of a saved map; it is not changed.
    config
        The configuration; ``sensors.lidar`` and ``sensors.rgbd`` select the sensors.
    registrations
        Pose of each colour camera relative to its depth camera, by camera name; None uses those that the
        mapping run estimated.
    start
        Approximate initial pose of the robot, in a map of a floor. The search is limited to it until the
        measurements contradict it. None searches the whole map.

    Raises
    ------
    MapFileError
        If the map has nothing in which the selected sensors can be localised, or an initial pose is given
        and the map is not of a floor.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> monday = write_synthetic_log("monday", seed=1, duration_s=10.0).log_path
    >>> tuesday = write_synthetic_log("tuesday", seed=2, duration_s=10.0).log_path
    >>> localizer = slam.Localizer(slam.map_log(monday, out="house"))
    >>> outputs = [localizer.add(measurement) for measurement in slam.open_dataset(tuesday)]
    >>> newest = [output for output in outputs if output is not None][-1]
    >>> newest.state is slam.State.TRACKING, newest.covariance.shape
    (True, (3, 3))
    """

    def __init__(
        self,
        known_map: Map | GridMap | MapContents | Path | str,
        config: Config | str | None = None,
        registrations: Mapping[str, ColorRegistration] | None = None,
        start: Measured | None = None,
    ) -> None:
        if not isinstance(known_map, MapContents):
            known_map = opened(known_map).contents
        if start is not None and not known_map.planar:
            raise MapFileError("a start is for planar maps only: leave it out, the robot is found without it")
        if start is not None and not isinstance(start, Measured):
            raise MapFileError(f"start is {type(start).__name__}; give Measured(gtsam.Pose2, covariance)")
        config = config_of(config)
        self._clouds: CloudSensor | None = None
        self._frames: deque[PreparedFrame] = deque()
        self._lidar = self._lidar_of(known_map, config, start)
        self._locator: VisualLocator | None = None
        if config.sensors.rgbd and known_map.frames is not None:
            self._locator = VisualLocator(known_map, config, registrations)
        self._camera: StateMachine[Any, Any] | None = None
        if self._lidar is None and self._locator is not None:
            self._camera = StateMachine(CameraSensor(self._locator, config), config.localization, start)
        if self._lidar is None and self._camera is None:
            raise MapFileError(
                "the map contains no scans or camera keyframes for the enabled sensors; "
                "'scanweave info' shows what it contains"
            )

    def add(self, measurement: Measurement | PreparedFrame) -> LocalizerOutput | None:
        """Process the next measurement.

        Returns
        -------
        The state after a scan or frame; None after a measurement that is only stored (wheels) or not used.

        Raises
        ------
        DatasetError
            If it is no measurement, or has a field that no sensor gives.

        Examples
        --------
        >>> import slam
        >>> from slam.simulation.synthetic_log import write_synthetic_log
        >>> log = write_synthetic_log("monday", duration_s=10.0).log_path
        >>> localizer = slam.Localizer(slam.map_log(log))
        >>> wheels, scan = (next(one for one in slam.open_dataset(log) if isinstance(one, kind))
        ...                 for kind in (slam.WheelOdometry, slam.LaserScan))
        >>> localizer.add(wheels) is None, localizer.add(scan).stamp_s == scan.stamp_s
        (True, True)
        """
        if type(measurement) not in SENSORS and not isinstance(measurement, PreparedFrame):
            measurement = checked(measurement, "the measurement")
        if self._lidar is None:
            assert self._camera is not None
            return self._camera.add(measurement)
        if self._locator is not None and isinstance(measurement, RgbdFrame | PreparedFrame):
            frame = self._locator.view(measurement)
            if frame is not None:
                self._frames.append(frame)
                # Also of a clock that was set back, whose frames would wait for ever.
                while abs(frame.frame.stamp_s - self._frames[0].frame.stamp_s) > LONGEST_STEP_S:
                    self._frames.popleft()
            return None
        output = self._lidar.add(measurement)
        if output is not None and self._locator is not None:
            self._help(self._lidar, self._locator, output.stamp_s)
        return output

    def warning(self) -> str | None:
        """Return why poses are doubtful: the map has look-alike places, or an IMU contradicts the lidar.

        None for most maps.

        Examples
        --------
        >>> import slam
        >>> from slam.simulation.synthetic_log import write_synthetic_log
        >>> log = write_synthetic_log("monday", duration_s=10.0).log_path
        >>> slam.Localizer(slam.map_log(log)).warning() is None
        True
        """
        if self._clouds is not None and self._clouds.unfit:
            return self._clouds.unfit
        if self._lidar is None or not self._lidar.copied:
            return None
        return (
            f"the robot was found by appearance alone, and {self._lidar.copied:.0%} of the map's own scans "
            "match other places of the map, too: the poses may be of another place; give --start"
        )

    def _lidar_of(
        self, known_map: MapContents, config: Config, start: Measured | None
    ) -> StateMachine[Any, Any] | None:
        """Create the localiser for the lidar; None if the map or the configuration has none."""
        sensor: PlanarSensor | CloudSensor
        settings = config.localization
        alike: Callable[[], float] = float
        if known_map.clouds is not None:
            if not config.sensors.lidar:
                raise MapFileError(
                    "the map is of a 3D lidar, and sensors.lidar is off: nothing can be localised"
                )
            field = Walls(known_map, config).field if has_walls(known_map) else None
            sensor = self._clouds = CloudSensor(known_map, field, config)
        elif has_walls(known_map) and config.sensors.lidar:
            walls = Walls(known_map, config)
            sensor = planar = PlanarSensor(walls, config)
            alike = partial(look_alikes, walls, planar, settings)
            if not known_map.node_poses and known_map.grid is not None:
                # The position of a drawn wall within its cells is unknown.
                half_m = 0.5 * known_map.grid.resolution_m
                sigma_m = max(settings.map_sigma_m, half_m)
                settings = settings.model_copy(update={"map_sigma_m": sigma_m})
        else:
            return None
        return StateMachine(sensor, settings, start, alike)

    def _help(self, lidar: StateMachine[Any, Any], locator: VisualLocator, stamp_s: float) -> None:
        """Use the newest frame of the time of a lidar reading as support, however early frames arrive.

        It proposes places during a search, and stabilises a tracked pose.
        """
        frame = None
        while self._frames and self._frames[0].frame.stamp_s <= stamp_s:
            frame = self._frames.popleft()
        if frame is None or not lidar.wants_help():
            return
        if lidar.tracked is None:
            for place in locator.anywhere(frame):
                lidar.propose(place.T_reference_base)
            return
        motion = locator.near(frame, lidar.tracked.pose)
        if motion is not None:
            lidar.confirm(Measured(motion.T_reference_base, motion.covariance))


def look_alikes(walls: Walls, sensor: PlanarSensor, settings: LocalizationConfig) -> float:
    """Return the share of a map's own scans, sampled along its path, that also fit elsewhere in it.

    Such a scan has more evidence there than a place needs to exceed the outside of the map. 0 for a map
    without scans, and if at most one in ten do: some places look alike in most maps.
    """
    asked = list(walls.sampled(FEWEST))
    elsewhere = 0
    for own, view in asked:
        seen = sensor.novel(view, own, None)
        points = view.points.points_base
        points = points[first_in_cells(points, settings.novel_cell_m)[0]]
        for place in at_once(search_map(walls.field, points, settings, settings.hypotheses)):
            guess = pose2_from_row(place.pose)
            motion = sensor.align(view, guess)
            pose = guess if motion is None else motion.T_reference_base
            if not same_place(own, pose) and sensor.weigh(pose, seen) > settings.nowhere_nats:
                elsewhere += 1
                break
    return elsewhere / len(asked) if 10 * elsewhere > len(asked) else 0.0
