import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam.errors import MapFileError
from slam.estimates import Trajectory
from slam.storage.tum import read_tum, write_tum

FINITE = st.floats(-1e9, 1e9, allow_subnormal=True)


def same(a, b):
    return (
        np.array_equal(a.stamps_s, b.stamps_s)
        and np.array_equal(a.positions_m, b.positions_m)
        and np.array_equal(a.quaternions_xyzw, b.quaternions_xyzw)
    )


@given(
    stamps=hnp.arrays(np.float64, 4, elements=st.floats(-1e10, 1e10)),
    positions=hnp.arrays(np.float64, (4, 3), elements=FINITE),
    seed=st.integers(0, 2**32 - 1),
)
def test_reading_back_gives_the_same_bits_in_the_same_order(tmp_path_factory, stamps, positions, seed):
    quaternions = np.random.default_rng(seed).normal(size=(4, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    trajectory = Trajectory(stamps, positions, quaternions)
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    write_tum(path, trajectory)
    assert same(read_tum(path), trajectory)


def test_stamps_are_full_epoch_seconds_with_nine_decimals(tmp_path):
    trajectory = Trajectory.from_planar(np.array([976052857.337776, 3.0, 1e-7]), np.zeros((3, 3)))
    write_tum(tmp_path / "t.tum", trajectory)
    stamps = [line.split()[0] for line in (tmp_path / "t.tum").read_text().splitlines()]
    assert stamps == ["976052857.337776000", "3.000000000", "0.000000100"]


def test_a_known_line_means_what_tum_says(tmp_path):
    path = tmp_path / "t.tum.gz"
    path.write_bytes(gzip.compress(b"# t x y z qx qy qz qw\n\n2.5 1 2 3 0 0 0.70711 0.70711\n"))
    trajectory = read_tum(path)
    assert trajectory.stamps_s.tolist() == [2.5]
    assert trajectory.positions_m.tolist() == [[1.0, 2.0, 3.0]]
    np.testing.assert_allclose(trajectory.to_planar(), [[1.0, 2.0, np.pi / 2]], atol=1e-12)
    # Five decimals are not unit length; what is returned is.
    np.testing.assert_allclose(np.linalg.norm(trajectory.quaternions_xyzw), 1.0, atol=1e-15)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 0 0 0 0 0 0", "7 fields"),
        ("1 0 0 0 0 0 0 1 9", "9 fields"),
        ("1 0 x 0 0 0 0 1", "could not convert"),
        ("1 0 nan 0 0 0 0 1", "'nan' is not a finite number"),
        ("inf 0 0 0 0 0 0 1", "'inf' is not a finite number"),
        ("1 0 0 0 0 0 0 0", "quaternion of length 0"),
        ("1 0 0 0 0 0 0 1.1", "quaternion of length 1.1"),
    ],
)
def test_a_bad_line_is_refused_by_number(tmp_path, line, reason):
    path = tmp_path / "t.tum"
    path.write_text(f"# head\n1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(MapFileError, match=f"t.tum:3: .*{reason}"):
        read_tum(path)


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "t.tum").write_text("# nothing\n")
    with pytest.raises(MapFileError, match="holds no pose"):
        read_tum(tmp_path / "t.tum")


def test_an_empty_trajectory_is_not_written(tmp_path):
    with pytest.raises(MapFileError, match="no pose"):
        write_tum(tmp_path / "t.tum", Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))))
    assert not list(tmp_path.iterdir())
