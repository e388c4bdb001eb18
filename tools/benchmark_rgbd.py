"""Measure ``scanweave map`` on a real RGB-D sequence beside the stock odometries of other libraries.

    python tools/benchmark_rgbd.py [FOLDER] [--row NAME] [--repeat N] [--json FILE]

FOLDER is any dataset with its ground truth; the default is 7-Scenes RedKitchen. Every row is a process of
its own: the real command for ours, `rgbd_baselines.py` for the others, each from decoding to the written
trajectory. Accuracy is the ATE RMSE after rigid alignment, by ``scanweave evaluate``. Wall and CPU seconds
(least of ``--repeat`` runs) and peak memory are the kernel's account of the child.

Two more rows tell how cost grows: the sequence at half its width, and four times its length (forward and
backward by turns).

Seconds drift with the machine and its load; compare ratios within one run: ``CPU ratio`` is relative to the
first row.
"""

# Only the standard library here: on Linux a child begins with its parent's peak memory, see benchmark.py.
from __future__ import annotations

import json
import os
import sys
import tempfile
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

from benchmark import REPO, machine, run, scanweave, score

OURS: dict[str, list[str]] = {
    "Scanweave": [],
    "Scanweave, no coloured map": ["dense_map.enabled=false"],
    "Scanweave, features only": ["rgbd_odometry.correlated_points=1e9"],
    "Scanweave, no loops": ["loops.enabled=false"],
    "Scanweave, colour taken as registered": ["rgbd.registration=given"],
}
OTHERS = (
    "Open3D hybrid",
    "Open3D point-to-plane",
    "Open3D intensity",
    "cv2.Odometry RGB-D",
    "ORB + PnP-RANSAC",
    "ORB + PnP-RANSAC, every 5th frame",
)
HALVED, LONGER = "Scanweave, half width", "Scanweave, four times as long"
SEQUENCES = {HALVED: ("2", "1"), LONGER: ("1", "4")}  # shrink, times


def main() -> None:
    """Measure, print the table, write what was asked for."""
    options = parse_options()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(options.folder, Path(folder), options.repeat)
        for name in options.row or [*OURS, *SEQUENCES, *OTHERS]:
            try:
                rows.append(bench.row(name))
            except SystemExit as error:
                # One method that fails is a finding; the others are still to be measured.
                print(f"{name}: {error}", file=sys.stderr)
                continue
            print(f"measured {name}: {json.dumps(rows[-1])}", file=sys.stderr)
    text = table(rows)
    print(text)
    if options.json:
        report = {"machine": machine(), "repeat": options.repeat, "rows": rows}
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def parse_options() -> Namespace:
    """The command line."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    default = REPO.parent / "shared" / "data" / "rgbd" / "redkitchen"
    parser.add_argument("folder", type=Path, nargs="?", default=default, help="a dataset with its truth")
    parser.add_argument(
        "--row", action="append", choices=[*OURS, *SEQUENCES, *OTHERS], help="only this one; repeatable"
    )
    parser.add_argument("--repeat", type=int, default=1, help="measured runs a row")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    return parser.parse_args()


class Bench:
    """Runs the children in a folder of their own."""

    def __init__(self, data: Path, folder: Path, repeat: int) -> None:
        self._data = data
        self._folder = folder
        self._repeat = repeat

    def row(self, name: str) -> dict[str, Any]:
        """Accuracy and cost of one row."""
        data, trajectory = self._data, self._folder / "out" / "trajectory.tum"
        if name in SEQUENCES:
            data = self._folder / name.replace(" ", "-")
            run([*tool("rgbd_sequences.py"), str(self._data), str(data), *SEQUENCES[name]])
        trajectory.parent.mkdir(exist_ok=True)
        if name in OTHERS:
            command = [*tool("rgbd_baselines.py"), name, str(data), str(trajectory)]
        else:
            settings = [part for value in OURS.get(name, []) for part in ("--set", value)]
            command = [*scanweave(), "map", str(data), "-o", str(trajectory.parent), *settings]
        costs = [run(command) for _ in range(self._repeat)]
        error = score(trajectory, "--groundtruth", data)["ate"]
        return {
            "variant": name,
            "frames": count_lines(trajectory),
            "ate_rmse_m": error["translation_m"]["rmse"],
            "wall_s": min(cost.wall_s for cost in costs),
            "cpu_s": min(cost.cpu_s for cost in costs),
            "peak_mb": max(cost.peak_mb for cost in costs),
            "load": os.getloadavg()[0],
        }


def tool(name: str) -> list[str]:
    """A script beside this one."""
    return [sys.executable, str(Path(__file__).with_name(name))]


def count_lines(trajectory: Path) -> int:
    """Poses in a TUM file."""
    with trajectory.open() as file:
        return sum(not line.startswith("#") for line in file)


def table(rows: list[dict[str, Any]]) -> str:
    """All rows as one Markdown table."""
    heads = ["variant", "ATE RMSE, m", "frames/s", "CPU ms a frame", "CPU ratio", "peak MB", "load"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    base_ms = 1e3 * rows[0]["cpu_s"] / rows[0]["frames"]
    for row in rows:
        cpu_ms = 1e3 * row["cpu_s"] / row["frames"]
        cells = [
            row["variant"],
            f"{row['ate_rmse_m']:.4f}",
            f"{row['frames'] / row['wall_s']:.1f}",
            f"{cpu_ms:.0f}",
            f"{cpu_ms / base_ms:.2f}",
            f"{row['peak_mb']:.0f}",
            f"{row['load']:.1f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
