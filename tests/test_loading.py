"""A command loads what it uses: what takes long to load stays away from those that do without it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.simulation.synthetic_log import write_synthetic_log

# A second of loading and two hundred megabytes together.
HEAVY = {
    *("numpy", "numba", "gtsam", "pydantic", "cv2", "matplotlib", "open3d", "rosbags", "jinja2", "PIL"),
    *(f"scipy.{part}" for part in ("interpolate", "ndimage", "optimize", "sparse", "spatial", "special")),
    *("numpy.f2py", "numpy.testing"),
    *("slam.datasets.published", "slam.edits.edited_file", "slam.mapper.pipeline"),
}
RUN = """
import json, sys
from slam.cli import main
sys.argv[0] = "scanweave"
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print(json.dumps(sorted(name for name, module in sys.modules.items() if hasattr(module, "__file__"))))
"""


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[str]]:
    """The folder of a map, and what making it has loaded."""
    folder = tmp_path_factory.mktemp("house")
    log = write_synthetic_log(folder / "log", duration_s=10.0).log_path
    return folder, loaded("map", str(log), "-o", str(folder))


def loaded(*arguments: str) -> set[str]:
    """The heavy modules whose code has run at the end of a command."""
    command = [sys.executable, "-P", "-c", RUN, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    return HEAVY & set(json.loads(done.stdout.splitlines()[-1]))


def test_help_loads_nothing() -> None:
    assert loaded("--help") <= {"pydantic"}  # of some versions of typer
    assert loaded("config") == {"pydantic"}


def test_what_is_in_a_map_takes_no_kernel_and_no_reader(house: tuple[Path, set[str]]) -> None:
    assert loaded("info", str(house[0])) == {"pydantic", "numpy"}


def test_a_map_is_written_again_without_what_makes_maps(house: tuple[Path, set[str]], tmp_path: Path) -> None:
    found = loaded("export", str(house[0]), "-f", "tum", "-o", str(tmp_path / "x.tum"))
    assert {name for name in found if not name.startswith("scipy.")} == {"pydantic", "numpy", "gtsam"}


def test_a_robot_with_wheels_and_a_lidar_takes_no_camera_and_no_other_reader(
    house: tuple[Path, set[str]],
) -> None:
    assert not house[1] & {"cv2", "open3d", "rosbags", "slam.datasets.published", "slam.edits.edited_file"}
    assert not house[1] & {"numpy.f2py", "numpy.testing"}
    assert {"numba", "gtsam", "slam.mapper.pipeline"} <= house[1]


def test_an_interpreter_that_ends_looks_through_nothing() -> None:
    code = RUN.partition("print(")[0] + "import gc\nprint(gc.get_freeze_count() > 0)"
    command = [sys.executable, "-P", "-c", code, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=True)
    assert done.stdout.splitlines()[-1] == "True"


def test_what_ends_a_run_is_loaded_when_it_tracks(tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path / "log", duration_s=10.0).log_path
    code = (
        "import sys, slam\nends, seen = {'slam.evaluation.report', 'slam.outputs.exports'}, []\n"
        "look = lambda progress: seen.append(ends <= sys.modules.keys())\nimport slam.app.mapping\n"
        "print(ends & sys.modules.keys())\nslam.map_log(sys.argv[1], on_progress=look)\nprint(seen[0])"
    )
    command = [sys.executable, "-P", "-c", code, str(log)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=True)
    assert done.stdout.split() == ["set()", "True"]
