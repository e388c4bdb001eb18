"""An experiment file: logs, configurations, and the references for the scores."""

from __future__ import annotations

import difflib
from collections import Counter
from pathlib import Path
from typing import Any, Literal, TypeAlias

from pydantic import Field, model_validator

import slam
from slam.config.files import StrictModel, find_file, model_of, nearest_field, read_tree

# Via the link to the top-level configs/, so that a wheel contains them like the presets.
_READY = Path(slam.__file__).parent / "presets" / "experiments"

Value: TypeAlias = bool | int | float | str | list[Any] | None
Baseline: TypeAlias = Literal[
    "wheels",
    "scan_matching",
    "no_loops",
    "no_fusion",
    "lidar_only",
    "rgbd_only",
    "kiss_icp",
    "open3d",
    "kiss_matching",
    "features",
    "dense",
]


class Simulation(StrictModel):
    """Drives of the simulator, one per home and seed; they are simulated once and cached."""

    rig: str = Field(default="xu2024", description="which robot, as in scanweave simulate")
    homes: list[int] = Field(min_length=1, description="seeds of plan and furniture")
    seeds: list[int] = Field(default=[0], min_length=1, description="seeds of tour, noise and faults")
    duration_s: float | None = Field(default=None, ge=1, description="one tour through all rooms if absent")
    faults: str = Field(default="usual", description="clocks, losses, people: none, usual or harsh")
    office: bool = Field(default=False, description="an office instead of a home")


class DatasetEntry(StrictModel):
    """One log, or several: exactly one of path, glob and simulate."""

    path: str | None = None
    glob: str | None = Field(default=None, description="pattern; every match is a data set")
    simulate: Simulation | None = None
    name: str | None = Field(default=None, description="in the tables; of a path only")
    group: str | None = Field(
        default=None, description="data sets of one group are not independent (drives in one home)"
    )
    relations: str | None = Field(default=None, description="relations file (Kuemmerle 2009)")
    groundtruth: str | None = Field(default=None, description="TUM file, where the log has no truth itself")

    @model_validator(mode="after")
    def _one_source(self) -> DatasetEntry:
        """Reject an entry without source or with several."""
        given = [name for name in ("path", "glob", "simulate") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"has {' and '.join(given) or 'none'} of path, glob and simulate; give one")
        alone = [name for name in ("name", "relations", "groundtruth") if getattr(self, name) is not None]
        if alone and self.path is None:
            raise ValueError(f"{alone[0]} belongs to one log; give it with path")
        return self


class Configuration(StrictModel):
    """A preset with overrides; a sweep creates one configuration per combination of its values."""

    name: str = Field(min_length=1)
    preset: str | None = Field(default=None, description="name of a preset, or a YAML file")
    overrides: dict[str, Value] = Field(default={}, description="as in scanweave map --set")
    sweep: dict[str, list[Value]] = Field(default={}, description="values by key; every combination is run")

    @model_validator(mode="after")
    def _sweeps_something(self) -> Configuration:
        """Reject a sweep without any value."""
        if empty := [key for key, values in self.sweep.items() if not values]:
            raise ValueError(f"sweep of '{empty[0]}' has no values; give at least one")
        return self


class External(StrictModel):
    """Trajectories of another system, scored like those of Scanweave."""

    name: str = Field(min_length=1)
    trajectory: str = Field(description="TUM file of the base; {dataset} stands for the data set's name")


class Command(StrictModel):
    """A program of the user; {out}, {python}, {data} and, if it runs per data set, {dataset} are replaced.

    Its {out}/trajectory.tum is scored; numbers in its JSON file of figures are added to the table.
    """

    name: str = Field(min_length=1)
    command: list[str] = Field(min_length=1)
    figures: str | None = Field(default=None, description="JSON file in {out}; nested keys join by dots")
    on_datasets: bool = Field(default=False, description="run on every data set, not once")


class Experiment(StrictModel):
    """Everything that determines a comparison, except the logs."""

    name: str = Field(min_length=1)
    description: str = ""
    datasets: list[DatasetEntry] = Field(default=[], description="logs, and drives to simulate")
    configurations: list[Configuration] = Field(default=[], description="of ours")
    baselines: list[Baseline] = Field(default=[], description="usual ones, by name")
    external: list[External] = Field(default=[], description="other systems' trajectories")
    commands: list[Command] = Field(default=[], description="programs of one's own")
    common: dict[str, Value] = Field(default={}, description="overrides of every configuration")
    reference: str | None = Field(
        default=None, description="the others are compared with this one, pair by pair; the first if absent"
    )
    seeds: list[int] = Field(default=[0], min_length=1, description="values of the configuration's seed")
    timeout_s: float = Field(default=3600.0, gt=0, description="a longer run is stopped")
    memory_mb: float = Field(default=8000.0, gt=0, description="a run that takes more is stopped")
    rpe_m: list[float] = Field(default=[1.0, 5.0, 10.0], description="lengths of the relative errors")

    @model_validator(mode="after")
    def _fits_together(self) -> Experiment:
        """Reject duplicate names, and an experiment without runs."""
        names = self.names()
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            raise ValueError(f"'{twice[0]}' names two configurations; give each its own name")
        if not names:
            raise ValueError("has no configurations, baselines, external or commands; give at least one")
        on_data = len(names) - sum(not command.on_datasets for command in self.commands)
        if on_data and not self.datasets:
            raise ValueError("has no datasets; give a path, a glob or a simulation")
        if self.reference is not None and self.reference not in names:
            hint = difflib.get_close_matches(self.reference, names, n=1) or names[:8]
            raise ValueError(f"reference '{self.reference}' is none of its names; nearest: {', '.join(hint)}")
        if not all(length > 0 for length in self.rpe_m):
            raise ValueError("rpe_m are lengths in metres; give numbers above 0")
        return self

    def names(self) -> list[str]:
        """Names of everything compared, in the order of the tables; parts of a sweep are named after it."""
        swept = [name for configuration in self.configurations for name, _ in swept_overrides(configuration)]
        others = [*(system.name for system in self.external), *(system.name for system in self.commands)]
        return [*swept, *map(baseline_name, self.baselines), *others]


def swept_overrides(configuration: Configuration) -> list[tuple[str, dict[str, Value]]]:
    """Name and overrides of every combination of a sweep; the configuration itself if there is no sweep."""
    swept = [(configuration.name, dict(configuration.overrides))]
    for key, values in configuration.sweep.items():
        short = key.rpartition(".")[2]
        swept = [
            (f"{name}, {short}={value}", {**overrides, key: value})
            for name, overrides in swept
            for value in values
        ]
    return swept


def baseline_name(baseline: Baseline) -> str:
    """A baseline's name in the tables."""
    shown = {
        "wheels": "wheels only",
        "scan_matching": "scan matching only",
        "kiss_icp": "KISS-ICP stock",
        "open3d": "Open3D stock",
        "rgbd_only": "RGB-D only",
        "kiss_matching": "KISS-ICP matching",
        "features": "features only",
        "dense": "Open3D dense",
    }
    return shown.get(baseline, baseline.replace("_", " "))


def find_experiment(name_or_path: str) -> Path:
    """Path of an experiment: a path if it ends in .yaml or .yml, else the name of a built-in one.

    Raises
    ------
    ConfigError
        If there is no experiment with that name.
    """
    return find_file(name_or_path, _READY, "experiment")


def load_experiment(path: Path) -> Experiment:
    """Read an experiment file.

    Raises
    ------
    ConfigError
        If the file is missing or malformed, a key is unknown (with the nearest one) or a value is invalid.
    """
    models = (Experiment, DatasetEntry, Simulation, Configuration, External, Command)
    return model_of(Experiment, read_tree(path), path.name, nearest_field(models))
