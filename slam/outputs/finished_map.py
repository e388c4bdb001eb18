"""A finished map in its file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.showing import drawn, extent, with_pictures
from slam.config import Config
from slam.config.edits import Edits, edits_of
from slam.config.files import read_tree
from slam.errors import MapFileError, path_of
from slam.estimates import Trajectory
from slam.graph.loop_candidate import LoopCandidate
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray, LaserScan
from slam.outputs.exports import Exports
from slam.outputs.floorplan import floor_plan
from slam.storage.map_contents import MapContents, SavedFactor, read_contents, refuse_misfits
from slam.storage.map_edits import regions_of
from slam.storage.map_file import MAP_NAME, MapFile
from slam.storage.map_identity import NOTES, WARNINGS, MapIdentity, lines_of
from slam.storage.map_sessions import MapSession, sessions_of
from slam.storage.map_soundness import sound_readings
from slam.storage.map_tables import KEYFRAMES
from slam.storage.whole_folder import copy_into, holds, remake
from slam.temporary import TemporaryFolder

if TYPE_CHECKING:
    from slam.edits.applying import Known

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Map:
    """A finished map; images and clouds are read when they are needed.

    Attributes
    ----------
    path
        Path of the file.
    identity
        Configuration, log and library versions of the run.
    sessions
        The logs in the map.
    contents
        The map data; properties below that exist there too are explained there.
    digest
        Digest of everything; equal for equal maps.
    notes, warnings
        Findings of the mapping run, and reasons to distrust the map: one line each.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> house = slam.map_log(write_synthetic_log("monday", duration_s=12.0).log_path)
    >>> house.grid.resolution_m, house.layers.resolution_m, house.keyframe_poses.shape[1]
    (0.05, 0.05, 3)
    >>> house.notes
    ['used: FLASER (2D lidar, 61), odometry (wheels, 121)']
    >>> house.check()  # no error: the map is sound
    >>> house.config.grid.resolution_m, house.edits, house.in_memory, house.covariances.shape[1:]
    (0.05, [], True, (3, 3))
    >>> len(house.loops), len(house.factors) >= len(house.keyframe_poses) - 1
    (0, True)
    >>> len(house.floor_plan().rooms) > 0, house.remap(["grid.resolution_m=0.1"]).grid.resolution_m
    (True, 0.1)
    >>> [path.name for path in house.export("nav2", "for-the-robot/")]
    ['map.yaml', 'map.pgm']
    >>> house.save("house")[0].name, slam.load_map("house").digest == house.digest
    ('map.db', True)
    """

    path: Path
    identity: MapIdentity
    sessions: Sequence[MapSession]
    contents: MapContents
    digest: str
    notes: Sequence[str]
    warnings: Sequence[str]
    _file: MapFile = field(repr=False)
    _folder: TemporaryFolder | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        contents, trajectory = self.contents, self.trajectory
        return (
            f"Map({str(self.path)!r}, sessions={len(self.sessions)}, keyframes={len(contents.node_poses)}, "
            f"poses={len(trajectory)} over {extent(trajectory.positions_m)} m, loops={len(contents.loops)}, "
            f"frames={len(contents.frames or ())}, clouds={len(contents.clouds or ())})"
        )

    def __enter__(self) -> Map:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        path_m = self.trajectory.positions_m[:, :2]
        return with_pictures(self, drawn(blue=path_m) if self.grid is None else self.grid.picture(path_m))

    @property
    def in_memory(self) -> bool:
        """Whether the map is in a temporary folder that is deleted with it."""
        return self._folder is not None

    @property
    def planar(self) -> bool:
        """Whether the robot is on a floor. Otherwise the nodes are bases with clouds, or cameras."""
        return self.contents.planar

    @property
    def config(self) -> Config:
        """The configuration of the map."""
        return self.identity.config

    @property
    def keyframe_poses(self) -> FloatArray:
        """(K, 3) x, y, yaw of the bases, map frame."""
        return self.contents.keyframe_poses

    @property
    def keyframe_scans(self) -> Sequence[LaserScan | None]:
        """K sweeps, after the repair if there was one."""
        return self.contents.keyframe_scans

    @property
    def grid(self) -> OccupancyGrid | None:
        """The lidar grid to which scans are matched; None if there are only cameras."""
        return self.contents.grid

    @property
    def layers(self) -> LayeredMap | None:
        """The navigation map and its layers from the run that saved it; None for a camera in 3D."""
        return self.contents.layers(self.config)

    @property
    def trajectory(self) -> Trajectory:
        """The pose of every reading of the log."""
        return self.contents.trajectory

    @property
    def covariances(self) -> FloatArray | None:
        """Covariance of every pose of the trajectory; None in a map of an older version.

        (N, 3, 3) of x, y, yaw, or in 3D (N, 6, 6) of x, y, z and a rotation vector, along the axes of the
        map, in metres and radians. They are relative to the first keyframe, which is fixed.
        """
        return self.contents.covariances

    @property
    def factors(self) -> Sequence[SavedFactor]:
        """The edges of the graph."""
        return self.contents.factors

    @property
    def loops(self) -> Sequence[LoopCandidate]:
        """All loop candidates, accepted and rejected."""
        return self.contents.loops

    def floor_plan(self) -> FloorPlan:
        """Compute the floor plan: rooms with walls, lengths, areas, their uncertainty, and doors.

        It needs the scans of a 2D lidar; without, it raises a `ScanweaveError`.
        """
        return floor_plan(self.contents, self.config)

    def check(self) -> None:
        """Read and check the whole file; a `MapFileError` names table and row of the first error."""
        self._file.check_pages()
        if self.contents.edits:
            self.parts()
        self.contents.read_all()

    def export(self, format_: str, out: Path | str) -> list[Path]:
        """Write the map in the format of another program, and return the files written.

        Parameters
        ----------
        format_
            nav2 (the navigation map), tum, g2o, ply or bt. For the floor plan svg, dxf, geojson or nav2-zones
            (keep-out and speed masks, route graph).
        out
            The file, or a folder (existing, or a name without ending) for the usual names. For nav2 it is the
            yaml; for ply the mesh of the images or, without images, the cloud of the 3D lidar. Related files
            are written next to it. For nav2-zones it is a folder.

        Raises
        ------
        ScanweaveError
            If the map does not contain the data for the format, or a file cannot be written.
        """
        return Exports(self.contents, self.config).write(format_, path_of(out, "out"))

    def write_files(self, folder: Path, like: Map | None = None) -> list[Path]:
        """Write the exported files that ``scanweave map`` writes; raises as `export`.

        Surfaces, which take long, are not written if they would be those of another map.
        """
        exports = Exports(self.contents, self.config)
        same = like is not None and exports.same_surfaces(Exports(like.contents, like.config))
        sessions = exports.write_sessions(folder, [session.poses for session in self.sessions])
        return exports.write_files(folder) + ([] if same else exports.write_surfaces(folder)) + sessions

    @property
    def edits(self) -> list[str]:
        """Edits of the map: each applied file, as YAML, in order."""
        return [entry.text for entry in self.contents.edits]

    @property
    def places(self) -> dict[str, FloatArray]:
        """(3,) x, y, yaw of the named places, by name, map frame."""
        return {one.name: one.pose(self.keyframe_poses) for one in regions_of(self.contents.edits, "place")}

    def zones(self, kind: str = "keep_out") -> dict[str, FloatArray]:
        """Return (n, 2) corners of the zones of a kind, ``keep_out`` or ``slow``, by name, map frame."""
        return {zone.name: zone.points(self.keyframe_poses) for zone in regions_of(self.contents.edits, kind)}

    def edited(self, edits: Edits | Mapping[str, Any] | Path | str, *, out: Path | str | None = None) -> Map:
        """Return the map with more edits applied; this map stays open and unchanged.

        Parameters
        ----------
        edits
            A file as in ``docs/edits.md``, or its contents.
        out
            Folder for the edited map, possibly that of this map; None keeps it in a temporary folder.

        Raises
        ------
        ScanweaveError
            If edits do not fit, or the folder has another map or cannot be written; the map is unchanged.

        Examples
        --------
        >>> import slam
        >>> from slam.simulation.synthetic_log import write_synthetic_log
        >>> house = slam.map_log(write_synthetic_log("monday", duration_s=12.0).log_path)
        >>> turned = house.edited({"turn": {"degrees": 90}, "places": [{"name": "dock", "position": [1, 0]}]})
        >>> turned.places["dock"].round(2).tolist()
        [0.0, 1.0, 1.57]
        >>> turned.undone().digest == house.digest
        True
        >>> stairs = {"name": "stairs", "polygon": [[0, 0], [1, 0], [1, 1]]}
        >>> (house.edited({"keep_out": [stairs]}).zones()["stairs"].round(2) + 0.0).tolist()
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
        """
        from slam.edits.edited_file import write_with

        if isinstance(edits, str | Path):
            chosen = edits_of(read_tree(Path(edits)), str(edits))
        else:
            chosen = edits if isinstance(edits, Edits) else edits_of(edits, "the edits")
        return made_anew(self, lambda path: write_with(self.parts(), chosen, path), out)

    def remap(self, settings: Sequence[str] = (), *, out: Path | str | None = None) -> Map:
        """Return the map recomputed with other settings, without its log; otherwise as `edited`.

        Parameters
        ----------
        settings
            Overrides as for `slam.load_config`; settings that need the log raise an error.
        """
        texts = [settings] if isinstance(settings, str) else settings
        pairs = (str(setting).partition("=") for setting in texts)
        return self.edited({"settings": {name: value for name, _, value in pairs}}, out=out)

    def undone(self, *, out: Path | str | None = None) -> Map:
        """Return the map before the last edits; otherwise as `edited`. Raises if there are no edits."""
        from slam.edits.edited_file import write_undone

        if not self.contents.edits:
            raise MapFileError(f"{self.path} has no edits to undo")
        return made_anew(self, lambda path: write_undone(self.parts(), path), out)

    def parts(self) -> Known:
        """Return the map as it is, and as it was before all edits."""
        from slam.edits.edited_file import known_of

        return known_of(self._file, self.contents, self.sessions)

    def save(self, folder: Path | str, *, overwrite: bool = False) -> list[Path]:
        """Write the map into a folder: ``map.db`` and the exported files. Return the files written.

        Parameters
        ----------
        overwrite
            Replace another map in the folder. The folder is created if missing.

        Raises
        ------
        ScanweaveError
            If the folder has another map that must not be replaced, or a file cannot be written.
        """
        target = copy_into(path_of(folder, "the folder"), self.path, overwrite=overwrite)
        return [target, *self.write_files(target.parent)]

    def close(self) -> None:
        """Close the file; images and clouds cannot be read afterwards, and a temporary map is deleted."""
        self._file.close()
        if self._folder is not None:
            self._folder.remove()


def made_anew(saved: Map, write: Callable[[Path], list[str]], out: Path | str | None) -> Map:
    """Write a map next to the existing one, then replace that one."""
    if out is None:
        kept_in = TemporaryFolder()
        write(kept_in.path / MAP_NAME)
        return load_map(kept_in.path, kept_in)
    folder = path_of(out, "out")
    ours = holds(folder, saved.path, "give another --out (out=)")

    def write_all(work: Path) -> None:
        for warning in write(work / MAP_NAME):
            log.warning("%s", warning)
        with load_map(work) as written_map:
            written_map.write_files(work, like=saved if ours else None)

    remake(folder, write_all)
    return load_map(folder)


def load_map(path: Path | str, kept_in: TemporaryFolder | None = None) -> Map:
    """Open a finished map: a folder that ``scanweave map`` wrote, or its ``map.db``.

    Parameters
    ----------
    kept_in
        A temporary folder that holds the map and is deleted with it.

    Raises
    ------
    MapFileError
        If there is no map, or it is unfinished, damaged, or of a newer version.

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
    file = MapFile.read(path_of(path, "the map"))
    try:
        meta = file.meta()
        identity = MapIdentity.from_meta(meta, file.path)
        contents = read_contents(file)
        sessions = sessions_of(meta, len(contents.node_poses), len(contents.trajectory))
        with file.naming_row(KEYFRAMES, len(contents.node_poses) - 1):
            sound_readings(contents.readings, sessions)
        refuse_misfits(file, contents)
    except BaseException:
        file.close()
        raise
    notes, warnings = (lines_of(meta, key, file.path) for key in (NOTES, WARNINGS))
    return Map(file.path, identity, sessions, contents, file.content_digest(), notes, warnings, file, kept_in)
