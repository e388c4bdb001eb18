"""Covariances beside a trajectory: the same bits back, and what is no such file is refused in one line."""

from pathlib import Path

import numpy as np
import pytest

from slam.errors import MapFileError
from slam.estimates import Trajectory
from slam.storage.tum import covariance_path, read_covariances, write_trajectory


def poses(count: int) -> Trajectory:
    return Trajectory.from_planar(1.6e9 + 0.1 * np.arange(count), np.zeros((count, 3)))


@pytest.mark.parametrize("size, columns", [(3, 6), (6, 21)])
def test_the_same_bits_come_back(size: int, columns: int, tmp_path: Path) -> None:
    root = np.random.default_rng(1).normal(size=(40, size, size))
    covariances = root @ root.transpose(0, 2, 1)
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    written = write_trajectory(tmp_path / "trajectory.tum", poses(40), covariances)
    assert [path.name for path in written] == ["trajectory.tum", "trajectory_covariance.csv"]
    stamps_s, found = read_covariances(written[1])
    assert np.array_equal(found, covariances) and np.array_equal(stamps_s, poses(40).stamps_s)
    head = written[1].read_text().splitlines()[0].split(",")
    assert len(head) == columns + 1 and head[:3] == ["stamp", "x_x", "x_y"]


def test_a_trajectory_without_covariances_has_no_such_file(tmp_path: Path) -> None:
    assert write_trajectory(tmp_path / "a.tum", poses(2), None) == [tmp_path / "a.tum"]
    assert covariance_path(tmp_path / "a-2.tum").name == "a-2_covariance.csv"


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "holds no covariances"),
        ("stamp,x\n1,2\n", "holds no covariances"),
        ("stamp,a,b,c,d,e,f\n1,2,3\n", ":2: 3 fields, the head has 7"),
        ("stamp,a,b,c,d,e,f\n1,1,0,0,1,0,nan\n", ":2: 'nan' is not a finite number"),
    ],
)
def test_what_is_none_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(MapFileError, match=said):
        read_covariances(tmp_path / "x.csv")
