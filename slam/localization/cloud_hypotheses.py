"""Where a robot with a 3D lidar may be: poses carried with the odometry, weighed by all that was seen."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.cloud_match import CloudMatcher, CloudView
from slam.localization.cloud_stations import CloudStation, CloudStations
from slam.localization.evidence import Hypothesis, is_correction, is_same_place, posterior, pruned
from slam.measurements import FloatArray

# One station counts for so many nats at most: somebody may stand before the lidar.
_MOST_NATS = 4.0
# What is newly found is weighed by so many earlier stations: those before cost time, and drift bends the way.
_BACK = 5


class CloudHypotheses:
    """All hypotheses, and how likely each is."""

    def __init__(self, matcher: CloudMatcher, config: Config) -> None:
        self._matcher = matcher
        self._config, self._stations = config.localization, CloudStations(config.localization)
        settings = config.cloud_localization
        self._least_stations, self._most = settings.least_stations, settings.hypotheses
        self._new_share = settings.new_share
        self._odometry_pose = gtsam.Pose3()
        self.members: list[Hypothesis[gtsam.Pose3]] = []
        self._search_at_m = 0.0

    def clear(self) -> None:
        """Begin anew: nothing is known."""
        self._stations.clear()
        self.members.clear()
        self._search_at_m = 0.0

    def due(self, pose: gtsam.Pose3) -> bool:
        """Whether a cloud at ``T_odom_base`` should be weighed."""
        return self._stations.due(pose)

    def add_station(self, view: CloudView, pose: gtsam.Pose3, carried: gtsam.Pose3 | None) -> None:
        """Carry all hypotheses to a cloud, weigh them by its news, and look for new ones.

        Parameters
        ----------
        pose
            ``T_odom_base``.
        carried
            ``T_map_base`` by dead reckoning from the last pose that was tracked; None where there is none.
        """
        dropped = self._stations.add(view, pose)
        station = self._stations.stations[-1]
        for member in self.members:
            del member.evidence[:dropped]
            self._settle(member, station, member.pose.compose(self._odometry_pose.between(pose)))
        self._odometry_pose = pose
        if len(self._stations.stations) == 1 and carried is not None:
            self._take_in(carried, self._config.carried_nats)
        if station.way_m >= self._search_at_m:
            self._search_at_m = station.way_m + self._config.search_every_m
            for found in self._matcher.search(view):
                self._take_in(found, 0.0)
        self._prune()

    def probabilities(self) -> FloatArray:
        """Posterior of each hypothesis; what is left to one is that of being nowhere in the map."""
        config = self._config
        totals = np.array([member.total(config.kidnap_nats) for member in self.members])
        return posterior(totals, config.nowhere_nats)

    def winner(self) -> Hypothesis[gtsam.Pose3] | None:
        """The hypothesis that is sure; None while there is none."""
        probabilities = self.probabilities()
        if not self.members or len(self._stations.stations) < self._least_stations:
            return None
        best = int(probabilities.argmax())
        return self.members[best] if probabilities[best] >= self._config.sure_probability else None

    def _settle(self, member: Hypothesis[gtsam.Pose3], station: CloudStation, predicted: gtsam.Pose3) -> None:
        """Align a hypothesis to the map near its predicted pose, and weigh the station's news."""
        member.pose, member.motion = predicted, None
        motion = self._matcher.align(station.view, predicted)
        if motion is not None:
            aligned = motion.T_reference_base
            assert isinstance(aligned, gtsam.Pose3)
            if is_correction(*_apart(predicted, aligned)):
                member.pose, member.motion = aligned, motion
        member.evidence.append(self._weighed(member.pose, station))

    def _weighed(self, pose: gtsam.Pose3, station: CloudStation) -> float:
        """What a station adds to the evidence for ``T_map_base``: in part it sees what others saw."""
        nats = self._new_share * self._matcher.weigh(pose, station.view)
        return min(max(nats, -_MOST_NATS), _MOST_NATS)

    def _take_in(self, pose: gtsam.Pose3, prior: float) -> None:
        """Weigh ``T_map_base`` at the newest station by all stations, unless it is known already."""
        *before, newest = self._stations.stations
        member = Hypothesis(pose, [], None, prior)
        self._settle(member, newest, pose)
        for other in self.members:
            if _same(member.pose, other.pose):
                other.prior = max(other.prior, prior)
                return
        way = [
            self._weighed(member.pose.compose(newest.pose.between(station.pose)), station)
            for station in before[-_BACK:]
        ]
        member.evidence = [*[0.0] * (len(before) - len(way)), *way, *member.evidence]
        self.members.append(member)

    def _prune(self) -> None:
        """Drop what is no longer worth carrying."""
        self.members = pruned(self.members, self._most, self._config.kidnap_nats, _same)


def _same(one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
    """Whether two poses are one place."""
    return is_same_place(*_apart(one, other))


def _apart(one: gtsam.Pose3, other: gtsam.Pose3) -> tuple[float, float]:
    """Metres and radians between two poses."""
    step = one.between(other)
    turned_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
    return float(np.linalg.norm(step.translation())), turned_rad
