"""Two drives of one building with different starts, one of its mirror image, and the command on them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log

READINGS = ("ODOM", "FLASER")


@dataclass(frozen=True)
class Sessions:
    """Logs.

    Attributes
    ----------
    first
        A round through the north of the building.
    later
        The same way, driven at another time, and begun on its way.
    later_log, prefix, mirrored
        The log of ``later``; the beginning of the first one's; the building as seen in a mirror.
    """

    first: SyntheticLog
    later: SyntheticLog
    later_log: Path
    prefix: Path
    mirrored: Path


def sessions_in(folder: Path) -> Sessions:
    """Write the logs."""
    first = write_synthetic_log(folder / "first", seed=1, duration_s=34.0)
    later = write_synthetic_log(folder / "later", seed=2, duration_s=19.0)
    begin_s = float(first.truth.stamps_s[0])
    later_log = part_of(later.log_path, folder / "later.log", begin_s + 9.0, begin_s + 99.0)
    return Sessions(
        first,
        later,
        later_log,
        part_of(first.log_path, folder / "prefix.log", begin_s, begin_s + 20.0),
        mirror_of(later_log, folder / "mirrored.log"),
    )


def part_of(log: Path, path: Path, begin_s: float, end_s: float) -> Path:
    """The readings of a log from one stamp to another."""
    lines = log.read_text().splitlines()
    kept = [
        line for line in lines if not line.startswith(READINGS) or begin_s <= float(line.split()[-3]) < end_s
    ]
    path.write_text("\n".join(kept) + "\n")
    return path


def mirror_of(log: Path, path: Path) -> Path:
    """A log as from the mirrored building: beams in reverse, left turns right."""
    lines = []
    for line in log.read_text().splitlines():
        fields = line.split()
        if line.startswith("FLASER"):
            count = int(fields[1])
            fields[2 : 2 + count] = fields[2 : 2 + count][::-1]
        if line.startswith(READINGS):
            at = [2, 3] if line.startswith("ODOM") else [-8, -7, -5, -4]
            for n in at:
                fields[n] = str(-float(fields[n]))
        lines.append(" ".join(fields))
    path.write_text("\n".join(lines) + "\n")
    return path
