"""A bank of files that nobody recorded: bombs, lies about sizes, loops, letters that steer a terminal.

    python tools/hostile_files.py FOLDER            writes them
    python tools/hostile_files.py FOLDER --run      and has every command that could meet one read it

Each must end in a line that says what is wrong, or be read as far as it is sound: within 5 CPU seconds and 1 GB
(what a child of a process that has loaded all libraries takes by itself), without a letter that a terminal obeys.
"""

from __future__ import annotations

import argparse
import bz2
import gzip
import os
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from backports import zstd
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from slam.simulation import ros_messages as ros
from tools.trial_process import Outcome, load_libraries, run_command

_HEADER: dict[str, Any] = {"stamp": {"sec": 1}}
STEERING = "\x1b[31m\x1b]0;owned\x07\u202egnp.exe\n\x9b2J\r"
MOST_CPU_S, MOST_MB = 5.0, 1024.0
_BANK: dict[str, Callable[[Path], Path]] = {}
_SCAN, _TF, _ECHOES = ros.LASER_SCAN, ros.TRANSFORMS, "sensor_msgs/msg/MultiEchoLaserScan"
_PACKED, _CLOUD = "sensor_msgs/msg/CompressedImage", ros.POINT_CLOUD

Writer = Callable[[Path], Path]


def bank(folder: Path) -> Iterator[tuple[str, Path]]:
    """Write the files one after another; name and path of each."""
    for name, write in _BANK.items():
        place = folder / name
        place.mkdir(parents=True)
        yield name, write(place)


def commands_for(path: Path, out: Path) -> list[list[str]]:
    """The commands that could meet a file."""
    if path.suffix == ".yaml":
        return [["plan", str(path), "--from", "0,0", "--to", "1,1", "-o", str(out / "plan.png")]]
    if path.name == "map.db":
        looks = [[name, str(path)] for name in ("check", "info")]
        return [*looks, ["export", str(path), "-f", "nav2", "-o", str(out / "nav2")]]
    return [["inspect", str(path)], ["map", str(path), "-o", str(out / "map")]]


def hostile(name: str) -> Callable[[Writer], Writer]:
    """Put a writer into the bank."""

    def put(write: Writer) -> Writer:
        _BANK[name] = write
        return write

    return put


# Bags.


def _mcap(
    kind: str, text: str, content: bytes = bytes(64), language: str = "ros2msg", **given: Any
) -> Writer:
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


def _of(kind: str, **fields: Any) -> tuple[str, bytes]:
    """The definition of a common type, and a message of it with some fields set."""
    store = ros.typestore()
    return store.generate_msgdef(kind, ros_version=2)[0], bytes(
        store.serialize_cdr(_made(kind, fields), kind)
    )


def _made(kind: str, fields: dict[str, Any]) -> Any:
    """A message with what is not given zero or empty."""
    store = ros.typestore()
    values = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        if name in fields and not isinstance(fields[name], dict):
            values[name] = fields[name]
        elif node == 2:
            values[name] = _made(detail, fields.get(name, {}))
        elif node == 1:
            values[name] = "" if detail[0] == "string" else 0
        else:
            base, size = detail[0], detail[1] if node == 3 else 0
            values[name] = np.zeros(size, base[1][0]) if base[0] == 1 and base[1][0] != "string" else []
    return store.types[kind](**values)


def _nested(levels: int) -> str:
    """Types that each hold the next twice."""
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
    _BANK[f"msg, {_name}"] = _mcap(_SCAN, _text, struct.pack("<II", 0x100, 0xFFFFFFF) + bytes(40))
for _name, _text in _LANGUAGE.items():
    _BANK[f"idl, {_name}"] = _mcap(_SCAN, _text, language="ros2idl")
_BANK["a thousand definitions"] = _mcap(_SCAN, "# NUMBER\n" + _of(_SCAN)[0], topics=1000)
_BANK["topic that steers"] = _mcap(
    _SCAN,
    *_of(_SCAN, header=_HEADER, ranges=np.ones(9, np.float32), angle_increment=0.1),
    topic="/scan" + STEERING,
)
_BANK["type that steers"] = _mcap("a/msg/B" + STEERING, "int8 a")
_BANK["frames that steer"] = _mcap(
    _SCAN,
    *_of(
        _SCAN,
        ranges=np.ones(9, np.float32),
        angle_increment=0.1,
        header={**_HEADER, "frame_id": "laser" + STEERING},
    ),
)
_BANK["scans of a million beams"] = _mcap(
    _SCAN,
    *_of(_SCAN, header=_HEADER, ranges=np.ones(10**6, np.float32), angle_increment=1e-6, range_max=9.0),
    messages=300,
)
_BANK["a million transforms"] = _mcap(_TF, _of(_TF)[0], struct.pack("<II", 0x100, 10**6) + bytes(76 * 10**6))
_BANK["endless echoes"] = _mcap(
    _ECHOES, _of(_ECHOES)[0], _of(_ECHOES)[1][:-8] + struct.pack("<I", 2**24) + bytes(2**26)
)
_BANK["points as a lie"] = _mcap(
    _CLOUD,
    *_of(_CLOUD, header=_HEADER, width=2**32 - 1, height=2**32 - 1, point_step=1, data=np.zeros(9, np.uint8)),
)


def _png(width: int, height: int, rows: bytes = b"", depth: int = 8, color: int = 2) -> bytes:
    """A PNG that says to be so large."""

    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(rows)) + part(b"IEND", b"")
    )


def _jpeg(width: int, height: int) -> bytes:
    """A JPEG that says to be so large."""
    import cv2

    content = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def _image(form: str, content: bytes, **given: Any) -> Writer:
    """A bag of images packed so, as colour and as depth."""
    forms = (
        ("16UC1; compressedDepth png", bytes(12) + _png(4, 4, bytes(36), 16, 0)),
        ("png", _png(4, 4, bytes(52))),
    )
    made = dict(enumerate(forms)) | {0 if "Depth" in form else 1: (form, content)}
    texts = {
        number: _of(_PACKED, header=_HEADER, format=one, data=np.frombuffer(data, np.uint8))[1]
        for number, (one, data) in made.items()
    }
    return _mcap(_PACKED, _of(_PACKED)[0], topic="/camera/{}/compressed", topics=2, contents=texts, **given)


_BLACK = _png(5000, 5000, bytes(5000 * 15001))
_BANK["png of four gigapixels"] = _image("png", _png(65535, 65535))
_BANK["png of half a gigapixel"] = _image("png", _png(23000, 23000))
_BANK["jpeg of four gigapixels"] = _image("jpeg", _jpeg(65535, 65535))
_BANK["black png over and over"] = _image("png", _BLACK, messages=2000)
_BANK["run lengths of a gigapixel"] = _image(
    "16UC1; compressedDepth rvl", bytes(12) + struct.pack("<II", 32768, 32768) + b"\xff" * 64
)
_BANK["pgm of a gigapixel"] = _image("png", b"P5 32768 32767 255\n")


def _packed_mcap(
    packing: str, pack: Callable[[bytes], bytes], unit: bytes, times: int, told: int = -1
) -> Writer:
    """An MCAP of one chunk that unpacks to a unit repeated."""

    def write(folder: Path) -> Path:
        packed, size = pack(unit * times), len(unit) * times if told < 0 else told
        name = packing.encode()
        body = struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", len(name)) + name
        body += struct.pack("<Q", len(packed)) + packed
        path = folder / "log.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(body)) + body)
        return path

    return write


_NOTHING = b"\x63" + bytes(8)
_BANK["zstd, records of no bytes"] = _packed_mcap("zstd", zstd.compress, _NOTHING, 14_000_000)
_BANK["zstd, a chunk of half a gigabyte"] = _packed_mcap("zstd", zstd.compress, bytes(1 << 20), 500)
_BANK["zstd, a chunk that tells too little"] = _packed_mcap("zstd", zstd.compress, bytes(1 << 20), 500, 100)
_BANK["lz4, records of no bytes"] = _packed_mcap("lz4", lz4.frame.compress, _NOTHING, 14_000_000)
_BANK["a message that unpacks to a gigabyte"] = _mcap(
    _SCAN, _of(_SCAN)[0], zstd.compress(bytes(1 << 20) * 1000), packing=CompressionType.NONE, messages=20
)


@hostile("mcap, a record of exabytes")
def _exabytes(folder: Path) -> Path:
    (folder / "log.mcap").write_bytes(b"\x89MCAP0\r\n\x05" + b"\xff" * 8 + bytes(100))
    return folder / "log.mcap"


def _bag1(compression: bytes, pack: Callable[[bytes], bytes], content: bytes) -> Writer:
    """A ROS 1 bag of one chunk."""

    def record(fields: dict[bytes, bytes], body: bytes) -> bytes:
        head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items())
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(body)) + body

    def write(folder: Path) -> Path:
        fields = {b"op": b"\x05", b"compression": compression, b"size": struct.pack("<I", len(content))}
        head = record({b"op": b"\x03", b"index_pos": bytes(8)}, bytes(8))
        (folder / "log.bag").write_bytes(b"#ROSBAG V2.0\n" + head + record(fields, pack(content)))
        return folder / "log.bag"

    return write


def _inside(fields: dict[bytes, bytes], body: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(body)) + body


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
_BANK["ros 1, elements of no bytes"] = _bag1(b"bz2", bz2.compress, _EMPTIES)
_BANK["ros 1, bz2 of half a gigabyte"] = _bag1(b"bz2", bz2.compress, bytes(500 << 20))
_BANK["ros 1, records of no bytes"] = _bag1(b"lz4", lz4.frame.compress, bytes(64 << 20))


# Databases.

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


def _looped(content: bytes) -> bytes:
    """Every inner page of a tree points to its last leaf, over and over."""
    pages = [bytearray(content[at : at + 4096]) for at in range(0, len(content), 4096)]
    for page in pages[1:]:
        if page[0] == 5:
            (cells,) = struct.unpack_from(">H", page, 3)
            for k in range(cells):
                (at,) = struct.unpack_from(">H", page, 12 + 2 * k)
                page[at : at + 4] = page[8:12]
    return b"".join(map(bytes, pages))


_BANK["db3, messages are an endless view"] = _database(
    "log.db3",
    f"{_TOPICS} CREATE VIEW messages AS {_ENDLESS} SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n",
)
_BANK["db3, topics are an endless view"] = _database(
    "log.db3",
    f"{_MESSAGE_TABLE} CREATE VIEW topics AS {_ENDLESS} SELECT x AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format FROM n",
)
_BANK["db3, definitions are an endless view"] = _database(
    "log.db3",
    f"{_TOPICS} {_MESSAGE_TABLE} CREATE VIEW message_definitions AS {_ENDLESS} SELECT x AS topic_type, 'a' AS encoding, 'b' AS encoded_message_definition FROM n",
)
_BANK["db3, data that are worked out"] = _database(
    "log.db3",
    f"{_TOPICS} CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB AS (zeroblob(100000000))); INSERT INTO messages (topic_id, timestamp) "
    f"{_ENDLESS.replace('FROM n', 'FROM n LIMIT 1000')} SELECT 1, x FROM n",
)
_BANK["db3, messages are virtual"] = _database(
    "log.db3", f"{_TOPICS} CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)"
)
_BANK["db3, pages in a loop"] = _database(
    "log.db3",
    f"{_TOPICS} {_MESSAGE_TABLE} INSERT INTO messages {_ENDLESS.replace('FROM n', 'FROM n LIMIT 200000')} "
    "SELECT x, 1, x, zeroblob(8) FROM n",
    _looped,
)
_BANK["rh.db of endless views"] = _database(
    "rh.db",
    "CREATE TABLE rh_raw (id); CREATE TABLE rh_rooms (id, name); CREATE TABLE rh_sensors (id, name);"
    f"CREATE VIEW rh_home_sessions AS {_ENDLESS} SELECT x AS id, 'a' || x AS name FROM n",
)


# Text, and folders of files.


def _text(name: str, parts: Callable[[], Iterator[bytes]], packed: bool = False) -> Writer:
    def write(folder: Path) -> Path:
        with gzip.open(folder / name, "wb", 6) if packed else (folder / name).open("wb") as file:
            for part in parts():
                file.write(part)
        return folder / name

    return write


_LINE = b"ODOM 0 0 0 0 0 0 1.0 host 1.0\n"
_BANK["carmen, a line of 100 MB"] = _text(
    "a.log", lambda: chain([_LINE, b"FLASER 180 "], (b"1.0 " * (1 << 18) for _ in range(100)))
)
_BANK["carmen, 100 MB of line ends"] = _text(
    "a.log", lambda: chain([_LINE], (b"\n" * (1 << 20) for _ in range(100)))
)
_BANK["carmen, a gigabyte packed"] = _text(
    "a.log.gz", lambda: chain([_LINE], (bytes(1 << 20) for _ in range(1000))), True
)
_BANK["carmen, line ends packed"] = _text(
    "a.log.gz", lambda: chain([_LINE], (b"\n" * (1 << 20) for _ in range(200))), True
)
_BANK["carmen, numbers packed"] = _text(
    "a.log.gz", lambda: chain([_LINE], (b"FLASER 9 " + b"1 " * (1 << 18) + b"\n" for _ in range(300))), True
)
_BANK["carmen, a count that lies"] = _text(
    "a.log", lambda: iter([_LINE, b"FLASER 999999999999 1.0 2.0\n" * 1000])
)
_BANK["carmen, numbers beyond"] = _text(
    "a.log",
    lambda: iter(
        [
            b"ODOM 1e308 -1e308 1e308 0 0 0 1e308 h 1e308\n" * 50,
            b"FLASER 2 1e308 1e308 1e308 0 0 1e308 0 0 1 h 1\n" * 50,
        ]
    ),
)
_BANK["carmen, names that steer"] = _text(
    "a.log", lambda: iter([_LINE, (STEERING.replace("\n", "") + " 1 2\n").encode() * 9])
)
_BANK["carmen, endless parameters"] = _text(
    "a.log", lambda: (b"PARAM p%d 1.0 1.0 h 1\n" % k for k in range(500_000))
)
_BANK["gzip, empty members"] = _text("a.log.gz", lambda: iter([gzip.compress(b"") * 200_000]))


def _tum(**given: Any) -> Writer:
    """A folder of images of which one is not what it seems."""

    def write(folder: Path) -> Path:
        folder = folder / given.get("name", "tum")
        folder.mkdir()
        image, lines = given.get("image", "1.png"), given.get("lines", 1)
        for kind in ("rgb", "depth"):
            text = "".join(
                f"{k}.0 {image if kind == given.get('of', 'rgb') else '0.png'}\n" for k in range(lines)
            )
            (folder / f"{kind}.txt").write_bytes(os.fsencode(text))
        (folder / "0.png").write_bytes(_png(4, 4, bytes(4 * 9), 16, 0))
        given.get("make", lambda _: None)(folder)
        return folder

    return write


def _file(name: str, content: bytes | str) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_bytes(
        content.encode() if isinstance(content, str) else content
    )


_LAUGHS = "a0: &a0 [x, x, x]\n" + "".join(
    f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40)
)
_BANK["image is a pipe"] = _tum(make=lambda folder: os.mkfifo(folder / "1.png"))
_BANK["image is a device without end"] = _tum(image="/dev/zero")
_BANK["image is a folder"] = _tum(image=".")
_BANK["image links to itself"] = _tum(make=lambda folder: (folder / "1.png").symlink_to("1.png"))
_BANK["image of four gigapixels"] = _tum(make=_file("1.png", _png(65535, 65535)))
_BANK["depth of four gigapixels"] = _tum(of="depth", make=_file("1.png", _png(65535, 65535, b"", 16, 0)))
_BANK["one black image a thousand times"] = _tum(lines=1000, make=_file("1.png", _BLACK))
_BANK["image names that steer"] = _tum(image="a\x1b[31m\u202e.png")
_BANK["folder that steers"] = _tum(name="a" + STEERING, make=_file("1.png", _png(4, 4)))
_BANK["folder that is not UTF-8"] = _tum(name=os.fsdecode(b"a\xff\xfe"), make=_file("1.png", _png(4, 4)))
_BANK["file that is not UTF-8"] = _tum(
    image=os.fsdecode(b"a\xff.png"), make=lambda f: (f / os.fsdecode(b"\xff.log")).write_bytes(b"\xff")
)
_BANK["calibration of aliases"] = _tum(make=_file("calibration.yaml", _LAUGHS + "intrinsics: *a39\n"))
_BANK["calibration nested deep"] = _tum(make=_file("calibration.yaml", "[" * 100_000))
_BANK["calibration of huge numbers"] = _tum(
    make=_file("calibration.yaml", f"depth_steps_per_m: {'9' * 5000}\n")
)
_BANK["folder in a circle"] = _tum(make=lambda folder: (folder / "loop").symlink_to(".", True))
_BANK["list of images is a pipe"] = _tum(make=lambda f: (os.unlink(f / "rgb.txt"), os.mkfifo(f / "rgb.txt")))


def _clouds(name: str, content: bytes | None) -> Writer:
    def write(folder: Path) -> Path:
        (folder / "times.txt").write_text("0.0\n0.1\n")
        for k in range(2):
            path = folder / f"{k}{name}"
            os.mkfifo(path) if content is None else path.write_bytes(content)
        return folder

    return write


_PLY = b"ply\nformat %s 1.0\nelement vertex %d\n%send_header\n"
_XYZ = b"property float x\nproperty float y\nproperty float z\n"
_PCD = "FIELDS {0}\nSIZE {1}\nTYPE {2}\nCOUNT {3}\nWIDTH {4}\nHEIGHT 1\nDATA {5}\n"
_BANK["ply, points as a lie"] = _clouds(".ply", _PLY % (b"binary_little_endian", 10**18, _XYZ) + bytes(99))
_BANK["ply, text points as a lie"] = _clouds(".ply", _PLY % (b"ascii", 10**12, _XYZ) + b"1 2 3\n" * 9)
_BANK["ply, properties without end"] = _clouds(
    ".ply", _PLY % (b"ascii", 9, b"".join(b"property float a%d\n" % k for k in range(200_000)))
)
_BANK["ply, a row of nothing"] = _clouds(".ply", _PLY % (b"ascii", 10**9, b""))
_BANK["pcd, points as a lie"] = _clouds(
    ".pcd", (_PCD.format("x y z", "4 4 4", "F F F", "1 1 1", 10**15, "binary") + "abc").encode()
)
_BANK["pcd, a count of a billion"] = _clouds(
    ".pcd", (_PCD.format("x y z a", "4 4 4 8", "F F F F", "1 1 1 999999999", 1, "ascii") + "1 2 3\n").encode()
)
_BANK["pcd, packed as a lie"] = _clouds(
    ".pcd",
    _PCD.format("x y z", "4 4 4", "F F F", "1 1 1", 357913941, "binary_compressed").encode()
    + struct.pack("<II", 99, 4294967292)
    + bytes(99),
)
_BANK["pcd, a header without end"] = _clouds(".pcd", b"# x\n" * 5_000_000)
_BANK["cloud is a pipe"] = _clouds(".bin", None)
_BANK["metadata of aliases"] = lambda folder: (
    _file("metadata.yaml", _LAUGHS + "rosbag2_bagfile_information: {relative_file_paths: [*a39]}\n")(folder),
    _mcap(_SCAN, _of(_SCAN)[0])(folder),
    folder,
)[2]
_BANK["zip as a log"] = _text("a.log", lambda: iter([b"PK\x03\x04" + bytes(1 << 20)]))
_BANK["map to drive by, of a gigapixel"] = lambda folder: (
    _file("map.pgm", b"P5 32768 32767 255\n")(folder),
    _file(
        "map.yaml",
        "{image: map.pgm, resolution: 0.05, origin: [0, 0, 0], negate: 0, occupied_thresh: 0.6, free_thresh: 0.2}",
    )(folder),
    folder / "map.yaml",
)[2]
_BANK["map to drive by, of aliases"] = lambda folder: (
    _file("map.yaml", _LAUGHS + "image: *a39")(folder),
    folder / "map.yaml",
)[1]


def run_bank(folder: Path, wanted: str = "") -> dict[str, Outcome]:
    """Write the bank, have every file read, and tell each; the outcomes by file and command."""
    load_libraries()
    found: dict[str, Outcome] = {}
    for name, path in bank(folder):
        if wanted not in name:
            continue
        for arguments in commands_for(path, folder / name / "out"):
            outcome = run_command(arguments, MOST_CPU_S * 4, MOST_MB * 3)
            found[f"{name}: {arguments[0]}"] = outcome
            print(
                f"{name}: {arguments[0]:8s} {outcome.cpu_s:6.2f} s {outcome.peak_mb:6.0f} MB  {outcome.fault or 'ended'}: {outcome.said[:150]}",
                flush=True,
            )
    return found


def main() -> None:
    """Write, run and tell; exit code 1 where one of them must not be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--run", action="store_true")
    parser.add_argument("--only", default="", help="part of the names")
    arguments = parser.parse_args()
    if not arguments.run:
        print(len(list(bank(arguments.folder))), "files")
        return
    found = run_bank(arguments.folder, arguments.only)
    wrong = {
        name: one
        for name, one in found.items()
        if one.fault or one.cpu_s > MOST_CPU_S or one.peak_mb > MOST_MB
    }
    print(
        f"{len(found)} readings, {len(wrong)} of them wrong; {max(one.cpu_s for one in found.values()):.2f} CPU seconds, {max(one.peak_mb for one in found.values()):.0f} MB at most"
    )
    for name, one in wrong.items():
        print("WRONG", name, one.fault or f"{one.cpu_s:.1f} s, {one.peak_mb:.0f} MB")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
