"""One map of both sensors: a lidar layer, a depth layer, their Bayes fusion, and the decision (Li2020).

Rebuilt from keyframes at their optimised poses, in any order, each counted once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import gtsam
import numpy as np

from fusion import bayes
from fusion.height_band import LensDistortion
from slam.errors import ConfigError, ScanweaveError
from slam.mapping.depth_grid import DepthModel, depth_board
from slam.mapping.evidence_tiles import Board, EvidenceTiles, Steps, union
from slam.mapping.footprint import footprint_board
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import OccupancyGrid, PosedScan, StateArray
from slam.mapping.ray_tracing import Box
from slam.measurements import FloatArray, LaserScan, Pose, RgbdFrame

Reading: TypeAlias = LaserScan | RgbdFrame
LayerName: TypeAlias = Literal["lidar", "depth", "fused", "decision"]

LAYERS: tuple[LayerName, ...] = ("lidar", "depth", "fused", "decision")
_MAX_POSITION_M = 1e6
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Li2020 Eq. (9) on either side: what is between is uncertain. Each sensor has its own."""

    occupied_above: float = 0.5
    free_below: float = 0.4

    def __post_init__(self) -> None:
        if not 0.0 < self.free_below <= self.occupied_above < 1.0:
            raise ConfigError(
                f"thresholds free_below={self.free_below:g} occupied_above={self.occupied_above:g}: "
                "needs 0 < free_below <= occupied_above < 1"
            )

    def states(self, steps: Steps) -> StateArray:
        """States of cells from their steps of log-odds."""
        states = np.full(steps.shape, bayes.UNKNOWN, dtype=np.int8)
        states[steps > bayes.log_odds(self.occupied_above) * bayes.STEPS_A_UNIT] = bayes.OCCUPIED
        states[steps < bayes.log_odds(self.free_below) * bayes.STEPS_A_UNIT] = bayes.FREE
        return states


@dataclass(frozen=True, slots=True)
class LayerSettings:
    """How keyframes become a layered map.

    Attributes
    ----------
    resolution_m
        Side of a cell; Yang2021's R.
    lidar, depth
        The inverse sensor models.
    lidar_thresholds, depth_thresholds, fused_thresholds
        Li2020 Eq. (9) for each layer.
    rule
        Li2020 Table 3, ``corrected`` or ``printed``.
    p_min, p_max
        Bounds of each sensor's finished layer; they leave the other a say in Eq. (10).
    axes_yaw_rad
        Direction of the grid's x axis in the map.
    distortion
        Of the depth images, where they do not come undistorted.
    robot_radius_m
        Of a disc around the base that the robot covers: what stood there has gone.
    memory_mb
        Memory for the tiles of each layer while building, 10^6 bytes; the rest waits on disk.
    max_cells
        Largest map; a guard against a lost pose.
    """

    resolution_m: float = 0.05
    lidar: LidarModel = field(default_factory=LidarModel)
    depth: DepthModel = field(default_factory=DepthModel)
    lidar_thresholds: Thresholds = field(default_factory=Thresholds)
    depth_thresholds: Thresholds = field(default_factory=Thresholds)
    fused_thresholds: Thresholds = field(default_factory=Thresholds)
    rule: bayes.Rule = "corrected"
    p_min: float = 0.02
    p_max: float = 0.98
    axes_yaw_rad: float = 0.0
    distortion: LensDistortion | None = None
    robot_radius_m: float = 0.0
    memory_mb: float = 24.0
    max_cells: int = 64_000_000

    def __post_init__(self) -> None:
        if not 1e-3 <= self.resolution_m < math.inf:
            raise ConfigError(f"resolution_m={self.resolution_m:g}: must be 0.001 or more (0.05 is usual)")
        if not 0.0 < self.p_min < 0.5 < self.p_max < 1.0:
            raise ConfigError(f"p_min={self.p_min:g} p_max={self.p_max:g}: needs 0 < p_min < 0.5 < p_max < 1")
        if self.rule not in ("corrected", "printed"):
            raise ConfigError(f"rule is {self.rule!r}; it must be corrected or printed")


@dataclass(frozen=True, slots=True)
class LayeredMap:
    """The finished layers, all on one lattice.

    Attributes
    ----------
    lidar, depth
        (rows, cols) log-odds in steps of 1 / `fusion.bayes.STEPS_A_UNIT`, row 0 at the lowest y; None where
        the sensor gave nothing.
    resolution_m
        Side of a cell.
    T_map_grid
        The lower-left corner of cell (0, 0).
    settings
        What it was built with.
    scans, frames
        Readings that made it.
    repeated
        Readings that came a second time and were not counted again.
    """

    lidar: Steps | None
    depth: Steps | None
    resolution_m: float
    T_map_grid: gtsam.Pose2
    settings: LayerSettings
    scans: int
    frames: int
    repeated: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        layer = self.lidar if self.lidar is not None else self.depth
        assert layer is not None  # the builder gives no map without a layer
        rows, cols = layer.shape
        return rows, cols

    def grid(self, name: Literal["lidar", "depth", "fused"]) -> OccupancyGrid:
        """A probability layer; ``fused`` is Li2020 Eq. (10), the sum of both log-odds."""
        log_odds = np.empty(self.shape, dtype=np.float32)
        for part in _blocks(self.shape[0]):
            log_odds[part] = self._steps(name, part) / np.float32(bayes.STEPS_A_UNIT)
        return OccupancyGrid(log_odds, self.resolution_m, self.T_map_grid)

    def states(self, name: LayerName) -> StateArray:
        """(rows, cols) of 100, 0 and -1: a layer by its own thresholds, or the decision by Table 3.

        The decision is what the robot must not hit.
        """
        states = np.empty(self.shape, dtype=np.int8)
        settings = self.settings
        for part in _blocks(self.shape[0]):
            if name == "decision":
                lidar = settings.lidar_thresholds.states(self._steps("lidar", part))
                depth = settings.depth_thresholds.states(self._steps("depth", part))
                states[part] = bayes.decide(lidar, depth, settings.rule)
            else:
                states[part] = self._thresholds(name).states(self._steps(name, part))
        return states

    def percent(self) -> StateArray:
        """(rows, cols) fused probability in percent, -1 where it is one half, which is unknown."""
        percent = np.empty(self.shape, dtype=np.int8)
        for part in _blocks(self.shape[0]):
            steps = self._steps("fused", part)
            odds = np.exp(steps / np.float32(-bayes.STEPS_A_UNIT))
            percent[part] = np.where(steps == 0, bayes.UNKNOWN, np.rint(100.0 / (1.0 + odds)))
        return percent

    def _thresholds(self, name: LayerName) -> Thresholds:
        """A layer's own."""
        own = {"lidar": self.settings.lidar_thresholds, "depth": self.settings.depth_thresholds}
        return own.get(name, self.settings.fused_thresholds)

    def _steps(self, name: LayerName, part: slice) -> Steps:
        """Some rows of a layer; a missing sensor is unknown everywhere."""
        chosen = {"lidar": (self.lidar,), "depth": (self.depth,)}.get(name, (self.lidar, self.depth))
        nothing = np.zeros((len(range(*part.indices(self.shape[0]))), self.shape[1]), dtype=np.int16)
        return sum((layer[part] for layer in chosen if layer is not None), nothing)


class LayerBuilder:
    """Layers that grow with the readings put into them; each is seen once and not kept."""

    def __init__(self, settings: LayerSettings | None = None) -> None:
        self._settings = settings or LayerSettings()
        self._axes = gtsam.Pose2(0.0, 0.0, self._settings.axes_yaw_rad)
        self._tiles: dict[str, EvidenceTiles] = {}
        self._seen: set[tuple[str, float]] = set()
        self._counts = {"lidar": 0, "depth": 0, "repeated": 0}

    def add(self, reading: Reading, T_map_base: Pose) -> bool:
        """Add one keyframe's scan or depth image; False where it was added before.

        Parameters
        ----------
        reading
            Known by its sensor and stamp.
        T_map_base
            The robot when the reading was taken; the map's z = 0 is the floor.

        Raises
        ------
        ScanweaveError
            Where the pose is not finite or too far away, the map would be too large, or a frame does not
            tell where its camera sits.
        """
        key = (reading.sensor, reading.stamp_s)
        if key in self._seen:
            self._counts["repeated"] += 1
            return False
        if not (np.abs(T_map_base.matrix()) < _MAX_POSITION_M).all():
            raise ScanweaveError(f"cannot map the reading at {reading.stamp_s:.6f} s: its pose is lost")
        name = "lidar" if isinstance(reading, LaserScan) else "depth"
        board = self._board(reading, T_map_base)
        self._seen.add(key)
        if board is not None:
            self._check_room(board.box())
            tiles = self._tiles.setdefault(name, EvidenceTiles(self._settings.memory_mb))
            tiles.add(board)
            under = self._axes.between(_planar(T_map_base))
            footprint = footprint_board(under, self._settings.robot_radius_m, self._settings.resolution_m)
            if footprint is not None:
                tiles.add(footprint)
            self._counts[name] += 1
        return True

    def finish(self) -> LayeredMap:
        """The map so far.

        Raises
        ------
        ScanweaveError
            Where no reading told anything.
        """
        box = self._box()
        if box is None:
            raise ScanweaveError("no reading was given to build a map from; does the log hold any?")
        settings = self._settings
        low, high = bayes.evidence_steps(settings.p_min), bayes.evidence_steps(settings.p_max)
        layers = {name: tiles.clipped(box, low, high) for name, tiles in self._tiles.items()}
        corner = gtsam.Pose2(box[1] * settings.resolution_m, box[0] * settings.resolution_m, 0.0)
        return LayeredMap(
            lidar=layers.get("lidar"),
            depth=layers.get("depth"),
            resolution_m=settings.resolution_m,
            T_map_grid=self._axes.compose(corner),
            settings=settings,
            scans=self._counts["lidar"],
            frames=self._counts["depth"],
            repeated=self._counts["repeated"],
        )

    def _board(self, reading: Reading, T_map_base: Pose) -> Board | None:
        """What the reading says; None where it says nothing."""
        settings = self._settings
        if isinstance(reading, LaserScan):
            scan = PosedScan.of(reading, self._axes.between(_planar(T_map_base)))
            return lidar_board(scan, settings.lidar, settings.resolution_m)
        T_grid_camera = self._T_grid_camera(reading, T_map_base)
        return depth_board(reading, T_grid_camera, settings.depth, settings.resolution_m, settings.distortion)

    def _T_grid_camera(self, frame: RgbdFrame, T_map_base: Pose) -> FloatArray:
        """Yang2021 Eq. (15)-(16): the chain from the optical frame to the lattice's axes."""
        if frame.T_base_camera is None:
            raise ScanweaveError(
                f"camera {frame.sensor} does not tell where it sits on the robot; "
                "give its mount in the config, or estimate it with fusion.camera_tilt"
            )
        T_map_body = gtsam.Pose3(T_map_base) if isinstance(T_map_base, gtsam.Pose2) else T_map_base
        T_map_camera = T_map_body.compose(frame.T_base_camera)
        T_grid_camera = gtsam.Pose3(self._axes).inverse().compose(T_map_camera)
        return np.asarray(T_grid_camera.matrix())

    def _box(self) -> Box | None:
        """The box that holds all layers."""
        boxes = [tiles.used for tiles in self._tiles.values() if tiles.used is not None]
        if not boxes:
            return None
        box = boxes[0]
        for other in boxes[1:]:
            box = union(box, other)
        return box

    def _check_room(self, box: Box) -> None:
        """Refuse to grow over the limit."""
        held = self._box()
        rows, cols = (box if held is None else union(held, box))[2:]
        if rows * cols > self._settings.max_cells:
            raise ScanweaveError(
                f"the map would have {rows} x {cols} cells of {self._settings.resolution_m:g} m, the limit "
                f"is {self._settings.max_cells}: choose a coarser resolution, or look for a lost pose"
            )


def build_layers(
    keyframes: Iterable[Reading], poses: Sequence[Pose], settings: LayerSettings | None = None
) -> LayeredMap:
    """Build the layers in one pass over keyframes at known poses; their order changes nothing.

    Parameters
    ----------
    keyframes
        Scans and depth images, mixed as they come; one is in memory at a time.
    poses
        ``T_map_base`` of each, in the same order.

    Raises
    ------
    ScanweaveError
        Where there are more or fewer poses than keyframes, and as `LayerBuilder.add` and `finish`.
    """
    builder = LayerBuilder(settings)
    count = 0
    for count, reading in enumerate(keyframes, start=1):
        if count > len(poses):
            raise ScanweaveError(f"more keyframes than their {len(poses)} poses; give one pose a keyframe")
        builder.add(reading, poses[count - 1])
    if count < len(poses):
        raise ScanweaveError(f"{count} keyframes for {len(poses)} poses; give one pose a keyframe")
    return builder.finish()


def _planar(T_map_base: Pose) -> gtsam.Pose2:
    """A pose on the floor."""
    if isinstance(T_map_base, gtsam.Pose2):
        return T_map_base
    return gtsam.Pose2(T_map_base.x(), T_map_base.y(), T_map_base.rotation().yaw())


def _blocks(rows: int) -> Iterator[slice]:
    """Rows in pieces that are small against the map."""
    return (slice(first, min(first + _ROWS_AT_ONCE, rows)) for first in range(0, rows, _ROWS_AT_ONCE))
