"""The data of a page: what goes in comes out, all kinds of maps have a page, and its size stays bounded."""

from __future__ import annotations

import base64
import io
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
from flat_worlds import room, sweep
from page_worlds import EVIL, Frames, contents, report
from PIL import Image
from reading_pages import page_data

import slam
from slam.config import Config
from slam.evaluation.localization_report import write_localization_report
from slam.evaluation.map_report import Beside
from slam.evaluation.page_cloud import cloud_data
from slam.evaluation.page_data import map_data
from slam.evaluation.report import write_report
from slam.evaluation.saved_page import saved_page
from slam.evaluation.work_page import packed
from slam.localization.drive_log import DriveLog
from slam.localization.output import LocalizerOutput, RecoveredPose, State
from slam.mapping.layered_map import OCCUPANCY, PASSED_BY, LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import MapContents
from slam.storage.map_sessions import MapSession


def decoded(data: dict[str, Any]) -> dict[str, Any]:
    return page_data(f'<script type="application/octet-stream" id="data">{packed(data)}</script>')


def test_what_is_packed_comes_out() -> None:
    given = {
        "texts": [EVIL, "ü"],
        "numbers": [1, 2.5, math.nan, math.inf, None, True, np.float64(0.5), np.int32(7)],
        "arrays": [{"a": np.arange(5, dtype=np.int16)}, np.full((2, 3), 0.25), np.zeros((0, 2), np.float32)],
    }
    found = decoded(given)
    assert found["numbers"] == [1, 2.5, None, None, None, True, 0.5, 7]
    assert "\x1b" not in found["texts"][0] and "\u202e" not in found["texts"][0] and found["texts"][1] == "ü"
    np.testing.assert_array_equal(found["arrays"][0]["a"], np.arange(5))
    assert found["arrays"][1].shape == (2, 3) and found["arrays"][2].shape == (0, 2)
    assert packed(given) == packed(given)


def test_the_graph_is_reported_as_it_is() -> None:
    made = contents()
    data = map_data(made, Config(), title="log")
    edges, loops = data["edges"], data["loops"]
    edge = made.factors[3].edge
    np.testing.assert_allclose(
        edges["measured"][3],
        [edge.T_source_target.x(), edge.T_source_target.y(), edge.T_source_target.theta()],
    )
    np.testing.assert_allclose(edges["covariance"][3][[0, 3, 5]], np.diag(edge.covariance))
    for number, loop in enumerate(made.loops):
        assert (loops["edge"][number] >= 0) == loop.accepted
        if loop.accepted:
            assert edges["loop"][loops["edge"][number]] == number
    matched = [number for number, loop in enumerate(made.loops) if loop.motion is not None]
    assert loops["matched"].tolist() == matched and len(loops["measured"]) == len(matched)
    # A loop's measured pose lays its keyframe where the map has it.
    at = loops["matched"].tolist().index(int(np.flatnonzero(loops["accepted"])[0]))
    loop = made.loops[matched[at]]
    place = gtsam.Pose2(*made.keyframe_poses[loop.place]).compose(gtsam.Pose2(*loops["measured"][at]))
    np.testing.assert_allclose([place.x(), place.y()], made.keyframe_poses[loop.keyframe, :2], atol=1e-9)


def test_what_fusion_changed_is_reported_by_kind() -> None:
    scan = sweep(room(), [0.0, 0.0, 0.0], beams=5)
    lost = replace(scan, ranges_m=np.array([np.inf, 2.0, 2.0, 2.0, np.nan], np.float32))
    mended = replace(scan, ranges_m=np.array([1.0, 2.0, 3.0, 2.0, np.nan], np.float32))
    made = contents(measured_scans=[lost, scan], keyframe_scans=[mended, scan])
    repairs = map_data(made, Config(), title="log")["repairs"]
    assert repairs["kind"].tolist() == [0, 1, 2] and repairs["first"].tolist() == [0, 3, 3]
    np.testing.assert_allclose(np.hypot(*repairs["points"].T), [100, 300, 200], atol=1)


def test_what_has_gone_is_shown_over_the_map() -> None:
    made = contents()
    shown = made.grids[OCCUPANCY]
    steps = np.zeros((2, 3), np.int16)
    steps[1, 2] = 4000
    beside = gtsam.Pose2(4 * shown.resolution_m, 7 * shown.resolution_m, 0.0)
    gone = OccupancyGrid(steps, shown.resolution_m, shown.T_map_grid.compose(beside))
    pictures = map_data(replace(made, grids={**made.grids, PASSED_BY: gone}), Config(), title="log")["layers"]
    (picture,) = (one for one in pictures if one["name"] == "removed objects")
    png = base64.b64decode(picture["png"].partition(",")[2])
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[::-1].astype(int)
    rows, columns = np.nonzero((pixels == (220, 38, 38)).all(axis=2))
    assert len(rows) == 1
    corner = gtsam.Pose2(*picture["corner"])
    found = corner.transformFrom((np.array([columns[0], rows[0]]) + 0.5) * picture["resolution_m"])
    asked = gone.T_map_grid.transformFrom(np.array([2.5, 1.5]) * gone.resolution_m)
    np.testing.assert_allclose(found, asked, atol=1e-9)


def test_nodes_know_their_session_and_their_way() -> None:
    made = contents()
    sessions = [MapSession("a", "", 30, 30), MapSession("b", "", 30, 30)]
    data = map_data(made, Config(), title="log", sessions=sessions)
    assert data["nodes"]["session"].tolist() == [0] * 30 + [1] * 30
    assert data["trajectory"]["node"].tolist() == list(range(60)) and data["sessions"] == ["a", "b"]
    np.testing.assert_allclose(data["nodes"]["sigmas_m"], 0.03 * np.sqrt(1.0 + np.arange(60)), rtol=1e-5)
    sources = [data["trajectory"]["sources"][index] for index in data["trajectory"]["source"]]
    assert set(sources) == {EVIL}  # the wheels' step was refused


def test_a_saved_map_has_its_page_without_its_run(tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path / "log", duration_s=10.0).log_path
    house = slam.map_log(log, out=tmp_path / "map")
    html = "".join(saved_page(house, connect="'self'"))
    data = page_data(html)
    assert data["digest"] == house.digest and "connect-src &#39;self&#39;" in html
    np.testing.assert_allclose(data["nodes"]["bases"], house.keyframe_poses)
    stated = page_data((tmp_path / "map" / "report.html").read_text())
    assert stated["digest"] == house.digest and stated["layers"] == data["layers"]
    house.close()


class Clouds:
    """Clouds of keyframes that lie in no file."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __iter__(self):  # type: ignore[no-untyped-def]
        return (self.rows(key)[:, :3] for key in range(self._count))

    def rows(self, key: int) -> np.ndarray:
        rows = np.random.default_rng(key).uniform(-3.0, 3.0, (20_000, 4))
        return rows[:, :3] if key % 2 else rows


def spatial_map(**changes: Any) -> MapContents:
    """The same in space."""
    made = contents()
    poses = [gtsam.Pose3(pose) for pose in made.node_poses]
    return replace(made, **{"node_poses": poses, "factors": [], "loops": [], "covariances": None, **changes})


def test_a_map_of_a_3d_lidar_has_a_cloud_of_a_stated_size(tmp_path: Path) -> None:
    made = spatial_map(clouds=Clouds(60), frames=None)
    write_report(tmp_path / "report.html", report(made, Beside()))
    html = (tmp_path / "report.html").read_text()
    data = page_data(html)
    assert not data["planar"] and data["nodes"]["poses"].shape == (60, 7)
    assert 150_000 < len(data["cloud"]["points"]) <= 200_000 and "THREE" in html
    assert any(line.startswith("The cloud: ") and "of 1,200,000 points" in line for line in data["limits"])
    blue, red = data["cloud"]["by_intensity"].min(axis=0), data["cloud"]["by_intensity"].max(axis=0)
    assert len(data["cloud"]["by_intensity"]) == len(data["cloud"]["points"]) and (blue < red).all()
    high = data["cloud"]["low"] + data["cloud"]["step_m"] * data["cloud"]["points"].max(axis=0)
    # Cubes of 6 m that are turned and moved by the way.
    assert (high > [4.0, 4.0, 2.9]).all() and (high < [5.8, 5.5, 3.0]).all()


def test_of_a_camera_alone_which_way_is_up_is_found(tmp_path: Path) -> None:
    from page_worlds import cloud

    made = spatial_map(measured_scans=[], keyframe_scans=[], grids={}, frames=Frames([0, 7]))
    turn = gtsam.Rot3.Ypr(0.0, 0.1, -0.2).matrix()
    level = cloud()
    tilted = replace(level, normals_map=(level.normals_map @ turn.T).astype(np.float32))
    found, _ = cloud_data(made, tilted)
    assert found is not None
    np.testing.assert_allclose(found["up"], turn[:, 2], atol=1e-3)
    write_report(tmp_path / "report.html", report(made, Beside(cloud=tilted)))
    data = page_data((tmp_path / "report.html").read_text())
    assert data["unit"] == "frame" and not data["layers"] and len(data["images"]["node"]) == 2


def test_the_cloud_holds_no_keyframe_whole() -> None:
    class Clouds(list[np.ndarray]):
        def rows(self, key: int) -> np.ndarray:
            return self[0] + float(key)

    clouds = Clouds([np.random.default_rng(1).normal(size=(20_000, 4))] * 50)  # 640 kB each
    found: Any = SimpleNamespace(clouds=clouds, node_poses=[gtsam.Pose3()] * 50, planar=False)
    tracemalloc.start()
    data, _ = cloud_data(found, None)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert data is not None and len(data["points"]) == len(data["by_intensity"]) and peak < 25e6


def test_a_localised_drive_is_coloured_by_sigma_and_confidence(tmp_path: Path) -> None:
    drive = DriveLog()
    for number in range(20):
        searching = number < 5
        pose = None if searching else gtsam.Pose2(0.1 * number, 0.0, 0.0)
        covariance = None if searching else np.diag([0.01, 0.02, 0.03]) ** 2
        past = (RecoveredPose(4.0, gtsam.Pose2(0.4, 0.0, 0.0)),) if number == 5 else ()
        state = State.SEARCHING if searching else State.TRACKING
        drive.add(LocalizerOutput(float(number), state, pose, covariance, 0.05 * number, (), 0.5, past), 0.01)
    grids = contents().grids
    layers = LayeredMap(*grids.values())
    write_localization_report(tmp_path / "report.html", EVIL, drive, layers, [(EVIL, EVIL)])
    html = (tmp_path / "report.html").read_text()
    data = page_data(html)
    way = data["trajectory"]
    assert way["stamps_s"].tolist() == list(range(4, 20))
    np.testing.assert_allclose(way["sigma_m"], [np.nan] + [0.02] * 15, rtol=1e-6)
    np.testing.assert_allclose(way["more"][0]["values"], [np.nan, *0.05 * np.arange(5, 20)])
    assert way["more"][2]["values"].tolist() == [1] + [0] * 15
    assert data["layers"][0]["name"] == "map" and "<img" not in html.replace("&lt;", "")
    write_localization_report(tmp_path / "none.html", "log", DriveLog(), None, [], ["doubtful"])
    html = (tmp_path / "none.html").read_text()
    assert page_data(html)["trajectory"]["stamps_s"].size == 0 and "<li>doubtful</li>" in html


def test_the_stages_add_up_to_the_run(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", report())
    html = (tmp_path / "report.html").read_text()
    assert "<td>other</td><td>1.00 s</td>" in html and "<td>total</td><td>4.00 s</td>" in html


def test_a_page_of_many_keyframes_stays_small(tmp_path: Path) -> None:
    """Scans of noise, which no packing makes smaller."""
    keyframes, generator = 5000, np.random.default_rng(0)
    scan = sweep(room(), [0.0, 0.0, 0.0], beams=361)
    scans = [
        replace(scan, ranges_m=generator.uniform(0.5, 20.0, 361).astype(np.float32)) for _ in range(keyframes)
    ]
    many = contents(167, frames=None, measured_scans=[], keyframe_scans=scans + scans[:10])
    path = tmp_path / "report.html"
    write_report(path, report(many, Beside()))
    data = page_data(path.read_text())
    assert path.stat().st_size < 11e6 and len(data["nodes"]["readings"]) == keyframes + 10
    assert len(data["scans"]["points"]) <= 1_000_000 and "Scans: one point in 2." in data["limits"]
