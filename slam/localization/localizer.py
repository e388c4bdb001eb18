"""The localiser of a known map: one measurement in, what is known of the pose out."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.body import Body, PlanarBody, SpatialBody
from slam.localization.camera_localizer import CameraLocalizer
from slam.localization.cloud_localizer import CloudLocalizer
from slam.localization.known_map import KnownMap, Walls
from slam.localization.output import LocalizerOutput
from slam.localization.planar_localizer import PlanarLocalizer
from slam.localization.visual_locator import VisualLocator
from slam.measurements import LaserScan, Measurement, PointCloud, RgbdFrame, WheelOdometry
from slam.outputs.finished_map import Map
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import FramePreparer, PreparedFrame


class Localizer:
    """Feed it the measurements of a log, or of a robot, one after the other.

    Scans are localised in the walls of the map, frames at its camera keyframes. Where the map has walls and
    scans come, frames of the map's camera help the scans; without scans they do it alone. In the map of a 3D
    lidar its clouds are localised, and nothing else.

    Parameters
    ----------
    known_map
        Where to localise: a saved map, or one that a run has just made; it is not changed.
    config
        The effective configuration; ``sensors.lidar`` and ``sensors.rgbd`` choose what is used.
    registrations
        Where colour cameras sit beside their depth cameras, by the cameras' names; None takes what the
        mapping run has learned.

    Raises
    ------
    MapFileError
        Where the map holds nothing that the chosen sensors could be localised in.

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
        known_map: KnownMap | Map,
        config: Config | None = None,
        registrations: Mapping[str, ColorRegistration] | None = None,
    ) -> None:
        if isinstance(known_map, Map):
            known_map = KnownMap.of_saved(known_map)
        self._config = config or Config()
        sensors = self._config.sensors
        self._clouds: CloudLocalizer | None = None
        if known_map.clouds is not None:
            if not sensors.lidar:
                raise MapFileError(
                    "the map is of a 3D lidar, and sensors.lidar is off: nothing can be localised"
                )
            field = Walls(known_map, self._config).field if known_map.has_walls else None
            self._clouds = CloudLocalizer(known_map.clouds, field, self._config)
        planar = sensors.lidar and known_map.has_walls and self._clouds is None
        self._scans = PlanarLocalizer(known_map, self._config) if planar else None
        self._map = known_map
        self._locator: VisualLocator | None = None
        if sensors.rgbd and known_map.cameras is not None and self._clouds is None:
            self._locator = VisualLocator(known_map.cameras, self._config)
        if self._scans is None and self._locator is None and self._clouds is None:
            raise MapFileError(
                "the map holds neither scans nor camera keyframes for the sensors that are switched on; "
                "see 'scanweave info' for what it holds"
            )
        self._frames: CameraLocalizer | None = None
        self._body: Body | None = None
        self._sensor = known_map.cameras.sensor if self._locator and known_map.cameras else ""
        if registrations is None and known_map.cameras is not None:
            registrations = known_map.cameras.registrations
        self._prepare = FramePreparer(self._config.rgbd, registrations or {})
        self._scanned = False

    def add(self, measurement: Measurement | PreparedFrame) -> LocalizerOutput | None:
        """Take the next measurement.

        Returns
        -------
        What is known after a scan or frame; None after one that is only kept (wheels), or not used.
        """
        if isinstance(measurement, WheelOdometry):
            for localizer in (self._scans, self._clouds):
                if localizer is not None:
                    localizer.add_odometry(measurement)
            return None
        if isinstance(measurement, LaserScan):
            self._scanned = True
            return None if self._scans is None else self._scans.add_scan(measurement)
        if isinstance(measurement, PointCloud):
            return None if self._clouds is None else self._clouds.add_cloud(measurement)
        return self._add_frame(measurement)

    def _add_frame(self, measurement: RgbdFrame | PreparedFrame) -> LocalizerOutput | None:
        """A frame of the map's camera; others are not used."""
        frame = measurement if isinstance(measurement, PreparedFrame) else self._prepare(measurement)
        if self._locator is None or not isinstance(frame, PreparedFrame):
            return None
        if frame.frame.sensor != self._sensor:
            return None
        if self._body is None:
            self._body = self._body_of(frame.frame)
        if self._scans is not None:
            if self._scanned:
                self._scans.add_frame(frame, self._locator, self._body)
            return None
        if self._frames is None:
            self._frames = CameraLocalizer(self._locator, self._body, self._config)
        return self._frames.add_frame(frame)

    def _body_of(self, frame: RgbdFrame) -> Body:
        """What carries the camera; where the log does not tell its mounting, the map does."""
        cameras = self._map.cameras
        mounting = frame.T_base_camera
        if mounting is None and cameras is not None:
            mounting = cameras.T_base_camera
        if self._map.planar:
            T_base_camera = T_BODY_CAMERA if mounting is None else mounting
            return PlanarBody(T_base_camera, self._config.sensors.greatest_excess)
        return SpatialBody(gtsam.Pose3() if mounting is None else mounting)
