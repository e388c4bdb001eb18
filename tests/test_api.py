"""The names in slam: loaded when asked for, and at work."""

from __future__ import annotations

import gzip
import itertools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import slam
from slam.measurements import FloatArray, Measurement
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log

DATA = Path(__file__).parents[2] / "shared" / "data"


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
    reported = [output for output in outputs if output is not None]
    assert len(reported) == another_day.scan_count
    assert reported[-1].state is slam.State.TRACKING and reported[-1].pose is not None
    # The map begins where the tour does, and so did this drive.
    x, y, _ = another_day.truth.to_planar()[-1] - another_day.truth.to_planar()[0]
    assert np.hypot(reported[-1].pose.x() - x, reported[-1].pose.y() - y) < 0.1
    map_.close()


def synthetic(folder: Path) -> Path:
    """A CARMEN log in which the robot comes back to its start."""
    return write_synthetic_log(folder, seed=3, duration_s=60.0).log_path


def corridor(folder: Path) -> Path:
    """The beginning of a real CARMEN log, to and fro in a corridor."""
    whole = DATA / "lidar2d" / "fr079" / "fr079.log.gz"
    if not whole.exists():
        pytest.skip(f"{whole} is not there: a map of a real CARMEN log stays UNTESTED here")
    with gzip.open(whole, "rt") as lines:
        (folder / "fr079.log").write_text("".join(itertools.islice(lines, 1000)))
    return folder / "fr079.log"


def kitchen(folder: Path) -> Path:
    """Two seconds of a real camera in a hand."""
    whole = DATA / "rgbd" / "redkitchen"
    if not whole.is_dir():
        pytest.skip(f"{whole} is not there: a map of a real RGB-D log stays UNTESTED here")
    for file in whole.iterdir():
        if not file.name.startswith("frame-") or int(file.name[6:12]) < 60:
            (folder / file.name).symlink_to(file.absolute())
    return folder


def fused(folder: Path) -> Path:
    """A simulated robot with a lidar and two cameras of few pixels."""
    few = slam.CameraIntrinsics(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
    rig = RIGS["xu2024"]
    cameras = [replace(one, model=replace(one.model, intrinsics=few)) for one in rig.cameras[2:]]
    rig = replace(rig, cameras=tuple(cameras))
    record_drive(generate_home(0), rig, 7, folder / "drive", duration_s=5.0, formats=("folder",))
    return folder / "drive"


Arrays = tuple[FloatArray, slam.Trajectory, FloatArray, FloatArray, np.ndarray | None, slam.Trajectory]


def from_log_to_arrays(log: Path, folder: Path) -> Arrays:
    """A log mapped, the saved map as arrays, and a localisation in it: ten lines of nothing but slam."""
    slam.map_log(log, out=folder).close()
    house = slam.load_map(folder)
    poses = house.keyframe_poses  # (K, 3) x, y, yaw
    way = house.trajectory  # stamps_s (N,), positions_m (N, 3), quaternions_xyzw (N, 4)
    loops = [loop for loop in house.loops if loop.accepted]
    begins, ends = poses[[loop.place for loop in loops]], poses[[loop.keyframe for loop in loops]]  # (L, 3)
    cells = None if house.grid is None else house.grid.states()  # (rows, cols) of 100, 0 and -1
    found = slam.localize_log(house, log).trajectory
    house.close()
    return poses, way, begins, ends, cells, found


@pytest.mark.parametrize(
    ("make", "least_loops", "with_grid"),
    [(synthetic, 1, True), (corridor, 1, True), (kitchen, 0, False), (fused, 0, True)],
)
def test_ten_lines_from_a_log_to_arrays(
    make: Callable[[Path], Path], least_loops: int, with_grid: bool, tmp_path: Path
) -> None:
    (tmp_path / "log").mkdir()
    log = make(tmp_path / "log")
    poses, way, begins, ends, cells, found = from_log_to_arrays(log, tmp_path / "house")
    assert poses.shape == (len(poses), 3) and np.isfinite(poses).all()
    assert way.positions_m.shape == (len(way), 3) and len(way) > len(poses) > 1
    assert len(begins) >= least_loops
    assert (np.hypot(*(begins - ends)[:, :2].T) < 4.0).all()  # who closes a loop sees the same
    if with_grid:
        assert cells is not None and set(np.unique(cells)) == {-1, 0, 100}
    else:
        assert cells is None  # of a camera in space
    layers = tmp_path / "house" / "layers"
    # People walk in the corridor: what stood for a while is a layer of its own.
    assert layers.is_dir() == (make in (fused, corridor))
    nearest = np.abs(way.stamps_s[None] - found.stamps_s[:, None]).argmin(axis=1)
    assert len(found) > 0.5 * len(set(nearest)) > 10
    apart_m = np.linalg.norm(way.positions_m[nearest] - found.positions_m, axis=1)
    assert np.median(apart_m) < 0.02 and apart_m.max() < 0.2


def test_a_log_and_its_measurements_make_the_same_map(another_day: SyntheticLog, tmp_path: Path) -> None:
    gathered: list[Measurement] = list(slam.open_dataset(another_day.log_path))
    expected = slam.map_log(another_day.log_path, out=tmp_path / "house")
    for measurements in (gathered, (one for one in gathered)):  # a list, and what can be read only once
        house = slam.build_map(measurements)
        for name in ("stamps_s", "positions_m", "quaternions_xyzw"):
            reported, wanted = getattr(house.trajectory, name), getattr(expected.trajectory, name)
            np.testing.assert_array_equal(reported, wanted, strict=True)
        assert house.grid is not None and expected.grid is not None
        np.testing.assert_array_equal(house.grid.states(), expected.grid.states())
        house.close()
    expected.close()


def test_a_finished_map_is_replaced_only_where_that_is_said(
    another_day: SyntheticLog, tmp_path: Path
) -> None:
    slam.map_log(another_day.log_path, out=tmp_path).close()
    before = (tmp_path / "map.db").read_bytes()
    coarser = slam.load_config(overrides=["keyframes.distance_m=0.6"])
    with pytest.raises(slam.ScanweaveError, match=r"is a finished map; .* \(overwrite=True\) replaces it"):
        slam.map_log(another_day.log_path, coarser, out=tmp_path)
    assert (tmp_path / "map.db").read_bytes() == before
    house = slam.map_log(another_day.log_path, coarser, out=tmp_path, overwrite=True)
    assert house.config.keyframes.distance_m == 0.6
    house.close()


@pytest.mark.parametrize("from_memory", [False, True])
def test_progress_rises_to_the_whole(from_memory: bool, another_day: SyntheticLog, tmp_path: Path) -> None:
    reported: list[slam.Progress] = []
    log = another_day.log_path
    if from_memory:
        house = slam.build_map(list(slam.open_dataset(log)), on_progress=reported.append)
    else:
        house = slam.map_log(log, out=tmp_path, on_progress=reported.append)
    mapped = len(reported)
    slam.localize_log(house, log, on_progress=reported.append)
    house.close()
    stages = [list(progress) for _, progress in itertools.groupby(reported, lambda one: one.stage)]
    assert [stage[0].stage for stage in stages] == ["mapping", "optimising", "writing", "localising"]
    assert reported[mapped - 1].stage == "writing"
    for stage in (stages[0], stages[3]):
        shares = [one.share for one in stage if one.share is not None]
        assert shares == sorted(shares) and shares[0] >= 0.0 and shares[-1] == 1.0
        assert [one.readings for one in stage] == sorted(one.readings for one in stage)
        assert stage[-1].readings == another_day.scan_count


@pytest.mark.parametrize("given", [[], [1.0], ["scan"], [None]])
def test_what_is_no_measurement_is_named(given: list[object]) -> None:
    with pytest.raises(slam.ScanweaveError, match=r"measurement|is a (float|str|NoneType)") as caught:
        slam.build_map(given)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_a_map_in_memory_is_joined_elsewhere(another_day: SyntheticLog) -> None:
    in_memory = slam.build_map(slam.open_dataset(another_day.log_path))
    with pytest.raises(slam.ScanweaveError, match="lies in a temporary folder; give --out"):
        slam.join(in_memory, another_day.log_path)


def test_a_file_that_is_no_map_is_not_replaced_unasked(another_day: SyntheticLog, tmp_path: Path) -> None:
    (tmp_path / "map.db").write_bytes(b"somebody's own")
    with pytest.raises(slam.ScanweaveError, match="not a complete map; --force"):
        slam.map_log(another_day.log_path, out=tmp_path)
    assert (tmp_path / "map.db").read_bytes() == b"somebody's own"
