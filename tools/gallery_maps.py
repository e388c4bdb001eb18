"""Maps for the gallery: simulates and maps what is needed, and draws a grid with a path."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

import slam
from slam.app.map_folder import Left, left_in
from slam.evaluation.figure_parts import BLUE, figure_of, png_of
from slam.evaluation.trajectory_error import compare_with_truth
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import FloatArray
from slam.simulation.campus import record_campus
from slam.simulation.campus_wheels import CAMPUS_FAULTS
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS, Rig
from slam.storage.nav2 import Nav2Map, read_nav2_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RIG, HOME, SEED = RIGS["xu2024"], 3, 7
CAMPUS = 1
WIDTH_PX = 1600
GAP_PX, TITLE_PX, FOOT_PX = 24, 44, 36
MARGIN_CELLS = 16
STRAY_SHARE = 0.001  # of the obstacles, on either side, which beams hit far outside
COLORS = 64  # of the palette; the file is a third of the size
WALL, UNSEEN, OPEN = (38, 50, 64), (223, 227, 232), (255, 255, 255)
INK = "#26323f"
TRUTH = "#8fd0a5"


@dataclass(frozen=True)
class Panel:
    """A map to draw.

    Attributes
    ----------
    title
        Above it.
    image
        (rows, cols, 3), row 0 at the lowest y.
    way, truth
        (N, 2) columns and rows of the trajectory, and of the true one, where they are drawn.
    """

    title: str
    image: np.ndarray
    way: FloatArray | None = None
    truth: FloatArray | None = None


class Work:
    """Drives and maps that the pictures are made of, in a folder; what is there is used again.

    Parameters
    ----------
    folder
        Keeps them.
    log
        Of a 2D lidar, such as Freiburg building 079, which is not part of a clone; None: its pictures stay.
    """

    def __init__(self, folder: Path, log: Path | None, source: str) -> None:
        self.folder, self.log, self.source = folder, log, source

    @cached_property
    def drive(self) -> Path:
        """A tour of a home by a robot with a lidar and four depth cameras."""
        return self._driven(self.folder / "drive", RIG, SEED)

    @cached_property
    def home(self) -> Path:
        """The map of that drive."""
        sizes = (
            f"layers.robot_height_m={RIG.robot_height_m}",
            f"layers.robot_radius_m={RIG.robot_radius_m}",
        )
        return self._mapped(self.drive, "home", *sizes)

    def visit(self, seed: int) -> Path:
        """A tour of the same home by a robot with a good 2D lidar."""
        return self._driven(self.folder / f"visit{seed}", RIGS["sick2d"], seed)

    @cached_property
    def rooms(self) -> Path:
        """The map of another home, divided into rooms."""
        return self._mapped(self._driven(self.folder / "tour", RIGS["sick2d"], 1, home=1), "rooms")

    @cached_property
    def visited(self) -> Path:
        """The map of the first such visit."""
        return self._mapped(self.visit(1), "visited")

    def campus(self, *, loops: bool) -> Path:
        """The map of a campus of corridors, with loops or without."""
        drive = self.folder / "campus"
        if not (drive / "scans.log").is_file():
            record_campus(CAMPUS, CAMPUS, drive, CAMPUS_FAULTS["usual"])
        return self._mapped(drive, f"campus-loops-{loops}", f"loops.enabled={str(loops).lower()}")

    @cached_property
    def recorded(self) -> Path:
        """The map of the log."""
        assert self.log is not None
        return self._mapped(self.log, "log")

    def _driven(self, folder: Path, rig: Rig, seed: int, home: int = HOME) -> Path:
        if not (folder / "scans.log").is_file():
            record_drive(generate_home(home), rig, seed, folder, FAULT_PRESETS["usual"], formats=("folder",))
        return folder

    def _mapped(self, log: Path, name: str, *overrides: str) -> Path:
        folder = self.folder / name
        if left_in(folder) is not Left.FINISHED:
            slam.map_log(log, slam.load_config(overrides=overrides), out=folder, overwrite=True).close()
        return folder


def aligned(house: slam.Map, drive: Path) -> tuple[FloatArray, FloatArray, float]:
    """(N, 2) way and true way on the map, and the RMSE of the way in metres."""
    truth = slam.open_dataset(drive).groundtruth()
    assert truth is not None
    compared = compare_with_truth(house.trajectory, truth)
    way, true_way = compared.positions_m[:, :2], compared.true_positions_m[:, :2]
    return way, true_way, compared.error.translation_m.rmse


def layer(folder: Path, name: str) -> Nav2Map:
    """A layer of a map on disk."""
    return read_nav2_map(folder / "layers" / f"{name}.yaml")


def lying(house: slam.Map, title: str) -> Panel:
    """A map's grid and its way, lying on its long side."""
    grid = house.grid
    assert grid is not None
    states = grid.states()
    seen = window(states)
    positions_m = house.trajectory.positions_m
    way = in_cells(positions_m[:, :2], Nav2Map(states, grid.resolution_m, grid.T_map_grid), seen)
    image = painted(states)[seen]
    if image.shape[0] > image.shape[1]:
        rows = image.shape[0]
        image, way = image.transpose(1, 0, 2)[:, ::-1], np.column_stack([rows - way[:, 1], way[:, 0]])
    return Panel(title, image, way)


def window(*layers: StateArray) -> tuple[slice, slice]:
    """The part of the layers in which obstacles are, and a margin."""
    found = np.argwhere(np.maximum.reduce(layers) == OCCUPIED)
    low, high = np.quantile(found, (STRAY_SHARE, 1.0 - STRAY_SHARE), axis=0)
    low = np.maximum(low - MARGIN_CELLS, 0)
    high = np.minimum(high + MARGIN_CELLS + 1, layers[0].shape)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


def painted(states: StateArray) -> np.ndarray:
    """(rows, cols, 3) walls, free and unknown cells."""
    image = np.empty((*states.shape, 3), dtype=np.uint8)
    image[:] = UNSEEN
    image[states == FREE] = OPEN
    image[states == OCCUPIED] = WALL
    return image


def in_cells(points_map: FloatArray, grid: Nav2Map, seen: tuple[slice, slice]) -> FloatArray:
    """(N, 2) columns and rows of (N, 2) points, in a window of the grid."""
    corner = grid.T_map_grid
    local = (points_map - corner.translation()) @ corner.rotation().matrix() / grid.resolution_m
    return local - (seen[1].start, seen[0].start) - 0.5


def page(panels: Sequence[Panel], legend: Sequence[tuple[str, float, str]]) -> Image.Image:
    """Panels beside each other at one scale, a legend of (color, width, label) below."""
    wide = sum(panel.image.shape[1] for panel in panels)
    scale = (WIDTH_PX - GAP_PX * (len(panels) + 1)) / wide
    tall = scale * max(panel.image.shape[0] for panel in panels)
    height = round(tall + TITLE_PX + FOOT_PX + GAP_PX)
    figure, left = figure_of(WIDTH_PX, height), float(GAP_PX)
    for panel in panels:
        size = scale * panel.image.shape[1], scale * panel.image.shape[0]
        corner = left / WIDTH_PX, (height - TITLE_PX - size[1]) / height
        axes = figure.add_axes((*corner, size[0] / WIDTH_PX, size[1] / height))
        figure.text(corner[0], (height - TITLE_PX + 10) / height, panel.title, fontsize=15, color=INK)
        draw(axes, panel)
        left += size[0] + GAP_PX
    foot = figure.add_axes((GAP_PX / WIDTH_PX, 6 / height, 1 - 2 * GAP_PX / WIDTH_PX, FOOT_PX / height))
    foot.set_axis_off()
    for color, width, label in legend:
        foot.plot([], [], color=color, linewidth=width, label=label)
    foot.legend(loc="center left", ncols=len(legend), fontsize=13, frameon=False, borderaxespad=0.0)
    return small(figure)


def draw(axes: Axes, panel: Panel) -> None:
    """One map."""
    axes.imshow(panel.image, origin="lower", interpolation="nearest", aspect="auto")
    if panel.truth is not None:
        axes.plot(*panel.truth.T, color=TRUTH, linewidth=5.0, solid_capstyle="round")
    if panel.way is not None:
        axes.plot(*panel.way.T, color=BLUE, linewidth=1.6)
    axes.set_xlim(-0.5, panel.image.shape[1] - 0.5)
    axes.set_ylim(-0.5, panel.image.shape[0] - 0.5)
    axes.set_axis_off()


def small(figure: Figure) -> Image.Image:
    """A figure as an image of few colours."""
    image = Image.open(io.BytesIO(png_of(figure))).convert("RGB")
    return image.quantize(COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
