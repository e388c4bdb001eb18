"""Spoil sound files at random, and read them: an error in one line, a counted skip, or the file as it was.

    PYTHONPATH=. python tools/fuzz.py [FORMAT ...] --seconds 60 --keep DIR

Bytes are flipped, cut, doubled, made zero or into sizes; numbers and words of text into such as no recorder
writes; definitions of messages are rewritten with the bag whole around them; rows of a map are rewritten with
checksums and seal made right again. Each is read in a child of its own with 2 GB and 10 CPU seconds.
A container without checksums cannot tell a changed range from a range: only such are "changed in silence".
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sqlite3
import sys
import tempfile
import zlib
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import MapFileError, ScanweaveError
from slam.measurements import RgbdFrame
from slam.storage.packing import pack
from tools.fuzz_seeds import BAGS, KINDS, LOGS, messages, write, write_log
from tools.hostile_maps import forge
from tools.trial_process import Outcome, load_libraries, run_child

FORMATS = (*BAGS, "definition", *LOGS, "map.db", "map row")
_CHECKED = frozenset({"mcap", "map.db"})  # where every change is noticed
_MOST_CPU_S, _MOST_MB = 10.0, 2048.0
_SIZES = (0, 1, 2**7 - 1, 2**15, 2**24, 2**27, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
_WORDS = (
    *(
        "0",
        "-1",
        "1e308",
        "1e-320",
        "nan",
        "inf",
        "-inf",
        "9" * 40,
        "9" * 5000,
        "0x7f",
        "1_0",
        "\x00",
        "\x1b[2J",
    ),
    *(
        "\u202e",
        "string[] x",
        "float64 y",
        "int8[999999999] z",
        "Header[] h",
        "T x",
        "const long A = 1 << 9999;",
    ),
    *(
        "(" * 50,
        "[" * 300,
        "{" * 300,
        "&a",
        "*a",
        "!!python/name:os",
        "%s%n",
        "../../etc/passwd",
        "/dev/zero",
    ),
)
_TEXT_ENDS = (".log", ".txt", ".yaml", ".ply", ".pcd", ".csv", ".json", ".traj", ".pincam", ".freiburg")
_WORD = re.compile(rb"[^\s,:=\[\]{}();]+")

# What a file that may be spoilt comes to.
VERDICTS = ("error in one line", "counted skip", "as it was", "changed in silence")

Rng = np.random.Generator


@dataclass(slots=True)
class Tally:
    """What became of the spoilt files of one format."""

    outcomes: Counter[str] = field(default_factory=Counter)
    cpu_s: float = 0.0
    longest_s: float = 0.0
    peak_mb: float = 0.0
    faults: list[str] = field(default_factory=list)

    def add(self, outcome: Outcome, verdict: str) -> None:
        """Count one."""
        self.outcomes[verdict] += 1
        self.cpu_s += outcome.cpu_s
        self.longest_s, self.peak_mb = max(self.longest_s, outcome.cpu_s), max(self.peak_mb, outcome.peak_mb)


# What a file says.


def log_content(path: Path) -> dict[str, list[str]]:
    """The readings of a log and its truth, and what is reported: skips, topics that are not read, notes."""
    from slam.datasets import open_dataset

    dataset = open_dataset(path)
    readings = [_digest(reading) for reading in dataset]
    report, truth = dataset.report, dataset.groundtruth()
    if truth is not None:
        readings.append(_digest(truth))
    return {"readings": readings, "told": sorted([*report.dropped, *report.ignored, *report.notes])}


def _digest(reading: Any) -> str:
    """Digest of all that a measurement says."""
    digest = hashlib.blake2b(type(reading).__name__.encode(), digest_size=8)
    for value in astuple(reading) if not isinstance(reading, RgbdFrame) else (reading.color, reading.depth_m):
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def map_content(path: Path) -> str:
    """Digest of everything that a reader gets from a map.

    Raises
    ------
    MapFileError
        Where the map is refused.
    """
    from slam.outputs.finished_map import load_map

    saved = load_map(path)
    try:
        saved.check()
        contents, digest = saved.contents, hashlib.blake2b()
        digest.update(repr(sorted(saved.identity.to_meta().items())).encode())
        scans = [list(contents.measured_scans), list(contents.keyframe_scans), list(contents.loops)]
        poses = [list(contents.node_poses), contents.stamps_s, contents.readings, contents.trajectory]
        digest.update(pack([scans, poses]))
        for factor in contents.factors:
            edge = factor.edge
            ends = [edge.source, edge.target, str(edge.kind), edge.trusted, factor.kept, edge.loop]
            digest.update(pack([ends, edge.T_source_target, edge.covariance]))
        for name, grid in contents.grids.items():
            digest.update(pack([name, grid.log_odds, grid.resolution_m, grid.T_map_grid]))
        frames, clouds = contents.frames, contents.clouds
        for number, frame in enumerate(frames or ()):
            assert frames
            node, camera = frames.head(number).node, [frame.intrinsics, frame.T_base_camera]
            images = [frame.color, frame.depth_m, frames.features(number)]
            digest.update(pack([node, frame.stamp_s, frame.sensor, camera, images]))
        for key, points in enumerate(clouds or ()):
            assert clouds
            digest.update(pack([points, clouds.T_base_lidar(key)]))
        return digest.hexdigest()
    finally:
        saved.close()


def map_outcome(path: Path, content: str) -> str:
    """``refused``, ``harmless``, or what went wrong."""
    try:
        return "harmless" if map_content(path) == content else "WRONG MAP"
    except MapFileError as error:
        return "refused" if len(str(error).splitlines()) == 1 else f"not one line: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


# How a file is spoilt.


def spoilt_bytes(content: bytes, rng: Rng) -> bytes:
    """A copy that is cut, has other bytes, a block twice or without its bytes, or another size somewhere."""
    changed, at = bytearray(content), int(rng.integers(max(len(content), 1)))
    match int(rng.integers(6)):
        case 0:
            del changed[at:]
        case 1:
            changed[at : at + int(rng.integers(1, 2000))] = bytes(int(rng.integers(1, 2000)))
        case 2:
            block = changed[at : at + int(rng.integers(1, 500))]
            changed[at:at] = block * int(rng.integers(1, 4))
        case 3:
            width = int(rng.choice([1, 2, 4, 8]))
            size = int(rng.choice(np.array(_SIZES, dtype=object))) % (1 << 8 * width)
            changed[at : at + width] = size.to_bytes(width, "little" if rng.integers(4) else "big")
        case _:
            for place in rng.integers(max(len(changed), 1), size=int(rng.choice([1, 1, 3, 30]))):
                if changed:
                    changed[place] ^= int(rng.integers(1, 256))
    return bytes(changed)


def spoilt_text(content: bytes, rng: Rng) -> bytes:
    """A copy in which some words or lines are others, away, or there twice."""
    for _ in range(int(rng.choice([1, 1, 2, 5]))):
        words = list(_WORD.finditer(content, int(rng.integers(max(len(content), 1)))))[:50]
        if not words or not rng.integers(4):
            lines = content.splitlines(keepends=True) or [b""]
            at = int(rng.integers(len(lines)))
            lines[at : at + int(rng.integers(2))] = [lines[int(rng.integers(len(lines)))]] * int(
                rng.integers(3)
            )
            content = b"".join(lines)
        else:
            word = words[int(rng.integers(len(words)))]
            content = content[: word.start()] + str(rng.choice(_WORDS)).encode() + content[word.end() :]
    return content


def spoilt_definition(path: Path, rng: Rng) -> Path:
    """A bag with another definition of one of its types."""
    from slam.storage import ros_messages as messages

    kind = str(rng.choice(KINDS))
    text = messages.typestore().generate_msgdef(kind, ros_version=2)[0].encode()
    name = str(rng.choice(["mcap_plain", "bag", "db3", "idl"]))
    if name == "idl":
        fields = " ".join(
            line.replace("[]", "") + ";" for line in text.decode().splitlines() if line.isprintable()
        )
        text = f"module sensor_msgs {{ module msg {{ struct X {{ {fields} }}; }}; }};".encode()
    return write(path, name, messages(), {kind: spoilt_text(text, rng).decode("utf-8", "replace")})


def spoil_row(path: Path, rng: Rng) -> None:
    """Change a value in a row of a map; its checksum and the seal are made right again."""
    from slam.storage.map_tables import TABLES

    with sqlite3.connect(path) as database:
        filled = [t for t in TABLES if database.execute(f"SELECT count(*) FROM {t.name}").fetchone()[0]]
        table = filled[int(rng.integers(len(filled)))]
        (count,) = database.execute(f"SELECT count(*) FROM {table.name}").fetchone()
        number = int(rng.integers(count))
        row = database.execute(f"SELECT * FROM {table.name} WHERE number = ?", (number,)).fetchone()
    database.close()
    column = int(rng.integers(len(table.columns)))
    forge(path, table.name, number, **{table.columns[column][0]: spoilt_value(row[2 + column], rng)})


def spoilt_value(value: Any, rng: Rng) -> Any:
    """Another value in a column, of the same kind or not."""
    if not rng.integers(5):
        others = (None, -1, 2**62, 1e300, float("nan"), "words", b"bytes", "[" * 5000)
        return others[int(rng.integers(len(others)))]
    if isinstance(value, bytes) and len(value) > 8 and value[8:9] == b"x":  # packed, with its size before it
        plain = spoilt_bytes(zlib.decompress(value[8:]), rng)
        return len(plain).to_bytes(8, "little") + zlib.compress(plain)
    if isinstance(value, bytes):
        return spoilt_bytes(value, rng)
    if isinstance(value, str):
        return spoilt_text(value.encode(), rng).decode("utf-8", "replace")
    return type(value)(rng.choice([0, -1, 7, 1e6])) if value is not None else 0


# The trials.


class Fuzzer:
    """Files of one format, spoilt one after another."""

    def __init__(self, name: str, folder: Path, seed_map: Path | None) -> None:
        self.name, self._folder = name, folder
        self._seed = folder / "seed"
        self._seed.mkdir(parents=True)
        if name in BAGS:
            self._sound = write(self._seed / "log", name, messages(), {})
        elif name == "definition":
            self._sound = write(self._seed / "log", "mcap", messages(), {})
        elif name in LOGS:
            self._sound = write_log(self._seed, name)
        else:
            assert seed_map is not None
            self._sound = Path(shutil.copy(seed_map, self._seed / "map.db"))
        self._is_map = name.startswith("map")
        self._expected: Any = map_content(self._sound) if self._is_map else log_content(self._sound)

    def spoil(self, rng: Rng) -> Path:
        """The next file, in a folder of its own."""
        place = self._folder / "trial"
        shutil.rmtree(place, ignore_errors=True)
        if self.name == "definition":
            place.mkdir()
            return spoilt_definition(place / "log", rng)
        shutil.copytree(self._seed, place)
        path = place / self._sound.relative_to(self._seed)
        if self.name == "map row":
            spoil_row(path, rng)
            return path
        # Of each kind as often: of a folder with many images the few lists and lenses matter most.
        kinds: dict[str, list[Path]] = {}
        for file in [path] if self.name in BAGS else sorted(place.rglob("*")):
            if file.is_file():
                kinds.setdefault(f"{file.parent.name}{file.suffix}", []).append(file)
        files = kinds[str(rng.choice(sorted(kinds)))]
        file = files[int(rng.integers(len(files)))]
        as_text = file.name.endswith(_TEXT_ENDS) and rng.integers(3)
        file.write_bytes((spoilt_text if as_text else spoilt_bytes)(file.read_bytes(), rng))
        return path

    def read(self, path: Path) -> tuple[Outcome, str]:
        """How reading it ended, and the verdict on that; what must not be begins with BAD."""

        def work() -> int:
            try:
                if self._is_map:
                    from slam.evaluation.map_info import map_info, render_info

                    print(json.dumps(map_content(path)))
                    render_info(map_info(path))
                else:
                    print(json.dumps(log_content(path)))
            except ScanweaveError as error:
                print(f"scanweave: {error}")
                return 1
            return 0

        outcome = run_child(work, _MOST_CPU_S, _MOST_MB)
        if outcome.fault or outcome.cpu_s > _MOST_CPU_S or outcome.peak_mb > _MOST_MB:
            return outcome, f"BAD: {outcome.fault or 'time or memory'}"
        if outcome.said.startswith("scanweave: "):
            return outcome, "error in one line"
        if warnings := [line for line in outcome.lines if "Warning: " in line]:
            return outcome, f"BAD: {warnings[-1]}"
        return outcome, self._verdict(json.loads(outcome.said))

    def _verdict(self, found: Any) -> str:
        """What became of a file that was read to its end."""
        if found == self._expected:
            return "as it was"
        if self._is_map:
            return "BAD: WRONG MAP" if self.name in _CHECKED else "as it was"
        if found["told"] != self._expected["told"]:
            return "counted skip"
        if found["readings"] == self._expected["readings"]:
            return "as it was"
        if self.name in _CHECKED or (
            len(found["readings"]) < len(self._expected["readings"]) and self.name in BAGS
        ):
            return "BAD: lost or changed in silence"
        return "changed in silence"


def fuzz(name: str, seconds: float, seed: int, keep: Path | None, seed_map: Path | None) -> Tally:
    """Spoil and read files of a format for so many CPU seconds of their children."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(name, Path(folder), seed_map)
        trial = 0
        while tally.cpu_s < seconds:
            rng = np.random.default_rng([seed, trial, *name.encode()])
            path = fuzzer.spoil(rng)
            outcome, verdict = fuzzer.read(path)
            tally.add(outcome, verdict)
            if verdict.startswith("BAD"):
                tally.faults.append(f"{name}, seed {seed}, trial {trial}: {verdict}: {outcome.said[:120]}")
                if keep is not None:
                    shutil.copytree(Path(folder) / "trial", keep / f"{name} {trial}", dirs_exist_ok=True)
            trial += 1
    return tally


def main() -> None:
    """Run the trials and tell the outcomes; exit code 1 where one of them must not be."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", metavar="FORMAT", help=f"of {', '.join(FORMATS)}; else all")
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU seconds a format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--map", type=Path, help="a sound map.db, for the formats of maps")
    parser.add_argument("--keep", type=Path, help="where files go that must not be")
    arguments = parser.parse_args()
    load_libraries()
    faults = []
    print(
        f"| format | files | CPU s | longest, s | peak MB | {' | '.join(VERDICTS)} |\n|{'---|' * 9}",
        flush=True,
    )
    for name in arguments.formats or FORMATS:
        if name.startswith("map") and arguments.map is None:
            print(f"{name}: give a map by --map", file=sys.stderr)
            continue
        tally = fuzz(name, arguments.seconds, arguments.seed, arguments.keep, arguments.map)
        faults += tally.faults
        counts = " | ".join(str(tally.outcomes[verdict]) for verdict in VERDICTS)
        spent = f"{tally.cpu_s:.0f} | {tally.longest_s:.2f} | {tally.peak_mb:.0f}"
        print(f"| {name} | {tally.outcomes.total()} | {spent} | {counts} |", flush=True)
        for fault in tally.faults[:20]:
            print(fault, file=sys.stderr)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
