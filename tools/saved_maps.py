"""Creates maps and drives for trials with the command, and reuses them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from slam.errors import MapFileError
from slam.outputs.finished_map import Map, load_map


def map_of(log: Path, folder: Path) -> Map:
    """The map of a log in a folder, created if it is missing or of another version."""
    try:
        return load_map(folder)
    except MapFileError:
        scanweave("map", log, "-o", folder, "--set", "dense_map.enabled=false")
        return load_map(folder)


def scanweave(*arguments: object) -> None:
    """Run the command of this tree; its output only where it fails."""
    begin = "import sys; from slam.cli import main; sys.argv[0] = 'scanweave'; sys.exit(main())"
    command = [sys.executable, "-c", begin, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: {done.stderr.strip()}")
