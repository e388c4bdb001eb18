"""The names in slam: loaded when asked for, and at work in the example."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import slam
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log

EXAMPLE = Path(__file__).parents[1] / "examples" / "localize_step_by_step.py"


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small saved map."""
    folder = tmp_path_factory.mktemp("house")
    log = write_synthetic_log(folder / "log", seed=1, duration_s=24.0).log_path
    slam.map_log(log, out=folder / "map").close()
    return folder / "map"


@pytest.fixture(scope="module")
def another_day(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("day"), seed=2, duration_s=12.0)


def test_importing_slam_alone_loads_nothing() -> None:
    code = "import slam, sys; print(sorted({'numpy', 'gtsam', 'numba', 'pydantic'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_every_public_name_is_there() -> None:
    for name in slam._HOMES:
        assert callable(getattr(slam, name)) and name in dir(slam)
    with pytest.raises(AttributeError, match="no attribute 'load_maps'; it has"):
        slam.load_maps  # noqa: B018


def test_measurements_are_fed_one_at_a_time(house: Path, another_day: SyntheticLog) -> None:
    map_ = slam.load_map(str(house))
    localizer = slam.Localizer(map_)
    outputs = [localizer.add(measurement) for measurement in slam.open_dataset(another_day.log_path)]
    told = [output for output in outputs if output is not None]
    assert len(told) == another_day.scan_count
    assert told[-1].state is slam.State.TRACKING and told[-1].pose is not None
    # The map begins where the tour does, and so did this drive.
    x, y, _ = another_day.truth.to_planar()[-1] - another_day.truth.to_planar()[0]
    assert np.hypot(told[-1].pose.x() - x, told[-1].pose.y() - y) < 0.1
    map_.close()


def test_the_example(
    house: Path,
    another_day: SyntheticLog,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["example", str(house), str(another_day.log_path)])
    runpy.run_path(str(EXAMPLE))
    out = capsys.readouterr().out
    assert "found at 100" in out and "% sure" in out
