"""Kill the mapping of a log at random moments, resume it, and compare with an uninterrupted run.

    python tools/kill_trials.py LOG --kills 50 --out DIR [--set ...]

Every attempt runs ``scanweave map LOG -o FOLDER --resume`` and is killed (SIGKILL) after a random part of the
time that the uninterrupted run took, so that kills meet the start, the replay, the mapping, the last
optimisation and the writing alike. Where an attempt ends by itself, its files must be the same bytes as those
of the uninterrupted run; the next attempt begins a new map.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

# What must be the same. The report contains times, and a surface's last bits depend on Open3D's threads.
COMPARED = ("trajectory.tum", "graph.g2o", "map.yaml", "map.pgm", "map.db")
_COMMAND = "import sys; from slam.cli import main; sys.argv[0] = 'scanweave'; main()"


@dataclass(slots=True)
class Trials:
    """What became of the attempts."""

    kills: int = 0
    finished: int = 0
    faults: list[str] = field(default_factory=list)


def run_trials(
    log: Path, out: Path, kills: int, seed: int, settings: Sequence[str] = (), begins: float = 0.0
) -> Trials:
    """Map once uninterrupted, then kill and resume until there were so many kills.

    Parameters
    ----------
    begins
        No kill comes before this share of the time that the uninterrupted run took.
    """
    out.mkdir(parents=True, exist_ok=True)
    whole, folder = out / "whole", out / "killed"
    started = time.monotonic()
    first = subprocess.run(_arguments(log, whole, settings), capture_output=True, text=True, check=False)
    if first.returncode:
        raise SystemExit(f"the uninterrupted run failed: {first.stderr}")
    whole_s = time.monotonic() - started
    rng, trials = np.random.default_rng(seed), Trials()
    shutil.rmtree(folder, ignore_errors=True)
    begun = True
    while not trials.faults and (trials.kills < kills or begun):
        patience_s = whole_s * rng.uniform(begins, 1.05) if trials.kills < kills else 100.0 * whole_s + 60.0
        _attempt(_arguments(log, folder, settings), patience_s, trials)
        begun = not _finished(folder)
        if not begun:
            trials.finished += 1
            trials.faults += _differences(whole, folder)
            if not trials.faults:  # else it stays, to be looked at
                shutil.rmtree(folder)
    return trials


def _arguments(log: Path, folder: Path, settings: Sequence[str]) -> list[str]:
    """The command of one attempt."""
    chosen = [part for setting in settings for part in ("--set", setting)]
    return [sys.executable, "-c", _COMMAND, "map", str(log), "-o", str(folder), "--resume", *chosen]


def _attempt(arguments: list[str], patience_s: float, trials: Trials) -> None:
    """Run once, at most for so long."""
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        complaint = process.communicate(timeout=patience_s)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        trials.kills += 1
        return
    if process.returncode:
        trials.faults.append(f"exit code {process.returncode}: {complaint.strip()[-500:]}")


def _finished(folder: Path) -> bool:
    """Whether the map was sealed, and nothing is beside it."""
    from slam.errors import MapFileError
    from slam.outputs.finished_map import load_map

    try:
        load_map(folder).close()
    except MapFileError:
        return False
    return True


def _differences(whole: Path, folder: Path) -> list[str]:
    """Files that are not the same."""
    return [
        f"{name} differs"
        for name in COMPARED
        if (whole / name).exists() != (folder / name).exists()
        or ((whole / name).exists() and (whole / name).read_bytes() != (folder / name).read_bytes())
    ]


def main() -> None:
    """Run and tell."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    arguments = parser.parse_args()
    found = run_trials(arguments.log, arguments.out, arguments.kills, arguments.seed, arguments.settings)
    print(f"{found.kills} kills, {found.finished} maps finished, {len(found.faults)} faults")
    for fault in found.faults:
        print(fault)
    sys.exit(bool(found.faults))


if __name__ == "__main__":
    main()
