"""Tags on the walls: they close the way, hold it where they were surveyed, and show what does not fit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml
from tag_world import SIDE_M, TAGS, ahead_of, drive, usual, way

import slam
from slam.app.mapping import Measured
from slam.config import load_config, with_places
from slam.config.tags import KnownPlaces, KnownStart, SurveyedPlace
from slam.errors import ConfigError
from slam.graph.edge import EdgeKind
from slam.measurements import Measurement
from slam.outputs.exports import Exports

PLAIN = load_config(overrides=["sensors.doctor=false"])
T_SURVEY_MAP = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([100.0, 50.0, 0.2]))


def surveyed(number: int, off_m: float = 0.0, **changes: object) -> SurveyedPlace:
    place = T_SURVEY_MAP.transformFrom(TAGS[number].T_map_tag.translation()) + np.array([off_m, 0.0, 0.0])
    return SurveyedPlace.model_validate(
        {"tag": number, "at_m": tuple(place.tolist()), "sigma_m": 0.002, **changes}
    )


def mapped(places: KnownPlaces | None, log: list[Measurement] | None = None) -> slam.Map:
    sensors = PLAIN.sensors.model_copy(update={"tags": places})
    return slam.map_log(
        Measured(usual() if log is None else log), PLAIN.model_copy(update={"sensors": sensors})
    )


def off_m(made: slam.Map, moment: int = 41) -> float:
    """How far the way to a moment is off; at 41 the robot is back and has seen the first tag again."""
    return float(np.linalg.norm((made.keyframe_poses[moment] - way()[moment])[:2]))


@pytest.fixture(scope="module")
def tagged() -> slam.Map:
    return mapped(KnownPlaces(size_m=SIDE_M))


def test_a_tag_closes_what_wheels_leave_open(tagged: slam.Map) -> None:
    assert off_m(mapped(None)) > 0.4
    assert off_m(tagged) < 0.03
    assert sum(factor.edge.kind is EdgeKind.TAG for factor in tagged.factors) > 10
    assert any(note.startswith("tags: 3 in ") for note in tagged.notes)
    places = tagged.contents.places
    assert places is not None
    assert [tag.number for tag in places.tags] == [0, 1, 2]
    first = places.tags[0]
    np.testing.assert_allclose(
        first.place_m(tagged.contents.node_poses), TAGS[0].T_map_tag.translation(), atol=0.03
    )
    turn = gtsam.Pose3(tagged.contents.node_poses[first.node]).compose(first.T_node_tag).rotation()
    assert turn.equals(TAGS[0].T_map_tag.rotation(), 0.05)


def with_check(off_m: float = 0.0) -> slam.Map:
    """Two tags are surveyed, a third one proves them; it may be written down far off."""
    tags = surveyed(0), surveyed(1, off_m, check=True), surveyed(2)
    return mapped(KnownPlaces(size_m=SIDE_M, surveyed=tags))


@pytest.fixture(scope="module")
def checked() -> slam.Map:
    return with_check()


def test_surveyed_tags_lay_the_map_and_checks_prove_it(checked: slam.Map) -> None:
    made = checked
    assert made.contents.places is not None and made.contents.places.T_survey_map is not None
    found = made.contents.places.T_survey_map
    np.testing.assert_allclose(found.translation(), T_SURVEY_MAP.translation(), atol=0.03)
    assert found.rotation().yaw() == pytest.approx(0.7, abs=0.01)
    (check,) = [note for note in made.notes if "(check)" in note]
    assert float(check.split(" is ")[1].split(" m off")[0]) < 0.05
    assert off_m(made) < 0.03


def test_a_wrong_check_is_a_warning_and_moves_nothing(checked: slam.Map) -> None:
    right, wrong = checked, with_check(2.0)
    assert any("tag 1 (check) is 2." in line or "tag 1 (check) is 1.9" in line for line in wrong.warnings)
    assert right.trajectory.positions_m == pytest.approx(wrong.trajectory.positions_m, abs=1e-12)


def test_a_known_start_is_enough() -> None:
    start = KnownStart(at_m=(100.0, 50.0, 0.2), yaw_deg=math.degrees(0.7), sigma_m=0.01, sigma_deg=0.5)
    made = mapped(KnownPlaces(start=start))
    assert made.contents.places is not None and made.contents.places.T_survey_map is not None
    assert made.contents.places.T_survey_map.equals(T_SURVEY_MAP, 1e-6)


def test_places_that_the_base_passed_hold_the_way() -> None:
    known = [
        SurveyedPlace(
            stamp_s=10.0 + 0.5 * moment,
            at_m=tuple(T_SURVEY_MAP.transformFrom(np.array([*way()[moment][:2], 0.0]))[:2].tolist()),
        )
        for moment in (0, 12, 25, 38, 48)
    ]
    made = mapped(KnownPlaces(surveyed=tuple(known)))
    assert off_m(made) < 0.05


def test_a_tag_that_hangs_twice_does_no_harm() -> None:
    # The second one on the far side.
    twin = ahead_of(21, 0)
    made = mapped(KnownPlaces(size_m=SIDE_M), drive([*TAGS, twin]))
    assert off_m(made) < 0.03
    assert any("Tag 0 is elsewhere" in line for line in made.warnings)


def test_two_of_one_number_in_an_image_are_not_used() -> None:
    pose = TAGS[0].T_map_tag
    beside = pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0])))
    made = mapped(KnownPlaces(size_m=SIDE_M), drive([*TAGS, replace(TAGS[0], T_map_tag=beside)]))
    assert any("Tag 0 was seen at several places" in line for line in made.warnings)
    assert made.contents.places is not None
    assert [tag.number for tag in made.contents.places.tags] == [1, 2]


def test_files(checked: slam.Map, tmp_path: Path) -> None:
    made = checked
    made.save(tmp_path / "map")
    saved = slam.load_map(tmp_path / "map").contents
    assert saved.places is not None and made.contents.places is not None
    assert [tag.number for tag in saved.places.tags] == [0, 1, 2]
    for one, other in zip(saved.places.tags, made.contents.places.tags, strict=True):
        assert one.T_node_tag.equals(other.T_node_tag, 1e-9)
    assert saved.places.T_survey_map is not None and made.contents.places.T_survey_map is not None
    assert saved.places.T_survey_map.equals(made.contents.places.T_survey_map, 1e-9)
    Exports(made.contents, made.config).write_files(tmp_path / "files")
    stated = with_places(PLAIN, tmp_path / "files" / "tags.yaml").sensors.tags
    assert stated is not None and stated.size_m == SIDE_M
    for one in stated.surveyed:
        true = T_SURVEY_MAP.transformFrom(TAGS[one.tag or 0].T_map_tag.translation())
        np.testing.assert_allclose(one.at_m[:2], true[:2], atol=0.05)


def test_what_is_no_file_of_tags_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "tags.yaml"
    with pytest.raises(ConfigError, match="no file of tags"):
        with_places(PLAIN, file)
    file.write_text(yaml.safe_dump({"size_m": -1.0}))
    with pytest.raises(ConfigError, match="size_m"):
        with_places(PLAIN, file)
    file.write_text(yaml.safe_dump({"surveyed": [{"at_m": [1.0, 2.0]}]}))
    with pytest.raises(ConfigError, match="either a tag or a stamp_s"):
        with_places(PLAIN, file)
