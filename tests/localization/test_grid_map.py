"""A grid map of another program is enough to be localised in; a start that somebody gives is weighed."""

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

import slam
from fusion.bayes import FREE, OCCUPIED, UNKNOWN
from slam.errors import ConfigError, MapFileError
from slam.localization.known_map import drawn_walls
from slam.localization.output import State
from slam.localization.poses import Measured, diagonal
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import row_from_pose2
from slam.outputs.grid_map import GridMap, load_grid_map
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log
from slam.storage.nav2 import write_nav2_map


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a mapped building."""
    folder = tmp_path_factory.mktemp("house")
    log = write_synthetic_log(folder / "mapped", seed=1, duration_s=30.0).log_path
    slam.map_log(log, out=folder / "map").close()
    return folder / "map"


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    """Another drive in it, whose true poses begin at (1, 4)."""
    return write_synthetic_log(tmp_path_factory.mktemp("driven"), seed=2, duration_s=16.0)


def errors_m(found: slam.Trajectory, driven: SyntheticLog) -> np.ndarray:
    """Of positions, as the map begins where the tour does."""
    truth = driven.truth.to_planar()
    at = np.abs(driven.truth.stamps_s[None] - found.stamps_s[:, None]).argmin(axis=1)
    return np.hypot(*(truth[at, :2] - [1.0, 4.0] - found.positions_m[:, :2]).T)


def turned(grid: GridMap, folder: Path) -> Path:
    """The same map in a picture that lies askew, as png."""
    import cv2

    states, side_m = grid.grid.states(), grid.grid.resolution_m
    corner = gtsam.Pose2(0.0, 0.0, 0.5).compose(gtsam.Pose2(-9.013, -21.027, 0.0))
    rows, columns = np.indices((800, 800)).reshape(2, -1) + 0.5
    x, y = columns * side_m, rows * side_m
    turn = corner.theta()
    middles = np.column_stack(
        [
            corner.x() + math.cos(turn) * x - math.sin(turn) * y,
            corner.y() + math.sin(turn) * x + math.cos(turn) * y,
        ]
    )
    cells = grid.grid.cells_of(middles)
    inside = ((cells >= 0) & (cells < states.shape)).all(axis=1)
    picture = np.full(len(cells), UNKNOWN, np.int8)
    picture[inside] = states[cells[inside, 0], cells[inside, 1]]
    yaml, pgm = write_nav2_map(folder / "askew", picture.reshape(800, 800), side_m, corner, "askew")
    grey = cv2.imread(str(pgm), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "askew.png"), 255 - grey)
    text = yaml.read_text().replace("askew.pgm", "askew.png").replace("negate: 0", "negate: 1")
    yaml.write_text(text)
    return yaml


@pytest.mark.parametrize("askew", [False, True])
def test_a_drive_is_found_in_the_picture_of_a_map(
    house: Path, driven: SyntheticLog, tmp_path: Path, askew: bool
) -> None:
    picture = load_grid_map(house / "map.yaml")
    if askew:
        picture = load_grid_map(turned(picture, tmp_path))
    found = slam.localize_log(picture, driven.log_path, out=tmp_path / "out")
    assert len(found.trajectory) > 0.5 * driven.scan_count
    assert np.median(errors_m(found.trajectory, driven)) < 0.05
    assert errors_m(found.trajectory, driven).max() < 0.25
    assert "map.yaml" in (page := (tmp_path / "out" / "report.html").read_text()) or "askew.yaml" in page


def test_a_start_is_believed_until_scans_speak_against_it(house: Path, driven: SyntheticLog) -> None:
    picture = load_grid_map(house / "map.yaml")
    for start, sure in (((0.3, -0.2, 0.1), True), ((4.0, 0.0, math.pi), False)):
        known = Measured(gtsam.Pose2(*start), diagonal(gtsam.Pose2(), 0.3, 0.2))
        localizer = slam.Localizer(picture, start=known)
        outputs = [localizer.add(scan) for scan in slam.open_dataset(driven.log_path)]
        said = [output for output in outputs if output is not None]
        truth = driven.truth.to_planar()
        states = [output.state for output in said]
        assert said[0].pose is not None
        assert (states[0] is State.TRACKING) is sure
        assert State.TRACKING in states, "found all the same"
        for output in said:
            if output.state is State.TRACKING and output.confidence > 0.5:
                assert output.pose is not None
                true = truth[np.abs(driven.truth.stamps_s - output.stamp_s).argmin()] - [1.0, 4.0, 0.0]
                assert np.hypot(*(row_from_pose2(output.pose) - true)[:2]) < 0.25


def test_what_cannot_be_is_refused_in_one_line(house: Path, driven: SyntheticLog, tmp_path: Path) -> None:
    picture = load_grid_map(house / "map.yaml")
    with pytest.raises(ConfigError, match="sigmas above zero"):
        slam.localize_log(picture, driven.log_path, start=(0.0, 0.0, 0.0), start_sigma=(0.0, 0.1))
    for start in ((1.0, 2.0), 5.0, (math.nan, 0.0, 0.0)):
        with pytest.raises(ConfigError, match="needs x, y, yaw"):
            slam.localize_log(picture, driven.log_path, start=start)
    empty = np.full((4, 4), FREE, np.int8)
    yaml, _ = write_nav2_map(tmp_path / "empty", empty, 0.05, gtsam.Pose2(), "nothing")
    with pytest.raises(MapFileError, match="no wall"):
        load_grid_map(yaml)


def test_each_side_of_a_wall_faces_its_room() -> None:
    states = np.full((40, 40), FREE, np.int8)
    states[:, 20] = OCCUPIED
    corner = gtsam.Pose2(1.0, 2.0, math.pi / 2.0)
    steps = np.where(states == OCCUPIED, 4000, -4000).astype(np.int16)
    walls = drawn_walls(OccupancyGrid(steps, 0.1, corner))
    # Columns run along the map's y: the wall's middle is 2.05 m along it.
    assert walls.points[:, 1] == pytest.approx(4.05)
    assert len(walls) == 80
    assert np.abs(walls.normals[:, 1]) == pytest.approx(np.ones(80))
    assert (walls.normals[:, 1] > 0).sum() == 40
