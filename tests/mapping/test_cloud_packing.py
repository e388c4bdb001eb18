"""Clouds as bytes: the nearest steps come back, in their order; what is no cloud is refused."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from slam.errors import ScanweaveError
from slam.mapping.sensor_packing import STEP_M, packed_cloud, unpacked_cloud
from slam.zstandard import zstd

METRES = st.floats(-200.0, 200.0, allow_nan=False)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 20).flatmap(lambda count: arrays(np.float64, (count, 3), elements=METRES)))
def test_the_nearest_steps_come_back(points: np.ndarray) -> None:
    content = packed_cloud(points)
    found = unpacked_cloud(content)
    assert found.shape == points.shape
    assert np.abs(found - points).max(initial=0.0) <= 0.5 * STEP_M + 1e-9
    assert packed_cloud(found) == content  # what was rounded once is lossless


def test_intensities_come_back_as_they_were() -> None:
    rows = np.random.default_rng(1).normal(size=(50, 4))
    rows[:, 3] = np.float32(300.0 * rows[:, 3])
    rows[7, 3] = np.nan
    found = unpacked_cloud(packed_cloud(rows))
    np.testing.assert_array_equal(found[:, 3], rows[:, 3])
    np.testing.assert_array_equal(found[:, :3], unpacked_cloud(packed_cloud(rows[:, :3])))
    assert unpacked_cloud(packed_cloud(rows[:0])).shape == (0, 3)  # nothing shows nothing


def test_far_points_take_coarser_steps() -> None:
    points = np.array([[1e7, -1e7, 3.0], [-1e7, 1e7, -3.0]])
    found = unpacked_cloud(packed_cloud(points))
    np.testing.assert_allclose(found, points, atol=0.5 * 1e7 / 2**29)


def test_a_turn_takes_a_third_of_its_bytes() -> None:
    bearing = np.linspace(0.0, 2.0 * np.pi, 5000)
    points = np.column_stack([5.0 * np.cos(bearing), 4.0 * np.sin(bearing), 0.1 * np.sin(9.0 * bearing)])
    assert 3 * len(packed_cloud(points)) < points.astype(np.float32).nbytes


def test_what_is_not_finite_is_refused() -> None:
    with pytest.raises(ScanweaveError, match="only finite points"):
        packed_cloud(np.array([[0.0, np.nan, 0.0]]))


CLOUD = packed_cloud(np.arange(30.0).reshape(10, 3))


def test_a_cloud_of_an_older_map_is_read() -> None:
    older = CLOUD[:12] + zlib.compress(zstd.decompress(CLOUD[12:]), 1)
    np.testing.assert_array_equal(unpacked_cloud(older), unpacked_cloud(CLOUD))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "ends too soon"),
        (CLOUD[:-1], "not of 10 points"),
        (CLOUD + b"\0", "not of 10 points"),
        (CLOUD[:8] + struct.pack("<I", 9) + CLOUD[12:], "not of 9 points"),
        (CLOUD[:8] + struct.pack("<I", 2**32 - 1) + CLOUD[12:], "not of 4294967295 points"),
        (struct.pack("<d", np.nan) + CLOUD[8:], "steps of nan"),
        (CLOUD[:12] + b"\xff" + CLOUD[13:], "damaged"),
    ],
)
def test_damage_is_refused(content: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        unpacked_cloud(content)
