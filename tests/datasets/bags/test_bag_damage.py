"""Damaged bags: an error in one line, or what could be read and a count of the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_writing import START_S, Sent, one_file, scan, write_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_bag_formats import robot

from slam.datasets import open_dataset
from slam.datasets.bags.decoding import NO_TYPE, UNDECODED
from slam.datasets.bags.records import CUT, DAMAGED
from slam.datasets.dataset import Dataset
from slam.errors import BadRecordError, DatasetError

WRITERS = ("mcap", "mcap_plain", "db3", "bag", "bag_lz4")
COUNT = 200


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A bag of many scans by each writer."""
    folder = tmp_path_factory.mktemp("whole")
    rng = np.random.default_rng(2)
    sent: list[Sent] = [*robot()]
    sent += [
        scan(stamp_s=START_S + 1.0 + 0.1 * k, ranges=rng.uniform(1.0, 7.0, 200), angle_increment=0.01)
        for k in range(COUNT)
    ]
    return {name: one_file(write_bag(folder / name, name, sent)).read_bytes() for name in WRITERS}


def scans(path: Path, content: bytes) -> tuple[int, Dataset]:
    path.write_bytes(content)
    dataset = open_dataset(path)
    return sum(m.sensor == "/scan" for m in dataset), dataset


@pytest.mark.parametrize("name", ["mcap", "mcap_plain", "db3", "bag"])
@pytest.mark.parametrize("share", [0.4, 0.7])
def test_a_cut_bag_is_read_up_to_the_cut_and_says_so(
    tmp_path: Path, whole: dict[str, bytes], name: str, share: float
) -> None:
    content = whole[name]
    count, dataset = scans(tmp_path / "cut", content[: int(share * len(content))])
    assert 0.3 * share * COUNT < count <= COUNT
    assert dataset.report.dropped[CUT].count == 1
    assert CUT in dataset.report.warnings
    with pytest.raises(BadRecordError, match="ends in the middle"):
        list(open_dataset(tmp_path / "cut", strict=True))


@pytest.mark.parametrize("name", ["mcap", "mcap_plain"])
def test_a_damaged_chunk_costs_itself(tmp_path: Path, whole: dict[str, bytes], name: str) -> None:
    content = bytearray(whole[name])
    at = len(content) // 2
    content[at : at + 40] = bytes(byte ^ 0x5A for byte in content[at : at + 40])
    count, dataset = scans(tmp_path / "damaged", bytes(content))
    assert 0 < count < COUNT + 1
    assert dataset.report.dropped_count > 0
    assert count > 0.5 * COUNT and dataset.report.dropped[DAMAGED].count == 1


def test_a_bag_without_its_index_is_whole_but_for_the_mark(tmp_path: Path, whole: dict[str, bytes]) -> None:
    content = whole["mcap_plain"]
    count, dataset = scans(tmp_path / "open", content[: content.rindex(b"\x0f" + b"\x04" + bytes(7))])
    assert count == COUNT + 1
    assert dataset.report.dropped[CUT].count == 1


@pytest.mark.parametrize(
    ("before", "after"),
    [(b"float32[] ranges", b"float64[] ranges"), (b"float32 angle_min", b"float32 angle_mi?")],
)
def test_a_wrong_definition_is_counted_a_message(
    tmp_path: Path, whole: dict[str, bytes], before: bytes, after: bytes
) -> None:
    assert before in whole["bag"]
    content = whole["bag"].replace(before, after)
    count, dataset = scans(tmp_path / "wrong", content)
    # An unreadable definition is replaced by that of the common releases; a readable one is believed.
    assert count + dataset.report.dropped_count == COUNT + 1
    assert count == COUNT + 1 or set(dataset.report.dropped) & {UNDECODED, NO_TYPE}


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data(), name=st.sampled_from(WRITERS))
def test_random_damage_never_ends_in_anything_else(
    tmp_path: Path, whole: dict[str, bytes], data: st.DataObject, name: str
) -> None:
    content = bytearray(whole[name])
    places = st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(1, 255)), max_size=20)
    for at, change in data.draw(places):
        content[at] ^= change
    try:
        count, dataset = scans(
            tmp_path / "damaged", bytes(content[: data.draw(st.integers(1, len(content)))])
        )
    except DatasetError as error:
        assert "\n" not in str(error)
        return
    assert count <= COUNT + 1
    assert count == COUNT + 1 or dataset.report.dropped_count or dataset.report.ignored


@pytest.mark.parametrize("content", [b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\x00", b"nothing"])
def test_a_file_that_only_begins_as_a_bag_is_reported(tmp_path: Path, content: bytes) -> None:
    for suffix in (".mcap", ".bag", ".db3"):
        path = tmp_path / f"short{suffix}"
        path.write_bytes(content)
        with pytest.raises(DatasetError) as reported:
            list(open_dataset(path))
        assert "\n" not in str(reported.value)
