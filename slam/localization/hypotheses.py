"""Where the robot may be: poses carried along with the odometry, each weighed by all that was seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.config_localization import LocalizationConfig
from slam.localization.evidence import posterior, way_nats
from slam.localization.global_search import search_everywhere
from slam.localization.known_map import Walls
from slam.localization.map_match import MapMatcher
from slam.localization.scan_view import ScanView, first_in_cells
from slam.localization.stations import Station, StationLog
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, MotionEstimate, row_from_pose2

# An alignment may correct a hypothesis by so much a station; what moves farther is another place.
_GREATEST_CORRECTION_M = 0.3
_GREATEST_CORRECTION_RAD = 0.15
# Hypotheses nearer than this are one.
_SAME_M = 0.3
_SAME_RAD = 0.15
# A hypothesis this much worse than the best is dropped, in nats.
_HOPELESS_NATS = 15.0


@dataclass(slots=True)
class Hypothesis:
    """A pose that may be the robot's.

    Attributes
    ----------
    pose
        (3,) in the map, at the newest station.
    evidence
        Nats by station, oldest first, as many as there are stations.
    motion
        The alignment of the newest station; None where there was nothing to align to.
    prior
        Nats in favour before anything was seen.
    """

    pose: FloatArray
    evidence: list[float]
    motion: MotionEstimate | None
    prior: float = 0.0

    def total(self, kidnap_nats: float) -> float:
        """Evidence of the way, or of its end alone if the robot was carried off in between."""
        return self.prior + way_nats(self.evidence, kidnap_nats)


class HypothesisSet:
    """All hypotheses, and how likely each is."""

    def __init__(self, walls: Walls, matcher: MapMatcher, config: LocalizationConfig) -> None:
        self._walls = walls
        self._matcher = matcher
        self._config = config
        self._odometry_pose = np.zeros(3)
        self._log = StationLog(config)
        self.members: list[Hypothesis] = []
        self.clear()

    def clear(self) -> None:
        """Begin anew: nothing is known."""
        self._log.clear()
        self.members.clear()
        self._search_at_m = 0.0
        self._searches = 0

    def due(self, pose: FloatArray) -> bool:
        """Whether a scan at a pose (3,) in the odometry frame should be weighed."""
        return self._log.due(pose)

    def add_station(self, view: ScanView, pose: FloatArray, carried: FloatArray | None) -> None:
        """Carry all hypotheses to a scan, weigh them by its news, and look for new ones.

        Parameters
        ----------
        pose
            (3,) in the odometry frame.
        carried
            (3,) in the map by dead reckoning from the last pose that was tracked; None where there is none.
        """
        dropped = self._log.add(view, pose)
        station = self._log.stations[-1]
        for member in self.members:
            del member.evidence[:dropped]
            predicted = compose(member.pose, between(self._odometry_pose, pose))
            self._settle(member, station, predicted)
        self._odometry_pose = pose
        if len(self._log.stations) == 1 and carried is not None:
            member = Hypothesis(carried, [], None, self._config.carried_nats)
            self._settle(member, station, carried)
            self.members.append(member)
        if station.way_m >= self._search_at_m:
            self._search_at_m = station.way_m + self._config.search_every_m
            self._search()
        self._prune()

    def propose(self, pose: FloatArray, odometry_pose: FloatArray) -> None:
        """Take in a pose (3,) in the map that something else has found.

        Parameters
        ----------
        odometry_pose
            (3,) of the robot at that moment, in the odometry frame.
        """
        if not self._log.stations:
            return
        station = self._log.stations[-1]
        self._take_in(compose(pose, between(odometry_pose, station.pose)), self._config.looks_nats)
        self._prune()

    def probabilities(self) -> FloatArray:
        """Posterior of each hypothesis; what is left to one is that of being nowhere in the map."""
        config = self._config
        totals = np.array([member.total(config.kidnap_nats) for member in self.members])
        return posterior(totals, config.nowhere_nats)

    def winner(self) -> Hypothesis | None:
        """The hypothesis that is sure; None while there is none."""
        probabilities = self.probabilities()
        if not self.members or probabilities.max() < self._config.sure_probability:
            return None
        return self.members[int(probabilities.argmax())]

    def _settle(self, member: Hypothesis, station: Station, predicted: FloatArray) -> None:
        """Align a hypothesis to the map near its predicted pose, and weigh the station's news."""
        member.pose, member.motion = predicted, None
        motion = self._matcher.align(station.view, predicted)
        if motion is not None and motion.inlier_share >= self._config.least_inlier_share:
            aligned = row_from_pose2(motion.T_reference_base)
            moved = between(predicted, aligned)
            if (
                math.hypot(moved[0], moved[1]) <= _GREATEST_CORRECTION_M
                and abs(moved[2]) <= _GREATEST_CORRECTION_RAD
            ):
                member.pose, member.motion = aligned, motion
        member.evidence.append(self._matcher.weigh(member.pose, station.view.laser, station.news))

    def _search(self) -> None:
        """Look everywhere for what was seen of late, and take in what is not yet among the hypotheses.

        By turns for all of the last way, which is rarer, and for the newest scan, which no drift has bent.
        """
        config = self._config
        self._searches += 1
        points = self._log.recent_points(config.search_back_m if self._searches % 2 else 0.0)
        points = points[first_in_cells(points, config.news_cell_m)[0]]
        points = points[:: max(1, -(-len(points) // config.search_points))]
        if len(points) == 0:
            return
        places = search_everywhere(
            self._walls.field,
            points,
            config.search_least_score,
            config.search_keep_share,
            config.hypotheses,
            config.search_threads,
        )
        for place in places:
            self._take_in(place.pose, 0.0)

    def _take_in(self, pose: FloatArray, prior: float) -> None:
        """Weigh a pose (3,) at the newest station by all stations, unless it is known already."""
        stations = self._log.stations
        member = Hypothesis(pose, [], None, prior)
        self._settle(member, stations[-1], pose)
        for other in self.members:
            if _same(member.pose, other.pose):
                other.prior = max(other.prior, prior)
                return
        way = [
            self._matcher.weigh(
                compose(member.pose, between(stations[-1].pose, station.pose)),
                station.view.laser,
                station.news,
            )
            for station in stations[:-1]
        ]
        member.evidence = way + member.evidence
        self.members.append(member)

    def _prune(self) -> None:
        """Drop what has become another's double, is hopeless, or is beyond the number that is carried."""
        totals = [member.total(self._config.kidnap_nats) for member in self.members]
        kept: list[Hypothesis] = []
        for n in sorted(range(len(totals)), key=lambda n: -totals[n]):
            if len(kept) == self._config.hypotheses or totals[n] < max(totals) - _HOPELESS_NATS:
                break
            if not any(_same(self.members[n].pose, other.pose) for other in kept):
                kept.append(self.members[n])
        self.members = kept


def _same(one: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (3,) are one place."""
    step = between(one, other)
    return bool(math.hypot(step[0], step[1]) < _SAME_M and abs(step[2]) < _SAME_RAD)
