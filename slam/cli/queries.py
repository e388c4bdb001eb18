"""Commands that look: scanweave inspect, doctor, evaluate, config, plan."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import (
    CalibrationOption,
    ConfigOption,
    JsonOption,
    KnownMapArgument,
    LogArgument,
    SetOption,
    StrictOption,
    TopicsOption,
    command,
    say,
    tell,
    topics_of,
)
from slam.errors import ScanweaveError

if TYPE_CHECKING:
    from slam.config.stages import SensorsConfig
    from slam.datasets.dataset import Dataset


@command("inspect drive.mcap")
def inspect(
    log: LogArgument,
    as_json: JsonOption = False,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Show what a log contains: sensors, rates, gaps, clock jumps, dropped records."""
    from slam.datasets.inspection import inspect_dataset, map_commands
    from slam.datasets.sensor_choice import UsedMeasurements
    from slam.doctor.diagnosis import diagnose
    from slam.evaluation.pages import inspection_text

    dataset, sensors = _opened(log, topics, calibration, strict=strict)
    inspection = inspect_dataset(dataset, sensors.calibration)
    inspection["commands"] = map_commands(inspection, log, topics_of(topics), calibration)
    findings = [] if inspection["refusal"] else diagnose(UsedMeasurements(dataset, sensors))
    inspection["findings"] = [{"line": finding.line, **finding.plain()} for finding in findings]
    lines = [inspection_text(inspection), *(f"  finding: {finding.line}" for finding in findings)]
    tell(json.dumps(inspection, indent=2) if as_json else "\n".join(lines))


@command("doctor monday.log --write calibration.yaml")
def doctor(
    log: LogArgument,
    write: Annotated[
        Path | None, typer.Option("--write", help="write the corrections to this file, for --calibration")
    ] = None,
    as_json: JsonOption = False,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Check the sensors of a log against each other, and show how to correct what is wrong."""
    if write is not None and write.suffix not in (".yaml", ".yml"):
        raise typer.BadParameter(f"--write is {write}; give a file that ends in .yaml")
    from slam.datasets.sensor_choice import UsedMeasurements
    from slam.doctor.diagnosis import examine
    from slam.doctor.finding import calibration_text, remedied
    from slam.storage.files import write_bytes

    dataset, sensors = _opened(log, topics, calibration, strict=strict)
    diagnosis = examine(UsedMeasurements(dataset, sensors))
    findings = diagnosis.findings
    if as_json:
        plain_findings = [finding.plain() for finding in findings]
        tell(json.dumps({"findings": plain_findings, "open": diagnosis.open}, indent=2))
    else:
        tell("\n".join(finding.line for finding in findings) or "no error found in the log")
        refused = [f"records that cannot be read ({dataset.report.refusals})"]
        for line in [*diagnosis.open, *(refused if dataset.report.dropped_count else [])]:
            tell(f"not judged: {line}")
    if write is not None:
        mended = remedied(sensors.calibration, findings, only_sure=False)
        write_bytes(write, calibration_text(mended, findings).encode())
        say(f"wrote {write}")


def _opened(
    log: Path, topics: list[str] | None, calibration: Path | None, *, strict: bool
) -> tuple[Dataset, SensorsConfig]:
    """A log to look into, and what is known of its sensors."""
    from slam.config import load_config
    from slam.datasets import open_dataset

    sensors = load_config(calibration=calibration).sensors
    files = sensors.calibration_files
    return open_dataset(log, strict=strict, topics=topics_of(topics), calibration=files), sensors


@command("evaluate house/trajectory.tum --groundtruth truth.tum")
def evaluate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="trajectory in TUM format")],
    relations: Annotated[
        Path | None, typer.Option(help="relations file (Kuemmerle 2009): t1 t2 x y z roll pitch yaw")
    ] = None,
    groundtruth: Annotated[
        Path | None, typer.Option(help="ground truth in a published format, or a folder that contains one")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(min=0.0, help="largest time to the true pose, seconds; default: 0.05")
    ] = None,
    delta: Annotated[float, typer.Option(min=0.0, help="distance over which RPE is taken, metres")] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Score a trajectory against relations, or by ATE and RPE against the ground truth."""
    from slam.evaluation.score import evaluate as score
    from slam.evaluation.score import score_text

    if (relations is None) == (groundtruth is None):
        raise typer.BadParameter("give --relations or --groundtruth, one of them")
    scores = score(
        trajectory, groundtruth=groundtruth, relations=relations, tolerance_s=tolerance, delta_m=delta
    )
    tell(json.dumps(scores, indent=2) if as_json else score_text(scores))


@command("config --set grid.resolution_m=0.1")
def config_command(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Print the effective configuration with a description of every field."""
    from slam.config import dump_config, load_config

    tell(dump_config(load_config(config, set_ or [])).rstrip("\n"))


@command("plan house/ --from 0,0 --to 3.5,-1 -o path.png")
def plan(
    map_: KnownMapArgument,
    start: Annotated[str, typer.Option("--from", help="x,y in metres, map frame")],
    goal: Annotated[str, typer.Option("--to", help="x,y in metres, map frame")],
    radius: Annotated[float, typer.Option(min=0.0, help="radius of the robot in metres")] = 0.2,
    out: Annotated[Path, typer.Option("--out", "-o", help="the image file to write")] = Path("plan.png"),
) -> None:
    """Plan and draw the shortest path over a map, avoiding unknown space where that costs little."""
    from slam.evaluation.figure_parts import plan_picture
    from slam.mapping.navigation import free_space, shortest_path
    from slam.storage.files import write_bytes
    from slam.storage.nav2 import read_nav2_map
    from slam.storage.nav2_zones import without_keep_out

    ends = _point(start, "--from"), _point(goal, "--to")
    path_yaml = _map_yaml(map_)
    grid = read_nav2_map(path_yaml)
    values = without_keep_out(grid, path_yaml)
    space = free_space(values, grid.resolution_m, grid.T_map_grid, radius)
    path = shortest_path(space, *ends)
    if path is None:
        raise ScanweaveError(
            f"no path from {start} to {goal} for a robot of radius {radius:g} m; try a smaller --radius"
        )
    write_bytes(out, plan_picture(values, space, path))
    tell(grid.what or f"{map_} does not record how it was made")
    tell(f"{path.length_m:.2f} m, at least {path.clearance_m:.2f} m from obstacles; wrote {out}")


def _map_yaml(map_: Path) -> Path:
    """The map to drive by that belongs to what was named."""
    from slam.storage.map_file import MAP_NAME
    from slam.storage.nav2_layers import MAP_YAML

    folder = map_.parent if map_.name == MAP_NAME else map_
    if not folder.is_dir():
        return map_
    if not (folder / MAP_YAML).is_file():
        raise ScanweaveError(
            f"no {MAP_YAML} in {folder}; 'scanweave map' writes one of a robot on a floor, "
            "'scanweave export --format nav2' writes it again"
        )
    return folder / MAP_YAML


def _point(text: str, option: str) -> tuple[float, float]:
    """A point from x,y."""
    try:
        x, y = (float(part) for part in text.split(","))
        if not math.isfinite(x + y):
            raise ValueError
    except ValueError as error:
        raise typer.BadParameter(f"{option} is '{text}'; give x,y in metres, as in 1.5,-0.2") from error
    return x, y
