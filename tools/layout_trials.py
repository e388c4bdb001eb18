"""Samples of recordings as data sets, drivers and phones publish them: is each read right, refused, or wrong?

    PYTHONPATH=. python tools/layout_trials.py -o DIR [--only WORDS] [--list]

Each sample is written after its publisher's words, with known lens, scale, stamps, mountings and truth; it is
inspected and mapped by the commands, and read through Python. Told of each is

    right       all that is true of it was found, and the command that `inspect` prints maps it to the true
                way
    mended      refused or warned, naming what mends it; that was done, and with it it is right
    reason      cannot be mapped, and is refused in one line that says why
    refused     no more than that
    told        wrong, with a note or a warning that says what was assumed
    SILENT      wrong, and nothing says so
    CRASH       a traceback
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import sys
import tempfile
import traceback
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import tools.layouts.all as _all_layouts  # noqa: F401  their writers put themselves on the list
from slam.cli import main as program
from slam.datasets import open_dataset
from slam.errors import ScanweaveError
from tools.layouts.judge import problems
from tools.layouts.samples import LAYOUTS, Sample

# What a map needs, loaded before the first is made.
_LIBRARIES = (
    "cv2 gtsam numba scipy.optimize scipy.spatial rosbags.typesys "
    "slam.app slam.mapper.pipeline slam.mapper.mapper"
)
_ASSUMED = re.compile(
    r"assum|warning|unknown|no tf|no CameraInfo|taken as|no mounting|first pose|left in the images",
    re.IGNORECASE,
)
_APART_M, _APART_RAD = 0.06, 0.03
_SECONDS = 300


class Nursery:
    """Runs commands, each in a process of its own that has the libraries loaded already.

    It is a process that does nothing but fork: loading them takes ten times as long as reading a sample.
    """

    def __init__(self) -> None:
        here, there = socket.socketpair()
        if not os.fork():
            here.close()
            asked = there.makefile("rw")
            for line in asked:
                asked.write(f"{_run(**json.loads(line))}\n")
                asked.flush()
            os._exit(0)
        there.close()
        self._asked = here.makefile("rw")

    def command(self, *words: str) -> tuple[int, str, str]:
        """Exit code, output and errors of the program."""
        with tempfile.TemporaryDirectory() as place:
            files = [str(Path(place) / name) for name in ("out", "err")]
            self._asked.write(json.dumps({"words": words, "files": files}) + "\n")
            self._asked.flush()
            code = int(self._asked.readline())
            return code, *(Path(file).read_text() for file in files)


def _run(words: list[str], files: list[str]) -> int:
    """Exit code of the program in a process of its own, its output and errors in files."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(_SECONDS)
    for place, file in enumerate(files, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), place)
    code: Any = 0
    try:
        sys.argv = ["scanweave", *words]
        code = program()
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0)


def judged(name: str, folder: Path, nursery: Nursery, *, maps: bool) -> dict[str, Any]:
    """Write a sample, try it, and tell how that went."""
    sample = LAYOUTS[name].write(folder)
    verdict = _tried(sample, (), folder, nursery, maps=maps)
    if sample.mend and verdict["result"] != "CRASH":
        option = sample.mend[0]
        if verdict["result"] != "right" and option in verdict["said"]:
            again = _tried(sample, sample.mend, folder, nursery, maps=maps)
            return again | {"result": "mended" if again["result"] == "right" else again["result"]}
    if sample.by_hand and sample.by_hand[0] in verdict["said"] and verdict["result"] != "right":
        path = sample.by_hand[1]() or sample.path
        again = _tried(replace(sample, path=path, refused=""), (), folder, nursery, maps=maps)
        return again | {"result": "mended" if again["result"] == "right" else again["result"]}
    return verdict


def _tried(
    sample: Sample, more: tuple[str, ...], folder: Path, nursery: Nursery, *, maps: bool
) -> dict[str, Any]:
    """Inspect, read and map."""
    code, output, errors = nursery.command("inspect", str(sample.path), "--json", *more)
    said = errors + output
    if "Traceback" in errors:
        return {"result": "CRASH", "why": errors.splitlines()[-1], "said": said}
    inspection = json.loads(output) if code == 0 else {}
    refusal = inspection.get("refusal") or ("" if code == 0 else errors.strip())
    if sample.refused or refusal:
        one_line = len(refusal.splitlines()) == 1
        if sample.refused:
            fine = one_line and re.search(sample.refused, refusal)
            wrong = "SILENT" if not refusal else "refused"
            return {"result": "reason" if fine else wrong, "why": refusal or "mapped", "said": said}
        return {"result": "refused" if one_line else "CRASH", "why": refusal, "said": said}
    calibration = [more[1]] if more[:1] == ("--calibration",) else []
    dataset = open_dataset(sample.path, calibration=calibration)
    try:
        wrong = problems(dataset, sample)
    except ScanweaveError as error:
        return {"result": "refused", "why": str(error), "said": said}
    notes = "; ".join(dataset.report.notes)
    wrong += [] if not maps else _mapped(inspection["commands"], sample, more, folder, nursery)
    if not wrong:
        return {"result": "right", "why": "", "said": said}
    result = "told" if _ASSUMED.search(notes) else "SILENT"
    return {"result": result, "why": "; ".join(wrong), "said": said}


def _mapped(
    commands: list[str], sample: Sample, more: tuple[str, ...], folder: Path, nursery: Nursery
) -> list[str]:
    """What is wrong with the map that the printed command makes."""
    out = folder / "map"
    words = shlex.split(commands[0])
    words = [*words[1 : words.index("-o")], "-o", str(out)]
    code, _, errors = nursery.command(*words, *(more if more and more[0] not in words else ()))
    if code != 0:
        return [f"map ends with {code}: {errors.strip()[-300:]}"]
    rows = np.loadtxt(out / "trajectory.tum", ndmin=2)
    shutil.rmtree(out)
    true = next((one for one in (*sample.cameras, sample.cloud, *sample.scans) if one is not None), None)
    poses = getattr(true, "poses", None)
    if poses is None or len(rows) < 2:
        return [] if len(rows) > 1 else ["a map of a single pose"]
    seconds = true.stamps_s[-1] - true.stamps_s[0]
    last = np.abs(rows[:, 0] - rows[0, 0] - seconds).argmin()
    far = float(np.linalg.norm(rows[last, 1:4] - rows[0, 1:4]))
    mount = getattr(true, "mount", None)
    bases = (
        [pose @ np.linalg.inv(mount) for pose in (poses[0], poses[-1])]
        if mount is not None
        else [poses[0], poses[-1]]
    )
    wanted = float(np.linalg.norm(bases[1][:3, 3] - bases[0][:3, 3]))
    return [f"the map is {far:.3f} m long, the way {wanted:.3f}"] if abs(far - wanted) > _APART_M else []


def _verdict(name: str, place: Path, nursery: Nursery, *, maps: bool) -> dict[str, Any]:
    """As `judged`, in a process of its own: what a sample leaves behind, or breaks, is gone with it."""
    file = place / "verdict.json"
    if child := os.fork():
        os.waitpid(child, 0)
        return json.loads(file.read_text())
    try:
        verdict = judged(name, place, nursery, maps=maps)
    except BaseException:
        verdict = {"result": "BROKEN", "why": traceback.format_exc()[-1500:]}
    file.write_text(json.dumps(verdict))
    os._exit(0)


def main() -> None:
    """Try all, or those whose names hold some words."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--list", action="store_true", help="names and sources alone")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--no-map", action="store_true", help="inspect and read alone: a quarter of the time")
    given = parser.parse_args()
    chosen = [
        one
        for one in LAYOUTS.values()
        if not given.only or any(word.lower() in one.name.lower() or word == one.group for word in given.only)
    ]
    counts: Counter[str] = Counter()
    groups: dict[str, Counter[str]] = {}
    for library in _LIBRARIES.split():
        import_module(library)
    nursery = Nursery()
    for number, one in enumerate(chosen):
        if given.list:
            print(f"{one.group:16} {one.name:36} {one.source}")
            continue
        place = given.output / f"{number:02d}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        verdict = _verdict(one.name, place, nursery, maps=not given.no_map)
        counts[verdict["result"]] += 1
        groups.setdefault(one.group, Counter())[verdict["result"]] += 1
        print(f"{one.group:16} {one.name:36} {verdict['result']:8} {verdict['why'][:400]}", flush=True)
        if not given.keep:
            shutil.rmtree(place, ignore_errors=True)
    for group, found in [*groups.items(), ("all", counts)]:
        row = (found[result] for result in ("right", "mended", "reason", "refused"))
        worse = found.total() - sum(found[result] for result in ("right", "mended", "reason", "refused"))
        print(f"| {group} | {found.total()} | {' | '.join(map(str, row))} | {worse} |")
    print(", ".join(f"{count} {result}" for result, count in counts.most_common()), f"of {len(chosen)}")


if __name__ == "__main__":
    main()
