"""Samples of recordings as data sets, drivers and phones publish them: is each read right, refused, or wrong?

    PYTHONPATH=. python tools/layout_trials.py -o DIR [--only WORDS] [--list]

Each sample is written after its publisher's words, with known lens, scale, stamps, mountings and truth; it is
inspected and mapped by the commands, and read through Python. Told of each is

    right       all that is true of it was found, and the command that `inspect` prints maps it to the true
                way; of what cannot be mapped: refused in one line that says why
    mended      refused or warned, naming what mends it; with that it is right
    refused     no more than that
    told        wrong, with a note or a warning that says what was assumed
    SILENT      wrong, and nothing says so
    CRASH       a traceback
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import tools.layouts.all as _all_layouts  # noqa: F401  their writers put themselves on the list
from slam.datasets import open_dataset
from slam.errors import ScanweaveError
from tools.layouts.judge import problems
from tools.layouts.samples import LAYOUTS, Sample

_RUN = "import sys; from slam.cli import main; sys.argv[0]='scanweave'; sys.exit(main())"
_ASSUMED = re.compile(
    r"assum|warning|not known|taken as|taken to|no tf|no CameraInfo|nothing tells|left in the images",
    re.IGNORECASE,
)
_APART_M, _APART_RAD = 0.06, 0.03
_SECONDS = 300


def command(*words: str) -> tuple[int, str, str]:
    """Exit code, output and errors of the program in a process of its own."""
    run = subprocess.run(
        [sys.executable, "-P", "-c", _RUN, *words],
        capture_output=True,
        text=True,
        timeout=_SECONDS,
        check=False,
    )
    return run.returncode, run.stdout, run.stderr


def judged(name: str, folder: Path, *, maps: bool) -> dict[str, Any]:
    """Write a sample, try it, and tell how that went."""
    sample = LAYOUTS[name].write(folder)
    verdict = _tried(sample, (), folder, maps=maps)
    if sample.mend and verdict["result"] != "CRASH":
        option = sample.mend[0]
        if verdict["result"] != "right" and option in verdict["said"]:
            again = _tried(sample, sample.mend, folder, maps=maps)
            return again | {"result": "mended" if again["result"] == "right" else again["result"]}
    if sample.by_hand and sample.by_hand[0] in verdict["said"] and verdict["result"] != "right":
        sample.by_hand[1]()
        again = _tried(sample, (), folder, maps=maps)
        return again | {"result": "mended" if again["result"] == "right" else again["result"]}
    return verdict


def _tried(sample: Sample, more: tuple[str, ...], folder: Path, *, maps: bool) -> dict[str, Any]:
    """Inspect, read and map."""
    code, output, errors = command("inspect", str(sample.path), "--json", *more)
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
            return {"result": "right" if fine else wrong, "why": refusal or "mapped", "said": said}
        return {"result": "refused" if one_line else "CRASH", "why": refusal, "said": said}
    calibration = [more[1]] if more[:1] == ("--calibration",) else []
    dataset = open_dataset(sample.path, calibration=calibration)
    try:
        wrong = problems(dataset, sample)
    except ScanweaveError as error:
        return {"result": "refused", "why": str(error), "said": said}
    notes = "; ".join(dataset.report.notes)
    wrong += [] if not maps else _mapped(inspection["commands"], sample, more, folder)
    if not wrong:
        return {"result": "right", "why": "", "said": said}
    result = "told" if _ASSUMED.search(notes) else "SILENT"
    return {"result": result, "why": "; ".join(wrong), "said": said}


def _mapped(commands: list[str], sample: Sample, more: tuple[str, ...], folder: Path) -> list[str]:
    """What is wrong with the map that the printed command makes."""
    out = folder / "map"
    words = shlex.split(commands[0])
    words = [*words[1 : words.index("-o")], "-o", str(out)]
    code, _, errors = command(*words, *(more if more and more[0] not in words else ()))
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


def main() -> None:
    """Try all, or those whose names hold some words."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--list", action="store_true", help="names and sources alone")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--no-map", action="store_true", help="inspect and read alone: a quarter of the time")
    parser.add_argument("--one", help="a single sample, its verdict as JSON")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(judged(given.one, given.output, maps=not given.no_map)))
        return
    chosen = [
        one
        for one in LAYOUTS.values()
        if not given.only or any(word.lower() in one.name.lower() or word == one.group for word in given.only)
    ]
    counts: Counter[str] = Counter()
    for number, one in enumerate(chosen):
        if given.list:
            print(f"{one.group:16} {one.name:36} {one.source}")
            continue
        place = given.output / f"{number:02d}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        run = subprocess.run(
            [
                sys.executable,
                __file__,
                "-o",
                str(place),
                "--one",
                one.name,
                *(["--no-map"] if given.no_map else []),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        try:
            verdict = json.loads(run.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            verdict = {"result": "BROKEN", "why": run.stderr.strip()[-1500:]}
        counts[verdict["result"]] += 1
        print(f"{one.group:16} {one.name:36} {verdict['result']:8} {verdict['why'][:400]}", flush=True)
        if not given.keep:
            shutil.rmtree(place, ignore_errors=True)
    print(", ".join(f"{count} {result}" for result, count in counts.most_common()), f"of {len(chosen)}")


if __name__ == "__main__":
    main()
