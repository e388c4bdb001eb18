"""What a set of claims entails along both ways: keyframes that fit as well, and those that fit nowhere."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slam.config.stages import GraphConfig, LoopConfig, MatchConfig, ScanConfig
from slam.estimates import MotionEstimate
from slam.graph.claim_trial import ClaimTrial
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.place_search import PlaceSearch
from slam.graph.submaps import SubmapStore
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.matching.scan_points import points_by
from slam.measurements import FloatArray, LaserScan, pose2_from_row
from slam.simulation.floor_plan import cast_rays

# Ten metres along a corridor, a metre a keyframe; carried back, and along it once more.
FIRST, AGAIN, REACH_M = range(10), range(100, 110), 3.0
CONFIG = LoopConfig()
SURE = np.eye(3) * 0.01**2


class Way:
    """The drive as submaps, stretches, sets and loop closer know it; a match fits up to a keyframe."""

    window_m, spacing_m, least_path_m = 3.0, 0.5, CONFIG.least_path_m

    def __init__(self, fits_before: int = 1000, degenerate: bool = False) -> None:
        self.submaps, self.fits_before, self.degenerate = self, fits_before, degenerate
        self.verified: list[tuple[int, int]] = []

    def travelled_m(self, key: int) -> float:
        return float(key)

    def wide_m(self, least_m: float, scans: float) -> float:
        return max(least_m, scans * self.spacing_m)

    def pose(self, key: int) -> FloatArray:
        return np.array([float(key % 100), 0.0, 0.0])

    def between(self, begin_m: float, end_m: float) -> list[int]:
        return [key for key in (*FIRST, *AGAIN) if begin_m <= key <= end_m]

    def way(self, start: int, end: int) -> Motion:
        return Motion(between(self.pose(start), self.pose(end)), SURE)

    def verify(self, place: int, key: int, guess: FloatArray, covariance: FloatArray) -> LoopCandidate:
        self.verified.append((place, key))
        motion = MotionEstimate(
            pose2_from_row(guess), covariance, 0.9, 0.9, 0.01, True, self.degenerate, np.zeros(3)
        )
        found = LoopCandidate(place, key, 0.0, 0.0, 1.0, motion, True, "")
        return found if key < self.fits_before else replace(found, accepted=False, motion=None, reason="no")


def tried(way: Way) -> tuple[list[LoopCandidate], int]:
    """What follows from the claim that keyframe 105 is where 5 was."""
    trial = ClaimTrial(way, way, way, CONFIG, REACH_M)  # type: ignore[arg-type]
    claim = way.verify(5, 105, np.zeros(3), SURE)
    way.verified.clear()
    return trial.hold([claim])


def test_what_lies_beyond_a_claim_is_found_at_its_own_place() -> None:
    more, refused = tried(Way())
    assert [(one.place, one.keyframe) for one in more] == [
        (2, 102),
        (3, 103),
        (4, 104),
        (6, 106),
        (7, 107),
        (8, 108),
    ]
    assert refused == 0
    for one in more:
        assert one.motion is not None
        np.testing.assert_allclose([one.motion.T_reference_base.x()], [0.0], atol=1e-9)


def test_a_keyframe_that_fits_at_no_place_is_counted_once() -> None:
    way = Way(fits_before=107)
    more, refused = tried(way)
    assert [one.keyframe for one in more] == [102, 103, 104, 106]
    assert refused == 2
    assert sum(key == 107 for _, key in way.verified) > 1, "the places beside were tried too"


def test_a_match_with_an_open_direction_confirms_and_is_no_claim() -> None:
    more, refused = tried(Way(degenerate=True))
    assert (more, refused) == ([], 0)


class Seen(Way):
    """The same in corridors that are alike, but do not end at the same distance."""

    def __init__(self, ends_m: tuple[float, float], sigma_m: float) -> None:
        super().__init__()
        self.store, scan, self.sigma_m = SubmapStore(CONFIG, MatchConfig()), ScanConfig(), sigma_m
        bearings, step = np.linspace(-np.pi, np.pi, 360, endpoint=False), np.pi / 180.0
        for number, end_m in enumerate(ends_m):
            corners = np.array([[-5.0, -2.0], [end_m, -2.0], [end_m, 2.0], [-5.0, 2.0]])
            walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
            for key in FIRST:
                pose = np.array([float(key), 0.0, 0.0])
                ranges_m = cast_rays(walls, pose[:2], bearings).astype(np.float32)
                sweep = LaserScan(0.0, ranges_m, -np.pi, step, 80.0, pose2_from_row(np.zeros(3)))
                points = points_by(scan, sweep)
                self.store.add(OrientedPoints.from_scan(points), pose, 100.0 * number + key)

    def way(self, start: int, end: int) -> Motion:
        return super().way(start, end).widened(np.diag([self.sigma_m, self.sigma_m, 0.0]) ** 2)

    def scan(self, key: int) -> OrientedPoints:
        return self.store.scan(key if key < 100 else key - 90)

    def surroundings(self, key: int, *, own: bool) -> LocalMap:
        return self.store.surroundings(key if key < 100 else key - 90, own=own)


@pytest.mark.parametrize(
    ("ends_m", "sigma_m", "contradicts"),
    [
        ((14.0, 14.0), 0.0, False),
        ((14.0, 16.0), 0.0, True),
        ((16.0, 14.0), 0.0, True),
        ((14.0, 16.0), 0.9, False),
    ],
)
def test_a_corridor_that_ends_elsewhere_contradicts(
    ends_m: tuple[float, float], sigma_m: float, contradicts: bool
) -> None:
    """Seen from either end, unless the path between is less certain than the difference."""
    way = Seen(ends_m, sigma_m)
    trial = ClaimTrial(way, way, way, CONFIG, REACH_M)  # type: ignore[arg-type]
    share = trial.contradicted([way.verify(5, 105, np.zeros(3), SURE)])
    assert (share > CONFIG.sigmas * (1.0 - CONFIG.inlier_probability)) is contradicts


@pytest.mark.parametrize("from_place", [True, False])
def test_the_end_that_contradicts_more_counts(from_place: bool) -> None:
    """Each end is looked at from the other, where the claim puts it."""
    asked: list[FloatArray] = []

    class OneSided(Seen):
        def surroundings(self, key: int, *, own: bool) -> LocalMap:
            def contradicted(scan: OrientedPoints, pose: FloatArray, covariance: FloatArray) -> float:
                asked.append(pose)
                return 0.2 if (key < 100) is from_place else 0.1

            return SimpleNamespace(contradicted=contradicted)  # type: ignore[return-value]

    way = OneSided((14.0, 14.0), 0.0)
    trial = ClaimTrial(way, way, way, CONFIG, REACH_M)  # type: ignore[arg-type]
    assert trial.contradicted([way.verify(5, 105, np.array([0.3, 0.1, 0.1]), SURE)]) == pytest.approx(0.2)
    for there, back in zip(asked[::2], asked[1::2], strict=True):
        np.testing.assert_allclose(between(there, np.zeros(3)), back, atol=1e-9)


@pytest.mark.parametrize("beyond", [CONFIG.reach_m + 0.5, 1.0])
def test_a_place_that_was_never_near_shows_nothing(beyond: float) -> None:
    """The second drive goes on beside the first: too far off, nothing is asked of it."""

    class Beside(Way):
        def way(self, start: int, end: int) -> Motion:
            aside = np.array([0.0, beyond if end > 105 else 0.0, 0.0])
            return Motion(super().way(start, end).pose + aside, SURE)

    _, refused = tried(way := Beside(fits_before=106))
    assert refused == (0 if beyond > CONFIG.reach_m else 3)
    assert any(key > 105 for _, key in way.verified) is (beyond <= CONFIG.reach_m)


def test_without_loops_no_place_is_searched() -> None:
    """Else it would ask the submaps, of which there are none here."""
    closer = type("NoSubmaps", (), {"submaps": None})()
    match, graph = MatchConfig(), GraphConfig()
    search = PlaceSearch(closer, LoopConfig(enabled=False), match, graph)  # type: ignore[arg-type]
    assert search.search(np.zeros((3, 3)), np.arange(3.0), [], np.zeros(0, np.bool_), []) == []
    with pytest.raises(AttributeError):
        PlaceSearch(closer, LoopConfig(), match, graph).search(  # type: ignore[arg-type]
            np.zeros((3, 3)), np.arange(3.0), [], np.zeros(0, np.bool_), []
        )
