"""Draw the README's picture: a simulated home by the lidar alone and with cameras, and a real log below it.

    python tools/readme_picture.py [--work FOLDER] [--log fr079.log.gz] [--source TEXT] [--out FILE]

The home is simulated and mapped once, a few minutes; with ``--work`` drive and maps are kept and used again.
``--log`` adds the map of a log, such as Freiburg building 079, which is not part of a clone.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

import slam
from slam.app.map_folder import Left, left_in
from slam.evaluation.figure_parts import BLUE, ORANGE, figure_of, png_of
from slam.evaluation.truth_comparison import compare_with_truth
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import FloatArray
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS
from slam.storage.nav2 import Nav2Map, read_nav2_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REPO = Path(__file__).parents[1]
RIG, HOME, SEED = RIGS["xu2024"], 3, 7
WIDTH_PX = 1600
GAP_PX, TITLE_PX, FOOT_PX = 24, 44, 36
MARGIN_CELLS = 16
STRAY_SHARE = 0.001  # of the obstacles, at either side: what a beam met far outside
COLORS = 48  # of the palette; the file is a third of the size
WALL, UNSEEN, OPEN = (38, 50, 64), (223, 227, 232), (255, 255, 255)
ONLY_CAMERAS = (217, 115, 13)  # figure_parts.ORANGE
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
        (N, 2) columns and rows of the trajectory, and of the true one where it is known.
    """

    title: str
    image: np.ndarray
    way: FloatArray
    truth: FloatArray | None = None


def main() -> None:
    """Map what is not mapped yet, draw, write."""
    options = parse_options()
    with TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        rows = [home_panels(work)]
        if options.log:
            rows.append([log_panel(options.log, work / "log", options.source)])
        picture = drawn(rows)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    picture.save(options.out, optimize=True)
    print(
        f"wrote {options.out}, {picture.width} x {picture.height}, {options.out.stat().st_size / 1e3:.0f} kB"
    )


def parse_options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, help="folder that keeps the drive and the maps")
    parser.add_argument("--log", type=Path, help="a log of a 2D lidar, drawn below")
    source = "Freiburg building 079 (C. Stachniss)"
    parser.add_argument("--source", default=source, help="where that log is from")
    parser.add_argument("--out", type=Path, default=REPO / "docs" / "images" / "maps.png")
    return parser.parse_args()


def home_panels(work: Path) -> list[Panel]:
    """The home by the lidar alone, and the map to drive by, with the way over it."""
    drive, folder = work / "drive", work / "home"
    if not (drive / "scans.log").is_file():
        record_drive(generate_home(HOME), RIG, SEED, drive, FAULT_PRESETS["usual"], formats=("folder",))
    house = mapped(
        drive,
        folder,
        "dense_map.enabled=false",
        f"layers.robot_height_m={RIG.robot_height_m}",
        f"layers.robot_radius_m={RIG.robot_radius_m}",
    )
    lidar, decision = (read_nav2_map(folder / "layers" / f"{name}.yaml") for name in ("lidar", "decision"))
    truth = slam.open_dataset(drive).groundtruth()
    assert truth is not None
    compared = compare_with_truth(house.trajectory, truth)
    way, true_path = compared.positions_m[:, :2], compared.true_positions_m[:, :2]
    error_cm = 100.0 * compared.error.translation_m.rmse
    house.close()
    seen = window(lidar.values, decision.values)
    both = painted(decision.values)
    both[(decision.values == OCCUPIED) & (lidar.values != OCCUPIED)] = ONLY_CAMERAS
    return [
        Panel("What the 2D lidar sees", painted(lidar.values)[seen], in_cells(way, lidar, seen)),
        Panel(
            f"What lidar and four depth cameras see (ATE {error_cm:.1f} cm)",
            both[seen],
            in_cells(way, decision, seen),
            in_cells(true_path, decision, seen),
        ),
    ]


def log_panel(log: Path, folder: Path, source: str) -> Panel:
    """A real log: its grid and the way, lying on its long side."""
    house = mapped(log, folder)
    grid = house.grid
    assert grid is not None
    states = grid.states()
    seen = window(states)
    way = in_cells(
        house.trajectory.positions_m[:, :2], Nav2Map(states, grid.resolution_m, grid.T_map_grid), seen
    )
    image = painted(states)[seen]
    if image.shape[0] > image.shape[1]:
        image, way = (
            image.transpose(1, 0, 2)[:, ::-1],
            np.column_stack([image.shape[0] - way[:, 1], way[:, 0]]),
        )
    length_m = float(np.linalg.norm(np.diff(house.trajectory.positions_m, axis=0), axis=1).sum())
    house.close()
    return Panel(f"A recorded log: {source}, 2D lidar and wheels, {length_m:.0f} m", image, way)


def mapped(log: Path, folder: Path, *overrides: str) -> slam.Map:
    """The finished map of a log, of an earlier call where there is one."""
    if left_in(folder) is Left.FINISHED:
        return slam.load_map(folder)
    return slam.map_log(log, slam.load_config(overrides=overrides), out=folder, overwrite=True)


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


def drawn(rows: list[list[Panel]]) -> Image.Image:
    """All panels on one page, those of a row at the same scale."""
    scales = [
        (WIDTH_PX - GAP_PX * (len(row) + 1)) / sum(panel.image.shape[1] for panel in row) for row in rows
    ]
    heights = [
        scale * max(p.image.shape[0] for p in row) + TITLE_PX for scale, row in zip(scales, rows, strict=True)
    ]
    height = round(sum(heights) + FOOT_PX + GAP_PX)
    figure = figure_of(WIDTH_PX, height)
    top = float(height)
    for row, scale, used in zip(rows, scales, heights, strict=True):
        left = float(GAP_PX)
        for panel in row:
            wide, tall = scale * panel.image.shape[1], scale * panel.image.shape[0]
            axes = figure.add_axes(
                (left / WIDTH_PX, (top - TITLE_PX - tall) / height, wide / WIDTH_PX, tall / height)
            )
            figure.text(
                left / WIDTH_PX, (top - TITLE_PX + 10) / height, panel.title, fontsize=15, color="#26323f"
            )
            draw(axes, panel, scale)
            left += wide + GAP_PX
        top -= used
    legend(figure.add_axes((GAP_PX / WIDTH_PX, 6 / height, 1 - 2 * GAP_PX / WIDTH_PX, FOOT_PX / height)))
    image = Image.open(io.BytesIO(png_of(figure))).convert("RGB")
    return image.quantize(COLORS, dither=Image.Dither.NONE)


def draw(axes: Axes, panel: Panel, scale: float) -> None:
    """One map."""
    axes.imshow(panel.image, origin="lower", interpolation="nearest", aspect="auto")
    if panel.truth is not None:
        axes.plot(*panel.truth.T, color=TRUTH, linewidth=5.0, solid_capstyle="round")
    axes.plot(*panel.way.T, color=BLUE, linewidth=1.6)
    axes.set_xlim(-0.5, panel.image.shape[1] - 0.5)
    axes.set_ylim(-0.5, panel.image.shape[0] - 0.5)
    axes.set_axis_off()


def legend(axes: Axes) -> None:
    """What the colours mean, in one line."""
    axes.set_axis_off()
    for color, wide, label in (
        (BLUE, 2.0, "estimated trajectory"),
        (TRUTH, 6.0, "true trajectory"),
        (ORANGE, 8.0, "obstacle that only the cameras see"),
        ("#263240", 8.0, "obstacle"),
    ):
        axes.plot([], [], color=color, linewidth=wide, label=label)
    axes.legend(loc="center left", ncols=4, fontsize=13, frameon=False, borderaxespad=0.0)


if __name__ == "__main__":
    main()
