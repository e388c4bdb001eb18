"""The table of sensor errors: the findings about each, and the errors of the maps."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from pathlib import Path

from slam.app.mapping import Measured
from slam.config import Config, calibrated, load_config
from slam.config.calibration import Calibration
from slam.doctor.finding import Finding, remedied
from slam.errors import ScanweaveError
from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import compare_with_truth
from slam.mapper.pipeline import build_map
from slam.measurements import Measurement

Log = list[Measurement]
CONFIGS = tuple(
    load_config(None, ["dense_map.enabled=false", f"sensors.doctor={doctor}"]) for doctor in ("false", "true")
)


def mapped_m(log: Log, truth: Trajectory, config: Config) -> float:
    """RMSE of a log's map, aligned in the plane; infinite where there is none."""
    try:
        return compare_with_truth(
            build_map(Measured(log), config).map.trajectory, truth
        ).error.translation_m.rmse
    except ScanweaveError:
        return math.inf


def told_row(
    drive: Path, name: str, size: float, findings: list[Finding], named: list[Finding], *, right: bool
) -> list[str]:
    """The findings about an error."""
    others = [one.kind for one in findings if one not in named]
    sure = "sure" if any(one.sure for one in named) else ""
    said = ["yes" if named else "NO", "yes" if right else "NO", sure]
    return [drive.name, name, f"{size:g}", *said, ", ".join(others)]


def mapped_row(wrong: Log, truth: Trajectory, findings: list[Finding], sound_m: float) -> list[str]:
    """Errors of the maps: correct log, wrong log without doctor, with doctor, corrected."""
    blind, config = CONFIGS
    mended = calibrated(config, remedied(Calibration(), findings, only_sure=False))
    errors_m = [mapped_m(wrong, truth, one) for one in (blind, config, mended)]
    within = "yes" if errors_m[2] <= 1.5 * sound_m else "NO"
    return [f"{sound_m:.3f}", *(f"{one:.3f}" for one in errors_m), within]


def main(text: str | None, rows_of: Callable[..., Iterator[list[str]]], *options: str) -> None:
    """Print one Markdown table; ``options`` are names of whole numbers that ``rows_of`` takes."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("drives", nargs="+", type=Path)
    parser.add_argument("--only", default="", help="only errors whose name contains this")
    parser.add_argument("--map", action="store_true", help="also map each log")
    for option in options:
        parser.add_argument(f"--{option}", type=int, default=3, help="use every N-th frame of each camera")
    arguments = vars(parser.parse_args())
    head = ["drive", "mistake", "size", "named", "right remedy", "sure", "also"]
    head += ["sound, m", "wrong", "as mapped", "mended", "within 1.5"] if arguments["map"] else []
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}", flush=True)
    given = {option: arguments[option] for option in options}
    for drive in arguments["drives"]:
        for row in rows_of(drive, arguments["only"], maps=arguments["map"], **given):
            print(f"| {' | '.join(row)} |", flush=True)
