"""Tags on the walls of a home: their poses, and their images in a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from slam.config.tags import KnownPlaces, SurveyedPlace
from slam.errors import ConfigError
from slam.measurements import BoolArray, CameraIntrinsics, Float32Array, FloatArray
from slam.simulation.home_model import Home, WallTag
from slam.simulation.scene import Scene
from slam.simulation.sensor_clock import generator
from slam.vision.tags import tag_cells

# Height of their centres, and free space in front of a tag for a robot.
_Z_M, _FREE_M = (0.7, 1.3), 1.2
# A tag is visible between these distances, within 20 degrees of the robot's heading, below 60 degrees slant.
_NEAR_M, _AHEAD, _FACING = (0.8, 2.5), 0.94, 0.5
_FAMILY, _CANDIDATES_A_WALL = "36h11", 12
# Printed black and white, of 255; rays per pixel along an edge; depth of the paper.
_INK, _PAPER, _RAYS, _THICK_M = 25.0, 225.0, 4, 0.01


def place_tags(home: Home, count: int, seed: int, path_xyt: FloatArray, side_m: float = 0.16) -> Home:
    """A home with tags on its walls, far from each other, each visible from the robot's path.

    Parameters
    ----------
    path_xyt
        (n, 3) x, y, yaw along the robot's path.

    Raises
    ------
    ConfigError
        If there are not enough free places.
    """
    rng, scene = generator(seed, "tags"), Scene(home)
    places = [place for room in home.rooms for place in _places(room.rectangle, rng)]
    places = [place for place in places if _is_seen(place, path_xyt)]
    free = [place for place in places if _is_free(scene, place, 0.5 * side_m * 1.5)]
    if len(free) < count:
        raise ConfigError(
            f"the robot sees {len(free)} free places for {count} tags; drive longer, or hang fewer"
        )
    at = np.array([place.translation() for place in free])
    chosen = [int(rng.integers(len(free)))]
    while len(chosen) < count:  # the place farthest from those already chosen
        apart_m = np.linalg.norm(at[:, None] - at[chosen], axis=2).min(axis=1)
        chosen.append(int(apart_m.argmax()))
    cells = [tag_cells(_FAMILY, number) for number in range(count)]
    tags = [WallTag(n, free[place], side_m, cells[n]) for n, place in enumerate(chosen)]
    return replace(home, tags=tuple(tags))


def known_places(tags: Sequence[WallTag]) -> KnownPlaces:
    """The survey of the tags: every second one is a check point."""
    surveyed = [
        SurveyedPlace(
            tag=tag.number,
            at_m=tuple(np.round(tag.T_map_tag.translation(), 4).tolist()),
            sigma_m=0.001,
            check=bool(rank % 2),
        )
        for rank, tag in enumerate(tags)
    ]
    return KnownPlaces(family=_FAMILY, size_m=tags[0].side_m, surveyed=tuple(surveyed))


def paint_tags(
    image: Float32Array,
    range_m: Float32Array,
    tags: Sequence[WallTag],
    T_world_camera: gtsam.Pose3,
    intrinsics: CameraIntrinsics,
) -> None:
    """Draw tags in a camera image with several rays per pixel, because edges define the corners.

    Parameters
    ----------
    image
        (H * W, 3) RGB 0..255, changed in place.
    range_m
        (H * W,) depth of the surfaces at the pixels.
    """
    height, width = intrinsics.height, intrinsics.width
    for tag in tags:
        T_camera_tag = T_world_camera.between(tag.T_map_tag)
        turn, place = np.asarray(T_camera_tag.rotation().matrix()), np.asarray(T_camera_tag.translation())
        across, normal = len(tag.cells) * tag.side_m / (len(tag.cells) - 2), turn[:, 2]
        rim = 0.5 * across * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ turn.T + place
        if rim[:, 2].min() < 0.05 or normal @ place >= 0.0:
            continue
        pixels = rim[:, :2] / rim[:, 2:] * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
        low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 1, 0, [width, height])
        high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 2, 0, [width, height])
        columns, rows = (
            n.ravel() for n in np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)))
        )
        middle = _rays(columns, rows, intrinsics)
        wall_m = (normal @ place) / (middle @ normal)
        index = rows * width + columns
        on_wall = np.abs(range_m[index] - wall_m) < _THICK_M * (1.0 + wall_m)
        index, columns, rows = index[on_wall], columns[on_wall], rows[on_wall]
        inside, brightness = np.zeros(len(index)), np.zeros(len(index))
        offsets = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
        for right in offsets:
            for down in offsets:
                rays = _rays(columns + right, rows + down, intrinsics)
                points = (rays * ((normal @ place) / (rays @ normal))[:, None] - place) @ turn
                value, hit = _ink_at(points[:, :2], tag.cells, across)
                inside += hit
                brightness += value * hit
        share = (inside / _RAYS**2)[:, None]
        light = 0.66 + 0.3 * share  # brightness of paper, independent of the wall
        drawn = np.where(inside > 0, brightness / np.maximum(inside, 1), 0.0)[:, None]
        image[index] = (1.0 - share) * image[index] + share * light * drawn


def _rays(columns: FloatArray, rows: FloatArray, intrinsics: CameraIntrinsics) -> FloatArray:
    """(N, 3) directions of pixels, z = 1."""
    x, y = (columns - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy
    return np.column_stack([x, y, np.ones_like(x)])


def _ink_at(points_m: FloatArray, cells: BoolArray, across_m: float) -> tuple[FloatArray, BoolArray]:
    """Brightness (N,) of points, and whether they are on the paper; the first row of cells is on top."""
    place = (points_m * [1.0, -1.0] / across_m + 0.5) * len(cells)
    cell = np.floor(place).astype(int)
    hit: BoolArray = np.all((cell >= 0) & (cell < len(cells)), axis=1)
    cell = np.clip(cell, 0, len(cells) - 1)
    return np.where(cells[cell[:, 1], cell[:, 0]], _PAPER, _INK), hit


def _places(rectangle: tuple[float, float, float, float], rng: np.random.Generator) -> list[gtsam.Pose3]:
    """Possible tag poses in a room: x to the right as seen by a viewer, y up, z out of the wall."""
    x0, y0, x1, y1 = rectangle
    places = list[gtsam.Pose3]()
    for _ in range(_CANDIDATES_A_WALL):
        x, y, z = rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(*_Z_M)
        walls = (((x0, y), (1.0, 0.0)), ((x1, y), (-1.0, 0.0)), ((x, y0), (0.0, 1.0)), ((x, y1), (0.0, -1.0)))
        for at, out in walls:
            axes = np.array([[-out[1], out[0], 0.0], [0.0, 0.0, 1.0], [*out, 0.0]]).T
            places.append(gtsam.Pose3(gtsam.Rot3(axes), np.array([*at, z])))
    return places


def _is_seen(place: gtsam.Pose3, path_xyt: FloatArray) -> bool:
    """Whether the robot comes close, looks at it, and sees it without too much slant."""
    offset = np.asarray(place.translation())[:2] - path_xyt[:, :2]
    far_m, out = np.linalg.norm(offset, axis=1), np.asarray(place.rotation().matrix())[:2, 2]
    ahead = np.sum(offset * np.column_stack([np.cos(path_xyt[:, 2]), np.sin(path_xyt[:, 2])]), axis=1)
    in_range = (far_m > _NEAR_M[0]) & (far_m < _NEAR_M[1])
    return bool(np.any(in_range & (ahead > _AHEAD * far_m) & (-offset @ out > _FACING * far_m)))


def _is_free(scene: Scene, place: gtsam.Pose3, half_m: float) -> bool:
    """Whether the wall is flat there, and nothing is in front of it."""
    corners = np.array([[x, y, _FREE_M] for x in (-half_m, 0.0, half_m) for y in (-half_m, 0.0, half_m)])
    origins = np.array([place.transformFrom(corner) for corner in corners])
    inward = np.tile(-np.asarray(place.rotation().matrix())[:, 2], (len(corners), 1))
    hits = scene.cast(np.hstack([origins, inward]).astype(np.float32))
    kinds = {scene.home.obstacles[int(n)].kind for n in hits.obstacle if n >= 0}
    matte = bool((hits.material == 0).all())
    return kinds == {"wall"} and matte and bool(np.abs(hits.range_m - _FREE_M).max() < 1e-3)
