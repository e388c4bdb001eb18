"""Damage small bags in 500 ways, and read them: an error in one line, a counted skip, or the bag as it was.

    python tools/bag_damage_trials.py --trials 500

Bags are written by the writers of rosbags and mcap, in ROS 1 and ROS 2; each is cut, or gets flipped bytes,
a block of zeros, or another definition of a message type. Every one is read in a process of its own kind, so
that a crash or a hang is seen and told. A container without checksums cannot tell a flipped byte of a range
from a range: such readings are "changed in silence", which only those of db3 and ROS 1 bags may be.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import astuple
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam.datasets import Dataset, open_dataset
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, LaserScan, RgbdFrame
from slam.simulation import ros_messages as ros

_START_S = 1000.0
_PATIENCE_S = 60.0  # a small bag that takes longer to read hangs
_WITH_CHECKSUMS = frozenset({"mcap", "mcap_plain"})
_PACKED = "sensor_msgs/msg/CompressedImage"
_DAMAGES = ("cut", "flip", "burst", "zeros", "schema")

_ROS1 = get_typestore(Stores.ROS1_NOETIC)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", ros.TRANSFORMS))

Sent = tuple[str, str, float, bytes]


def main() -> None:
    """Run the trials and tell the outcomes; exit code 1 where one of them must not be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    outcomes: Counter[tuple[str, str]] = Counter()
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        whole = {name: write(Path(folder) / name, name, _messages(), {}) for name in _WRITERS}
        expected = {name: _content(path) for name, path in whole.items()}
        reader = _Reader()
        for trial in range(arguments.trials):
            rng = np.random.default_rng([arguments.seed, trial])
            name = list(_WRITERS)[trial % len(_WRITERS)]
            kind = _DAMAGES[trial // len(_WRITERS) % len(_DAMAGES)]
            path = damaged(Path(folder) / f"trial{trial}", name, whole[name], kind, rng)
            outcome = judged(reader.read(path), expected[name], name)
            outcomes[kind, outcome] += 1
            if outcome.startswith("BAD"):
                failures.append(f"trial {trial}, {name}, {kind}: {outcome}")
            path.unlink()
        reader.stop()
    for (kind, outcome), count in sorted(outcomes.items()):
        print(f"{kind:8s} {outcome:32s} {count}")
    print(
        "\n".join(failures)
        or f"{arguments.trials} damaged bags: none crashed, hung or lost readings in silence"
    )
    sys.exit(1 if failures else 0)


def judged(found: Any, expected: tuple[list[str], list[str]], name: str) -> str:
    """What became of a damaged bag, in a few words; what must not be begins with BAD."""
    if isinstance(found, str):
        return found
    readings, reported = found
    if readings == expected[0]:
        return "as it was" if reported == expected[1] else "as it was, and told"
    if reported != expected[1]:
        return "a counted or noted skip"
    if len(readings) == len(expected[0]) and name not in _WITH_CHECKSUMS:
        return "changed in silence"
    return f"BAD: {len(readings)} of {len(expected[0])} readings, nothing told"


def damaged(path: Path, name: str, whole: Path, kind: str, rng: np.random.Generator) -> Path:
    """A damaged copy of a bag."""
    if kind == "schema":
        return write(path, name, _messages(), _wrong_definition(rng))
    content = bytearray(whole.read_bytes())
    at = int(rng.integers(len(content)))
    if kind == "cut":
        del content[at:]
    elif kind == "zeros":
        size = min(int(rng.integers(1, 2000)), len(content) - at)
        content[at : at + size] = bytes(size)
    else:
        for place in rng.integers(len(content), size=1 if kind == "flip" else 30):
            content[place] ^= int(rng.integers(1, 256))
    copy = path.with_suffix(whole.suffix)
    copy.write_bytes(content)
    return copy


def _wrong_definition(rng: np.random.Generator) -> dict[str, str]:
    """For one message type a text that does not describe it."""
    kind = str(
        rng.choice([ros.LASER_SCAN, ros.IMAGE, ros.ODOMETRY, ros.POINT_CLOUD, ros.TRANSFORMS, _PACKED])
    )
    text = ros.typestore().generate_msgdef(kind)[0]
    lines = text.splitlines()
    at = int(rng.integers(len(lines)))
    others = ["float64 surprise", "string[] names", "uint8[3", "", "Unknown[] what", "=" * 80]
    wrong = [*lines[:at], str(rng.choice(others)), *lines[at + int(rng.integers(2)) :]]
    choices = ["", "no definition at all \0", "float32 x\n", text[: len(text) // 2], "\n".join(wrong)]
    return {kind: str(rng.choice(np.array(choices, dtype=object)))}


class _Reader:
    """A process that reads bags; another one after a crash or a hang."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self._here, there = multiprocessing.Pipe()
        self._process = multiprocessing.Process(target=_serve, args=(there,), daemon=True)
        self._process.start()
        there.close()

    def read(self, path: Path) -> Any:
        """Readings and whether something was reported, or the outcome in words."""
        self._here.send(path)
        try:
            if self._here.poll(_PATIENCE_S):
                return self._here.recv()
            outcome = f"BAD: no end after {_PATIENCE_S:g} s"
        except EOFError:
            outcome = "BAD: crash"
        self._process.kill()
        self._process.join()
        self._start()
        return outcome

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection) -> None:
    """Read bag after bag."""
    while True:
        path = pipe.recv()
        try:
            dataset = open_dataset(path)
            readings = [_digest(reading) for reading in dataset]
            pipe.send((readings, _reported(dataset)))
        except DatasetError as error:
            pipe.send("an error in one line" if "\n" not in str(error) else "BAD: an error of several lines")
        except Exception as error:
            pipe.send(f"BAD: {type(error).__name__}: {error}")


def _content(path: Path) -> tuple[list[str], list[str]]:
    """The readings of a bag, and what is told of it."""
    dataset = open_dataset(path)
    return [_digest(reading) for reading in dataset], _reported(dataset)


def _reported(dataset: Dataset) -> list[str]:
    """What a reader tells of a bag: skips, topics that are not read, notes."""
    report = dataset.report
    return sorted([*report.dropped, *report.ignored, *report.notes])


def _digest(reading: Any) -> str:
    """Digest of all that a measurement says."""
    digest = hashlib.blake2b(type(reading).__name__.encode(), digest_size=8)
    for value in astuple(reading) if not isinstance(reading, RgbdFrame) else (reading.color, reading.depth_m):
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def _messages() -> list[Sent]:
    """A robot that drives for a second with every sensor, as serialised messages."""
    rng = np.random.default_rng(1)
    lens = CameraIntrinsics(30.0, 30.0, 16.0, 12.0, 32, 24)
    mounts = dict.fromkeys(
        ("laser", "lidar", "optical"), gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.3]))
    )
    sent = [("/tf_static", ros.TRANSFORMS, _START_S, ros.transforms(_START_S, "base_link", mounts))]
    for k in range(10):
        at_s = _START_S + 0.1 * k
        pose = gtsam.Pose3(gtsam.Pose2(0.05 * k, 0.0, 0.01 * k))
        scan = LaserScan(at_s, rng.uniform(0.5, 7.0, 90).astype(np.float32), -1.5, 0.03, 8.0)
        points, ring = rng.normal(size=(50, 3)).astype(np.float32), np.zeros(50, np.uint8)
        color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        depth = rng.integers(500, 4000, (24, 32), dtype=np.uint16)
        frame = RgbdFrame(at_s, color, depth.astype(np.float32), lens)
        picture, distances = ros.color_image(frame, "optical"), ros.depth_image(depth, at_s, "optical")
        sent += [
            ("/odom", ros.ODOMETRY, at_s, ros.odometry(at_s, pose, (0.5, 0.1), "odom", "base_link")),
            ("/scan", ros.LASER_SCAN, at_s, ros.laser_scan(scan, "laser", 0.1, 0.1)),
            ("/points", ros.POINT_CLOUD, at_s, ros.point_cloud(points, ring, at_s, "lidar")),
            ("/camera/depth/camera_info", ros.CAMERA_INFO, at_s, ros.camera_info(lens, at_s, "optical")),
            ("/camera/color/image_raw", ros.IMAGE, at_s, picture),
            ("/camera/depth/image_raw", ros.IMAGE, at_s, distances),
            ("/rear/depth/camera_info", ros.CAMERA_INFO, at_s, ros.camera_info(lens, at_s, "optical")),
            ("/rear/color/image_raw/compressed", _PACKED, at_s, _packed(picture, color, "png", b"")),
            (
                "/rear/depth/image_raw/compressedDepth",
                _PACKED,
                at_s,
                _packed(distances, depth, "16UC1; compressedDepth png", bytes(12)),
            ),
        ]
    store = ros.typestore()
    return [
        (topic, kind, at_s, bytes(store.serialize_cdr(message, kind))) for topic, kind, at_s, message in sent
    ]


def _packed(raw: Any, pixels: np.ndarray, form: str, before: bytes) -> Any:
    """A CompressedImage of what a raw message shows."""
    done, content = cv2.imencode(".png", pixels)
    assert done
    data = np.frombuffer(before + content.tobytes(), np.uint8)
    return ros.typestore().types[_PACKED](header=raw.header, format=form, data=data)


def write(path: Path, name: str, messages: list[Sent], definitions: dict[str, str]) -> Path:
    """A bag by one of the writers; ``definitions`` replaces those of message types."""
    return _WRITERS[name](path, messages, definitions)


def _write_mcap(packing: CompressionType) -> Callable[[Path, list[Sent], dict[str, str]], Path]:
    """MCAP by the package mcap."""

    def written(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
        path = path.with_suffix(".mcap")
        with path.open("wb") as file:
            bag = McapWriter(file, chunk_size=16384, compression=packing)
            bag.start()
            topics: dict[str, int] = {}
            for topic, kind, at_s, content in messages:
                if topic not in topics:
                    text = definitions.get(kind, ros.typestore().generate_msgdef(kind, ros_version=2)[0])
                    schema = bag.register_schema(kind, "ros2msg", text.encode())
                    topics[topic] = bag.register_channel(topic, "cdr", schema)
                bag.add_message(topics[topic], round(at_s * 1e9), content, round(at_s * 1e9))
            bag.finish()
        return path

    return written


def _write_db3(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
    """rosbag2's SQLite by the package rosbags."""
    with Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics: dict[str, Any] = {}
        for topic, kind, at_s, content in messages:
            if topic not in topics:
                given: dict[str, Any] = {"typestore": ros.typestore()}
                if kind in definitions:
                    given = {"msgdef": definitions[kind], "rihs01": "RIHS01_" + "0" * 64}
                topics[topic] = bag.add_connection(topic, kind, **given)
            bag.write(topics[topic], round(at_s * 1e9), content)
    (inside,) = path.glob("*.db3")
    return inside.replace(path.with_suffix(".db3"))


def _write_ros1(packing: str) -> Callable[[Path, list[Sent], dict[str, str]], Path]:
    """A ROS 1 bag by the package rosbags."""

    def written(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
        bag = Writer1(path.with_suffix(".bag"))
        if packing:
            bag.set_compression(Writer1.CompressionFormat[packing])
        with bag:
            topics: dict[str, Any] = {}
            for topic, kind, at_s, content in messages:
                if topic not in topics:
                    given: dict[str, Any] = {"typestore": _ROS1}
                    if kind in definitions:
                        given = {"msgdef": definitions[kind], "md5sum": "0" * 32}
                    topics[topic] = bag.add_connection(topic, kind, **given)
                bag.write(topics[topic], round(at_s * 1e9), ros.typestore().cdr_to_ros1(content, kind))
        return path.with_suffix(".bag")

    return written


_WRITERS: dict[str, Callable[[Path, list[Sent], dict[str, str]], Path]] = {
    "mcap": _write_mcap(CompressionType.ZSTD),
    "mcap_plain": _write_mcap(CompressionType.NONE),
    "db3": _write_db3,
    "bag": _write_ros1(""),
    "bag_lz4": _write_ros1("LZ4"),
}


if __name__ == "__main__":
    main()
