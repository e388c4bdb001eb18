import gtsam
import numpy as np
import pytest

from fusion.bayes import STEPS_A_UNIT
from slam.mapping.layered_map import LAYERS, LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.storage.nav2 import read_nav2_map
from slam.storage.nav2_layers import write_driving_map, write_layers


def built(lidar=True):
    steps = (np.array([[-3, 0, 3], [1, -1, 2]]) * STEPS_A_UNIT).astype(np.int16)
    other = (np.array([[1, 0, -3], [-1, 1, 1]]) * STEPS_A_UNIT).astype(np.int16)
    corner = gtsam.Pose2(0.0, 0.0, 0.5).compose(gtsam.Pose2(1.5, -2.25, 0.0))
    grids = [OccupancyGrid(part, 0.05, corner) for part in (steps, other)]
    return LayeredMap(grids[0] if lidar else None, grids[1])


def test_every_layer_reads_back_trinary_and_raw(tmp_path):
    made = built()
    paths = write_layers(tmp_path / "map", made)
    assert [path.stem for path in paths] == [*LAYERS, "fused_probability"]
    for name in LAYERS:
        read = read_nav2_map(tmp_path / "map" / f"{name}.yaml")
        np.testing.assert_array_equal(read.values, made.states(name))
        assert read.T_map_grid.equals(made.T_map_grid, 1e-12)
    raw = read_nav2_map(paths[-1])
    expected = np.rint(100.0 * made.grid("fused").probabilities())
    expected[made.grid("fused").log_odds == 0.0] = -1
    np.testing.assert_array_equal(raw.values, expected)
    assert raw.resolution_m == 0.05
    assert raw.values.tolist() == [[12, -1, -1], [-1, -1, 95]]


@pytest.mark.parametrize("name", ["lidar", "decision"])
def test_scale_mode_understands_the_same_pixels(tmp_path, name):
    path = next(p for p in write_layers(tmp_path, built()) if p.stem == name)
    path.write_text(path.read_text().replace("mode: trinary", "mode: scale"))
    scaled, states = read_nav2_map(path).values, built().states(name)
    # Sure cells stay; unknown, pixel 205, is p = 50 / 255, just above free_thresh.
    np.testing.assert_array_equal(scaled[states >= 0], states[states >= 0])
    assert set(scaled[states < 0].tolist()) <= {0}


def test_a_missing_sensor_has_no_file(tmp_path):
    stems = [path.stem for path in write_layers(tmp_path, built(lidar=False))]
    assert stems == ["depth", "fused", "decision", "fused_probability"]


def test_the_map_to_drive_by_is_the_decision_and_every_file_says_what_it_is(tmp_path):
    path, image_path = write_driving_map(tmp_path / "map", built())
    layers = write_layers(tmp_path / "layers", built())
    said = [yaml.read_text().splitlines()[0] for yaml in (path, *layers)]
    reported = "what the robot must not hit, as seen by lidar and cameras, by rule cautious (layers.rule)."
    assert said[0] == f"# The map to drive by: {reported}"
    assert read_nav2_map(path).what == said[0].removeprefix("# ")
    assert len(set(said)) == len(said) and all("../map.yaml" in line for line in said[1:])
    assert image_path.read_bytes() == (tmp_path / "layers" / "decision.pgm").read_bytes()
    assert "image: fused_probability.pgm" in layers[-1].read_text()


def test_a_map_of_the_lidar_alone_has_no_layers_beside_it(tmp_path):
    alone = LayeredMap(built().lidar, None)
    assert write_layers(tmp_path / "layers", alone) == [] and not (tmp_path / "layers").exists()
    # Nor those of an earlier run, which would show another map.
    write_layers(tmp_path / "layers", built())
    (tmp_path / "layers" / "mine.txt").write_text("mine")
    assert write_layers(tmp_path / "layers", alone) == []
    assert [path.name for path in (tmp_path / "layers").iterdir()] == ["mine.txt"]
    path, _ = write_driving_map(tmp_path / "map", alone)
    assert "as seen by lidar." in path.read_text()
    np.testing.assert_array_equal(read_nav2_map(path).values, alone.lidar.states())
