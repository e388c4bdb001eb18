"""The process of one run: `python -m slam.comparison.child JOB.json FOLDER`.

It ends with its parent: standard input is a pipe, and when it closes, the whole process group is killed, so
that no process of a run outlives a killed worker.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slam import heap
from slam.comparison.files import ERRORS, FAILURE, MAPS, MEASURED, TRAJECTORY
from slam.comparison.run import SCANWEAVE, Run
from slam.errors import EvaluationError, ScanweaveError


def main() -> None:
    """Do a job; an error is written as one line to a file, with details in the log."""
    job_path, folder, heap.own_process = Path(sys.argv[1]), Path(sys.argv[2]), True
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        job = json.loads(job_path.read_text(encoding="utf-8"))
        if "drive" in job:
            from slam.comparison.drives import Drive, record

            record(Drive(**job["drive"]), Path(job["folder"]))
            return
        run = Run.from_dict(job)
        measured = _command(run, folder) if run.method == "command" else _measured(run, folder)
        _write_json(folder / MEASURED, measured)
    except Exception as error:
        kind = "" if isinstance(error, ScanweaveError) else f"{type(error).__name__}: "
        _write_json(folder / FAILURE, {"reason": f"{kind}{error}".strip()})
        traceback.print_exc()
        sys.exit(1)


def _end_with_parent() -> None:
    """Wait until the parent closes the pipe."""
    while os.read(0, 4096):
        pass
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _measured(run: Run, folder: Path) -> dict[str, Any]:
    """Compute the trajectory, score it, and save it with its maps in the folder."""
    from slam.comparison.methods import ODOMETRIES, STOCK, WITHOUT_IMAGES, by_odometry, scanweave
    from slam.comparison.product import Product
    from slam.config import Config
    from slam.datasets import open_dataset
    from slam.storage.tum import read_tum

    config = Config.model_validate_json(run.config) if run.config else Config()
    images = config.sensors.rgbd and run.method not in WITHOUT_IMAGES
    sensors = config.sensors
    dataset = open_dataset(
        Path(run.log), topics=sensors.topics, images=images, calibration=sensors.calibration_files
    )
    if run.method == "external":
        return _scored(run, Product(read_tum(Path(run.trajectory))), folder)
    if run.method == SCANWEAVE:
        product, cost = _timed(lambda: scanweave(dataset, config))
    elif run.method in ODOMETRIES:
        product, cost = _timed(lambda: by_odometry(dataset, config, ODOMETRIES[run.method]))
    else:
        product, cost = _timed(lambda: STOCK[run.method](dataset))
    measured = _scored(run, product, folder)
    stamps = product.trajectory.stamps_s
    duration_s = float(stamps.max() - stamps.min())
    cost["real_time_factor"] = duration_s / max(cost["wall_s"], 1e-9)
    measured["figures"] |= {**cost, "peak_mb": _peak_mb()}
    return measured


def _timed(work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """The result of a function, with its wall and CPU time."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall_s": time.perf_counter() - wall_s, "cpu_s": time.process_time() - cpu_s}


def _scored(run: Run, product: Any, folder: Path) -> dict[str, Any]:
    """Score a product and write the data for the report."""
    import numpy as np

    from slam.comparison.scoring import Truths, scores_of
    from slam.datasets import open_dataset
    from slam.storage.tum import read_tum, write_tum

    log_path = Path(run.log)
    truth = read_tum(Path(run.groundtruth)) if run.groundtruth else open_dataset(log_path).groundtruth()
    grids = log_path / "truth" if log_path.is_dir() else log_path.parent / "truth"
    truths = Truths(truth, Path(run.relations) if run.relations else None, grids if grids.is_dir() else None)
    scores = scores_of(product, truths, run.rpe_m)
    write_tum(folder / TRAJECTORY, product.trajectory)
    maps = {"plane": product.plane, "decision": product.decision}
    arrays: dict[str, Any] = {}
    for name, grid in maps.items():
        if grid is not None:
            corner = grid.T_map_grid
            arrays[name] = grid.states
            arrays[f"{name}_at"] = np.array([grid.resolution_m, corner.x(), corner.y(), corner.theta()])
    if arrays:
        np.savez_compressed(folder / MAPS, **arrays)
    if scores.truth is not None:
        np.savez_compressed(
            folder / ERRORS,
            stamps_s=scores.truth.stamps_s,
            errors_m=scores.truth.errors_m,
            positions_m=scores.truth.positions_m,
            true_positions_m=scores.truth.true_positions_m,
            T_true_map=scores.truth.error.T_reference_map,
        )
    return {"figures": scores.figures, "warnings": [*product.warnings, *scores.warnings]}


def _command(run: Run, folder: Path) -> dict[str, Any]:
    """Run a program of the user, and read its output files."""
    reported = {"{out}": str(folder), "{python}": sys.executable}
    words = []
    for word in run.command:
        for name, value in reported.items():
            word = word.replace(name, value)
        words.append(word)
    started = time.perf_counter()
    try:
        # Closed standard input: the program must not read the pipe to the parent.
        ended = subprocess.run(words, stdin=subprocess.DEVNULL, check=False)
    except OSError as error:
        raise EvaluationError(f"cannot start {words[0]}: {error.strerror or error}") from error
    if ended.returncode:
        raise EvaluationError(f"{Path(words[0]).name} ended with {ended.returncode}; see the run's log")
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    cost = {"wall_s": time.perf_counter() - started, "cpu_s": usage.ru_utime + usage.ru_stime}
    measured: dict[str, Any] = {"figures": {}, "warnings": []}
    if (folder / TRAJECTORY).is_file() and run.log:
        from slam.comparison.product import Product
        from slam.storage.tum import read_tum

        measured = _scored(run, Product(read_tum(folder / TRAJECTORY)), folder)
    if run.figures:
        measured["figures"] |= _reported_figures(folder / run.figures)
    measured["figures"] |= cost
    return measured


def _reported_figures(path: Path) -> dict[str, float]:
    """Every number of a JSON file, nested keys joined by dots."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise EvaluationError(f"cannot read the figures of the command, {path.name}: {error}") from error
    return dict(_numbers(content, ""))


def _numbers(value: Any, name: str) -> list[tuple[str, float]]:
    """Numbers in a tree of dictionaries; lists are data, not metrics."""
    if isinstance(value, dict):
        return [
            pair for key, inner in value.items() for pair in _numbers(inner, f"{name}.{key}" if name else key)
        ]
    return [(name, float(value))] if isinstance(value, int | float) else []


def _peak_mb() -> float:
    """Peak resident size of this process; on Linux the kernel's value starts with that of the parent."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024.0
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a small file; it is only read after this process has ended."""
    path.write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main()
