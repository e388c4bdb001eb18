"""Change random single bytes of a finished map, and read it: each must be refused in one line, or harmless.

    python tools/damage_trials.py out/map.db --trials 1000

Harmless is a byte that nothing depends on: what is read then is what was written, to the bit. Every copy is
read in a process of its own kind, so that a crash or a hang is seen and told.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.outputs.finished_map import open_map
from slam.storage.packing import pack

# A map that takes longer than this to read hangs.
_PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Damage:
    """One byte to change, and to what."""

    place: int
    value: int


def content_of(path: Path) -> str:
    """Digest of everything that a reader gets from a map.

    Raises
    ------
    MapFileError
        Where the map is refused.
    """
    saved = open_map(path)
    try:
        contents, digest = saved.contents, hashlib.blake2b()
        digest.update(repr(sorted(saved.identity.to_meta().items())).encode())
        scans = [list(contents.measured_scans), list(contents.keyframe_scans), list(contents.loops)]
        poses = [list(contents.node_poses), contents.stamps_s, contents.readings, contents.trajectory]
        digest.update(pack([scans, poses]))
        for factor in contents.factors:
            edge = factor.edge
            ends = [edge.source, edge.target, edge.kind.value, edge.trusted, factor.kept, edge.loop]
            digest.update(pack([ends, edge.T_source_target, edge.covariance]))
        for name, grid in contents.grids.items():
            digest.update(pack([name, grid.log_odds, grid.resolution_m, grid.T_map_grid]))
        frames, clouds = contents.frames, contents.clouds
        for number, frame in enumerate(frames or ()):
            node, camera = frames.head(number).node, [frame.intrinsics, frame.T_base_camera]
            images = [frame.color, frame.depth_m, frames.features(number)]
            digest.update(pack([node, frame.stamp_s, frame.sensor, camera, images]))
        for key, points in enumerate(clouds or ()):
            digest.update(pack([points, clouds.T_base_lidar(key)]))
        return digest.hexdigest()
    finally:
        saved.close()


def outcome_of(path: Path, content: str) -> str:
    """``refused``, ``harmless``, or what went wrong."""
    try:
        return "harmless" if content_of(path) == content else "WRONG MAP"
    except MapFileError as error:
        return "refused" if len(str(error).splitlines()) == 1 else f"not one line: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def damages_of(size: int, trials: int, seed: int) -> list[Damage]:
    """Random bytes to change; the value is what is added to the byte there, never 0."""
    rng = np.random.default_rng(seed)
    return [Damage(int(rng.integers(size)), int(rng.integers(1, 256))) for _ in range(trials)]


def damaged(content: bytes, damage: Damage) -> bytes:
    """A copy with one byte changed."""
    changed = bytearray(content)
    changed[damage.place] = (changed[damage.place] + damage.value) % 256
    return bytes(changed)


def _serve(pipe: Connection, content: str) -> None:
    """Read maps as they are named."""
    while path := pipe.recv():
        pipe.send(outcome_of(path, content))


def run_trials(path: Path, damages: list[Damage]) -> dict[Damage, str]:
    """The outcome of each damage."""
    whole, content = path.read_bytes(), content_of(path)
    outcomes: dict[Damage, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "map.db"
        pipe, process = _reader(content)
        for damage in damages:
            copy.write_bytes(damaged(whole, damage))
            pipe.send(copy)
            try:
                outcomes[damage] = pipe.recv() if pipe.poll(_PATIENCE_S) else "HANG"
            except EOFError:
                outcomes[damage] = "CRASH"
            if outcomes[damage] in ("HANG", "CRASH"):
                process.kill()
                pipe, process = _reader(content)
        pipe.send(None)
        process.join()
    return outcomes


def _reader(content: str) -> tuple[Connection, multiprocessing.process.BaseProcess]:
    """A process that reads maps."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, content))
    process.start()
    there.close()
    return here, process


def main() -> None:
    """Run and tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    damages = damages_of(arguments.map.stat().st_size, arguments.trials, arguments.seed)
    outcomes = run_trials(arguments.map, damages)
    print(dict(Counter(outcomes.values())))
    faults = {
        damage: reported for damage, reported in outcomes.items() if reported not in ("refused", "harmless")
    }
    for damage, reported in faults.items():
        print(damage, reported)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
