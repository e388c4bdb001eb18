"""Malicious bags and databases for `tools/hostile_files.py`."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from slam.simulation import ros_messages as ros
from slam.storage import ros_messages as messages
from slam.zstandard import zstd
from tools.hostile_maps import looped
from tools.layouts.messages import ROS2, made

Writer = Callable[[Path], Path]

STEERING = "\x1b[31m\x1b]0;owned\x07\u202egnp.exe\n\x9b2J\r"
BAGS: dict[str, Writer] = {}
_HEADER: dict[str, Any] = {"stamp": {"sec": 1}}
_SCAN, _TF, _ECHOES = ros.LASER_SCAN, messages.TRANSFORMS, "sensor_msgs/msg/MultiEchoLaserScan"
_PACKED, _CLOUD = "sensor_msgs/msg/CompressedImage", messages.POINT_CLOUD


def mcap(kind: str, text: str, content: bytes = bytes(64), language: str = "ros2msg", **given: Any) -> Writer:
    """A bag of one topic and one message."""

    def write(folder: Path) -> Path:
        with (folder / "log.mcap").open("wb") as file:
            bag = McapWriter(file, compression=given.get("packing", CompressionType.ZSTD))
            bag.start()
            for number in range(given.get("topics", 1)):
                schema = bag.register_schema(kind, language, text.replace("NUMBER", str(number)).encode())
                topic = bag.register_channel(
                    given.get("topic", "/scan{}").format(
                        ["depth", "color"][number] if given.get("topic") else number
                    ),
                    "cdr",
                    schema,
                )
                for k in range(given.get("messages", 1)):
                    bag.add_message(topic, k, given.get("contents", {}).get(number, content), k)
            bag.finish()
        return folder / "log.mcap"

    return write


def of(kind: str, **fields: Any) -> tuple[str, bytes]:
    """The definition of a common type, and a message of it with some fields set."""
    text, _ = ROS2.generate_msgdef(kind, ros_version=2)
    return text, bytes(ROS2.serialize_cdr(made(ROS2, kind, fields), kind))


def _nested(levels: int) -> str:
    """Types that each contain the next one twice."""
    rest = [
        f"\n{'=' * 80}\nMSG: a/T{k}\n" + (f"T{k + 1} a\nT{k + 1} b" if k < levels else "int8 a")
        for k in range(levels + 1)
    ]
    return "T0 a" + "".join(rest)


def _idl(inside: str) -> str:
    return "module sensor_msgs { module msg { " + inside + " struct LaserScan { double a; }; }; };"


_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
_MESSAGES = {
    "array of a billion texts": "string[1000000000] x",
    "array of a million texts": "string[1000000] x",
    "array of a million records": f"std_msgs/Header[1000000] x{_SEPARATOR}std_msgs/Header\nint8 a",
    "types that double thirty times": _nested(30),
    "nine thousand fields": "\n".join(f"int8 a{k}" for k in range(9000)),
    "a type that contains itself": f"a/T x{_SEPARATOR}a/T\na/T x",
    "a list of its own kind": f"a/T x{_SEPARATOR}a/T\na/T[] x",
    "a count of a thousand digits": f"int8[{'9' * 1000}] x",
    "a definition of ten megabytes": "# " + "x" * 10_000_000,
    "no definition but letters": "\x00\xff{}[]()" * 1000,
    "a list of nothing": f"a/T[] x{_SEPARATOR}a/T\n",
}
_LANGUAGE = {
    "shifts": _idl("const long A = 1 << 99999999999;"),
    "shifts of shifts": _idl("const long A = " + "1 << (" * 50 + "40" + ")" * 50 + ";"),
    "parentheses": _idl("const long A = " + "(" * 400 + "1" + ")" * 400 + ";"),
    "signs": _idl("const long A = " + "-" * 3000 + "1;"),
    "powers in an array": _idl("typedef double a[(1 << 30) * (1 << 30)];"),
    "sequences in sequences": _idl("typedef " + "sequence<" * 60 + "octet" + ">" * 60 + " s;"),
    "types in a circle": _idl("typedef A B; typedef B A;"),
    "modules in modules": "module a { " * 3000 + "};" * 3000,
    "arrays of arrays": _idl("typedef string a[60000]; typedef a b[60000]; struct X { b c; };"),
}
for _name, _text in _MESSAGES.items():
    BAGS[f"msg, {_name}"] = mcap(_SCAN, _text, struct.pack("<II", 0x100, 0xFFFFFFF) + bytes(40))
for _name, _text in _LANGUAGE.items():
    BAGS[f"idl, {_name}"] = mcap(_SCAN, _text, language="ros2idl")
BAGS["a thousand definitions"] = mcap(_SCAN, "# NUMBER\n" + of(_SCAN)[0], topics=1000)
BAGS["topic that steers"] = mcap(
    _SCAN,
    *of(_SCAN, header=_HEADER, ranges=np.ones(9, np.float32), angle_increment=0.1),
    topic="/scan" + STEERING,
)
BAGS["type that steers"] = mcap("a/msg/B" + STEERING, "int8 a")
BAGS["frames that steer"] = mcap(
    _SCAN,
    *of(
        _SCAN,
        ranges=np.ones(9, np.float32),
        angle_increment=0.1,
        header={**_HEADER, "frame_id": "laser" + STEERING},
    ),
)
BAGS["scans of a million beams"] = mcap(
    _SCAN,
    *of(_SCAN, header=_HEADER, ranges=np.ones(10**6, np.float32), angle_increment=1e-6, range_max=9.0),
    messages=300,
)
BAGS["a million transforms"] = mcap(_TF, of(_TF)[0], struct.pack("<II", 0x100, 10**6) + bytes(76 * 10**6))
BAGS["endless echoes"] = mcap(
    _ECHOES, of(_ECHOES)[0], of(_ECHOES)[1][:-8] + struct.pack("<I", 2**24) + bytes(2**26)
)
BAGS["points as a lie"] = mcap(
    _CLOUD,
    *of(_CLOUD, header=_HEADER, width=2**32 - 1, height=2**32 - 1, point_step=1, data=np.zeros(9, np.uint8)),
)


def png(width: int, height: int, rows: bytes = b"", depth: int = 8, color: int = 2) -> bytes:
    """A PNG with this size in its header."""

    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(rows)) + part(b"IEND", b"")
    )


def _jpeg(width: int, height: int) -> bytes:
    """A JPEG with this size in its header."""
    import cv2

    content = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def _image(form: str, content: bytes, **given: Any) -> Writer:
    """A bag with compressed images, as colour and as depth."""
    forms = (
        ("16UC1; compressedDepth png", bytes(12) + png(4, 4, bytes(36), 16, 0)),
        ("png", png(4, 4, bytes(52))),
    )
    made = dict(enumerate(forms)) | {0 if "Depth" in form else 1: (form, content)}
    texts = {
        number: of(_PACKED, header=_HEADER, format=one, data=np.frombuffer(data, np.uint8))[1]
        for number, (one, data) in made.items()
    }
    return mcap(_PACKED, of(_PACKED)[0], topic="/camera/{}/compressed", topics=2, contents=texts, **given)


BLACK = png(5000, 5000, bytes(5000 * 15001))
BAGS["png of four gigapixels"] = _image("png", png(65535, 65535))
BAGS["png of half a gigapixel"] = _image("png", png(23000, 23000))
BAGS["jpeg of four gigapixels"] = _image("jpeg", _jpeg(65535, 65535))
BAGS["black png over and over"] = _image("png", BLACK, messages=2000)
BAGS["run lengths of a gigapixel"] = _image(
    "16UC1; compressedDepth rvl", bytes(12) + struct.pack("<II", 32768, 32768) + b"\xff" * 64
)
BAGS["pgm of a gigapixel"] = _image("png", b"P5 32768 32767 255\n")


def _chunk(packing: str, pack: Callable[[bytes], bytes], unit: bytes, times: int, stated: int = -1) -> Writer:
    """An MCAP with one chunk that decompresses to a repeated unit."""

    def write(folder: Path) -> Path:
        packed, size = pack(unit * times), len(unit) * times if stated < 0 else stated
        name = packing.encode()
        body = struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", len(name)) + name
        body += struct.pack("<Q", len(packed)) + packed
        path = folder / "log.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(body)) + body)
        return path

    return write


_NOTHING = b"\x63" + bytes(8)
BAGS["zstd, records of no bytes"] = _chunk("zstd", zstd.compress, _NOTHING, 14_000_000)
BAGS["zstd, a chunk of half a gigabyte"] = _chunk("zstd", zstd.compress, bytes(1 << 20), 500)
BAGS["zstd, a chunk that states too small a size"] = _chunk("zstd", zstd.compress, bytes(1 << 20), 500, 100)
BAGS["lz4, records of no bytes"] = _chunk("lz4", lz4.frame.compress, _NOTHING, 14_000_000)
BAGS["a message that unpacks to a gigabyte"] = mcap(
    _SCAN, of(_SCAN)[0], zstd.compress(bytes(1 << 20) * 1000), packing=CompressionType.NONE, messages=20
)


def _exabytes(folder: Path) -> Path:
    (folder / "log.mcap").write_bytes(b"\x89MCAP0\r\n\x05" + b"\xff" * 8 + bytes(100))
    return folder / "log.mcap"


BAGS["mcap, a record of exabytes"] = _exabytes


def _inside(fields: dict[bytes, bytes], body: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(body)) + body


def _bag1(compression: bytes, pack: Callable[[bytes], bytes], content: bytes) -> Writer:
    """A ROS 1 bag of one chunk."""

    def write(folder: Path) -> Path:
        fields = {b"op": b"\x05", b"compression": compression, b"size": struct.pack("<I", len(content))}
        head = _inside({b"op": b"\x03", b"index_pos": bytes(8)}, bytes(8))
        (folder / "log.bag").write_bytes(b"#ROSBAG V2.0\n" + head + _inside(fields, pack(content)))
        return folder / "log.bag"

    return write


_NUMBER = struct.pack("<I", 0)
_DESCRIBED = b"".join(
    struct.pack("<I", len(part)) + part
    for part in (
        b"type=sensor_msgs/LaserScan",
        b"message_definition=std_msgs/Empty[] ranges" + _SEPARATOR.encode() + b"std_msgs/Empty\n",
    )
)
_EMPTIES = _inside({b"op": b"\x07", b"conn": _NUMBER, b"topic": b"/scan"}, _DESCRIBED) + _inside(
    {b"op": b"\x02", b"conn": _NUMBER, b"time": bytes(8)}, struct.pack("<I", 1 << 26) + bytes(1 << 26)
)
BAGS["ros 1, elements of no bytes"] = _bag1(b"bz2", bz2.compress, _EMPTIES)
BAGS["ros 1, bz2 of half a gigabyte"] = _bag1(b"bz2", bz2.compress, bytes(500 << 20))
BAGS["ros 1, records of no bytes"] = _bag1(b"lz4", lz4.frame.compress, bytes(64 << 20))


_ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
_TOPICS = (
    "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    "INSERT INTO topics VALUES (1, '/scan', 'sensor_msgs/msg/LaserScan', 'cdr');"
)
_MESSAGE_TABLE = (
    "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
)


def _database(name: str, script: str, change: Callable[[bytes], bytes] = bytes) -> Writer:
    def write(folder: Path) -> Path:
        with sqlite3.connect(folder / name) as database:
            database.executescript(script)
        database.close()
        (folder / name).write_bytes(change((folder / name).read_bytes()))
        return folder / name

    return write


BAGS["db3, messages are an endless view"] = _database(
    "log.db3",
    f"{_TOPICS} CREATE VIEW messages AS {_ENDLESS} "
    "SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n",
)
BAGS["db3, topics are an endless view"] = _database(
    "log.db3",
    f"{_MESSAGE_TABLE} CREATE VIEW topics AS {_ENDLESS} "
    "SELECT x AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format FROM n",
)
BAGS["db3, definitions are an endless view"] = _database(
    "log.db3",
    f"{_TOPICS} {_MESSAGE_TABLE} CREATE VIEW message_definitions AS {_ENDLESS} "
    "SELECT x AS topic_type, 'a' AS encoding, 'b' AS encoded_message_definition FROM n",
)
BAGS["db3, data that are worked out"] = _database(
    "log.db3",
    f"{_TOPICS} CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB AS (zeroblob(100000000))); INSERT INTO messages (topic_id, timestamp) "
    f"{_ENDLESS.replace('FROM n', 'FROM n LIMIT 1000')} SELECT 1, x FROM n",
)
BAGS["db3, messages are virtual"] = _database(
    "log.db3", f"{_TOPICS} CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)"
)
BAGS["db3, pages in a loop"] = _database(
    "log.db3",
    f"{_TOPICS} {_MESSAGE_TABLE} INSERT INTO messages {_ENDLESS.replace('FROM n', 'FROM n LIMIT 200000')} "
    "SELECT x, 1, x, zeroblob(8) FROM n",
    looped,
)
BAGS["rh.db of endless views"] = _database(
    "rh.db",
    "CREATE TABLE rh_raw (id); CREATE TABLE rh_rooms (id, name); CREATE TABLE rh_sensors (id, name);"
    f"CREATE VIEW rh_home_sessions AS {_ENDLESS} SELECT x AS id, 'a' || x AS name FROM n",
)
