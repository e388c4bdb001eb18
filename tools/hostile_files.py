"""A bank of files that nobody recorded: bombs, lies about sizes, loops, letters that steer a terminal.

    PYTHONPATH=. python tools/hostile_files.py FOLDER          writes them
    PYTHONPATH=. python tools/hostile_files.py FOLDER --run    and has every command read them

Each must end in a line that says what is wrong, or be read as far as it is sound: within 5 CPU seconds and
1 GB, without a letter that a terminal obeys. The time is that of a child of a process that has loaded all
libraries.
"""

from __future__ import annotations

import gzip
import os
import struct
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from slam.simulation import ros_messages as ros
from tools.hostile_bags import BAGS, BLACK, STEERING, mcap, of, png
from tools.hostile_maps import hostile_maps
from tools.trial_process import Outcome, load_libraries, run_command

MOST_CPU_S, MOST_MB = 5.0, 1024.0
Writer = Callable[[Path], Path]
_BANK: dict[str, Writer] = {**BAGS, **hostile_maps(STEERING)}


def bank(folder: Path, wanted: Sequence[str] = ("",)) -> Iterator[tuple[str, Path]]:
    """Write the files one after another, those with such names; name and path of each."""
    for name, write in _BANK.items():
        if any(part in name for part in wanted):
            (folder / name).mkdir(parents=True)
            yield name, write(folder / name)


def commands_for(path: Path, out: Path) -> list[list[str]]:
    """The commands that could meet a file."""
    if path.suffix == ".yaml":
        return [["plan", str(path), "--from", "0,0", "--to", "1,1", "-o", str(out / "plan.png")]]
    if path.name == "map.db":
        log = path.with_name("drive.log")
        log.write_bytes(_LINE * 3)
        looks = [
            ["check", str(path)],
            ["info", str(path)],
            ["localize", str(path), str(log), "-o", str(out / "o")],
        ]
        return [*looks, ["export", str(path), "-f", "nav2", "-o", str(out / "nav2")]]
    return [["inspect", str(path)], ["map", str(path), "-o", str(out / "map")]]


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
        (folder / "0.png").write_bytes(png(4, 4, bytes(4 * 9), 16, 0))
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
_BANK["image of four gigapixels"] = _tum(make=_file("1.png", png(65535, 65535)))
_BANK["depth of four gigapixels"] = _tum(of="depth", make=_file("1.png", png(65535, 65535, b"", 16, 0)))
_BANK["one black image a thousand times"] = _tum(lines=1000, make=_file("1.png", BLACK))
_BANK["image names that steer"] = _tum(image="a\x1b[31m\u202e.png")
_BANK["folder that steers"] = _tum(name="a" + STEERING, make=_file("1.png", png(4, 4)))
_BANK["folder that is not UTF-8"] = _tum(name=os.fsdecode(b"a\xff\xfe"), make=_file("1.png", png(4, 4)))
_BANK["file that is not UTF-8"] = _tum(
    image=os.fsdecode(b"a\xff.png"), make=lambda f: (f / os.fsdecode(b"\xff.log")).write_bytes(b"\xff")
)
_BANK["calibration of aliases"] = _tum(make=_file("calibration.yaml", _LAUGHS + "intrinsics: *a39\n"))
_BANK["calibration nested deep"] = _tum(make=_file("calibration.yaml", "[" * 100_000))
_BANK["calibration of huge numbers"] = _tum(
    make=_file("calibration.yaml", f"depth_steps_per_m: {'9' * 5000}\n")
)
_BANK["folder in a circle"] = _tum(make=lambda folder: (folder / "loop").symlink_to(".", True))
_BANK["list of images is a pipe"] = _tum(make=lambda f: ((f / "rgb.txt").unlink(), os.mkfifo(f / "rgb.txt")))


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
    mcap(ros.LASER_SCAN, *of(ros.LASER_SCAN))(folder),
    folder,
)[2]
_BANK["zip as a log"] = _text("a.log", lambda: iter([b"PK\x03\x04" + bytes(1 << 20)]))
_BANK["map to drive by, of a gigapixel"] = lambda folder: (
    _file("map.pgm", b"P5 32768 32767 255\n")(folder),
    _file(
        "map.yaml",
        "{image: map.pgm, resolution: 0.05, origin: [0, 0, 0], negate: 0, occupied_thresh: 0.6, "
        "free_thresh: 0.2}",
    )(folder),
    folder / "map.yaml",
)[2]
_BANK["map to drive by, of aliases"] = lambda folder: (
    _file("map.yaml", _LAUGHS + "image: *a39")(folder),
    folder / "map.yaml",
)[1]


def run_bank(folder: Path, wanted: Sequence[str] = ("",)) -> dict[str, Outcome]:
    """Write the bank, have every file read, and tell each; the outcomes by file and command."""
    load_libraries()
    found: dict[str, Outcome] = {}
    for name, path in bank(folder, wanted):
        for arguments in commands_for(path, folder / name / "out"):
            outcome = run_command(arguments, MOST_CPU_S * 4, MOST_MB * 3)
            found[f"{name}: {arguments[0]}"] = outcome
            took = f"{outcome.cpu_s:6.2f} s {outcome.peak_mb:6.0f} MB"
            print(
                f"{name}: {arguments[0]:8s} {took}  {outcome.fault or 'ended'}: {outcome.said[:150]}",
                flush=True,
            )
    return found


def main() -> None:
    """Write, run and tell; exit code 1 where one of them must not be."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--run", action="store_true")
    parser.add_argument("--only", nargs="+", default=[""], help="parts of the names")
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
    longest, largest = max(one.cpu_s for one in found.values()), max(one.peak_mb for one in found.values())
    print(f"{len(found)} readings, {len(wrong)} wrong; at most {longest:.2f} CPU seconds, {largest:.0f} MB")
    for name, one in wrong.items():
        print("WRONG", name, one.fault or f"{one.cpu_s:.1f} s, {one.peak_mb:.0f} MB")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
