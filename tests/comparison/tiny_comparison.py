"""A whole comparison of a few seconds: a flat world's log, what we make of it, and how runs can go wrong."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from slam.comparison.compare import Comparison, compare
from slam.simulation.synthetic_log import write_synthetic_log


@dataclass(frozen=True)
class Tiny:
    """The folder of the experiment file, and what was made of it in ``out``."""

    folder: Path
    done: Comparison

    @property
    def file(self) -> Path:
        return self.folder / "tiny.yaml"

    @property
    def out(self) -> Path:
        return self.folder / "out"


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Tiny:
    folder = tmp_path_factory.mktemp("tiny")
    made = write_synthetic_log(folder / "made", duration_s=12.0)
    shutil.copy(made.truth_path, folder / "theirs.tum")
    entry = {"path": str(made.log_path), "name": "flat", "groundtruth": str(made.truth_path)}
    content = {
        "name": "Tiny <world>",
        "datasets": [entry],
        "configurations": [{"name": "full"}],
        "baselines": ["wheels"],
        "external": [
            {"name": "theirs", "trajectory": "theirs.tum"},
            {"name": "absent", "trajectory": "absent-{dataset}.tum"},
        ],
        "rpe_m": [1.0],
        "timeout_s": 120.0,
    }
    (folder / "tiny.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return Tiny(folder, compare(folder / "tiny.yaml", folder / "out", workers=2))
