"""Faults that act on single readings: holes and burrs, each with its cause as ground truth.

One model applies to lidars and depth cameras: a scan is an image of one row. `FaultConfig` contains the
differences.
Sensor noise and quantisation are no faults; they are added later (`slam.simulation.sensors`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.errors import ConfigError
from slam.measurements import BoolArray, Float32Array
from slam.simulation.fault_kernels import depth_edges, stereo_shadow
from slam.simulation.home_model import Int32Array, Material

FaultMask = NDArray[np.uint8]


class Fault(IntEnum):
    """Reason why a reading is not the distance of the first surface: missing (hole) or wrong (burr)."""

    NONE = 0
    HOLE_GLASS = 1  # no return from glass
    HOLE_DARK = 2  # the surface absorbs the light
    HOLE_RANGE = 3  # nearer or farther than the sensor measures, or nothing there
    HOLE_BACKLIGHT = 4  # daylight blinds the camera
    HOLE_RANDOM = 5
    HOLE_GRAZING = 6  # the surface is seen at a grazing angle
    HOLE_SHADOW = 7  # occluded for the projector or the second camera
    BURR_EDGE = 8  # flying pixel between foreground and background
    BURR_MULTIPATH = 9  # multipath: too far
    THROUGH_GLASS = 10  # the reading is of the surface behind the glass
    PERSON = 11  # a correct reading of a moving object


@dataclass(frozen=True, slots=True)
class FaultConfig:
    """Rates and conditions of faults; all zeros disable everything except the sensor's range.

    Attributes
    ----------
    glass_mirror_cos
        Glass returns the beam if the cosine of incidence is above this; 1 or more: never.
    glass_hole_share
        Share of the other readings of glass without return; the others see what is behind.
    dark_range_m
        Beyond this, dark surfaces give no return; from half of it on, with increasing probability. A slanted
        surface counts as farther. 0: dark surfaces are like all others.
    grazing_cos, grazing_hole_share
        Below this cosine of incidence, this share of the readings is lost.
    backlight_reach, backlight_hole_share
        Around a window, up to this many readings, this share of the patches is lost; the window itself is
        lost completely. 0: the sensor sees through windows as through glass.
    random_hole_share
        Share of all readings, independently.
    edge_jump_m, edge_jump_share, edge_burr_share
        Definition of an edge, see `depth_edges`, and the share of readings there that become burrs.
    multipath_share, multipath_m
        Share of the patches on shiny surfaces that are too far, and the minimum and maximum error.
    shadow_focal_baseline_px_m
        Focal length times baseline of a stereo or structured-light camera; 0: one view, no shadow.
    patch
        Side, in readings, of patches with a common fault, because faults of light are blobs.
    """

    glass_mirror_cos: float = 1.0
    glass_hole_share: float = 0.0
    dark_range_m: float = 0.0
    grazing_cos: float = 0.0
    grazing_hole_share: float = 0.0
    backlight_reach: int = 0
    backlight_hole_share: float = 0.0
    random_hole_share: float = 0.0
    edge_jump_m: float = 0.1
    edge_jump_share: float = 0.03
    edge_burr_share: float = 0.0
    multipath_share: float = 0.0
    multipath_m: tuple[float, float] = (0.05, 0.4)
    shadow_focal_baseline_px_m: float = 0.0
    patch: int = 1

    def __post_init__(self) -> None:
        shares = [name for name in self.__dataclass_fields__ if name.endswith("share")]
        for name in shares:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)}; give a share from 0 to 1")
        if self.patch < 1:
            raise ConfigError(f"patch is {self.patch}; give 1 or more readings")


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Surfaces on the ray of each reading, all arrays (H, W).

    Attributes
    ----------
    distance_m, behind_m
        First surface, and first one that is not glass; ``inf`` if there is none.
    material
        `Material` of the first surface.
    cos_incidence
        0 for a grazing ray, 1 for a right angle.
    face
        One number for each flat face.
    person
        Whether the first surface is the person.
    """

    distance_m: Float32Array
    behind_m: Float32Array
    material: NDArray[np.uint8]
    cos_incidence: Float32Array
    face: Int32Array
    person: BoolArray


@dataclass(frozen=True, slots=True)
class FaultyReadings:
    """Distances before noise, ``nan`` in a hole, and the `Fault` behind each reading, both (H, W)."""

    distance_m: Float32Array
    fault: FaultMask


NO_FAULTS = FaultConfig()


def corrupt(
    surfaces: Surfaces,
    config: FaultConfig,
    range_min_m: float,
    range_max_m: float,
    rng: np.random.Generator,
) -> FaultyReadings:
    """Apply all faults, in the order of their causes along the light path.

    A reading keeps its first hole; a hole overrides a burr.

    Parameters
    ----------
    range_min_m, range_max_m
        Distances outside are holes.
    rng
        Used in a fixed order, so that equal seeds give equal faults.
    """
    distance = surfaces.distance_m.copy()
    fault: FaultMask = surfaces.person * np.uint8(Fault.PERSON)
    _meet_glass(distance, fault, surfaces, config, range_max_m, rng)
    _burr_edges(distance, fault, surfaces, config, rng)
    _reflect(distance, fault, surfaces, config, rng)
    for cause, lost in (
        (Fault.HOLE_BACKLIGHT, _blinded(surfaces, config, rng)),
        (Fault.HOLE_RANGE, ~((distance >= range_min_m) & (distance <= range_max_m))),
        (Fault.HOLE_DARK, _swallowed(surfaces, config, rng)),
        (Fault.HOLE_GRAZING, _too_slanted(surfaces, config, rng)),
        (Fault.HOLE_SHADOW, _in_shadow(surfaces, config)),
        (Fault.HOLE_RANDOM, _lost_at_random(distance.shape, config, rng)),
    ):
        if lost is not None:
            hole = lost & ~np.isnan(distance)
            np.copyto(distance, np.nan, where=hole)
            np.copyto(fault, np.uint8(cause), where=hole)
    return FaultyReadings(distance, fault)


def _patches(shape: tuple[int, ...], patch: int, rng: np.random.Generator) -> Float32Array:
    """(H, W) uniform numbers that are equal within patches; the lattice of patches has a random offset."""
    if patch == 1:
        return rng.random(shape, dtype=np.float32)
    shift = rng.integers(patch, size=2)
    rows, cols = ((np.arange(n) + s) // patch for n, s in zip(shape, shift, strict=True))
    coarse = rng.random((int(rows[-1]) + 1, int(cols[-1]) + 1), dtype=np.float32)
    return np.asarray(coarse[rows][:, cols])


def _meet_glass(
    distance: Float32Array,
    fault: FaultMask,
    surfaces: Surfaces,
    config: FaultConfig,
    range_max_m: float,
    rng: np.random.Generator,
) -> None:
    """Glass reflects the beam back only near a right angle; else it is lost, or goes through."""
    if config.glass_mirror_cos >= 1.0 and config.glass_hole_share == 0.0:
        return  # for this sensor, glass is like any wall
    glass = surfaces.material == Material.GLASS
    if config.backlight_reach == 0:
        glass |= surfaces.material == Material.WINDOW
    glass &= surfaces.cos_incidence < config.glass_mirror_cos
    if not glass.any():
        return
    lost = glass & (_patches(distance.shape, config.patch, rng) < config.glass_hole_share)
    lost |= glass & ~(surfaces.behind_m <= range_max_m)
    through = glass & ~lost
    distance[through], fault[through] = surfaces.behind_m[through], Fault.THROUGH_GLASS
    distance[lost], fault[lost] = np.nan, Fault.HOLE_GLASS


def _burr_edges(
    distance: Float32Array,
    fault: FaultMask,
    surfaces: Surfaces,
    config: FaultConfig,
    rng: np.random.Generator,
) -> None:
    """A reading at an edge mixes foreground and background: a flying point between them."""
    if config.edge_burr_share == 0.0:
        return
    edge, fore, back = depth_edges(
        surfaces.distance_m, surfaces.face, config.edge_jump_m, config.edge_jump_share
    )
    # Glass mixes by other rules.
    places = np.flatnonzero(edge & (fault != Fault.THROUGH_GLASS) & (fault != Fault.HOLE_GLASS))
    places = places[rng.random(places.size) < config.edge_burr_share]
    before, behind = fore.ravel()[places], back.ravel()[places]
    mixed = before + (behind - before) * rng.uniform(0.1, 0.9, places.size)
    distance.ravel()[places], fault.ravel()[places] = mixed, Fault.BURR_EDGE


def _reflect(
    distance: Float32Array,
    fault: FaultMask,
    surfaces: Surfaces,
    config: FaultConfig,
    rng: np.random.Generator,
) -> None:
    """Patches of a shiny surface appear behind it."""
    shiny = surfaces.material == Material.SHINY
    if config.multipath_share == 0.0 or not shiny.any():
        return
    chosen = _patches(distance.shape, config.patch, rng)
    places = shiny & (chosen < config.multipath_share)
    # The selected numbers are uniform below the share, so they also define the amount.
    low, high = config.multipath_m
    distance[places] += low + (high - low) * chosen[places] / config.multipath_share
    fault[places] = Fault.BURR_MULTIPATH


def _blinded(surfaces: Surfaces, config: FaultConfig, rng: np.random.Generator) -> BoolArray | None:
    """A window, and patches around it."""
    window = surfaces.material == Material.WINDOW
    if config.backlight_reach == 0 or not window.any():
        return None
    patch = config.patch
    height, width = window.shape
    rows, cols = -(-height // patch), -(-width // patch)
    padded = np.zeros((rows * patch, cols * patch), dtype=bool)
    padded[:height, :width] = window
    coarse = padded.reshape(rows, patch, cols, patch).any(axis=(1, 3))
    around = np.asarray(
        ndimage.binary_dilation(np.asarray(coarse), iterations=-(-config.backlight_reach // patch))
    )
    around &= rng.random(coarse.shape) < config.backlight_hole_share
    halo = np.repeat(np.repeat(around, patch, axis=0), patch, axis=1)[:height, :width]
    return np.asarray(window | halo)


def _swallowed(surfaces: Surfaces, config: FaultConfig, rng: np.random.Generator) -> BoolArray | None:
    """Dark surfaces, with a probability that increases with distance and slant."""
    dark = surfaces.material == Material.DARK
    if config.dark_range_m == 0.0 or not dark.any():
        return None
    seen_as = surfaces.distance_m / np.sqrt(np.maximum(surfaces.cos_incidence, 0.01))
    chance = np.clip(2.0 * seen_as / config.dark_range_m - 1.0, 0.0, 1.0)
    return np.asarray(dark & (_patches(dark.shape, config.patch, rng) < chance))


def _too_slanted(surfaces: Surfaces, config: FaultConfig, rng: np.random.Generator) -> BoolArray | None:
    """Surfaces at a grazing angle."""
    if config.grazing_hole_share == 0.0:
        return None
    slanted = (surfaces.cos_incidence < config.grazing_cos) & np.isfinite(surfaces.distance_m)
    return slanted & (_patches(slanted.shape, config.patch, rng) < config.grazing_hole_share)


def _in_shadow(surfaces: Surfaces, config: FaultConfig) -> BoolArray | None:
    """Areas that only one view sees."""
    if config.shadow_focal_baseline_px_m == 0.0:
        return None
    return np.asarray(stereo_shadow(surfaces.distance_m, config.shadow_focal_baseline_px_m))


def _lost_at_random(
    shape: tuple[int, ...], config: FaultConfig, rng: np.random.Generator
) -> BoolArray | None:
    """Single readings."""
    if config.random_hole_share == 0.0:
        return None
    return np.asarray(rng.random(shape, dtype=np.float32) < config.random_hole_share)
