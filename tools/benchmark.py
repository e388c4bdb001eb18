"""Measure accuracy and cost of ``scanweave map`` on the real logs.

    python tools/benchmark.py [--data ../shared/data] [--log fr079 --log intel] [--set k=v] [--repeat N]
                              [--cold] [--json FILE]
    python tools/benchmark.py rgbd ...            the RGB-D sequence instead: see benchmark_rgbd.py

For every log and variant the real command runs in a process of its own: once to warm numba's cache, then
``--repeat`` times for wall and CPU seconds (medians) and peak memory (greatest), from the kernel's account of
the child. The time a scan comes from one more run through the Python API. ``--cold`` adds, for the first
log, a first run ever: with an empty numba cache. ``--json`` has more: errors over short and long relations,
wall seconds, times a scan.

Seconds drift between machines and from day to day; compare ratios within one run.
"""

# Only the standard library here: on Linux a child begins with its parent's peak memory, so this process
# must stay small. What needs numpy runs as a child too.
from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from argparse import SUPPRESS, ArgumentParser, Namespace, RawDescriptionHelpFormatter
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

REPO = Path(__file__).parents[1]

# Settings of `scanweave map`, and the logs that they are measured on (None: all).
VARIANTS: dict[str, tuple[list[str], set[str] | None]] = {
    "default": ([], None),
    "no odometry": (["sensors.wheels=false"], {"fr079"}),
    "no loops": (["loops.enabled=false"], None),
}
WHEELS = "wheels alone"


@dataclass(frozen=True)
class Cost:
    """What a child cost, by the kernel's account."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def main() -> None:
    """Measure, print the table, write the JSON."""
    if sys.argv[1:2] == ["rgbd"]:
        other = Path(__file__).with_name("benchmark_rgbd.py")
        sys.exit(subprocess.call([sys.executable, str(other), *sys.argv[2:]]))
    options = parse_options()
    if options.child:
        child(options.child, options.arguments)
        return
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(options, Path(folder))
        for name in options.log or ["fr079", "intel"]:
            rows.append(bench.wheels(name))
            for variant, (settings, logs) in VARIANTS.items():
                if (options.variant is None or variant in options.variant) and (logs is None or name in logs):
                    rows.append(bench.variant(name, variant, settings))
                    print(f"measured {name}, {variant}", file=sys.stderr)
        cold = bench.cold((options.log or ["fr079"])[0]) if options.cold else None
    report = {"machine": machine(), "settings": options.set, "repeat": options.repeat, "rows": rows}
    text = table(rows)
    if cold:
        report["cold"] = cold
        text += f"\n\nFirst run ever ({cold['log']}, numba compiles): {cold['wall_s']:.1f} s wall, "
        text += f"{cold['cpu_s']:.1f} s CPU, {cold['peak_mb']:.0f} MB."
    print(text)
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def parse_options() -> Namespace:
    """The command line."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=REPO.parent / "shared" / "data", help="holds lidar2d/")
    parser.add_argument("--log", action="append", help="fr079 or intel; repeatable; both by default")
    parser.add_argument("--variant", action="append", choices=VARIANTS, help="only this one; repeatable")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave map --set")
    parser.add_argument("--repeat", type=int, default=1, help="measured runs a row")
    parser.add_argument("--cold", action="store_true", help="also measure a first run ever")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--child", choices=("profile", "wheels"), help=SUPPRESS)
    parser.add_argument("arguments", nargs="*", help=SUPPRESS)
    return parser.parse_args()


class Bench:
    """Runs the children in a folder of their own."""

    def __init__(self, options: Namespace, folder: Path) -> None:
        self._data: Path = options.data / "lidar2d"
        self._settings: list[str] = options.set
        self._repeat: int = options.repeat
        self._folder = folder

    def wheels(self, name: str) -> dict[str, Any]:
        """The baseline: the wheels' own trajectory."""
        out = self._folder / "wheels.tum"
        run_helper("wheels", str(self._log(name)), str(out))
        return {"log": name, "variant": WHEELS, "relations": self._score(name, out)}

    def variant(self, name: str, variant: str, settings: list[str]) -> dict[str, Any]:
        """One row: costs, time a scan, accuracy."""
        out = self._folder / "out"
        command = self._map(name, out, settings)
        run(command)
        costs = [run(command) for _ in range(self._repeat)]
        profile = self._folder / "profile.json"
        run_helper("profile", str(self._log(name)), str(profile), *self._settings, *settings)
        measured: dict[str, Any] = json.loads(profile.read_text())
        wall_s = statistics.median(cost.wall_s for cost in costs)
        return {
            "log": name,
            "variant": variant,
            "wall_s": wall_s,
            "cpu_s": statistics.median(cost.cpu_s for cost in costs),
            "peak_mb": max(cost.peak_mb for cost in costs),
            "real_time_factor": measured["duration_s"] / wall_s,
            **measured,
            "relations": self._score(name, out / "trajectory.tum"),
        }

    def cold(self, name: str) -> dict[str, Any]:
        """A run with an empty numba cache."""
        cache = self._folder / "numba"
        command = self._map(name, self._folder / "out", [])
        return {"log": name, **asdict(run(command, {**os.environ, "NUMBA_CACHE_DIR": str(cache)}))}

    def _map(self, name: str, out: Path, settings: list[str]) -> list[str]:
        """The command line of a run."""
        where = [str(self._log(name)), "-o", str(out), "--force"]
        chosen = [part for value in (*self._settings, *settings) for part in ("--set", value)]
        return [*scanweave(), "map", *where, *chosen]

    def _log(self, name: str) -> Path:
        """Path of a log."""
        return self._data / name / f"{name}.log.gz"

    def _score(self, name: str, trajectory: Path) -> dict[str, Any]:
        """Errors over the relations."""
        relations = self._data / name / f"{name}.relations"
        return score(trajectory, "--relations", relations)["relations"]


def score(trajectory: Path, option: str, truth: Path) -> Any:
    """What the product's own command says of a trajectory."""
    command = [*scanweave(), "evaluate", str(trajectory), option, str(truth), "--json"]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def scanweave() -> list[str]:
    """The installed command beside this interpreter."""
    return [str(Path(sys.executable).with_name("scanweave"))]


def run(command: list[str], environment: dict[str, str] | None = None) -> Cost:
    """Run a command to its end and ask the kernel what it cost."""
    started = perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stderr is not None
    complaint = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{' '.join(command)} failed ({process.returncode}): {complaint.strip()}")
    per_mb = 1024.0**2 if sys.platform == "darwin" else 1024.0
    return Cost(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / per_mb)


def run_helper(mode: str, *arguments: str) -> None:
    """Run this file as a child, for what needs numpy."""
    run([sys.executable, __file__, "--child", mode, "--", *arguments])


def child(mode: str, arguments: list[str]) -> None:
    """What the children do: the time of every scan, or the wheels' trajectory."""
    log, out, *overrides = arguments
    if mode == "wheels":
        write_wheels(Path(log), Path(out))
    else:
        Path(out).write_text(json.dumps(profile_scans(Path(log), overrides)))


def write_wheels(log: Path, out: Path) -> None:
    """Write the wheel odometry of a log as a trajectory."""
    import numpy as np

    from slam.datasets import open_dataset
    from slam.estimates import Trajectory
    from slam.measurements import WheelOdometry, row_from_pose2
    from slam.storage.tum import write_tum

    readings = [reading for reading in open_dataset(log) if isinstance(reading, WheelOdometry)]
    stamps_s = np.array([reading.stamp_s for reading in readings])
    write_tum(
        out, Trajectory.from_planar(stamps_s, np.array([row_from_pose2(r.T_odom_base) for r in readings]))
    )


def profile_scans(log: Path, overrides: list[str]) -> dict[str, float]:
    """Map a log and compare the time of its last scans with that of its first.

    The first scan is left out: it loads compiled code.
    """
    import numpy as np

    from slam.config import load_config
    from slam.datasets import open_dataset
    from slam.mapper.pipeline import build_map

    result = build_map(open_dataset(log), load_config(None, overrides))
    seconds = result.scans.seconds[1:]
    tenth = max(1, seconds.size // 10)
    first, last = seconds[:tenth], seconds[-tenth:]
    return {
        "scans": int(result.scans.stamps_s.size),
        "keyframes": len(result.map.keyframe_poses),
        "loops_accepted": sum(loop.accepted for loop in result.map.loops),
        "loops_tried": len(result.map.loops),
        "duration_s": float(np.ptp(result.map.trajectory.stamps_s)),
        "scan_ms_mean": 1e3 * float(seconds.mean()),
        "scan_ms_median": 1e3 * float(np.median(seconds)),
        "scan_ms_p99": 1e3 * float(np.quantile(seconds, 0.99)),
        "last_over_first_mean": float(last.mean() / first.mean()),
        "last_over_first_median": float(np.median(last) / np.median(first)),
    }


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {"python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count()}


def table(rows: list[dict[str, Any]]) -> str:
    """All rows as one Markdown table."""
    heads = ["log", "variant", "translation, m", "rotation, degrees", "CPU s", "peak MB", "x real time"]
    heads += ["last/first tenth: mean, median", "loops"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        errors = [spread(row, "translation_m", 1.0, 4), spread(row, "rotation_rad", 57.29577951308232, 3)]
        lines.append("| " + " | ".join([row["log"], row["variant"], *errors, *cost_cells(row)]) + " |")
    return "\n".join(lines)


def spread(row: dict[str, Any], name: str, scale: float, digits: int) -> str:
    """Mean and standard deviation over all relations."""
    error = row["relations"][name]
    return f"{scale * error['mean']:.{digits}f} ± {scale * error['std']:.{digits}f}"


def cost_cells(row: dict[str, Any]) -> list[str]:
    """What a run cost; nothing for the baseline, which costs nothing."""
    if "cpu_s" not in row:
        return [""] * 5
    return [
        f"{row['cpu_s']:.1f}",
        f"{row['peak_mb']:.0f}",
        f"{row['real_time_factor']:.0f}",
        f"{row['last_over_first_mean']:.2f}, {row['last_over_first_median']:.2f}",
        f"{row['loops_accepted']} of {row['loops_tried']}",
    ]


if __name__ == "__main__":
    main()
