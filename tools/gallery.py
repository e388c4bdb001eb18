"""Draw the pictures of README.md and docs/ anew.

    python tools/gallery.py [NAME...] [--work FOLDER] [--log fr079.log.gz] [--source TEXT]

Without names all. What they need is simulated and mapped once, some ten minutes; with ``--work`` that is
kept and used again. ``--log`` is a recorded log, such as Freiburg building 079, which is not part of a clone:
without it its picture stays as it is. The picture of the report asks for Chromium and Playwright.
"""

from __future__ import annotations

import io
import shutil
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import gallery_concepts as concepts
import numpy as np
from architecture import drawing
from gallery_maps import (
    TRUTH,
    Panel,
    Work,
    aligned,
    in_cells,
    layer,
    lying,
    page,
    painted,
    window,
)
from PIL import Image

import slam
from slam.evaluation.figure_parts import BLUE, ORANGE
from slam.evaluation.saved_page import saved_page
from slam.mapping.occupancy_grid import OCCUPIED

REPO = Path(__file__).parents[1]
IMAGES = REPO / "docs" / "images"
ONLY_CAMERAS = (217, 115, 13)  # figure_parts.ORANGE
WAY, WALLS = (BLUE, 2.0, "estimated trajectory"), ("#263240", 8.0, "obstacle")


def main() -> None:
    """Draw what is asked for."""
    options = parse_options()
    with TemporaryDirectory() as temporary:
        work = Work(options.work or Path(temporary), options.log, options.source)
        for name in options.names or PICTURES:
            if name == "freiburg.png" and work.log is None:
                print(f"{name} stays: no --log was given")
                continue
            (IMAGES / name).write_bytes(content(PICTURES[name](work)))
            print(f"wrote {name}, {(IMAGES / name).stat().st_size / 1e3:.0f} kB")


def parse_options() -> Namespace:
    """The command line."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", choices=[*PICTURES, []], help=", ".join(PICTURES))
    parser.add_argument("--work", type=Path, help="folder that keeps the drives and the maps")
    parser.add_argument("--log", type=Path, help="a log of a 2D lidar")
    source = "Freiburg building 079 (C. Stachniss)"
    parser.add_argument("--source", default=source, help="where that log is from")
    return parser.parse_args()


def content(drawn: Image.Image | str) -> bytes:
    """A picture as a file."""
    if isinstance(drawn, str):
        return drawn.encode()
    buffer = io.BytesIO()
    drawn.save(buffer, "png", optimize=True)
    return buffer.getvalue()


def home(work: Work) -> Image.Image:
    """The home by the lidar alone, and the map to drive by, with the way over it."""
    lidar, decision = layer(work.home, "lidar"), layer(work.home, "decision")
    house = slam.load_map(work.home)
    way, true_way, rmse_m = aligned(house, work.drive)
    house.close()
    seen = window(lidar.values, decision.values)
    both = painted(decision.values)
    both[(decision.values == OCCUPIED) & (lidar.values != OCCUPIED)] = ONLY_CAMERAS
    over = f"What lidar and four depth cameras see (ATE {100 * rmse_m:.1f} cm)"
    shown = [
        Panel("What the 2D lidar sees", painted(lidar.values)[seen], in_cells(way, lidar, seen)),
        Panel(over, both[seen], in_cells(way, decision, seen), in_cells(true_way, decision, seen)),
    ]
    true = (TRUTH, 6.0, "true trajectory")
    return page(shown, (WAY, true, (ORANGE, 8.0, "obstacle that only the cameras see"), WALLS))


def freiburg(work: Work) -> Image.Image:
    """A recorded log, lying on its long side."""
    house = slam.load_map(work.recorded)
    length_m = float(np.linalg.norm(np.diff(house.trajectory.positions_m, axis=0), axis=1).sum())
    shown = lying(house, f"A recorded log: {work.source}, 2D lidar and wheels, {length_m:.0f} m")
    house.close()
    return page([shown], (WAY, WALLS))


def floorplan(work: Work) -> str:
    """The floor plan of a home."""
    house = slam.load_map(work.rooms)
    with TemporaryDirectory() as folder:
        (written,) = house.export("svg", Path(folder) / "plan.svg")
        house.close()
        return written.read_text("utf-8")


def report(work: Work) -> Image.Image:
    """The page of a map, as a browser shows it."""
    from playwright.sync_api import sync_playwright

    house = slam.load_map(work.home)
    with TemporaryDirectory() as folder, sync_playwright() as play:
        page_file = Path(folder) / "report.html"
        page_file.write_text("".join(saved_page(house)), "utf-8")
        house.close()
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        shown = browser.new_page(viewport={"width": 1400, "height": 900})
        shown.goto(page_file.as_uri())
        shown.wait_for_selector("html.ready", timeout=60_000)
        shown.get_by_text("+", exact=True).first.click()
        shown.get_by_text("Loops", exact=True).first.click()
        shown.wait_for_timeout(2000)
        picture = Image.open(io.BytesIO(shown.screenshot())).convert("RGB")
        browser.close()
    return picture.quantize(64, dither=Image.Dither.NONE)


PICTURES: dict[str, Callable[[Work], Image.Image | str]] = {
    "home.png": home,
    "freiburg.png": freiburg,
    "report.png": report,
    "floorplan.svg": floorplan,
    "factors.png": concepts.factors,
    "loops.png": concepts.loops,
    "repair.png": concepts.repair,
    "layers.png": concepts.layers,
    "localisation.png": concepts.localisation,
    "uncertainty.png": concepts.uncertainty,
    "architecture.svg": lambda _: drawing(),
}

if __name__ == "__main__":
    main()
