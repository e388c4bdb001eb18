"""A finished map, read back: poses, scans, clouds, camera keyframes, factors, loops, trajectory, grids."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.graph.loop_closure import LoopCandidate
from slam.mapping.keyframe_grid import layers_of_grids
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray, LaserScan, Pose, Trajectory
from slam.storage.map_clouds import MapClouds
from slam.storage.map_contents import DEPTH, OCCUPANCY, MapContents, SavedFactor, read_contents
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_identity import MapIdentity
from slam.storage.map_sessions import MapSession, sessions_of
from slam.storage.map_tables import FRAMES

# What the run told people, as rows of the file.
NOTES, WARNINGS = "notes", "warnings"


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A finished map; images and clouds are read when they are asked for.

    Attributes
    ----------
    path
        Of the file.
    identity
        What decided it.
    sessions
        The logs that it was made of.
    contents
        Everything but the camera keyframes and the clouds.
    frames
        The camera keyframes.
    clouds
        The clouds of the nodes; none where no 3D lidar made the map.
    digest
        Of everything; equal for equal maps.
    notes, warnings
        What the mapping run found out, and what a person should know before trusting the map: a line each.
    """

    path: Path
    identity: MapIdentity
    sessions: Sequence[MapSession]
    contents: MapContents
    frames: MapFrames
    clouds: MapClouds
    digest: str
    notes: Sequence[str]
    warnings: Sequence[str]
    _file: MapFile = field(repr=False)
    _folder: TemporaryDirectory[str] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        sizes = (
            f"sessions={len(self.sessions)}, keyframes={len(self.contents.node_poses)}, "
            f"poses={len(self.trajectory)}, loops={len(self.loops)}, frames={len(self.frames)}, "
            f"clouds={len(self.clouds)}"
        )
        return f"SavedMap({str(self.path)!r}, {sizes})"

    @property
    def planar(self) -> bool:
        """Whether the robot stays on a floor; in space the nodes are bases with clouds, or else cameras."""
        return isinstance(self.contents.node_poses[0], gtsam.Pose2)

    @property
    def config(self) -> Config:
        """The effective configuration."""
        return self.identity.config

    @property
    def keyframe_poses(self) -> FloatArray:
        """(K, 3) x, y, yaw of the nodes, map frame."""
        return np.array([[pose.x(), pose.y(), _yaw(pose)] for pose in self.contents.node_poses])

    @property
    def keyframe_scans(self) -> Sequence[LaserScan | None]:
        """K sweeps, repaired where they were."""
        return self.contents.scans

    @property
    def grid(self) -> OccupancyGrid | None:
        """The lidar's grid, which other scans are matched to; None of cameras alone."""
        return self.contents.grids.get(OCCUPANCY)

    @property
    def layers(self) -> LayeredMap | None:
        """The map to drive by and its layers, those of the run that saved it; None of a camera in space."""
        return layers_of_grids(self.grid, self.contents.grids.get(DEPTH), self.config)

    @property
    def trajectory(self) -> Trajectory:
        """A pose for every reading of the log."""
        return self.contents.trajectory

    @property
    def factors(self) -> Sequence[SavedFactor]:
        """The edges of the graph."""
        return self.contents.factors

    @property
    def loops(self) -> Sequence[LoopCandidate]:
        """Every loop candidate with its verdict."""
        return self.contents.loops

    def frame_poses(self) -> list[gtsam.Pose3]:
        """``T_map_camera`` of every camera keyframe."""
        return self.frames.poses(self.contents.node_poses, bases=len(self.clouds) > 0)

    def check(self) -> None:
        """Read everything, images and clouds too.

        Raises
        ------
        MapFileError
            With the first fault, in one line that names table and row.
        """
        self._file.check_pages()
        for index in range(len(self.frames)):
            self.frames.features(index)
            self.frames.frame(index)
        for key in range(len(self.clouds)):
            self.clouds.points(key)
            self.clouds.T_base_lidar(key)

    def close(self) -> None:
        """Close the file; no image or cloud can be read afterwards."""
        self._file.close()


def open_saved_map(path: Path | str, kept_in: TemporaryDirectory[str] | None = None) -> SavedMap:
    """Open a finished map: a folder that ``scanweave map`` has made, or its ``map.db``.

    Parameters
    ----------
    kept_in
        A temporary folder that holds it, and lives as long as the map.

    Raises
    ------
    MapFileError
        Where there is none, it is not finished, damaged, or of a newer version.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> slam.map_log(write_synthetic_log("monday", duration_s=10.0).log_path, out="house").close()
    >>> house = slam.load_map("house")
    >>> house.planar, len(house.keyframe_scans) == len(house.keyframe_poses)
    (True, True)
    >>> house.close()
    """
    file = MapFile.read(Path(path))
    try:
        meta = file.meta()
        identity = MapIdentity.from_meta(meta, file.path)
        contents = read_contents(file)
        sessions = sessions_of(meta, len(contents.node_poses), len(contents.trajectory))
        frames, clouds = MapFrames(file), MapClouds(file)
        nodes = contents.node_poses
        in_space = sum(isinstance(pose, gtsam.Pose3) for pose in nodes)
        if len(clouds) and not len(clouds) == len(nodes) == in_space:
            raise MapFileError(
                f"{file.path} holds {len(clouds)} clouds for {len(nodes)} nodes, {in_space} of them in "
                "space; make the map anew"
            )
        for index in range(len(frames)):
            with file.blaming(FRAMES, index):
                head = frames.head(index)
                if not 0 <= head.node < len(contents.node_poses):
                    raise MapFileError("it belongs to no node")
                if len(clouds) and head.T_base_camera is None:
                    raise MapFileError("it does not tell where the camera was on the robot")
    except BaseException:
        file.close()
        raise
    digest = file.content_digest()
    notes, warnings = (_lines(meta, key, file.path) for key in (NOTES, WARNINGS))
    return SavedMap(
        file.path, identity, sessions, contents, frames, clouds, digest, notes, warnings, file, kept_in
    )


def _lines(meta: Mapping[str, str], key: str, path: Path) -> list[str]:
    """Lines of text from a row of the file; none in a map of an older version."""
    try:
        lines = json.loads(meta.get(key, "[]"))
    except ValueError as error:
        raise MapFileError(f"{path} tells no {key} ({error}); make the map anew") from error
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise MapFileError(f"{path} tells no {key}; make the map anew")
    return lines


def _yaw(pose: Pose) -> float:
    """Heading of a pose in the map's plane."""
    return pose.theta() if isinstance(pose, gtsam.Pose2) else pose.rotation().yaw()
