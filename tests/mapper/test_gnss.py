"""Fixes of a satellite receiver: the map lies where they say, and they mend what nothing else holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml
from flat_worlds import box, sweep

import slam
from slam.app.mapping import Measured, run_log
from slam.config import load_config
from slam.earth import TangentPlane
from slam.errors import ScanweaveError
from slam.graph.anchors import Anchor, anchored
from slam.graph.edge import Edge, EdgeKind
from slam.matching.planar import compose
from slam.measurements import FloatArray, GnssFix, Measurement, WheelOdometry, pose2_from_row

STEP = np.array([0.1, 0.0, 0.04])
MOMENTS = 80
ROOM = box(-3.0, -2.0, 6.0, 6.0)
PLANE = TangentPlane(48.0, 8.0, 300.0)
# The map's x axis looks north, 10 m east of the plane's origin.
T_ENU_MAP = gtsam.Pose3(gtsam.Rot3.Yaw(0.5 * math.pi), np.array([10.0, 0.0, 2.0]))
ANTENNA = np.array([0.3, -0.2, 1.0])


def fix_at(stamp_s: float, pose: FloatArray, sigma_m: float = 0.005, **changes: object) -> GnssFix:
    robot = gtsam.Pose3(pose2_from_row(pose))
    place = PLANE.geodetic(T_ENU_MAP.compose(robot).transformFrom(ANTENNA))
    return replace(GnssFix(stamp_s, *place, np.eye(3) * sigma_m**2, ANTENNA), **changes)


def drive(fixes: Sequence[int] = range(MOMENTS), **changes: object) -> list[Measurement]:
    """On a curve; wheels turn a third too little, and the lidar sees no wall after the first second."""
    found, true, wheels = list[Measurement](), np.zeros(3), np.zeros(3)
    for n in range(MOMENTS):
        stamp_s = 10.0 + 0.1 * n
        scan = sweep(ROOM, true, beams=181, fov_rad=math.pi, stamp_s=stamp_s)
        if n > 10:
            scan = replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan))
        found += [WheelOdometry(stamp_s, pose2_from_row(wheels)), scan]
        if n in fixes:
            found.append(fix_at(stamp_s, true, **changes))
        true, wheels = compose(true, STEP), compose(wheels, STEP * [1.0, 1.0, 0.67])
    return found


def missed_m(made: slam.Map) -> float:
    """How far the last place is off: on the earth where the map lies there, else from the first."""
    true, last = np.zeros(3), made.trajectory.positions_m[-1]
    for _ in range(MOMENTS - 1):
        true = compose(true, STEP)
    place = np.array([*true[:2], 0.0])
    if (earth := made.contents.georeference) is not None:
        last, place = PLANE.enu_m(*earth.geodetic(last)), np.asarray(T_ENU_MAP.transformFrom(place))
    return math.hypot(*(last - place)[:2])


def test_it_holds_the_way_that_wheels_lose() -> None:
    alone = slam.map_log(Measured(drive(())))
    assert missed_m(alone) > 1.0
    made = slam.map_log(Measured(drive()))
    assert missed_m(made) < 0.1
    earth = made.contents.georeference
    assert earth is not None
    # A metre of the way shows the heading at its start.
    assert math.cos(math.radians(earth.heading_deg)) > 0.98
    np.testing.assert_allclose(PLANE.enu_m(*earth.geodetic(np.zeros(3))), [10.0, 0.0, 2.0], atol=0.3)
    assert any(note.startswith("GNSS: ") for note in made.notes)


def test_mirrored_signals_are_refused() -> None:
    wrong = range(30, 40)
    sound = [n for n in range(MOMENTS) if n not in wrong]
    false = [one for one in drive(wrong, latitude_deg=48.0003) if isinstance(one, GnssFix)]
    log = sorted([*drive(sound), *false], key=lambda one: one.stamp_s)
    made = slam.map_log(Measured(log))
    assert missed_m(made) < 0.15
    held = [
        factor.edge.target for factor in made.factors if factor.edge.kind is EdgeKind.GNSS and factor.kept
    ]
    assert len(held) > 15
    assert not {key for key in held if 13.0 <= made.contents.stamps_s[key] < 14.0}


@pytest.mark.parametrize(
    ("fixes", "changes", "why"),
    [(range(MOMENTS), {"sigma_m": 5.0}, "uncertain"), (range(5), {}, "only")],
)
def test_what_shows_nothing_is_not_used(fixes: range, changes: dict[str, float], why: str) -> None:
    run = run_log(Measured(drive(fixes, **changes)))
    assert run.map.contents.georeference is None
    assert missed_m(run.map) == pytest.approx(missed_m(slam.map_log(Measured(drive(())))), abs=1e-9)
    assert any("gnss (GNSS" in note and why in note for note in run.map.notes)


def test_a_calibration_shows_the_antenna_or_leaves_the_receiver_out() -> None:
    untold = [replace(one, antenna_m=None) if isinstance(one, GnssFix) else one for one in drive()]
    settings = ["sensors.calibration.gnss.gnss.antenna_m=[0.3,-0.2,1.0]"]
    made = slam.map_log(Measured(untold), load_config(None, settings))
    assert missed_m(made) < 0.1
    left = slam.map_log(Measured(drive()), load_config(None, ["sensors.calibration.gnss.gnss.use=false"]))
    assert left.contents.georeference is None


def test_files_say_where_on_the_earth_it_lies(tmp_path: Path) -> None:
    made = slam.map_log(Measured(drive()), out=tmp_path / "map")
    stated = yaml.safe_load((tmp_path / "map" / "georeference.yaml").read_text())
    assert stated["latitude_deg"] == pytest.approx(48.0, abs=1e-5)
    earth, saved = made.contents.georeference, slam.load_map(tmp_path / "map").contents.georeference
    assert earth is not None
    assert saved is not None
    assert saved.T_enu_map.equals(earth.T_enu_map, 1e-9)
    np.testing.assert_allclose(stated["T_enu_map"], earth.T_enu_map.matrix()[:3], atol=1e-8)
    turned = made.edited({"turn": {"degrees": 30.0}})
    last = [one.contents.georeference.geodetic(one.trajectory.positions_m[-1]) for one in (made, turned)]
    np.testing.assert_allclose(last[0], last[1], atol=1e-9)
    made.export("gpx", tmp_path / "way.gpx")
    assert (tmp_path / "way.gpx").read_text().count("<trkpt") == len(made.trajectory)
    with pytest.raises(ScanweaveError, match="no GNSS"):
        slam.map_log(Measured(drive(()))).export("gpx", tmp_path / "none.gpx")


@pytest.mark.parametrize("planar", [True, False])
def test_a_way_that_bends_is_straightened(planar: bool) -> None:
    """Steps of 1 m that turn 0.03 degrees too far, and claim ten times less."""
    rng, anchors, edges = np.random.default_rng(0), list[Anchor](), list[Edge]()
    lift = (lambda pose: pose) if planar else gtsam.Pose3
    true, poses = [gtsam.Pose2()], [lift(gtsam.Pose2())]
    sigmas = [0.01, 0.01, 5e-5] if planar else [5e-5] * 3 + [0.01] * 3
    for k in range(300):
        step = gtsam.Pose2(1.0, 0.0, 0.02 if k % 150 < 75 else -0.01)
        true.append(true[-1].compose(step))
        stated = lift(step.compose(gtsam.Pose2(0.0, 0.0, 5e-4)))
        edges.append(Edge(k, k + 1, stated, np.diag(np.square(sigmas)), EdgeKind.LIDAR, trusted=True))
        poses.append(poses[-1].compose(stated))
    for k in range(0, 301, 2):
        place = np.asarray(T_ENU_MAP.compose(gtsam.Pose3(true[k])).transformFrom(ANTENNA))
        place = place + rng.normal(0.0, 0.3, 3) + (20.0 * rng.normal(size=3) if k % 20 == 0 else 0.0)
        anchors.append(Anchor(k, place, np.eye(3) * 0.09, ANTENNA))
    places = {one.node: one.place_m[:2] for one in anchors}
    found = anchored(poses, edges, anchors)
    assert found is not None
    assert {edge.target for edge in found.edges}.isdisjoint(range(0, 301, 20))
    assert len(found.edges) > 90
    # From node 0 an edge leads where the anchor lies in the map.
    last = gtsam.Pose3(found.edges[-1].T_source_target) if planar else found.edges[-1].T_source_target
    seen = found.T_enu_map.compose(last).transformFrom(ANTENNA)
    np.testing.assert_allclose(seen[:2], places[found.edges[-1].target], atol=1e-6)


def test_a_place_on_the_earth_comes_back() -> None:
    for place in ((48.01, 8.02, 250.0), (-33.9, 151.2, 5.0), (89.9999, 10.0, 0.0), (0.001, -179.9999, 8e3)):
        plane = TangentPlane(place[0] - 0.005, place[1], place[2] - 3.0) if place[0] < 80 else PLANE
        back = plane.geodetic(plane.enu_m(*place))
        np.testing.assert_allclose(back, place, atol=1e-5)
    # A degree of latitude on WGS 84 at the equator and at the pole, and of longitude at 60 degrees.
    for latitude, north, east in ((0.0, 110_574.3, 111_319.5), (60.0, 111_412.2, 55_800.0)):
        plane = TangentPlane(latitude, 0.0, 0.0)
        assert 1e5 * plane.enu_m(latitude + 1e-5, 0.0, 0.0)[1] == pytest.approx(north, abs=1.0)
        assert 1e5 * plane.enu_m(latitude, 1e-5, 0.0)[0] == pytest.approx(east, abs=1.0)
