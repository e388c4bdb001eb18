"""One function scores what a program holds and what lies in files, and takes one reference at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import slam
from slam.evaluation.relations import read_relations
from slam.storage.tum import write_tum


@pytest.fixture
def truth() -> slam.Trajectory:
    """A circle of 2 m radius."""
    stamps_s = np.arange(0.0, 20.0, 0.1)
    yaw = stamps_s / 3.0
    return slam.Trajectory.from_planar(stamps_s, np.column_stack([2 * np.sin(yaw), -2 * np.cos(yaw), yaw]))


@pytest.fixture
def wider(truth: slam.Trajectory) -> slam.Trajectory:
    """The circle, 1 per cent too wide."""
    return slam.Trajectory(truth.stamps_s, 1.01 * truth.positions_m, truth.quaternions_xyzw)


def test_files_and_trajectories_are_scored_alike(
    truth: slam.Trajectory, wider: slam.Trajectory, tmp_path: Path
) -> None:
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "mine.txt", wider)
    scores = slam.evaluate(wider, groundtruth=truth)
    assert scores["ate"]["translation_m"]["rmse"] == pytest.approx(0.02, abs=0.001)
    assert scores["rpe"]["translation_m"]["mean"] == pytest.approx(0.01, abs=0.001)
    for path in (str, Path):
        assert slam.evaluate(path(tmp_path / "mine.txt"), groundtruth=path(tmp_path / "truth.txt")) == scores
    assert slam.evaluate(wider, groundtruth=tmp_path / "truth.txt", delta_m=1000.0)["rpe"] is None


def test_relations_by_file_and_by_value(
    truth: slam.Trajectory, wider: slam.Trajectory, tmp_path: Path
) -> None:
    half_turn = 3.0 * np.pi
    (tmp_path / "relations").write_text(f"0.0 {half_turn:.6f} 0 4 0 0 0 {np.pi:.6f}\n")
    by_file = slam.evaluate(wider, relations=tmp_path / "relations")
    assert slam.evaluate(wider, relations=read_relations(tmp_path / "relations")) == by_file
    assert by_file["relations"]["used"] == 1
    assert by_file["relations"]["translation_m"]["mean"] == pytest.approx(0.04, abs=0.02)


def test_one_reference_is_wanted(truth: slam.Trajectory, tmp_path: Path) -> None:
    with pytest.raises(slam.ScanweaveError, match="by groundtruth or by relations: give one, not none"):
        slam.evaluate(truth)
    with pytest.raises(slam.ScanweaveError, match="by groundtruth or by relations: give one, not both"):
        slam.evaluate(truth, groundtruth=truth, relations=tmp_path)


def test_the_tolerance_is_that_of_stamps(truth: slam.Trajectory, wider: slam.Trajectory) -> None:
    late = slam.Trajectory(wider.stamps_s + 0.06, wider.positions_m, wider.quaternions_xyzw)
    sparse = slam.Trajectory(truth.stamps_s[::5], truth.positions_m[::5], truth.quaternions_xyzw[::5])
    with pytest.raises(slam.ScanweaveError, match=r"no pose is within 0.01 s"):
        slam.evaluate(late, groundtruth=sparse, tolerance_s=0.01)
    count = slam.evaluate(late, groundtruth=sparse)["ate"]["count"]
    assert count == len(sparse) - 1  # the first comes 0.06 s too early
