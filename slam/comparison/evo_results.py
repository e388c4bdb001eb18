"""Results in the format of evo_res: a zip of info.json, stats.json and one file per array.

M. Grupp, evo: Python package for the evaluation of odometry and SLAM. Written without evo, which is GPL.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slam.comparison.files import ERRORS, TRAJECTORY
from slam.comparison.perform import Row
from slam.comparison.store import ResultStore
from slam.evaluation.trajectory_error import ErrorStatistics
from slam.measurements import FloatArray
from slam.storage.files import make_folder, write_bytes


def write_evo_results(folder: Path, rows: Sequence[Row], store: ResultStore) -> list[Path]:
    """Write a zip for every run with a ground truth; ``evo_res FOLDER/*.zip`` compares them.

    Files of an earlier comparison in the folder are deleted.

    Raises
    ------
    MapFileError
        If one cannot be written.
    """
    shutil.rmtree(folder, ignore_errors=True)
    written = []
    for row in rows:
        errors = store.of(row["key"]) / ERRORS
        if row["status"] != "ok" or not errors.is_file():
            continue
        make_folder(folder)
        label = f"{row['dataset']}, {row['configuration']}, seed {row['seed']}"
        path = folder / f"{re.sub(r'[^A-Za-z0-9.]+', '-', label)}-{row['key'][:6]}.zip"
        write_bytes(path, _zipped(label, errors, errors.with_name(TRAJECTORY)))
        written.append(path)
    return written


def _zipped(label: str, errors: Path, trajectory: Path) -> bytes:
    """The bytes of one result."""
    with np.load(errors, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    errors_m, stamps_s = arrays["errors_m"], arrays["stamps_s"]
    statistics = asdict(ErrorStatistics.of(errors_m)) | {"sse": float(np.square(errors_m).sum())}
    info = {
        "title": "APE w.r.t. translation part (m)\n(with SE(3) Umeyama alignment)",
        "label": "APE (m)",
        "ref_name": "ground truth",
        "est_name": label,
    }
    reported = {
        "error_array": errors_m,
        "timestamps": stamps_s,
        "seconds_from_start": stamps_s - stamps_s[0],
        "distances": _path_m(arrays["positions_m"]),
        "distances_from_start": _path_m(arrays["true_positions_m"]),
        "alignment_transformation_sim3": arrays["T_true_map"],
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        # With a plain name, zipfile would store the current time; equal results must give equal bytes.
        for name, content in (
            ("info.json", json.dumps(info).encode()),
            ("stats.json", json.dumps(statistics).encode()),
            *((f"{name}.npy", _npy(array)) for name, array in reported.items()),
            ("estimate.tum", trajectory.read_bytes()),
        ):
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _path_m(positions_m: FloatArray) -> FloatArray:
    """(N,) path length from the start."""
    steps = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _npy(array: FloatArray) -> bytes:
    """An array as an npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
