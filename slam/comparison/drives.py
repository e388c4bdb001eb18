"""Simulated drives of an experiment: identified by all their inputs, simulated once, and cached."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import slam
from slam.comparison.experiment import Simulation
from slam.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Drive:
    """One drive through one home, see `slam.simulation.record.record_drive`."""

    rig: str
    home: int
    seed: int
    duration_s: float | None
    faults: str
    office: bool

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{self.rig} {self.group} drive {self.seed}"

    @property
    def group(self) -> str:
        """Group: drives through the same home are not independent."""
        return f"{'office' if self.office else 'home'} {self.home}"

    @property
    def identity(self) -> str:
        """Hash of the drive and of the simulator's code, because another simulator gives another drive."""
        reported = json.dumps([asdict(self), _simulator_digest()], sort_keys=True)
        return hashlib.blake2b(reported.encode(), digest_size=8).hexdigest()

    @property
    def folder_name(self) -> str:
        """Folder name in the cache."""
        return f"{self.rig}-{self.group.replace(' ', '-')}-{self.seed}-{self.identity}"


def drives_of(simulation: Simulation) -> Iterator[Drive]:
    """The drives of an entry, home by home.

    Raises
    ------
    ConfigError
        If rig or faults are unknown.
    """
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.rigs import RIGS

    for what, name, known in (("rig", simulation.rig, RIGS), ("faults", simulation.faults, FAULT_PRESETS)):
        if name not in known:
            raise ConfigError(f"simulate.{what} is '{name}'; there are {', '.join(sorted(known))}")
    for home in simulation.homes:
        for seed in simulation.seeds:
            yield Drive(
                simulation.rig, home, seed, simulation.duration_s, simulation.faults, simulation.office
            )


def record(drive: Drive, folder: Path) -> None:
    """Simulate a drive into a new folder.

    Raises
    ------
    ScanweaveError
        If it cannot be planned or written.
    """
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.home import generate_home
    from slam.simulation.record import record_drive
    from slam.simulation.rigs import RIGS

    home = generate_home(drive.home, "office" if drive.office else "home")
    faults = FAULT_PRESETS[drive.faults]
    record_drive(home, RIGS[drive.rig], drive.seed, folder, faults, drive.duration_s, formats=("folder",))


def is_recorded(folder: Path) -> bool:
    """Whether a drive is in the cache; only complete drives appear there."""
    return (folder / "groundtruth.txt").is_file()


@cache
def _simulator_digest() -> str:
    """Digest of the simulator's source."""
    digest = hashlib.blake2b(digest_size=8)
    for file in sorted((Path(slam.__file__).parent / "simulation").glob("*.py")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()
