"""One run as it travels: to the worker, and from there to the process that does it."""

# Only the standard library: the process of a run that needs nothing else starts at once.
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

SCANWEAVE = "scanweave"
# Our mapper with an odometry of others, see `slam.comparison.methods.ODOMETRIES`.
OTHER_ODOMETRY = frozenset({"kiss_matching", "dense"})


@dataclass(frozen=True, slots=True)
class Run:
    """One run, in plain types: it travels to the worker, and from there to the process that does it.

    Attributes
    ----------
    key
        Hash of data set, effective configuration and code: the same key, the same result.
    configuration
        Name in the tables.
    method
        ``scanweave``, a baseline of its own (``wheels``, ``kiss_icp``, ``open3d``), one of
        `OTHER_ODOMETRY`, ``external`` or ``command``.
    dataset, group, log, relations, groundtruth
        As in `slam.comparison.runs.Source`; empty if there is none.
    seed
        Of the configuration.
    config
        The effective configuration as JSON; empty if none decides.
    trajectory, command, figures
        Of an outside system.
    timeout_s, memory_mb, rpe_m
        As in the experiment.
    """

    configuration: str
    method: str
    dataset: str
    group: str
    log: str
    relations: str
    groundtruth: str
    seed: int
    timeout_s: float
    memory_mb: float
    rpe_m: tuple[float, ...]
    config: str = ""
    trajectory: str = ""
    command: tuple[str, ...] = ()
    figures: str = ""
    key: str = ""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Run:
        """From JSON."""
        return cls(**{**values, "rpe_m": tuple(values["rpe_m"]), "command": tuple(values["command"])})
