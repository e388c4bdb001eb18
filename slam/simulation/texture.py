"""Computes a colour for every point of the home, independent of the viewpoint.

All patterns are hashed from the point on the surface, so nothing is stored and two cameras agree. A pattern
finer than a pixel fades to its mean, as on a real sensor, to avoid aliasing.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import Float32Array
from slam.simulation.home_model import Home, Style
from slam.simulation.scene import PERSON, PERSON_HEIGHT_M, Hits

_Rgb: TypeAlias = tuple[float, float, float]

_PLASTER, _PLANKS, _TILES, _WOOD = int(Style.PLASTER), int(Style.PLANKS), int(Style.TILES), int(Style.WOOD)
_FABRIC, _BOOKS, _PANELS, _SKY = int(Style.FABRIC), int(Style.BOOKS), int(Style.PANELS), int(Style.SKY)
_PERSON = int(PERSON)
_SKY_RGB = (222.0, 236.0, 250.0)
# Direction of the ceiling lights, from above.
_LIGHT_X, _LIGHT_Y, _LIGHT_Z = 0.36, 0.55, 0.75


def paint(
    home: Home,
    origins_dirs: Float32Array,
    hits: Hits,
    pixel_rad: float,
    person_xy: tuple[float, float] | None = None,
) -> Float32Array:
    """Compute the colour of the surface on each ray.

    Parameters
    ----------
    origins_dirs
        (N, 6) the rays that were cast.
    hits
        Surfaces that they hit.
    pixel_rad
        Angle of a pixel; finer patterns fade.
    person_xy
        Position of the person, so that the clothes move along.

    Returns
    -------
    (N, 3) RGB, 0..255; sky without a surface.
    """
    person = (0.0, 0.0) if person_xy is None else (float(person_xy[0]), float(person_xy[1]))
    return np.asarray(
        _paint(
            origins_dirs,
            hits.range_m,
            hits.triangle,
            hits.obstacle,
            hits.normal,
            home.style_of_triangle,
            home.color_of_triangle,
            pixel_rad,
            person,
        )
    )


@kernel(error_model="numpy")
def _hash(a: int, b: int, c: int) -> float:
    """A number in [0, 1) from three integers."""
    h = np.uint32(a) * np.uint32(0x9E3779B1) ^ np.uint32(b) * np.uint32(0x85EBCA77)
    h = np.uint32(h ^ (np.uint32(c) * np.uint32(0xC2B2AE3D)))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return float(h) * (1.0 / 4294967296.0)


@kernel(error_model="numpy")
def _visible(size_m: float, footprint_m: float) -> float:
    """Contrast of a pattern of this size at this pixel size, 0..1."""
    return min(1.0, max(0.0, size_m / footprint_m - 1.0))


@kernel(error_model="numpy")
def _blocks(u: float, v: float, size_m: float, footprint_m: float, seed: int) -> float:
    """Squares of random brightness, -0.5..0.5: corners for a feature detector."""
    contrast = _visible(size_m, footprint_m)
    if contrast == 0.0:
        return 0.0
    return contrast * (_hash(math.floor(u / size_m), math.floor(v / size_m), seed) - 0.5)


@kernel(error_model="numpy")
def _clouds(u: float, v: float, seed: int) -> float:
    """Smooth noise on a unit lattice, -0.5..0.5."""
    i, j = math.floor(u), math.floor(v)
    a, b = u - i, v - j
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    low = _hash(i, j, seed) * (1.0 - a) + _hash(i + 1, j, seed) * a
    high = _hash(i, j + 1, seed) * (1.0 - a) + _hash(i + 1, j + 1, seed) * a
    return low * (1.0 - b) + high * b - 0.5


@kernel(error_model="numpy")
def _line(at: float, period_m: float, width_m: float, footprint_m: float) -> float:
    """1 on periodic thin lines, 0 between; fainter if a pixel is wider than the line."""
    if at - period_m * math.floor(at / period_m) >= max(width_m, min(footprint_m, 0.25 * period_m)):
        return 0.0
    return min(1.0, width_m / footprint_m)


@kernel(error_model="numpy")
def _poster(u: float, v: float, pixel: float, seed: int) -> tuple[bool, float, float, float]:
    """Posters on a wall in two rows, one for low cameras: whether there is one here, and its colour."""
    row = 0 if v < 1.1 else 1
    low, high = (0.25, 1.0) if row == 0 else (1.2, 2.0)
    column = math.floor(u / 1.15)
    if _hash(column, row, seed + 11) > 0.6:
        return False, 0.0, 0.0, 0.0
    x, y = u - 1.15 * column - 0.1 - 0.25 * _hash(column, row, seed + 12), v - low
    width = 0.35 + 0.35 * _hash(column, row, seed + 13)
    height = (high - low) * (0.55 + 0.45 * _hash(column, row, seed + 14))
    if x < 0.0 or x > width or y < 0.0 or y > height:
        return False, 0.0, 0.0, 0.0
    if min(x, width - x, y, height - y) < 0.02:
        return True, 40.0, 36.0, 34.0
    size = 0.05 + 0.06 * _hash(column, row, seed + 15)
    i, j = math.floor(x / size), math.floor(y / size)
    key = seed + 977 * column + 31 * row
    contrast = _visible(size, pixel)
    red = 128.0 + contrast * 210.0 * (_hash(i, j, key) - 0.5)
    green = 128.0 + contrast * 210.0 * (_hash(i, j, key + 1) - 0.5)
    return True, red, green, 128.0 + contrast * 210.0 * (_hash(i, j, key + 2) - 0.5)


@kernel(error_model="numpy")
def _plaster(u: float, v: float, pixel: float, seed: int, color: _Rgb) -> _Rgb:
    """A wall: wallpaper, stains, a skirting board, pictures."""
    here, red, green, blue = _poster(u, v, pixel, seed)
    if here:
        return red, green, blue
    light = 1.0 + 0.16 * _clouds(u / 0.7, v / 0.7, seed) + 0.14 * _blocks(u, v, 0.13, pixel, seed + 1)
    light += 0.12 * _blocks(u, v, 0.03, pixel, seed + 2)
    if v < 0.08:
        light *= 0.55
    return light * color[0], light * color[1], light * color[2]


@kernel(error_model="numpy")
def _books(u: float, v: float, pixel: float, seed: int, color: _Rgb) -> _Rgb:
    """Shelves of upright books."""
    shelf = math.floor(v / 0.33)
    inside = v / 0.33 - shelf
    if inside < 0.08:
        return color
    book = math.floor(u / 0.042)
    if inside > 0.62 + 0.34 * _hash(book, shelf, seed):
        return 0.25 * color[0], 0.25 * color[1], 0.25 * color[2]
    contrast = _visible(0.042, pixel)
    band = 0.7 if 0.4 < inside < 0.5 and _hash(book, shelf, seed + 4) < 0.5 else 1.0
    red = band * (120.0 + contrast * 200.0 * (_hash(book, shelf, seed + 1) - 0.5))
    green = band * (110.0 + contrast * 180.0 * (_hash(book, shelf, seed + 2) - 0.5))
    return red, green, band * (105.0 + contrast * 180.0 * (_hash(book, shelf, seed + 3) - 0.5))


@kernel(error_model="numpy")
def _brightness(style: int, u: float, v: float, pixel: float, seed: int) -> float:
    """Patterns that change only the brightness of a surface."""
    if style == _PLANKS:
        row = math.floor(v / 0.14)
        plank = math.floor((u + 1.2 * _hash(row, 0, seed)) / 1.2)
        gap = _line(v, 0.14, 0.005, pixel) + _line(u + 1.2 * _hash(row, 0, seed), 1.2, 0.005, pixel)
        light = 0.8 + 0.4 * _hash(row, plank, seed + 1) + 0.2 * _blocks(u, v, 0.047, pixel, seed + 2)
        return (light + 0.2 * _clouds(u / 0.3, v / 0.03, seed) * _visible(0.03, pixel)) * (1.0 - 0.5 * gap)
    if style == _TILES:
        gap = min(1.0, _line(u, 0.3, 0.008, pixel) + _line(v, 0.3, 0.008, pixel))
        light = 1.0 + 0.3 * _blocks(u, v, 0.3, pixel, seed) + 0.16 * _blocks(u, v, 0.05, pixel, seed + 1)
        return light * (1.0 - 0.4 * gap)
    if style == _WOOD:
        gap = _line(u, 0.47, 0.006, pixel)
        light = 1.0 + 0.4 * _clouds(u / 0.05, v / 0.5, seed) * _visible(0.05, pixel)
        return (light + 0.25 * _blocks(u, v, 0.08, pixel, seed + 1)) * (1.0 - 0.6 * gap)
    if style == _FABRIC:
        light = 1.0 + 0.55 * _blocks(u, v, 0.1, pixel, seed) + 0.3 * _blocks(u, v, 0.035, pixel, seed + 1)
        return light + 0.15 * _clouds(u / 0.4, v / 0.4, seed)
    if style == _PANELS:
        gap = min(1.0, _line(u, 0.6, 0.012, pixel) + _line(v, 0.6, 0.012, pixel))
        light = 1.0 + 0.08 * _blocks(u, v, 0.6, pixel, seed) + 0.08 * _blocks(u, v, 0.04, pixel, seed + 1)
        return light * (1.0 - 0.35 * gap)
    light = 1.0 + 0.2 * _clouds(u / 0.35, v / 0.35, seed)
    if _hash(math.floor(u / 0.22), math.floor(v / 0.22), seed + 1) < 0.3:  # a label
        light += 0.5 * _blocks(u, v, 0.05, pixel, seed + 2)
    return light


@kernel(error_model="numpy")
def _dress(u: float, z: float, pixel: float) -> _Rgb:
    """The person: trousers, shirt, face."""
    light = 1.0 + 0.4 * _blocks(u, z, 0.07, pixel, 71)
    if z < 0.85:
        return 58.0 * light, 66.0 * light, 96.0 * light
    if z < 1.45:
        return 178.0 * light, 64.0 * light, 58.0 * light
    return 206.0 * light, 160.0 * light, 130.0 * light


@kernel(error_model="numpy")
def _side(nx: float, ny: float, nz: float) -> int:
    """Index of the side of a box with this normal."""
    if abs(nz) > 0.7:
        return 4 if nz > 0.0 else 5
    if abs(nx) > abs(ny):
        return 0 if nx > 0.0 else 1
    return 2 if ny > 0.0 else 3


@kernel(nogil=True, error_model="numpy")
def _paint(
    rays: Float32Array,
    range_m: Float32Array,
    triangle: NDArray[np.int32],
    obstacle: NDArray[np.int32],
    normal: Float32Array,
    style_of_triangle: NDArray[np.uint8],
    color_of_triangle: NDArray[np.uint8],
    pixel_rad: float,
    person: tuple[float, float],
) -> Float32Array:
    """See `paint`."""
    image = np.empty((range_m.size, 3), np.float32)
    for ray in range(range_m.size):
        t = float(range_m[ray])
        face = triangle[ray]
        if not t < math.inf or (face >= 0 and style_of_triangle[face] == _SKY):
            image[ray, 0], image[ray, 1], image[ray, 2] = _SKY_RGB
            continue
        dx, dy, dz = float(rays[ray, 3]), float(rays[ray, 4]), float(rays[ray, 5])
        x, y, z = rays[ray, 0] + t * dx, rays[ray, 1] + t * dy, rays[ray, 2] + t * dz
        nx, ny, nz = float(normal[ray, 0]), float(normal[ray, 1]), float(normal[ray, 2])
        facing = abs(nx * dx + ny * dy + nz * dz)
        # At a slant, a pixel covers more of the surface in one direction only, therefore the square root.
        pixel = t * pixel_rad / math.sqrt(max(facing, 0.04))
        light = 0.66 + 0.3 * max(0.0, _LIGHT_X * nx + _LIGHT_Y * ny + _LIGHT_Z * nz)
        if face == _PERSON:
            around = 0.25 * math.atan2(y - person[1], x - person[0])
            color = _dress(around, min(z, PERSON_HEIGHT_M), pixel)
        else:
            base = color_of_triangle[face]
            color = (float(base[0]), float(base[1]), float(base[2]))
            flat = abs(nz) > 0.7
            u, v = (x, y) if flat else (y * nx - x * ny, z)
            # One pattern per side of an obstacle, independent of its parts.
            seed = 8 * obstacle[ray] + _side(nx, ny, nz)
            style = int(style_of_triangle[face])
            if style == _PLASTER:
                color = _plaster(u, v, pixel, 64 * seed, color)
            elif style == _BOOKS and not flat:
                color = _books(u, v, pixel, 64 * seed, color)
            else:
                light *= _brightness(style, u, v, pixel, 64 * seed)
        image[ray, 0], image[ray, 1], image[ray, 2] = light * color[0], light * color[1], light * color[2]
    return image
