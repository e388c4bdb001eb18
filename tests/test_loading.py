"""A command loads what it uses: what takes long to load stays away from those that do without it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import pytest

from slam.cli import later
from slam.simulation.synthetic_log import write_synthetic_log

# A second of loading and two hundred megabytes together.
HEAVY = {
    *("numpy", "numba", "gtsam", "pydantic", "cv2", "matplotlib", "open3d", "rosbags", "jinja2", "PIL"),
    *(f"scipy.{part}" for part in ("interpolate", "ndimage", "optimize", "sparse", "spatial", "special")),
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
unused = [name for name, module in sys.modules.items() if type(module).__name__ == "_NotYet"]
print(json.dumps(sorted(set(sys.modules) - set(unused))))
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
    assert loaded("info", str(house[0])) == {"pydantic", "numpy", "gtsam"}


def test_a_map_is_written_again_without_what_makes_maps(house: tuple[Path, set[str]], tmp_path: Path) -> None:
    found = loaded("export", str(house[0]), "-f", "tum", "-o", str(tmp_path / "x.tum"))
    assert found == {"pydantic", "numpy", "gtsam"}


def test_a_robot_with_wheels_and_a_lidar_takes_no_camera_and_no_other_reader(
    house: tuple[Path, set[str]],
) -> None:
    assert not house[1] & {"cv2", "open3d", "rosbags", "slam.datasets.published", "slam.edits.edited_file"}
    assert {"numba", "gtsam", "slam.mapper.pipeline"} <= house[1]


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A library that is loaded later, and counts how often its code runs."""
    (tmp_path / "slow_library.py").write_text(
        "import sys\nsys.slow_runs = getattr(sys, 'slow_runs', 0) + 1\nif sys.slow_runs == 1 and "
        "getattr(sys, 'slow_fails', False):\n    raise ImportError('not this time')\nANSWER = 42\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "slow_runs", 0, raising=False)
    monkeypatch.setattr(sys, "meta_path", [later._Finder(), *sys.meta_path])
    monkeypatch.setattr(later, "LIBRARIES", frozenset({"slow_library"}))
    monkeypatch.delitem(sys.modules, "slow_library", raising=False)
    return "slow_library"


def test_a_library_runs_once_when_a_name_of_it_is_first_asked_for(library: str) -> None:
    module, again = __import__(library), __import__(library)
    assert module is again and sys.slow_runs == 0  # type: ignore[attr-defined]
    found: list[int] = []
    threads = [threading.Thread(target=lambda: found.append(module.ANSWER)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [42] * 4 and sys.slow_runs == 1  # type: ignore[attr-defined]
    assert type(module) is ModuleType
    with pytest.raises(AttributeError, match="no attribute 'other'"):
        _ = module.other


def test_one_that_cannot_be_loaded_says_so_each_time_it_is_asked(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "slow_fails", True, raising=False)
    module = __import__(library)
    with pytest.raises(ImportError, match="not this time"):
        _ = module.ANSWER
    assert module.ANSWER == 42


@pytest.mark.parametrize("first", [*later._OF_SCIPY, "spatial.distance", "sparse.csgraph"])
def test_parts_of_a_library_load_in_any_order(first: str) -> None:
    """None has run when one of them, or a module inside, is asked for."""
    code = f"""
import sys
from slam.cli import later
later.load_later()
for part in later._OF_SCIPY:
    __import__("scipy." + part)
import scipy.{first}
first = sys.modules["scipy.{first}"]
getattr(first, "__all__")
before = sys.modules["scipy.{first}"]
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree, distance
from scipy.sparse import csgraph, csr_array
from scipy.sparse.linalg import splu
assert sys.modules["scipy.spatial.distance"] is distance and sys.modules["scipy.sparse.csgraph"] is csgraph
assert sys.modules["scipy.{first}"] is before
assert CubicSpline([0, 1, 2], [0, 1, 4])(1.0) == 1.0 and KDTree([[0.0]]).query([1.0])[0] == 1.0
assert distance.__spec__.name == "scipy.spatial.distance" and distance.__spec__.origin
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
