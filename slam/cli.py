"""The commands. Nothing else prints."""

from __future__ import annotations

import json
import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from slam.errors import ScanweaveError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Offline SLAM from lidar and RGB-D logs: one trajectory, one map, no ROS.",
)

LogArgument = Annotated[
    Path,
    typer.Argument(
        help="the log: a CARMEN file (.log, .clf, plain or .gz), or a folder (simulated, TUM, 7-Scenes, "
        "OpenLORIS-Scene, Robot@Home)"
    ),
]
ConfigOption = Annotated[
    str | None, typer.Option("--config", "-c", help="preset name or a YAML file of your own")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", "-s", help="one value, as in grid.resolution_m=0.1; repeatable")
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON instead of text")]
StrictOption = Annotated[bool, typer.Option("--strict", help="stop at the first bad record")]

# Conventional exit code of a program that the user interrupted.
_INTERRUPTED = 130
_DEMO_ROOMS = 3


def main() -> None:
    """Run a command: exit code 1 for a known error in one line, 2 for wrong usage."""
    try:
        app()
    except ScanweaveError as error:
        print(f"scanweave: {error}", file=sys.stderr)
        sys.exit(1)
    except (KeyboardInterrupt, SystemExit) as end:
        # Typer turns an interrupt into its exit code and says nothing.
        if isinstance(end, SystemExit) and end.code != _INTERRUPTED:
            raise
        print("scanweave: interrupted; nothing half-written was left behind", file=sys.stderr)
        sys.exit(_INTERRUPTED)


@app.callback()
def _logging(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="one line an event, on stderr")] = False,
) -> None:
    """Set up logging before any command."""
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")


@app.command("map")
def map_command(
    log: LogArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results; made where missing")],
    config: ConfigOption = None,
    set_: SetOption = None,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="ignore the wheels")] = False,
    no_loops: Annotated[bool, typer.Option("--no-loops", help="close no loops")] = False,
    no_fusion: Annotated[
        bool, typer.Option("--no-fusion", help="do not let lidar and cameras repair each other")
    ] = False,
    strict: StrictOption = False,
) -> None:
    """Map a log: trajectory, graph, grid and report."""
    overrides = list(set_ or [])
    if no_odometry:
        overrides.append("lidar_odometry.use_wheel_odometry=false")
    if no_loops:
        overrides += ["loops.enabled=false", "visual_loops.enabled=false"]
    if no_fusion:
        overrides.append("fusion.enabled=false")
    _map(log, out, config, overrides, strict)


@app.command()
def inspect(log: LogArgument, as_json: JsonOption = False, strict: StrictOption = False) -> None:
    """Tell what is in a log: sensors, rates, gaps, clock steps, dropped records."""
    from slam.datasets import open_dataset
    from slam.datasets.inspection import inspect_dataset, render_inspection

    inspection = inspect_dataset(open_dataset(log, strict=strict))
    print(json.dumps(inspection.to_dict(), indent=2) if as_json else render_inspection(inspection))


@app.command()
def evaluate(
    trajectory: Annotated[Path, typer.Argument(help="trajectory in TUM format")],
    relations: Annotated[
        Path | None, typer.Option(help="relations file (Kuemmerle 2009): t1 t2 x y z roll pitch yaw")
    ] = None,
    groundtruth: Annotated[
        Path | None, typer.Option(help="true trajectory in TUM format, or a dataset folder that has one")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(min=0.0, help="greatest time between a pose and its true pose, seconds")
    ] = None,
    delta: Annotated[float, typer.Option(min=0.0, help="RPE over this many metres")] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Score a trajectory by relations, or by ATE and RPE against the truth."""
    from slam.evaluation.score_text import score, score_text

    if (relations is None) == (groundtruth is None):
        raise typer.BadParameter("give --relations or --groundtruth, one of them")
    scores = score(trajectory, relations, groundtruth, tolerance_s=tolerance, delta_m=delta)
    print(json.dumps(scores, indent=2) if as_json else score_text(scores))


@app.command("config")
def config_command(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Print the effective configuration, every field explained."""
    from slam.config import dump_config, load_config

    print(dump_config(load_config(config, set_ or [])), end="")


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
        with _progress("simulating", "s") as progress:
            record_drive(
                generate_home(seed, rooms=_DEMO_ROOMS),
                RIGS["sick2d"],
                seed,
                folder,
                progress=lambda done_s, _: progress(int(done_s)),
                formats=("folder",),
            )
    return folder / "scans.log", folder / "groundtruth.txt"


@app.command()
def simulate(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the log; must be empty or new")],
    rig: Annotated[
        str,
        typer.Option(help="which robot; a wrong name lists them"),
    ] = "xu2024",
    home: Annotated[int, typer.Option(min=0, help="which home: the seed of its plan and furniture")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="which drive: the seed of tour, noise and faults")] = 0,
    office: Annotated[bool, typer.Option("--office", help="an office instead of a home")] = False,
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="seconds; one tour through all rooms if not given")
    ] = None,
    faults: Annotated[str, typer.Option(help="clocks, losses, people: none, usual or harsh")] = "usual",
    formats: Annotated[
        list[str] | None, typer.Option("--format", help="folder (CARMEN + TUM) or mcap; both if not given")
    ] = None,
) -> None:
    """Drive a simulated robot through a furnished home and record its sensors with the truth."""
    from slam.errors import ConfigError
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.home import generate_home
    from slam.simulation.record import FORMATS, record_drive
    from slam.simulation.rigs import RIGS

    if rig not in RIGS:
        raise ConfigError(f"no rig '{rig}'; there are {', '.join(sorted(RIGS))}")
    if faults not in FAULT_PRESETS:
        raise ConfigError(f"no fault preset '{faults}'; there are {', '.join(FAULT_PRESETS)}")
    with _progress("simulating", "s") as progress:
        summary = record_drive(
            generate_home(home, "office" if office else "home"),
            RIGS[rig],
            seed,
            out,
            FAULT_PRESETS[faults],
            duration,
            lambda done_s, _: progress(int(done_s)),
            formats=tuple(formats) if formats else FORMATS,
        )
    counts = ", ".join(f"{count} {name}" for name, count in summary.counts.items())
    print(f"{summary.duration_s:.0f} s, {summary.path_m:.1f} m through {len(summary.rooms)} rooms: {counts}")
    print(f"wrote {summary.folder}")


@app.command()
def plan(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="a nav2 map (.yaml), or a folder with layers")],
    start: Annotated[str, typer.Option("--from", help="x,y in metres, map frame")],
    goal: Annotated[str, typer.Option("--to", help="x,y in metres, map frame")],
    radius: Annotated[float, typer.Option(min=0.0, help="of the robot, metres")] = 0.2,
    out: Annotated[Path, typer.Option("--out", "-o", help="the picture")] = Path("plan.png"),
) -> None:
    """Plan the shortest path over a map, and draw it."""
    from slam.evaluation.plan_picture import plan_picture
    from slam.mapping.navigation import clearance_m, free_space, shortest_path
    from slam.storage.files import write_bytes
    from slam.storage.nav2 import read_nav2_map

    ends = _point(start, "--from"), _point(goal, "--to")
    grid = read_nav2_map(map_ / "decision.yaml" if map_.is_dir() else map_)
    space = free_space(grid.values, grid.resolution_m, grid.T_map_grid, radius)
    path = shortest_path(space, *ends, clearance_m(grid.values, grid.resolution_m))
    if path is None:
        raise ScanweaveError(
            f"no way from {start} to {goal} for a robot of radius {radius:g} m; try a smaller --radius"
        )
    write_bytes(out, plan_picture(grid.values, space, path))
    print(f"{path.length_m:.2f} m, at least {path.clearance_m:.2f} m from obstacles; wrote {out}")


def _point(text: str, option: str) -> tuple[float, float]:
    """A point from x,y."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"{option} is '{text}'; give x,y in metres, as in 1.5,-0.2") from error
    return x, y


def _map(log: Path, out: Path, config: str | None, overrides: list[str], strict: bool) -> None:
    """Run the pipeline on a log and write its results."""
    started = time.perf_counter()
    from slam.config import load_config
    from slam.datasets import open_dataset
    from slam.evaluation.map_report import RunCost, beside_of, report_data
    from slam.evaluation.report import write_report
    from slam.layer_outputs import save_layers
    from slam.pipeline import build_map
    from slam.run_outputs import save_run
    from slam.storage.files import make_folder

    settings = load_config(config, overrides)
    dataset = open_dataset(log, strict=strict)
    make_folder(out)
    with _progress("mapping", "scans and frames") as advance, _interrupted_between_scans(advance) as on_scan:
        result = build_map(dataset, settings, on_scan)
    written = save_run(out, result, settings.dense_map)
    try:
        written += save_layers(out, result, settings)
    except ScanweaveError as error:  # the rest of the run is still worth its report
        result.warnings.append(f"No layers were written: {error}")
    cost = RunCost(time.perf_counter() - started, time.process_time())
    data = report_data(log.name, dataset.report, result, settings, cost, beside_of(dataset, result, written))
    write_report(out / "report.html", data)
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
    print("wrote " + ", ".join(str(path) for path in [*written, out / "report.html"]))


@contextmanager
def _interrupted_between_scans(advance: Callable[[int], None]) -> Iterator[Callable[[int], None]]:
    """Let Ctrl-C wait for the end of a scan: in compiled code it surfaces as some other error.

    A second one does not wait.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield advance  # whoever ignores or handles the signal has a reason
        return
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def on_scan(count: int) -> None:
        if asked:
            raise KeyboardInterrupt
        advance(count)

    signal.signal(signal.SIGINT, note)
    try:
        yield on_scan
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt


@contextmanager
def _progress(what: str, unit: str = "scans") -> Iterator[Progress]:
    """A counter on stderr while work goes on; silent where stderr is not a terminal."""
    progress = Progress(what, unit)
    try:
        yield progress
    finally:
        progress.close()


class Progress:
    """Rewrites one line a few times a second."""

    def __init__(self, what: str, unit: str) -> None:
        self._what = what
        self._unit = unit
        self._shown_at = time.perf_counter()
        self._terminal = sys.stderr.isatty()
        self._shown = False

    def __call__(self, count: int) -> None:
        """Show that ``count`` units are done."""
        now = time.perf_counter()
        if self._terminal and now - self._shown_at > 0.2:
            print(f"\r{self._what}: {count} {self._unit}", end="", file=sys.stderr, flush=True)
            self._shown_at, self._shown = now, True

    def close(self) -> None:
        """Clear the line."""
        if self._shown:
            print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)
