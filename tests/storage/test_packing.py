"""Packed values: exact round trips, and no bytes that hurt the reader."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import fields, is_dataclass
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam.errors import MapFileError
from slam.estimates import MotionEstimate
from slam.measurements import CameraIntrinsics, LaserScan
from slam.storage import packing
from slam.storage.packing import pack, pack_small, unpack, unpack_small

ARRAYS = st.sampled_from(["f8", "f4", "i8", "i4", "i2", "i1", "u1", "?"]).flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(), st.binary(), ARRAYS
)
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3).map(tuple), max_leaves=8)
SCAN = LaserScan(12.5, np.array([1.0, np.inf, np.nan], np.float32), -1.5, 0.01, 30.0, gtsam.Pose2(0.1, 0, 3))


def same(one: Any, other: Any) -> bool:
    """Equal to the bit, and of one type."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        order = (one.flags.c_contiguous, one.flags.f_contiguous)
        return (
            (one.dtype, one.shape) == (other.dtype, other.shape)
            and one.tobytes() == other.tobytes()
            and order == (other.flags.c_contiguous, other.flags.f_contiguous)
        )
    if isinstance(one, gtsam.Pose2 | gtsam.Pose3):
        return bool(one.matrix().tobytes() == other.matrix().tobytes())
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other) or (isinstance(one, float) and math.isnan(one) and math.isnan(other))


@settings(deadline=None, max_examples=60)
@given(VALUES)
def test_what_is_packed_comes_back(value: Any) -> None:
    assert same(unpack(pack(value)), value)
    assert same(unpack_small(pack_small(value)), value)


@settings(deadline=None)
@given(st.floats(-1e3, 1e3), st.floats(-10, 10), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_poses_come_back_to_the_bit(x: float, yaw: float, pitch: float, roll: float) -> None:
    planar = gtsam.Pose2(x, -x, yaw).compose(gtsam.Pose2(0.1, 0.2, pitch))
    spatial = gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, 1.0, 0.1])) * gtsam.Pose3(planar)
    assert same(unpack(pack([planar, spatial])), [planar, spatial])


def test_records_come_back_with_their_order_of_memory() -> None:
    covariance = np.asfortranarray(np.arange(9.0).reshape(3, 3))
    motion = MotionEstimate(gtsam.Pose2(1, 2, 3), covariance, 0.5, 0.6, 0.01, True, False, np.zeros(3))
    camera = CameraIntrinsics(1.0, 2.0, 3.0, 4.0, 5, 6)
    assert same(unpack(pack((SCAN, motion, camera))), (SCAN, motion, camera))


def test_a_large_grid_is_packed_and_unpacked_where_it_lies() -> None:
    grid = np.zeros((1500, 2000), np.int16)
    grid[::7, ::5] = 3
    tracemalloc.start()
    content = pack_small(grid)
    packed_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.reset_peak()
    found = unpack_small(content)
    unpacked_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    assert same(found, grid) and found.flags.writeable and found.flags.aligned
    assert packed_mb < 1.0 and unpacked_mb < 9.5  # of 6 MB, which grow by an eighth


def test_what_comes_back_can_be_written_to() -> None:
    found = unpack(pack(np.zeros(3)))
    found[0] = 1.0
    assert found.flags.owndata


@pytest.mark.parametrize("value", [{1: 2}, object(), {1}, 1j])
def test_nothing_else_is_packed(value: object) -> None:
    with pytest.raises(TypeError, match=type(value).__name__):
        pack(value)


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=60))
def test_any_bytes_are_a_value_or_refused(content: bytes) -> None:
    for read in (unpack, unpack_small):
        try:
            read(content)
        except MapFileError as error:
            assert str(error)


@settings(deadline=None, max_examples=200)
@given(st.data())
def test_damaged_bytes_are_a_value_or_refused(data: st.DataObject) -> None:
    content = bytearray(pack([SCAN, np.zeros((3, 3)), gtsam.Pose3(), "text", None]))
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] = data.draw(st.integers(0, 255))
    try:
        unpack(bytes(content))
    except MapFileError as error:
        assert str(error)


@pytest.mark.parametrize(
    "bomb",
    [
        b"a\x00\x00\x01\xff\xff\xff\xff",  # an array of 32 GB
        b"a\x00\x00\x04" + b"\xff\xff\xff\x7f" * 4,
        b"a\x00\x00\xff",
        b"l\xff\xff\xff\xff",
        b"s\xff\xff\xff\xff",
        b"l\x01\x00\x00\x00" * 5000 + b"N",
    ],
)
def test_a_lie_about_the_size_allocates_nothing(bomb: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(MapFileError):
        unpack(bomb)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_compressed_values_are_what_they_say() -> None:
    content = pack_small(np.zeros(100_000))
    with pytest.raises(MapFileError, match=r"are not the|values of"):
        unpack_small((10**12).to_bytes(8, "little") + content[8:])
    for size in (0, 799_000):
        with pytest.raises(MapFileError, match=r"are not the|values of"):
            unpack_small(size.to_bytes(8, "little") + content[8:])
    with pytest.raises(MapFileError, match=r"damaged|are not"):
        unpack_small(content[:20] + b"\xff" + content[21:])
    with pytest.raises(MapFileError, match="too soon"):
        unpack_small(b"abc")


def test_another_field_is_another_schema() -> None:
    """Whoever changes a record sees this: raise SCHEMA_VERSION, and read the old one or refuse it."""
    known = {
        number: (record.__name__, len(packing._FIELDS[number])) for number, record in packing._RECORDS.items()
    }
    assert known == {
        0: ("MotionEstimate", 8),
        1: ("LaserScan", 7),
        2: ("CameraIntrinsics", 6),
        3: ("Features", 4),
        4: ("LoopCandidate", 8),
        5: ("VisualMatch", 4),
        6: ("ColorRegistration", 7),
        9: ("Trajectory", 3),
        10: ("LearnedCamera", 5),
    }


@pytest.mark.parametrize("number", [7, 8, 11, 255])
def test_a_record_that_no_version_or_an_older_one_knows_is_refused(number: int) -> None:
    with pytest.raises(MapFileError, match=f"unknown record {number}"):
        unpack(b"o" + bytes([number]) + b"N")
