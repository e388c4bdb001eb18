"""Flat scans of clouds are read when they are asked for, and are those that were made."""

from __future__ import annotations

import numpy as np

from slam.measurements import LaserScan
from slam.storage.map_parts import KeptScans
from slam.storage.packing import pack


def _scans() -> list[LaserScan]:
    ranges_m = np.random.default_rng(0).uniform(0.5, 9.0, (5, 90)).astype(np.float32)
    ranges_m[:, ::7] = np.nan
    return [LaserScan(float(stamp), row, 0.0, 0.07, 20.0) for stamp, row in enumerate(ranges_m)]


def test_scans_on_disk_are_those_that_were_made() -> None:
    made = _scans()
    kept = KeptScans.on_disk(iter(made))
    assert [pack(scan) for scan in kept] == [pack(scan) for scan in made]
    assert pack(kept[-1]) == pack(made[-1])
    assert [pack(scan) for scan in kept[1:3]] == [pack(scan) for scan in made[1:3]]


def test_two_who_go_through_them_together_are_given_the_same() -> None:
    asked = list[int]()
    made = _scans()

    def read(number: int) -> LaserScan:
        asked.append(number)
        return made[number]

    kept = KeptScans(len(made), read)
    assert all(one is other for one, other in zip(kept, kept, strict=True))
    assert asked == [0, 1, 2, 3, 4]
