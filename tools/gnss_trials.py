"""What fixes of a satellite receiver are worth: streets without an IMU, with a gap of the lidar.

    python tools/gnss_trials.py STREET/log.mcap [...] [--gap BEGIN END] [--until SECONDS]

Each is a bag of ``scanweave simulate --street``, with ``groundtruth.txt`` beside it. It is mapped without its
IMU, with its fixes and without; each row has the error of the path aligned to the truth, and how often
the 95 % ellipses hold it. What the runs say goes to stderr.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator
from pathlib import Path

import slam
from slam.datasets import open_dataset
from slam.datasets.dataset import Dataset
from slam.evaluation.coverage import coverage
from slam.evaluation.trajectory_error import absolute_error
from slam.measurements import GnssFix, ImuReading, Measurement, PointCloud
from slam.storage.tum import read_tum


def cut(log: Dataset, gap_s: tuple[float, float], until_s: float, *, fixes: bool) -> Iterator[Measurement]:
    """A log without the IMU, the clouds of the gap, and perhaps the fixes."""
    begun_s = None
    for one in log:
        begun_s = one.stamp_s if begun_s is None else begun_s
        at_s = one.stamp_s - begun_s
        blind = isinstance(one, PointCloud) and gap_s[0] < at_s < gap_s[1]
        if at_s > until_s:
            return
        if not (blind or isinstance(one, ImuReading) or (isinstance(one, GnssFix) and not fixes)):
            yield one


def main() -> None:
    """Map every street with and without fixes."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("streets", nargs="+", type=Path)
    parser.add_argument("--gap", nargs=2, type=float, default=(0.0, 0.0), help="seconds without clouds")
    parser.add_argument("--until", type=float, default=float("inf"), help="seconds that are mapped")
    arguments = parser.parse_args()
    print("| street | ATE RMSE, m | worst | 95 % ellipses hold |\n|---|---|---|---|", flush=True)
    for street in arguments.streets:
        truth = read_tum(street.parent / "groundtruth.txt")
        for fixes in (False, True):
            log = cut(open_dataset(street), tuple(arguments.gap), arguments.until, fixes=fixes)
            made = slam.build_map(log)
            error = absolute_error(made.trajectory, truth).translation_m
            assert made.covariances is not None
            held = coverage(made.trajectory, made.covariances, truth, 0.02)
            name = f"{street.parent.name}, {'with fixes' if fixes else 'loops alone'}"
            print(f"| {name} | {error.rmse:.2f} | {error.max:.2f} | {held.position:.2f} |", flush=True)
            gnss_notes = [note for note in made.notes if note.startswith("GNSS")]
            print("; ".join([*gnss_notes, *made.warnings]), file=sys.stderr)
            made.close()


if __name__ == "__main__":
    main()
