"""One run, serialisable for the worker and for the process of the run."""

# Uses only the standard library, so that the process of a run starts fast.
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

SCANWEAVE = "scanweave"
# Scanweave's mapper with another odometry, see `slam.comparison.methods.ODOMETRIES`.
OTHER_ODOMETRY = frozenset({"kiss_matching", "dense"})


@dataclass(frozen=True, slots=True)
class Run:
    """One run in plain types, for the worker and for the process of the run.

    Attributes
    ----------
    key
        Hash of data set, effective configuration and code; equal keys have equal results.
    configuration
        Name in the tables.
    method
        ``scanweave``, a baseline of its own (``wheels``, ``kiss_icp``, ``open3d``), one of
        `OTHER_ODOMETRY`, ``external`` or ``command``.
    dataset, group, log, relations, groundtruth
        As in `slam.comparison.runs.Source`; empty if there is none.
    seed
        Seed of the configuration.
    config
        The effective configuration as JSON; empty if there is none.
    trajectory, command, figures
        Inputs of an external system.
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
        """Convert to plain types for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Run:
        """Create from plain types of JSON."""
        return cls(**{**values, "rpe_m": tuple(values["rpe_m"]), "command": tuple(values["command"])})
