"""Result of a finished run, and warnings about its constraints and about poses that nothing measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.datasets.sensor_choice import SensorUse
from slam.errors import ScanweaveError
from slam.estimates import Trajectory
from slam.forked import Begun
from slam.mapper.keyframe_fusion import FusionSummary
from slam.mapper.scan_record import CameraRecord, ScanRecord
from slam.mapping.elevation import Elevation
from slam.mapping.glass_gaps import with_glass
from slam.mapping.keyframe_grid import layer_settings, lidar_grids
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.layered_map import DEPTH, OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray, RgbdFrame
from slam.storage.map_contents import MapContents
from slam.storage.map_frames import MapFrames
from slam.trajectory.carried import grown_covariances


@dataclass(slots=True)
class MapResult:
    """A finished map, and what is known only during its run.

    Attributes
    ----------
    scans
        Scores and timings of every scan, or of every frame where a camera alone made the map.
    stage_seconds
        Wall time by stage.
    warnings
        One line each, for people.
    notes
        Notes of the run, one line each: mountings, registrations, the fusion.
    fused
        Mutual repair of scans and depth images; None if there were not both.
    cameras
        How the frames of every camera were used, by its name.
    unused
        Why the run could not use a sensor that was chosen, by its name.
    uses
        How everything in the log was used.
    ground
        Ground under the clouds of a 3D lidar; None in other maps, or if it was not seen.
    """

    map: MapContents
    scans: ScanRecord
    stage_seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    fused: FusionSummary | None = None
    cameras: Mapping[str, CameraRecord] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    uses: list[SensorUse] = field(default_factory=list)
    ground: Elevation | None = None

    def add_cameras(self, cameras: Mapping[str, CameraRecord], frames: MapFrames) -> None:
        """Add the results of cameras, and their keyframes."""
        self.cameras = cameras
        learned = {name: record.learned for name, record in cameras.items()}
        self.map = replace(self.map, cameras=learned, frames=frames if len(frames) else None)

    def add_imu_notes(self, notes: list[str], unused: dict[str, str]) -> None:
        """Add the notes of an IMU, and, by its name, why it was not used."""
        self.notes += notes
        self.warnings += [f"{name} is not used: {why}" for name, why in unused.items()]
        self.unused |= unused

    def draw(self, config: Config, grids: Begun | None = None) -> None:
        """Draw the grids, see `drawn`; a grid that cannot be drawn gives a warning."""
        self.map, warnings = drawn(self.map, config, grids)
        self.warnings += warnings


def drawn(saved: MapContents, config: Config, grids: Begun | None = None) -> tuple[MapContents, list[str]]:
    """Return a map with ``grids``, or the `lidar_grids` of its scans, and the depth layer of its frames.

    Returns
    -------
    The map, and a line on each grid that cannot be drawn.
    """
    settled, warnings = config, list[str]()
    try:
        scans, measured = saved.keyframe_scans, saved.measured_scans
        of_lidar = lidar_grids(scans, saved.keyframe_poses, config, measured) if grids is None else grids()
    except ScanweaveError as error:  # a map that would not fit in memory
        warnings.append(f"No grid was built: {error}")
        of_lidar = {}
    lidar = of_lidar.get(OCCUPANCY)
    if lidar is not None and lidar.resolution_m > config.grid.resolution_m:
        warnings.append(
            f"The map is so large that its cells are {lidar.resolution_m:g} m wide; for cells of "
            f"{config.grid.resolution_m:g} m raise grid.greatest_cells = {config.grid.greatest_cells}"
        )
        cells = config.grid.model_copy(update={"resolution_m": lidar.resolution_m})
        settled = config.model_copy(update={"grid": cells})
    if saved.frames is not None and (saved.planar or lidar is not None):
        try:
            depth = depth_grid(saved.frames.taken(), saved.frame_poses(), settled, saved.ground_m)
            of_lidar |= {} if depth is None else {DEPTH: depth}
            if depth is not None and lidar is not None and saved.planar:
                # A camera marks the space behind glass as free.
                of_lidar[OCCUPANCY] = with_glass(lidar, saved.keyframe_scans, saved.keyframe_poses, settled)
        except ScanweaveError as error:
            warnings.append(f"No depth layer was drawn; the map is from the lidar only: {error}")
    return replace(saved, grids=of_lidar), warnings


def depth_grid(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3], config: Config, ground_m: float | None = None
) -> OccupancyGrid | None:
    """Return the depth layer of camera keyframes; None if it is switched off, or they have no depth.

    Parameters
    ----------
    poses
        ``T_map_camera`` of each.
    ground_m
        Height of the floor in the base frame of a robot in 3D, which is then assumed level; None for a robot
        that stays in the plane.

    Raises
    ------
    ScanweaveError
        If the map would not fit.
    """
    if not config.layers.enabled:
        return None
    builder = LayerBuilder(layer_settings(config))
    for frame, T_map_camera in zip(frames, poses, strict=True):
        if frame.T_base_camera is not None:
            base = T_map_camera.compose(frame.T_base_camera.inverse())
            if ground_m is not None:
                level = gtsam.Rot3.Yaw(base.rotation().yaw())
                base = gtsam.Pose3(level, np.array([base.x(), base.y(), -ground_m]))
            builder.add(frame, base)
    return builder.grid("depth")


def apart(pieces: NDArray[np.int64], stamps_s: FloatArray) -> list[str]:
    """Warn if only guesses connect parts of the map; single keyframes do not count as parts.

    Parameters
    ----------
    pieces
        (n,) the piece of each keyframe.
    stamps_s
        (n,) seconds since the start.
    """
    counts = np.bincount(pieces)
    (parts,) = np.nonzero(counts > 1)
    if len(parts) < 2:
        return []
    begins_s = sorted(float(stamps_s[pieces == part][0]) for part in parts)
    share = counts.max() / len(pieces)
    return [
        f"The map is in {len(parts)} pieces whose relative poses are only a guess: the first piece ends "
        f"before {begins_s[1]:.0f} s, the largest has {share:.0%} of the keyframes. Wheel odometry, more "
        "scans or a place that is visited again would connect them"
    ]


def unseen(
    trajectory: Trajectory,
    placed: NDArray[np.int64],
    fixed: NDArray[np.int64],
    covariances: FloatArray,
    config: Config,
) -> list[str]:
    """Warn if no scan was matched in all directions for a while, and poses are too uncertain for a match.

    Parameters
    ----------
    placed, fixed
        (S,) numbers of the poses given by a scan match, and of those that leave no direction open. An open
        direction counts once the robot, as fast as on average, has gone farther than a match finds.
    covariances
        (N, d, d) covariances of all poses.
    """
    # A point at this distance from the robot may be so uncertain.
    most_m, lever_m = config.match.search_half_width_m, config.loops.reach_m
    way_m, stamps_s = np.diff(trajectory.positions_m, axis=0), trajectory.stamps_s
    speed_m_s = float(np.linalg.norm(way_m, axis=1).sum()) / max(float(np.ptp(stamps_s)), GAP_S)
    lost = {
        (int(known[gap]), int(known[gap + 1]))
        for known, longest_s in ((placed, GAP_S), (fixed, max(GAP_S, most_m / max(speed_m_s, TINY))))
        for gap in np.flatnonzero(np.diff(stamps_s[known]) > longest_s)
    }
    periods = []
    for first, last in lost:
        grown = np.diagonal(grown_covariances(trajectory, covariances, first, last), axis1=1, axis2=2)
        variances = np.column_stack([grown[:, 0] + grown[:, 1], grown[:, -1]]).clip(0.0)
        off_m2 = variances @ [1.0, lever_m**2]
        at = int(off_m2.argmax())
        if off_m2[at] > most_m**2:
            periods.append((float(off_m2[at]), first, last, *np.sqrt(variances[at]).tolist()))
    if not periods:
        return []
    _, first, last, position_m, turn_rad = max(periods)
    from_s, to_s = trajectory.stamps_s[[first, last]] - trajectory.stamps_s[0]
    others = f" (the worst of {len(periods)} such periods)" if len(periods) > 1 else ""
    return [
        f"No scan or image was matched in all directions from {from_s:.1f} to {to_s:.1f} s{others}: relative "
        f"to before, poses are uncertain by up to {position_m:.2f} m and {np.degrees(turn_rad):.1f} degrees "
        "(one sigma)"
    ]
