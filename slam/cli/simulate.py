"""scanweave simulate."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import command, folder_of, say
from slam.cli.progress import interruptible, progress_bar

if TYPE_CHECKING:
    from slam.simulation.drive_faults import DriveFaults
    from slam.simulation.home_model import Home
    from slam.simulation.record import DriveSummary
    from slam.simulation.rigs import Rig

_RIG = "xu2024"


@command()
def simulate(
    out: Annotated[
        Path, typer.Option("--out", "-o", parser=folder_of, help="folder for the log; must be empty or new")
    ],
    rig: Annotated[str, typer.Option(help="robot type; an unknown name lists all")] = _RIG,
    home: Annotated[int, typer.Option(min=0, help="random seed of the floor plan")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the route, noise and faults")] = 0,
    moved: Annotated[
        int, typer.Option(min=0, help="number of pieces of furniture that moved, disappeared or appeared")
    ] = 0,
    tags: Annotated[
        int, typer.Option(min=0, help="number of AprilTags on the walls; tags.yaml lists their poses")
    ] = 0,
    imu: Annotated[bool, typer.Option("--imu", help="add a 200 Hz IMU (always with --street)")] = False,
    office: Annotated[bool, typer.Option("--office", help="simulate an office instead of a home")] = False,
    campus: Annotated[
        bool, typer.Option("--campus", help="2 km of corridors, a SICK lidar, bad wheel odometry; no --rig")
    ] = False,
    street: Annotated[
        bool,
        typer.Option(
            "--street", help="a car with a 3D lidar in a town, without wheels; --rig car64 or car16"
        ),
    ] = False,
    tunnel: Annotated[
        bool, typer.Option("--tunnel", help="with --street: one road with 200 m of smooth tunnel")
    ] = False,
    undistorted: Annotated[
        bool, typer.Option("--undistorted", help="with --street: write clouds without motion distortion")
    ] = False,
    duration: Annotated[
        float | None,
        typer.Option(
            min=1.0, help="duration in seconds; default: one tour, the whole campus, or 34 s of a street"
        ),
    ] = None,
    faults: Annotated[
        str, typer.Option(help="none, usual or harsh (not for a campus): clock errors, losses, people")
    ] = "usual",
    formats: Annotated[
        list[str] | None, typer.Option("--format", help="folder (CARMEN + TUM) or mcap; default: both")
    ] = None,
) -> None:
    """Simulate a robot in a home, office, campus or town, and record its sensors and ground truth."""
    from dataclasses import replace

    from slam.errors import ConfigError
    from slam.simulation.campus import record_campus
    from slam.simulation.campus_wheels import CAMPUS_FAULTS
    from slam.simulation.drive import leading_sensor
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.home import generate_home
    from slam.simulation.record import FORMATS
    from slam.simulation.rigs import RIGS, ROBOT_IMU
    from slam.simulation.street import STREET_FAULTS, STREET_RIGS, record_street

    if (tunnel or undistorted) and not street:
        raise ConfigError("--tunnel and --undistorted need --street")
    if street:
        if campus or office or moved or tags:
            raise ConfigError("--street has no furniture; leave out --campus, --office, --moved and --tags")
        rig = "car64" if rig == _RIG else rig
        if rig not in STREET_RIGS or faults not in STREET_FAULTS:
            raise ConfigError(
                f"no rig '{rig}' or no fault preset '{faults}'; there are {', '.join(STREET_RIGS)}, and "
                f"{', '.join(STREET_FAULTS)}"
            )
        with _seconds_shown() as on_progress:
            recording = record_street(
                home,
                seed,
                out,
                STREET_RIGS[rig],
                STREET_FAULTS[faults],
                duration,
                on_progress,
                tunnel=tunnel,
                undistorted=undistorted,
                formats=tuple(formats) if formats else FORMATS,
            )
        say(f"{recording.text}\nwrote {out}")
        return
    if rig not in RIGS:
        raise ConfigError(f"no rig '{rig}'; there are {', '.join(sorted(RIGS))}")
    if campus and (office or formats or moved or tags or imu or rig != _RIG):
        raise ConfigError(
            "--campus has its own robot and format, and no furniture; leave out --rig, --imu, --office, "
            "--format, --moved and --tags"
        )
    presets = CAMPUS_FAULTS if campus else FAULT_PRESETS
    if faults not in presets:
        raise ConfigError(f"no fault preset '{faults}'; there are {', '.join(presets)}")
    if campus:
        with _seconds_shown() as on_progress:
            drive = record_campus(home, seed, out, CAMPUS_FAULTS[faults], duration, on_progress)
        say(f"{drive.text}\nwrote {out}")
        return
    building = generate_home(home, "office" if office else "home", moved=moved, day=seed)
    if tags:
        from slam.simulation.tour import plan_tour
        from slam.simulation.wall_tags import place_tags

        robot = RIGS[rig]
        tour = plan_tour(building, robot.robot_radius_m, robot.robot_height_m, seed, duration)
        building = place_tags(building, tags, home, tour.poses_xyt)
    chosen = FAULT_PRESETS[faults]
    if chosen.dying_sensor:
        chosen = replace(chosen, dying_sensor=leading_sensor(RIGS[rig]))
    summary = simulate_into(
        out,
        building,
        replace(RIGS[rig], imu=ROBOT_IMU if imu else None),
        seed,
        chosen,
        duration,
        tuple(formats) if formats else FORMATS,
    )
    counts = ", ".join(f"{count} {name}" for name, count in summary.counts.items())
    say(f"{summary.duration_s:.0f} s, {summary.path_m:.1f} m through {len(summary.rooms)} rooms: {counts}")
    say(f"wrote {summary.folder}")


def simulate_into(
    out: Path,
    home: Home,
    rig: Rig,
    seed: int,
    faults: DriveFaults | None,
    duration_s: float | None,
    formats: tuple[str, ...],
) -> DriveSummary:
    """Record a drive, and show how far it is."""
    from slam.simulation.record import record_drive

    with _seconds_shown() as on_progress:
        return record_drive(home, rig, seed, out, faults, duration_s, on_progress, formats=formats)


@contextmanager
def _seconds_shown() -> Iterator[Callable[[float, float], None]]:
    """A bar of the seconds driven; what is yielded takes those done and those in all."""
    from slam.app.progress import Progress

    with progress_bar("s driven") as shown, interruptible(shown) as show:
        yield lambda done_s, all_s: show(Progress("simulating", int(done_s), done_s / all_s))
