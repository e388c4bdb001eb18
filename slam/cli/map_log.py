"""scanweave map, scanweave demo."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import (
    ConfigOption,
    LogArgument,
    RecordOption,
    SetOption,
    StrictOption,
    TopicsOption,
    app,
    topics_override,
)
from slam.cli.progress import interrupted_between_scans, progress_of
from slam.errors import ScanweaveError

if TYPE_CHECKING:
    from slam.config import Config
    from slam.map_result import MapResult
    from slam.mapping.layered_map import LayeredMap

_DEMO_ROOMS = 3


@app.command("map")
def map_command(
    log: LogArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="folder for the results; made where missing")
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            "--into",
            metavar="MAP",
            help="add the log to this saved map; with --out the joined map goes there, and MAP stays",
        ),
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="ignore the wheels")] = False,
    no_loops: Annotated[bool, typer.Option("--no-loops", help="close no loops")] = False,
    no_fusion: Annotated[
        bool, typer.Option("--no-fusion", help="do not let lidar and cameras repair each other")
    ] = False,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="go on with the map that an interrupted run has left in the folder"),
    ] = False,
    record: RecordOption = None,
) -> None:
    """Map a log: trajectory, graph, grid, report, and all of it in map.db."""
    overrides = [*(set_ or []), *topics_override(topics)]
    if no_odometry:
        overrides += [f"{stage}.use_wheel_odometry=false" for stage in ("lidar_odometry", "cloud_odometry")]
    if no_loops:
        overrides += [f"{stage}.enabled=false" for stage in ("loops", "visual_loops", "cloud_loops")]
    if no_fusion:
        overrides.append("fusion.enabled=false")
    if into is not None and record is not None:
        raise typer.BadParameter("--record is for a map of its own, not for one that joins another (--into)")
    if into is not None:
        from slam.cli.map_into import map_into
        from slam.config import load_config

        own = load_config(config, overrides) if config or overrides else None
        map_into(log, into, out, own, strict, resume)
    elif out is None:
        raise typer.BadParameter("say where the map goes (--out), or which map the log joins (--into)")
    else:
        _map(log, out, config, overrides, strict, resume, record)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the log and the results")] = Path(
        "demo-out"
    ),
    seed: Annotated[int, typer.Option(min=0, help="another seed, another drive")] = 0,
) -> None:
    """Simulate a small home, map its lidar log, and score the map against the truth."""
    from slam.evaluation.score_text import score, score_text

    log, truth = _demo_log(out / f"simulated-{seed}", seed)
    _map(log, out, None, [], strict=False)
    print(score_text(score(out / "trajectory.tum", None, truth, tolerance_s=None, delta_m=1.0)))
    print(f"open {out / 'report.html'} to look at it")


def _demo_log(folder: Path, seed: int) -> tuple[Path, Path]:
    """A simulated lidar log and its truth; a flat world where ray casting is not to be had."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        from slam.simulation.synthetic_log import write_synthetic_log

        print(f"no ray casting here ({error}); a flat world instead of a home", file=sys.stderr)
        flat = write_synthetic_log(folder, seed=seed)
        return flat.log_path, flat.truth_path
    from slam.simulation.home import generate_home
    from slam.simulation.record import record_drive
    from slam.simulation.rigs import RIGS

    # The same seed gives the same log: what an earlier demo left is used again.
    if not (folder / "scans.log").is_file():
        with progress_of("simulating", "s") as progress:
            record_drive(
                generate_home(seed, rooms=_DEMO_ROOMS),
                RIGS["sick2d"],
                seed,
                folder,
                progress=lambda done_s, _: progress(int(done_s)),
                formats=("folder",),
            )
    return folder / "scans.log", folder / "groundtruth.txt"


def _map(
    log: Path,
    out: Path,
    config: str | None,
    overrides: list[str],
    strict: bool,
    resume: bool = False,
    record: Path | None = None,
) -> None:
    """Run the pipeline on a log and write its results."""
    started = time.perf_counter()
    from slam.cli.map_opening import finished_map, opened_map
    from slam.config import load_config
    from slam.datasets import open_dataset
    from slam.evaluation.map_report import RunCost, beside_of, report_data
    from slam.evaluation.report import write_report
    from slam.journal import Journal
    from slam.map_recording import record_map
    from slam.pipeline import build_map
    from slam.run_outputs import contents_of
    from slam.storage.files import make_folder
    from slam.storage.map_contents import write_contents
    from slam.storage.map_file import MAP_NAME
    from slam.storage.map_identity import identity_of
    from slam.viewer import recording

    settings = load_config(config, overrides)
    sensors = settings.sensors
    dataset = open_dataset(log, strict=strict, topics=sensors.topics, images=sensors.rgbd)
    make_folder(out)
    identity = identity_of(dataset.path, settings)
    if resume and finished_map(out, identity):
        print(f"{out / MAP_NAME} is finished already; there is nothing to resume")
        return
    with recording(record) as viewer, opened_map(out, identity, resume=resume) as file:
        with (
            progress_of("mapping", "scans and frames") as advance,
            interrupted_between_scans(advance) as on_scan,
        ):
            result = build_map(dataset, settings, on_scan, Journal(file))
        written, layers = _save(out, result, settings)
        cost = RunCost(time.perf_counter() - started, time.process_time())
        beside = beside_of(dataset, result, written)
        data = report_data(log.name, dataset.report, result, settings, cost, beside, layers)
        write_report(out / "report.html", data)
        record_map(viewer, result, layers, settings)
        write_contents(file, contents_of(result, layers))
        file.seal()
    for warning in data.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for note in result.notes:
        print(note)
    accepted = sum(loop.accepted for loop in result.loops)
    print(
        f"{data.scans} {data.unit}s, {len(result.keyframe_poses)} keyframes, {data.path_length_m:.1f} m, "
        f"{accepted} of {len(result.loops)} loops accepted, "
        f"{dataset.report.dropped_count} records dropped, {time.perf_counter() - started:.1f} s"
    )
    if data.truth is not None:
        print(f"{data.truth.error.translation_m.rmse:.4f} m RMSE against the ground truth, rigidly aligned")
    print("wrote " + ", ".join(str(path) for path in [*written, out / MAP_NAME, out / "report.html"]))


def _save(out: Path, result: MapResult, config: Config) -> tuple[list[Path], LayeredMap | None]:
    """Write the files for other programs; which they are, and the layers."""
    from slam.layer_outputs import layers_of
    from slam.run_outputs import save_clouds, save_dense, save_run

    layers = layers_of(result, config)
    written = save_run(out, result, layers)
    # Whatever fails of these, the rest of the run is still worth its report.
    try:
        written += save_dense(out, result, config.dense_map)
        written += save_clouds(out, result, config.cloud_map, config.dense_map)
    except ScanweaveError as error:
        result.warnings.append(f"No coloured surface was written: {error}")
    return written, layers
