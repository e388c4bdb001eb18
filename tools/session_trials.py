"""Join sessions to maps: drives of one home against the joint truth, drives of different homes, real logs.

Drives are simulated and mapped by the command line, once each, into a folder that keeps them. Every ordered
pair of a map and a session is then connected. Both trajectories of a joined map are scored together, after
one rigid alignment to the truth: the simulator gives it in the frame of the home for all drives.
"""

from __future__ import annotations

import dataclasses
import gzip
import itertools
import shutil
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from saved_maps import map_of, scanweave

from slam.datasets import open_dataset
from slam.estimates import Trajectory, one_after_another
from slam.evaluation.relations import read_relations, score_relations
from slam.evaluation.trajectory_error import absolute_error
from slam.outputs.finished_map import Map
from slam.sessions.connection import Connection, connect
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS
from slam.storage.tum import read_tum

_READINGS = ("ODOM", "FLASER")
# Beyond any clock: keeps the stamps of two sessions apart.
_APART_S = 1e7
# A joined map farther off than this is a false one.
FALSE_M = 0.3


@dataclasses.dataclass(frozen=True)
class Drive:
    """A simulated or real log, where it is from, its saved map, and its true poses if they are known."""

    name: str
    place: str
    log: Path
    map_folder: Path
    truth: Trajectory | None

    def opened(self) -> Map:
        """Its map, made where it is missing."""
        return map_of(self.log, self.map_folder)


def main() -> None:
    """Run the trials that are asked for and print Markdown tables."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="keeps drives and maps; what is there is used again")
    parser.add_argument("--rig", default="sick2d")
    parser.add_argument("--homes", type=int, default=3, help="homes, from seed 1")
    parser.add_argument("--seeds", type=int, default=2, help="drives a home, from seed 1")
    parser.add_argument("--duration", type=float, help="seconds of driving; one tour if absent")
    parser.add_argument(
        "--skip", type=float, default=0.0, help="drives but the first of a home begin so many seconds later"
    )
    parser.add_argument("--lidar-alone", action="store_true", help="drives without cameras and people")
    parser.add_argument("--people", action="store_true", help="people walk about in these, too")
    parser.add_argument("--cut", type=float, action="append", default=[], help="also sessions of s seconds")
    parser.add_argument("--strangers", action="store_true", help="also all pairs of different places")
    parser.add_argument(
        "--log", action="append", default=[], help="LOG:RELATIONS, a CARMEN log cut into two sessions"
    )
    parser.add_argument(
        "--halves",
        type=Path,
        action="append",
        default=[],
        help="frames as in 7-Scenes, or clouds in velodyne/ with times.txt, cut into two sessions",
    )
    arguments = parser.parse_args()
    drives = [
        _simulated(arguments, home, seed)
        for home in range(1, arguments.homes + 1)
        for seed in range(1, arguments.seeds + 1)
    ]
    real = [_halves(log, arguments.folder) for log in arguments.log]
    if drives:
        same_place(drives)
    for cut_s in arguments.cut:
        print(f"\n## Sessions of {cut_s:g} s\n")
        cuts = [piece for drive in drives for piece in _pieces(drive, cut_s, arguments.folder)]
        same_place(drives, cuts)
        if arguments.strangers:
            different_places(drives, cuts)
    for log, (first, second) in zip(arguments.log, real, strict=True):
        two_halves(log, first, second)
    for source in arguments.halves:
        print(f"\n## Halves of {source.name}\n")
        same_place(_linked_halves(source, arguments.folder))
    if arguments.strangers:
        everything = [*drives, *itertools.chain(*real)]
        different_places(everything, everything)


def same_place(maps: Sequence[Drive], sessions: Sequence[Drive] | None = None) -> None:
    """Every session into every map of its place but its own; one row each."""
    print("| map | session | nats, rival | loops kept | ATE m | max m | alone m | map moved m | s | |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    errors, refused, false = [], 0, 0
    for known, session in _pairs(maps, maps if sessions is None else sessions):
        if known.place != session.place or session.log == known.log or session.name.startswith(known.name):
            continue
        found, took_s = _connected(known, session)
        start = f"| {known.name} | {session.name} | {_evidence(found)} |"
        if found.joined is None:
            refused += 1
            print(f"{start} | | | | | {took_s:.1f} | {found.reason} |", flush=True)
            continue
        joint, largest, alone = _scores(found, known, session)
        errors.append(joint)
        false += largest > FALSE_M
        joined = found.joined
        print(
            f"{start} {joined.loops_kept} of {joined.loops_between} | {joint:.4f} | {largest:.4f} "
            f"| {alone:.4f} | {joined.moved_m:.3f} | {took_s:.1f} | |",
            flush=True,
        )
    print(
        f"\n{len(errors)} joined: median {np.median(errors or [np.nan]):.4f} m, worst "
        f"{max(errors, default=np.nan):.4f} m, {false} of them false (farther off than {FALSE_M} m "
        f"somewhere); {refused} refused"
    )


def different_places(maps: Sequence[Drive], sessions: Sequence[Drive]) -> None:
    """Every session into every map of another place; only what is not refused gets a line."""
    refused, joined, nats = 0, 0, []
    for known, session in _pairs(maps, sessions):
        if known.place == session.place:
            continue
        found, _ = _connected(known, session)
        refused += found.joined is None
        nats.append(found.placing.nats)
        if found.joined is not None:
            joined += 1
            print(f"FALSE: {session.name} joined to {known.name}, {_evidence(found)} nats", flush=True)
    most = ", ".join(f"{one:.1f}" for one in sorted(nats, reverse=True)[:8])
    print(f"\nDifferent places: {joined} joined, {refused} refused; most evidence for a place, nats: {most}")


def two_halves(log: str, first: Drive, second: Drive) -> None:
    """Both halves of a real log, each into the other, scored by the relations of the whole."""
    relations = read_relations(Path(log.rpartition(":")[2]))
    for known, session in ((first, second), (second, first)):
        found, took_s = _connected(known, session)
        if found.joined is None:
            print(f"{session.name} refused by {known.name}: {found.reason}")
            continue
        score = score_relations(found.joined.contents.trajectory, relations).all
        print(
            f"{session.name} in {known.name}: {_evidence(found)} nats, {found.joined.loops_kept} of "
            f"{found.joined.loops_between} loops; relations {score.translation_m.mean:.4f} m, "
            f"{np.degrees(score.rotation_rad.mean):.3f} degrees, {score.used} used; {took_s:.1f} s"
        )


def _pairs(maps: Iterable[Drive], sessions: Sequence[Drive]) -> Iterator[tuple[Drive, Drive]]:
    """Every map with every session."""
    return itertools.product(maps, sessions)


def _connected(known: Drive, session: Drive) -> tuple[Connection, float]:
    """What becomes of a session, and seconds."""
    one, other = known.opened(), session.opened()
    begun = time.perf_counter()
    found = connect(one, other)
    took_s = time.perf_counter() - begun
    one.close()
    other.close()
    return found, took_s


def _evidence(found: Connection) -> str:
    """Evidence for the likeliest place, and for its rival."""
    return f"{found.placing.nats:.1f}, {found.placing.rival_nats:.1f}"


def _scores(found: Connection, known: Drive, session: Drive) -> tuple[float, float, float]:
    """RMSE and greatest error of both sessions, and the RMSE of the worse one when mapped alone."""
    assert found.joined is not None and known.truth is not None and session.truth is not None
    whole = found.joined.contents.trajectory
    stamps_s = whole.stamps_s.copy()
    one, other = known.opened(), session.opened()
    stamps_s[len(one.trajectory) :] += _APART_S
    later = session.truth.stamps_s + _APART_S
    truth = one_after_another([known.truth, dataclasses.replace(session.truth, stamps_s=later)])
    moved = Trajectory(stamps_s, whole.positions_m, whole.quaternions_xyzw)
    joint = absolute_error(moved, truth).translation_m
    alone = max(
        absolute_error(one.trajectory, known.truth).translation_m.rmse,
        absolute_error(other.trajectory, session.truth).translation_m.rmse,
    )
    one.close()
    other.close()
    return joint.rmse, joint.max, alone


def _simulated(arguments: Namespace, home: int, seed: int) -> Drive:
    """A drive of the simulator."""
    name = f"{arguments.rig}-{home}-{seed}"
    folder = arguments.folder / name
    simulated = (folder / "groundtruth.txt").is_file()
    if not simulated and arguments.lidar_alone:
        _simulate_lidar(arguments, home, seed, folder)
    elif not simulated:
        length = () if arguments.duration is None else ("--duration", arguments.duration)
        chosen = ("--rig", arguments.rig, "--home", home, "--seed", seed, *length)
        scanweave("simulate", *chosen, "--format", "folder", "-o", folder)
    if seed > 1 and arguments.skip > 0.0:
        name += f"-from-{arguments.skip:g}"
        folder = _later(folder, arguments.folder / name, arguments.skip)
    flat = not (folder / "points.txt").is_file()
    log = folder / "scans.log" if flat and (arguments.lidar_alone or not _has_cameras(folder)) else folder
    map_name = f"map-{name}-lidar" if arguments.lidar_alone else f"map-{name}"
    truth = read_tum(folder / "groundtruth.txt")
    return Drive(name, f"home {home}", log, arguments.folder / map_name, truth)


def _simulate_lidar(arguments: Namespace, home: int, seed: int, folder: Path) -> None:
    """A drive without cameras, and with nobody about unless people are asked for."""
    rig = dataclasses.replace(RIGS[arguments.rig], cameras=())
    faults = DriveFaults(person=arguments.people)
    record_drive(
        generate_home(home), rig, seed, folder, faults, duration_s=arguments.duration, formats=("folder",)
    )


def _later(source: Path, folder: Path, skip_s: float) -> Path:
    """A recorded drive without its first seconds: another start."""
    folder.mkdir(exist_ok=True)
    lines = (source / "scans.log").read_text(encoding="ascii").splitlines()
    begin_s = skip_s + min(float(line.split()[-3]) for line in lines if line.startswith(_READINGS))
    _write_part(folder / "scans.log", lines, begin_s, np.inf)
    shutil.copyfile(source / "groundtruth.txt", folder / "groundtruth.txt")
    for listed in source.glob("*/*.txt"):
        camera = folder / listed.parent.name
        camera.mkdir(exist_ok=True)
        entries = listed.read_text(encoding="ascii").splitlines()
        kept = [entry for entry in entries if entry[0] == "#" or float(entry.split()[0]) >= begin_s]
        (camera / listed.name).write_text("\n".join(kept) + "\n", encoding="ascii")
        for beside in listed.parent.iterdir():
            if beside.suffix != ".txt" and not (camera / beside.name).exists():
                (camera / beside.name).symlink_to(beside.resolve())
    return folder


def _has_cameras(folder: Path) -> bool:
    """Whether a recorded drive holds more than its lidar's log."""
    return any(folder.glob("*/rgb.txt"))


def _pieces(drive: Drive, length_s: float, folder: Path) -> list[Drive]:
    """The lidar's log of a drive in pieces of a length; what is shorter is left out."""
    source = drive.log / "scans.log" if drive.log.is_dir() else drive.log
    lines = source.read_text(encoding="ascii").splitlines()
    stamps = [float(line.split()[-3]) for line in lines if line.startswith(_READINGS)]
    pieces = []
    for number in range(int((stamps[-1] - stamps[0]) / length_s)):
        begin_s = stamps[0] + number * length_s
        name = f"{drive.name}-{length_s:g}s-{number}"
        path = folder / f"{name}.log"
        _write_part(path, lines, begin_s, begin_s + length_s)
        pieces.append(Drive(name, drive.place, path, folder / f"map-{name}", drive.truth))
    return pieces


def _halves(argument: str, folder: Path) -> tuple[Drive, Drive]:
    """The two halves of a real CARMEN log."""
    log = Path(argument.rpartition(":")[0])
    lines = gzip.decompress(log.read_bytes()).decode("ascii").splitlines()
    stamps = sorted(float(line.split()[-3]) for line in lines if line.startswith(_READINGS))
    middle_s = stamps[len(stamps) // 2]
    name = log.name.partition(".")[0]
    halves = []
    for half, begin_s, end_s in ((1, -np.inf, middle_s), (2, middle_s, np.inf)):
        path = folder / f"{name}-half-{half}.log"
        _write_part(path, lines, begin_s, end_s)
        halves.append(Drive(path.stem, name, path, folder / f"map-{path.stem}", None))
    return halves[0], halves[1]


def _linked_halves(source: Path, folder: Path) -> list[Drive]:
    """The two halves of a log of frames or of clouds, as links to its files."""
    clouds = sorted(source.glob("velodyne/*.bin"))
    names = sorted({path.name.partition(".")[0] for path in clouds or source.glob("frame-*")})
    halves = []
    for half, part in enumerate((names[: len(names) // 2], names[len(names) // 2 :]), start=1):
        log = folder / f"{source.name}-half-{half}"
        inside = log / "velodyne" if clouds else log
        inside.mkdir(parents=True, exist_ok=True)
        for number, name in enumerate(part):
            for path in (source / "velodyne" if clouds else source).glob(f"{name}.*"):
                link = inside / (f"{number:06d}{path.suffix}" if clouds else path.name)
                if not link.exists():
                    link.symlink_to(path.resolve())
        for path in source.glob("*.txt"):
            if not path.name.startswith("frame-"):
                shutil.copyfile(path, log / path.name)
        if clouds:
            first = names.index(part[0])
            stamps = (source / "times.txt").read_text(encoding="ascii").splitlines()
            (log / "times.txt").write_text("\n".join(stamps[first : first + len(part)]) + "\n")
        halves.append(
            Drive(log.name, source.name, log, folder / f"map-{log.name}", open_dataset(log).groundtruth())
        )
    return halves


def _write_part(path: Path, lines: Iterable[str], begin_s: float, end_s: float) -> None:
    """The lines of a log with stamps from ``begin_s`` to before ``end_s``, and all that are no readings."""
    kept = [
        line for line in lines if not line.startswith(_READINGS) or begin_s <= float(line.split()[-3]) < end_s
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(kept) + "\n", encoding="ascii")


if __name__ == "__main__":
    main()
