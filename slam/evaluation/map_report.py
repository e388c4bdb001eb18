"""Results of a run, as shown in its report."""

from __future__ import annotations

import resource
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.datasets.dataset import Dataset, ReadReport
from slam.datasets.sensor_choice import use_lines
from slam.errors import ScanweaveError
from slam.evaluation.trajectory_error import TruthComparison, compare_with_truth
from slam.graph.edge import EdgeKind
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import CameraRecord
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray
from slam.storage.map_contents import SavedFactor
from slam.storage.map_identity import current_versions
from slam.storage.map_sessions import MapSession
from slam.storage.ply import read_cloud_ply

CLOUD_FILE = "cloud.ply"
# A larger share of unmatched scans gives a warning at the top of the page.
_UNMATCHED_SHARE = 0.01
# A smaller share of matching places of a camera, too; good recordings have 0.3 to 0.8: docs/figures/input.md.
_FITTING_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class RunCost:
    """Cost of a run up to the report."""

    wall_s: float
    cpu_s: float

    @staticmethod
    def peak_memory_mb() -> float:
        """Return the peak resident memory of this process so far."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)


@dataclass(frozen=True, slots=True)
class Beside:
    """Additional data of a report: the ground truth trajectory, the coloured cloud."""

    truth: TruthComparison | None = None
    cloud: ColoredCloud | None = None
    warnings: tuple[str, ...] = ()


def beside_of(
    dataset: Dataset, result: MapResult, written: Iterable[Path], warnings: Iterable[str] = ()
) -> Beside:
    """Collect additional data of a report. Missing data give a warning, since the map itself is finished.

    Parameters
    ----------
    written
        The files of the run; the cloud of the images is read from there, not fused again.
    warnings
        Warnings about files that could not be written.
    """
    truth, cloud, lines = None, None, list(warnings)
    try:
        true_trajectory = dataset.groundtruth()
        if true_trajectory is not None:
            truth = compare_with_truth(result.map.trajectory, true_trajectory)
            if truth.error.mirrored:
                lines.append(f"The map disagrees with the ground truth: {truth.error.mirrored}")
    except ScanweaveError as error:
        lines.append(f"Not compared with the ground truth: {error}")
    try:
        for path in written:
            if path.name == CLOUD_FILE and result.map.frames is not None:
                cloud = read_cloud_ply(path)
    except ScanweaveError as error:
        lines.append(f"No picture of the coloured map: {error}")
    return Beside(truth, cloud, tuple(lines))


@dataclass(frozen=True, slots=True)
class ReportData:
    """Data of a run for its report.

    Attributes
    ----------
    sessions, digest
        Sessions and digest of the saved map, see `slam.Map`.
    """

    log_name: str
    reading: ReadReport
    result: MapResult
    config: Config
    cost: RunCost
    beside: Beside = Beside()
    sessions: Sequence[MapSession] = ()
    digest: str = ""

    @property
    def unit(self) -> Literal["scan", "frame"]:
        """Return the kind of readings of the map: ``frame`` if there were only cameras."""
        return "scan" if any(scan is not None for scan in self.result.map.keyframe_scans) else "frame"

    @property
    def warnings(self) -> list[str]:
        """Return the warnings about the map, one line each."""
        return [*self.result.warnings, *_warnings(self), *self.beside.warnings]

    @property
    def notes(self) -> list[tuple[str, str]]:
        """Return notes of the reader, the graph and the run: subject and value."""
        uses = use_lines(self.result.uses)
        notes = [("note", note) for note in self.result.notes if note not in uses]
        return _reader_notes(self.reading) + _edge_notes(self.result.map.factors) + notes

    @property
    def sensors(self) -> list[tuple[str, str, str, str]]:
        """Return the use of everything in the log: name, kind, readings, and whether it is used."""
        return [
            (use.sensor, use.kind, f"{use.readings:,}", f"no: {use.why_not}" if use.why_not else "yes")
            for use in self.result.uses
        ]

    def registrations(self) -> list[tuple[str, str]]:
        """Return for every camera whether colour is registered to depth, in a line with the reason."""
        cameras = self.result.cameras
        return [(name, _registration_text(record, self.config)) for name, record in cameras.items()]

    @staticmethod
    def versions() -> list[tuple[str, str]]:
        """Return versions by library, and the digest of Scanweave's own source."""
        return list(current_versions().items())


def _reader_notes(reading: ReadReport) -> list[tuple[str, str]]:
    """Return notes of the reader as rows."""
    rows = [(f"read: {name}", f"{count:,}") for name, count in sorted(reading.records.items())]
    for reason, tally in sorted(reading.dropped.items()):
        rows.append((f"dropped: {reason}", f"{tally.count:,} (first at line {tally.lines[0]})"))
    for sensor, tally in sorted(reading.backward_steps.items()):
        rows.append((f"stamps backward: {sensor}", f"{tally.count:,} (largest {tally.largest:.3f} s)"))
    for note, tally in sorted(reading.notes.items()):
        rows.append((note, f"{tally.count:,}"))
    return rows


def _edge_notes(factors: Sequence[SavedFactor]) -> list[tuple[str, str]]:
    """Return the edges of the graph by source, and the number of rejected ones."""
    kinds = Counter(factor.edge.kind for factor in factors)
    refused = Counter(factor.edge.kind for factor in factors if not factor.kept)
    return [
        (f"edges: {kind}", f"{count:,}" + (f" ({refused[kind]:,} refused)" if refused[kind] else ""))
        for kind, count in kinds.items()
    ]


def _registration_text(record: CameraRecord, config: Config) -> str:
    """Return whether a camera's colour is registered to its depth, with the evidence."""
    registration = record.learned.registration
    if registration is None:
        is_auto = config.rgbd.registration == "auto"
        return "taken as registered" if is_auto else "taken as registered (rgbd.registration=given)"
    reason = registration.reason
    return f"registered by the log itself: {reason}" if registration.accepted else reason


def _warnings(data: ReportData) -> list[str]:
    """Return warnings from the scores of the scans or frames."""
    lines = list[str]()
    scans, unit = data.result.scans, data.unit
    count, carried = scans.stamps_s.size, _carried_by_cameras(data.result)
    if not count:
        return lines
    lost = int(np.count_nonzero(scans.unmatched & ~carried))
    if lost > _UNMATCHED_SHARE * count:
        lines.append(f"{lost:,} of {count:,} {unit}s matched nothing; their motion is from dead reckoning.")
    helped = int(np.count_nonzero(scans.unmatched & carried))
    if unit == "scan" and helped > _UNMATCHED_SHARE * count:
        lines.append(f"At {helped:,} of {count:,} moments only the cameras gave a motion, not the lidar.")
    tried, fitted = len(data.result.map.loops), sum(loop.accepted for loop in data.result.map.loops)
    if unit == "frame" and tried >= FEWEST // 2 and fitted < _FITTING_SHARE * tried:
        lines.append(
            f"Only {fitted:,} of the {tried:,} revisited places match what the camera saw there before: "
            "its lens, registration or depth is wrong, or its colour and depth images have different times."
        )
    degenerate = float(scans.degenerate.mean())
    if degenerate > _UNMATCHED_SHARE:
        what = "corridors" if unit == "scan" else "flat or empty views"
        lines.append(
            f"{degenerate:.1%} of the {unit}s do not fix one direction ({what}); its variance was inflated."
        )
    return lines


def _carried_by_cameras(result: MapResult) -> BoolArray:
    """Return (S,) whether a robot's cameras measured the step between the keyframes around each time.

    If the map is made of frames, a lost frame stays lost.
    """
    count, keyframes = result.scans.stamps_s.size, result.map.readings
    reported = np.zeros(len(keyframes), dtype=np.bool_)
    for factor in result.map.factors if result.map.planar else ():
        edge = factor.edge
        if factor.kept and edge.kind is EdgeKind.RGBD and edge.target == edge.source + 1:
            reported[edge.target] = True
    # After the last keyframe, the robot has hardly moved: the value before stays valid.
    return reported[np.minimum(np.searchsorted(keyframes, np.arange(count)), len(keyframes) - 1)]
