"""What public types show of themselves: one short line in a shell, a small picture in a notebook."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from PIL import Image

import fusion
import slam
from fusion.showing import drawn, extent, shaded, shrunk
from slam.simulation.synthetic_log import write_synthetic_log

LONGEST = 420


def ranges_m(bearings: Any) -> Any:
    """Of the walls of a room of 6 m by 4 m, from a place in it."""
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    return ((np.array([3.0, 2.0]) - np.sign(rays) * [0.5, 0.3]) / np.abs(rays)).min(axis=1)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One of each that the public names return."""
    folder = tmp_path_factory.mktemp("shown")
    log = write_synthetic_log(folder / "monday", seed=1, duration_s=10.0).log_path
    tuesday = write_synthetic_log(folder / "tuesday", seed=2, duration_s=10.0).log_path
    house = slam.map_log(log, out=folder / "house")
    later = slam.map_log(tuesday)
    localizer = slam.Localizer(house)
    outputs = [localizer.add(one) for one in slam.open_dataset(log)]
    graph = slam.PoseGraph(gtsam.Pose2())
    scan = house.keyframe_scans[0]
    assert scan is not None
    beams, slopes = np.linspace(-np.pi, np.pi, 721, endpoint=False), (79.5 - np.arange(160)) / 120
    depth_m = ranges_m(np.arctan(slopes) + 0.9) * np.cos(np.arctan(slopes))
    depth = fusion.DepthImage(
        np.tile(depth_m, (120, 1)).astype(np.float32), fusion.Intrinsics(120, 120, 79.5, 59.5)
    )
    curve = fusion.LidarCurve(ranges_m(beams), -np.pi, 2 * np.pi / 721)
    pair = fusion.register(curve, depth)
    rig = fusion.Rig()
    rig.add(pair)
    color, depth_m = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32)
    lens = slam.CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
    return {
        "map": house,
        "config": slam.load_config(overrides=["grid.resolution_m=0.1"]),
        "identity": house.identity,
        "grid": house.grid,
        "layers": house.layers,
        "contents": house.contents,
        "factor": house.factors[0],
        "trajectory": house.trajectory,
        "floor plan": house.floor_plan(),
        "wall": house.floor_plan().rooms[0].walls[0],
        "dataset": slam.open_dataset(log),
        "report": slam.open_dataset(log).report,
        "localization": slam.localize_log(house, log),
        "output": next(one for one in outputs if one is not None),
        "difference": slam.diff_maps(house, later),
        "joined": slam.join(house, tuesday, out=folder / "both"),
        "grid map": slam.load_grid_map(folder / "house" / "map.yaml"),
        "graph": graph,
        "match": slam.match_scans(scan, scan),
        "progress": slam.Progress("mapping", 3),
        "scan": scan,
        "wheels": slam.WheelOdometry(1.7e9 + 0.25, gtsam.Pose2(1.0, 2.0, 0.5)),
        "frame": slam.RgbdFrame(np.float64(2.5), color, depth_m, lens, gtsam.Pose3()),
        "loop": slam.check_loop(scan, scan),
        "cloud": slam.PointCloud(0.0, np.zeros((5000, 3), np.float32)),
        "curve": curve,
        "depth": depth,
        "pair": pair,
        "repaired": fusion.denoise(curve, depth, pair),
        "rig": rig,
        "rig estimate": rig.estimate(),
    }


def test_everything_is_shown_in_one_short_line(shown: dict[str, Any]) -> None:
    lines = {name: repr(one) for name, one in shown.items()}
    assert {name: text for name, text in lines.items() if "\n" in text or len(text) > LONGEST} == {}
    assert not [name for name, text in lines.items() if " object at 0x" in text]


def test_what_matters_is_shown(shown: dict[str, Any]) -> None:
    house = shown["map"]
    assert re.search(rf"keyframes={len(house.keyframe_poses)}, poses=\d+ over \d.* x .* x 0 m", repr(house))
    assert repr(shown["config"]) == "Config(grid=GridConfig(resolution_m=0.1))"
    assert repr(slam.load_config()) == "Config()"
    assert "stamp_s=1700000000.250, T_odom_base=Pose2(1, 2, 0.5)" in repr(shown["wheels"])
    assert re.search(r"covariance=float64\[3, 3\] sigmas 0\.\d+, 0\.\d+, 0\.\d+", repr(shown["factor"]))
    assert "kind=EdgeKind.LIDAR" in repr(shown["factor"])
    assert repr(shown["curve"]).startswith("LidarCurve(ranges_m=float64[721] 1.7..4.17")
    assert re.search(r"walls=list\[\d+ Wall\]", repr(shown["floor plan"].rooms[0]))
    frame = repr(shown["frame"])
    assert "stamp_s=2.5, color=uint8[480, 640, 3] 0..0, " in frame and "Pose3(xyz=(0, 0, 0), rpy=(" in frame
    assert "T_base_laser=Pose2(0.1, 0, 0)" in repr(shown["scan"]) and "times_s=None" in repr(shown["cloud"])
    assert repr(shown["rig"]) == "Rig(1 pairs)"


def test_empty_and_odd_arrays_are_shown() -> None:
    nothing = slam.Trajectory.from_planar(np.zeros(0), np.zeros((0, 3)))
    assert "positions_m=float64[0, 3]" in repr(nothing) and extent(nothing.positions_m) == "nothing"
    unknown = slam.LaserScan(0.0, np.full(9, np.nan, np.float32), 0.0, 0.1, 9.0)
    assert "ranges_m=float32[9], " in repr(unknown)
    assert "<img" not in unknown._repr_html_().replace("<img", "", 1)


@pytest.mark.parametrize(
    ("name", "pictures"),
    [
        *(("map", 1), ("grid", 1), ("grid map", 1), ("trajectory", 1), ("localization", 1)),
        *(("scan", 1), ("cloud", 1), ("frame", 2), ("curve", 1), ("depth", 1), ("pair", 2), ("repaired", 1)),
        ("difference", 1),
    ],
)
def test_notebooks_show_small_pictures(shown: dict[str, Any], name: str, pictures: int) -> None:
    html = shown[name]._repr_html_()
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert len(found) == pictures and len(html) < 200_000
    for data in found:
        width, height = Image.open(io.BytesIO(base64.b64decode(data))).size
        assert width > 1 and height > 1
    assert "<code>" in html and "<" not in html.split("<code>")[1].split("</code>")[0]


def test_points_are_drawn_to_scale_with_y_up() -> None:
    red = np.array([[0.0, 5.0], [np.nan, 0.0]])
    picture = drawn(side=103, black=np.array([[0.0, 0.0], [10.0, 0.0]]), red=red)
    assert picture is not None and picture.shape == (53, 103, 3)
    assert (picture[1, 1] == (255, 0, 0)).all()  # the highest is at the top
    assert (picture[-2, [1, 101]] == 0).all()
    assert drawn(black=np.zeros((0, 2))) is None


def test_numbers_are_shaded_and_drawings_shrunk() -> None:
    assert shaded(np.array([[1.0, 2.0], [np.nan, 3.0]])).tolist() == [[30, 142], [0, 255]]
    assert shaded(np.full((2, 2), np.nan)).max() == 0
    photo = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert (shaded(photo) == photo).all()
    wall = np.full((1000, 700, 3), 255, np.uint8)
    wall[333] = 0
    small = shrunk(wall)
    assert small.shape == (250, 175, 3) and (small[83] == 0).all() and (small[84] == 255).all()


def test_the_way_is_drawn_into_the_grid(shown: dict[str, Any]) -> None:
    picture = shown["grid"].picture(shown["trajectory"].positions_m[:, :2])
    assert (picture == (0, 0, 255)).all(axis=2).any() and (picture == 0).all(axis=2).any()


def test_a_name_of_a_file_is_escaped(tmp_path: Path) -> None:
    path = tmp_path / "<script>" / "monday"
    log = write_synthetic_log(path, seed=1, duration_s=10.0).log_path
    assert "<script>" not in slam.map_log(log, out=tmp_path / "<script>" / "map")._repr_html_()
