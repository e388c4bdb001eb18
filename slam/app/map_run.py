"""Run one log through the mapper into one folder: map.db, the exported files and the report."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.showing import one_line
from slam.app.map_folder import finished_map, opened_map
from slam.app.progress import OnProgress, Progress
from slam.datasets.dataset import Dataset
from slam.errors import ScanweaveError
from slam.forked import Begun, is_core_free
from slam.heap import end_stage
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.storage.files import make_folder
from slam.storage.map_contents import MapContents, write_contents
from slam.storage.map_facts import write_facts
from slam.storage.map_file import MAP_NAME
from slam.storage.map_identity import NOTES, WARNINGS, MapIdentity
from slam.storage.map_places import write_places
from slam.storage.map_sessions import MapSession, sessions_of
from slam.temporary import TemporaryFolder
from slam.viewer.map_recording import record_map
from slam.viewer.viewer import recording

if TYPE_CHECKING:
    from slam.evaluation.map_report import ReportData
    from slam.outputs.exports import Exports
    from slam.outputs.finished_map import Map


@dataclass(frozen=True)
class MapRun:
    """What became of a run.

    Attributes
    ----------
    report
        Content of its report; None if the map was finished before, and nothing was done.
    written
        The files, ``map.db`` and the report among them.
    dropped
        Records of the log that were refused.
    kept_in
        A temporary folder that goes with the map.
    """

    folder: Path
    report: ReportData | None
    written: tuple[Path, ...]
    dropped: int = 0
    kept_in: TemporaryFolder | None = None

    __repr__ = one_line

    @cached_property
    def map(self) -> Map:
        """The finished map, opened when first asked for: what anybody reads from the file."""
        from slam.outputs.finished_map import load_map

        return load_map(self.folder, self.kept_in)


def run_into(
    folder: Path,
    dataset: Dataset,
    identity: MapIdentity,
    *,
    on_progress: OnProgress,
    resume: bool = False,
    exports: bool = True,
    report: bool = True,
    record: Path | None = None,
) -> MapRun:
    """Map a log into a folder.

    Parameters
    ----------
    folder
        Made where it is missing; what an earlier run has left there is replaced, unless ``resume``.
    identity
        What decides the map: the settings, and which log it is.
    resume
        Go on with what an interrupted run of the same log and settings has left.
    exports, report
        Whether the files for other programs, and ``report.html``, are written beside ``map.db``.
    record
        Where a recording for the Rerun viewer goes; None for none.

    Raises
    ------
    ScanweaveError
        If the log holds nothing to map, a file is at fault, or what is resumed does not fit.
    """
    started = time.perf_counter()
    make_folder(folder)
    if resume and finished_map(folder, identity):
        return MapRun(folder, None, ())
    config = identity.config
    with ExitStack() as stack:
        viewer = stack.enter_context(recording(record))
        file = stack.enter_context(opened_map(folder, identity, resume=resume))

        def on_step(stage: str, count: int) -> None:
            if stage == "begun":
                # Loaded while a copy of the process tracks (`slam.mapper.lookahead`), not before that begins.
                import slam.evaluation.report
                import slam.outputs.exports  # noqa: F401

                return
            on_progress(Progress(stage, count, dataset.report.share if stage == "mapping" else None))

        result = build_map(dataset, config, on_step, Checkpoint(file))
        readings = result.scans.stamps_s.size
        on_progress(Progress("writing", readings))
        before = time.perf_counter()
        beside_file = _beside_file(folder, result, identity, exports=exports, report=report)
        result.stage_seconds["files for other programs"] = time.perf_counter() - before
        if viewer is not None:
            record_map(viewer, result, config)
        before = time.perf_counter()
        made = result.map
        write_contents(file, made)
        write_facts(file, made.ground_m, made.georeference, made.node_poses[0], made.clock_sigma_s)
        write_places(file, made.places, made.node_poses[0])
        file.add_meta(NOTES, json.dumps(result.notes))
        file.add_meta(WARNINGS, json.dumps(result.warnings))
        files, missing = beside_file()
        digest = file.seal()
    result.stage_seconds["map.db"] = time.perf_counter() - before
    run = MapRun(folder, None, (*files, folder / MAP_NAME), dataset.report.dropped_count)
    if not report:
        return run
    from slam.evaluation.map_report import ReportData, RunCost, beside_of
    from slam.evaluation.report import write_report

    cost = RunCost(time.perf_counter() - started, sum(os.times()[:4]))
    beside, sessions = beside_of(dataset, result, files, missing), _sessions(result.map, identity)
    data = ReportData(identity.log_name, dataset.report, result, config, cost, beside, sessions, digest)
    run = replace(run, report=data, written=(*run.written, folder / "report.html"))
    with ExitStack() as stack:
        if _needs_file(result.map):
            result.map = replace(result.map, grids={})  # one in memory at a time
            result.map = run.map.contents
            stack.callback(run.map.close)
        end_stage()
        write_report(folder / "report.html", data, beside_file)
        stack.pop_all()
    return run


def _beside_file(
    folder: Path, result: MapResult, identity: MapIdentity, *, exports: bool, report: bool
) -> Callable[[], Any]:
    """What is made while ``map.db`` is written: files for other programs, as `_written`, and `_head`.

    Images and clouds are in the file, which is open here: their files are written first. There, and where
    no core is free, the head is None.
    """
    from slam.outputs.exports import Exports

    made = Exports(result.map, identity.config, result.ground)
    export: Callable[[], Any] = partial(_written, folder, made) if exports else lambda: ([], [])
    if _needs_file(result.map) or not is_core_free():
        return iter([export(), None]).__next__
    return Begun(export, partial(_head, result.map, identity) if report else lambda: None)


def _head(saved: MapContents, identity: MapIdentity) -> dict[str, Any]:
    """The map as the data of its page."""
    from slam.evaluation.page_data import map_data

    return map_data(saved, identity.config, title=identity.log_name, sessions=_sessions(saved, identity))


def _sessions(saved: MapContents, identity: MapIdentity) -> list[MapSession]:
    """Of a map that is about to be saved."""
    return sessions_of(identity.to_meta(), len(saved.node_poses), len(saved.trajectory))


def _needs_file(saved: MapContents) -> bool:
    """Whether parts of a map are in its open file: those no copy of this process may read."""
    return saved.frames is not None or saved.clouds is not None


def _written(folder: Path, made: Exports) -> tuple[list[Path], list[str]]:
    """Write the files for other programs; which they are, and what of them could not be had.

    Without surfaces the map is still worth its report.
    """
    files = made.write_files(folder)
    try:
        return files + made.write_surfaces(folder), []
    except ScanweaveError as error:
        return files, [f"No coloured surface was written: {error}"]
