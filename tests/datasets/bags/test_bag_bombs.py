"""Bags that ask for more than any recorder wrote are read as far as that is sound, and say so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_writing import ROS2, SCAN, Sent, cloud, scan, write_bag
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from slam.datasets import open_dataset
from slam.datasets.bags.definitions import message_parts, simple_idl
from slam.datasets.budget import TOO_MUCH, Budget
from slam.datasets.dataset import RecordFault
from slam.errors import DatasetError


def types(text: str) -> dict[str, object]:
    from rosbags.typesys import get_types_from_msg

    return get_types_from_msg(text, "a/msg/A")  # type: ignore[return-value]


PART = "\n" + "=" * 80 + "\nMSG: a/B\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("string[2000] x", "steps"),
        (f"B[2000] x{PART}int8 y", "steps"),
        (f"A x{PART}int8 y", "itself"),
        (f"B x{PART}A y", "itself"),
        (f"B[] x{PART}A y", "itself"),
        (f"B[] x{PART}", "of nothing"),
        (f"B[] x{PART}int8[0] y", "of nothing|array"),
        ("string[] x", "of texts"),
        ("\n".join(f"int8 x{k}" for k in range(1100)), "steps"),
    ],
)
def test_a_definition_that_asks_for_much_is_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        message_parts(types(text), "a/msg/A")  # type: ignore[arg-type]


def test_a_definition_is_cut_to_what_its_messages_need() -> None:
    found = types(f"B b\nfloat64[36] covariance\nuint8 RED=1{PART}C[] c\n{'=' * 80}\nMSG: a/C\nint8 d")
    found["a/msg/D"] = ([], [])
    parts, listed = message_parts(found, "a/msg/A")  # type: ignore[arg-type]
    assert set(parts) == {"a/msg/A", "a/msg/B", "a/msg/C"} and listed == ["a/msg/C"]
    assert not parts["a/msg/A"][0]


def test_idl_loses_constants_and_comments_and_must_be_plain() -> None:
    text = '// one\nmodule a { module A_Constants { const long X = 1 << 3; }; @verbatim (text="(")'
    text += " struct A { /* ( */ "
    assert "struct A" in simple_idl(text + "double x[36]; sequence<octet, 3> y; }; };")
    for wrong in ("double x[(1)];", "double x[1 << 3];", "sequence<sequence<octet>> y;", "{" * 10):
        with pytest.raises(ValueError, match="expressions"):
            simple_idl(text + wrong + " }; };")


def test_a_budget_grows_with_the_file_and_ends() -> None:
    small, large = Budget(0), Budget(1 << 20)
    small.take(1 << 27, 1)
    with pytest.raises(RecordFault, match=TOO_MUCH):
        small.take(1, 1)
    large.take(1 << 28, 100_000)
    with pytest.raises(RecordFault, match=TOO_MUCH):
        large.take(0, 100_000)


def test_many_small_messages_in_few_bytes_are_read_up_to_the_budget(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    (first,) = [scan(stamp_s=1.7e9)]
    content = bytes(ROS2.serialize_cdr(_message(first), SCAN))
    with path.open("wb") as file:
        bag = McapWriter(
            file, chunk_size=1 << 30, compression=CompressionType.ZSTD, index_types=IndexType.NONE
        )
        bag.start()
        schema = bag.register_schema(SCAN, "ros2msg", ROS2.generate_msgdef(SCAN, ros_version=2)[0].encode())
        topic = bag.register_channel("/scan", "cdr", schema)
        for _ in range(40_000):
            bag.add_message(topic, 0, content, 0)
        bag.finish()
    dataset = open_dataset(path)
    assert path.stat().st_size < 200_000
    assert 10_000 < sum(1 for _ in dataset) < 40_000
    assert dataset.report.dropped[TOO_MUCH].count >= 1


def _message(sent: Sent) -> object:
    from bag_writing import built

    return built(ROS2, sent)


def test_frames_that_steer_a_terminal_are_plain(tmp_path: Path) -> None:
    sent = scan(stamp_s=1.7e9)
    sent.frame = "laser\x1b[31m\n"
    dataset = open_dataset(write_bag(tmp_path / "log", "mcap", [sent]))
    assert len(list(dataset)) == 1
    stated = " ".join([*dataset.report.notes, *dataset.figures.tree.lines()])  # type: ignore[attr-defined]
    assert stated.isprintable()


def test_a_database_of_views_is_no_bag(tmp_path: Path) -> None:
    import sqlite3

    path = tmp_path / "log.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        database.execute(
            "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, x'00' AS data"
        )
    database.close()
    with pytest.raises(DatasetError, match="does not begin as a bag"):
        list(open_dataset(path))


def test_a_signalling_nan_in_a_cloud_is_no_point_and_no_warning(tmp_path: Path) -> None:
    sent = cloud({axis: np.ones(3, np.float32) for axis in "xyz"})
    data = sent.fields["data"].reshape(-1).copy()
    data[:4] = np.frombuffer((0x7FA00000).to_bytes(4, "little"), np.uint8)
    sent.fields["data"] = data
    (found,) = open_dataset(write_bag(tmp_path / "log", "mcap", [sent]))
    assert len(found.points_lidar) == 2  # type: ignore[union-attr]
