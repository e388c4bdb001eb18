"""Where the robot may be: poses carried along with the odometry, each weighed by all that was seen."""

from __future__ import annotations

import math

import numpy as np

from slam.config.localization import LocalizationConfig
from slam.localization.evidence import Hypothesis, is_same_place, posterior, pruned
from slam.localization.global_search import search_everywhere
from slam.localization.known_map import Walls
from slam.localization.map_match import MapMatcher
from slam.localization.scan_view import ScanView, first_in_cells
from slam.localization.stations import Station, StationLog
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, row_from_pose2


class HypothesisSet:
    """All hypotheses, and how likely each is."""

    def __init__(self, walls: Walls, matcher: MapMatcher, config: LocalizationConfig) -> None:
        self._walls = walls
        self._matcher = matcher
        self._config = config
        self._odometry_pose = np.zeros(3)
        self._log = StationLog(config)
        self.members: list[Hypothesis[FloatArray]] = []
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

    def winner(self) -> Hypothesis[FloatArray] | None:
        """The hypothesis that is sure; None while there is none."""
        probabilities = self.probabilities()
        if not self.members or probabilities.max() < self._config.sure_probability:
            return None
        return self.members[int(probabilities.argmax())]

    def _settle(self, member: Hypothesis[FloatArray], station: Station, predicted: FloatArray) -> None:
        """Align a hypothesis to the map near its predicted pose, and weigh the station's news."""
        member.pose, member.motion = predicted, None
        motion = self._matcher.correct(station.view, predicted)
        if motion is not None:
            member.pose, member.motion = row_from_pose2(motion.T_reference_base), motion
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
        """Drop what is no longer worth carrying."""
        config = self._config
        self.members = pruned(self.members, config.hypotheses, config.kidnap_nats, _same)


def _same(one: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (3,) are one place."""
    step = between(one, other)
    return is_same_place(math.hypot(step[0], step[1]), abs(float(step[2])))
