"""Expands an experiment to its runs, each with a key: the hash of everything that determines its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slam.comparison.dense_odometry import POINTS_IGNORED
from slam.comparison.drives import Drive, drives_of
from slam.comparison.experiment import (
    Baseline,
    DatasetEntry,
    Experiment,
    Value,
    baseline_name,
    swept_overrides,
)
from slam.comparison.run import OTHER_ODOMETRY, SCANWEAVE, Run
from slam.config import Config, load_config
from slam.errors import DatasetError, MapFileError
from slam.storage.map_identity import current_versions, fingerprint_of

# A baseline is a Scanweave configuration or a separate method.
_NO_LOOPS: dict[str, Value] = {"loops.enabled": False}
_OVERRIDES: dict[Baseline, dict[str, Value]] = {
    "scan_matching": {
        **_NO_LOOPS,
        "sensors.rgbd": False,
        "sensors.wheels": False,
    },
    "no_loops": _NO_LOOPS,
    "no_fusion": {"fusion.enabled": False},
    "lidar_only": {"sensors.rgbd": False},
    "rgbd_only": {"sensors.lidar": False},
    "kiss_matching": {},
    "dense": {},
    "features": {"rgbd_odometry.correlated_points": POINTS_IGNORED},
}


@dataclass(frozen=True, slots=True)
class Source:
    """A data set of the experiment.

    Attributes
    ----------
    name, group
        Name and group in the tables; data sets of one group are not independent.
    path
        Path of the log; for a simulated drive, its future path.
    drive
        How it is simulated; None for an existing log.
    relations, groundtruth
        References for scoring, in addition to the ground truth in the log.
    """

    name: str
    group: str
    path: Path
    drive: Drive | None = None
    relations: Path | None = None
    groundtruth: Path | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """The expanded experiment: its data sets, and its runs in the order of the tables."""

    experiment: Experiment
    sources: tuple[Source, ...]
    runs: tuple[Run, ...]
    reference: str
    versions: dict[str, str] = field(default_factory=dict)


def plan_of(experiment: Experiment, data: Path, cache: Path) -> Plan:
    """Expand an experiment.

    Parameters
    ----------
    data
        Base folder of relative paths.
    cache
        Folder of simulated drives.

    Raises
    ------
    ConfigError
        If a configuration does not fit the model, or a rig is unknown.
    DatasetError, MapFileError
        If a file is missing.
    """
    sources = tuple(source for entry in experiment.datasets for source in _sources(entry, data, cache))
    names = [source.name for source in sources]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(f"two data sets are called '{twice[0]}'; give each its own name")
    versions = current_versions()
    fingerprints: dict[Path, str] = {}
    runs = [
        _keyed(run, versions, fingerprints, {source.path: source for source in sources})
        for run in _runs(experiment, sources, data)
    ]
    return Plan(experiment, sources, tuple(runs), experiment.reference or experiment.names()[0], versions)


def _sources(entry: DatasetEntry, data: Path, cache: Path) -> Iterator[Source]:
    """The data sets of one entry."""
    if entry.simulate is not None:
        for drive in drives_of(entry.simulate):
            yield Source(drive.name, entry.group or drive.group, cache / drive.folder_name, drive)
    elif entry.glob is not None:
        root = data if not Path(entry.glob).is_absolute() else Path(entry.glob).anchor
        paths = sorted(Path(root).glob(entry.glob.removeprefix(str(Path(entry.glob).anchor))))
        if not paths:
            raise DatasetError(f"nothing matches {entry.glob} under {root}; is --data right?")
        yield from (Source(path.name, entry.group or path.name, path) for path in paths)
    else:
        assert entry.path is not None
        path = _existing(data / entry.path)
        name = entry.name or path.name.partition(".")[0]
        truths = [
            None if file is None else _existing(data / file) for file in (entry.relations, entry.groundtruth)
        ]
        yield Source(name, entry.group or name, path, None, *truths)


def _existing(path: Path) -> Path:
    """The path, if it exists."""
    if not path.exists():
        raise DatasetError(f"{path} does not exist; relative paths are taken from --data")
    return path


def _runs(experiment: Experiment, sources: Sequence[Source], data: Path) -> Iterator[Run]:
    """All runs without their keys; runs that depend on no seed occur once per data set."""
    for configuration, method, config in _configs(experiment):
        for source in sources:
            for seed in experiment.seeds:
                seeded = config.model_copy(update={"seed": seed})
                yield _run(experiment, configuration, method, source, seed, config=seeded.model_dump_json())
    for baseline in experiment.baselines:
        if baseline not in _OVERRIDES:
            for source in sources:
                yield _run(experiment, baseline_name(baseline), baseline, source, 0)
    for external in experiment.external:
        for source in sources:
            file = data / external.trajectory.replace("{dataset}", source.name)
            yield _run(experiment, external.name, "external", source, 0, trajectory=str(file))
    for program in experiment.commands:
        reported = {"{data}": str(data.resolve())}
        for on in sources if program.on_datasets else [None]:
            words = tuple(
                _filled(word, reported | ({"{dataset}": str(on.path)} if on else {}))
                for word in program.command
            )
            yield _run(
                experiment, program.name, "command", on, 0, command=words, figures=program.figures or ""
            )


def _configs(experiment: Experiment) -> Iterator[tuple[str, str, Config]]:
    """Name, method and effective configuration of every Scanweave configuration."""
    for configuration in experiment.configurations:
        for name, overrides in swept_overrides(configuration):
            yield name, SCANWEAVE, _config(configuration.preset, {**experiment.common, **overrides})
    for baseline in experiment.baselines:
        if baseline in _OVERRIDES:
            method = baseline if baseline in OTHER_ODOMETRY else SCANWEAVE
            config = _config(None, {**experiment.common, **_OVERRIDES[baseline]})
            yield baseline_name(baseline), method, config


def _config(preset: str | None, overrides: dict[str, Value]) -> Config:
    """An effective configuration; JSON is valid YAML, so values are passed as text of overrides."""
    return load_config(preset, [f"{key}={json.dumps(value)}" for key, value in overrides.items()])


def _run(
    experiment: Experiment, configuration: str, method: str, source: Source | None, seed: int, **own: Any
) -> Run:
    """A run without its key."""
    return Run(
        configuration=configuration,
        method=method,
        dataset="" if source is None else source.name,
        group="" if source is None else source.group,
        log="" if source is None else str(source.path.resolve()),
        relations="" if source is None or source.relations is None else str(source.relations.resolve()),
        groundtruth="" if source is None or source.groundtruth is None else str(source.groundtruth.resolve()),
        seed=seed,
        timeout_s=experiment.timeout_s,
        memory_mb=experiment.memory_mb,
        rpe_m=tuple(experiment.rpe_m),
        **own,
    )


def _filled(word: str, reported: dict[str, str]) -> str:
    """A word of a command with placeholders replaced; the worker replaces {out} and {python}."""
    for name, value in reported.items():
        word = word.replace(name, value)
    return word


def _keyed(
    run: Run, versions: dict[str, str], fingerprints: dict[Path, str], sources: dict[Path, Source]
) -> Run:
    """The run with its key, without the limits, which do not change the result."""
    drives = {str(path.resolve()): source.drive for path, source in sources.items()}
    files: dict[str, Any] = {}
    for name in ("log", "relations", "groundtruth", "trajectory"):
        text = getattr(run, name)
        drive = drives.get(text)
        if name == "log" and drive is not None:
            files[name] = drive.identity
        elif text:
            files[name] = _fingerprint(Path(text), fingerprints)
    decisive: dict[str, Any] = {
        **run.to_dict(),
        **files,
        "versions": versions,
        "timeout_s": None,
        "memory_mb": None,
    }
    digest = hashlib.blake2b(json.dumps(decisive, sort_keys=True).encode(), digest_size=10)
    return Run.from_dict({**run.to_dict(), "key": digest.hexdigest()})


def _fingerprint(path: Path, known: dict[Path, str]) -> str:
    """Fingerprint of a file or folder, cached; empty for a missing trajectory, whose run will fail."""
    if path not in known:
        try:
            known[path] = fingerprint_of(path) if path.exists() else "absent"
        except (DatasetError, MapFileError) as error:
            raise DatasetError(f"cannot take the fingerprint of {path}: {error}") from error
    return known[path]
