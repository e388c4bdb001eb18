"""Where a robot with a 3D lidar may be: poses carried with the odometry, weighed by all that was seen."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.cloud_match import CloudMatcher, CloudView
from slam.localization.cloud_stations import CloudStation, CloudStations
from slam.localization.evidence import posterior, way_nats
from slam.measurements import FloatArray, MotionEstimate

# An alignment may correct a hypothesis by so much a station; what moves farther is another place.
_GREATEST_CORRECTION_M = 0.3
_GREATEST_CORRECTION_RAD = 0.15
# Hypotheses nearer than this are one.
_SAME_M, _SAME_RAD = 0.3, 0.15
# One station counts for so many nats at most: somebody may stand before the lidar.
_MOST_NATS = 4.0
# What is newly found is weighed by so many earlier stations: those before cost time, and drift bends the way.
_BACK = 5
# A hypothesis this much worse than the best is dropped, in nats.
_HOPELESS_NATS = 15.0


@dataclass(slots=True)
class CloudHypothesis:
    """A pose that may be the robot's.

    Attributes
    ----------
    pose
        ``T_map_base`` at the newest station.
    evidence
        Nats by station, oldest first, as many as there are stations.
    motion
        The alignment of the newest station; None where there was nothing to align to.
    prior
        Nats in favour before anything was seen.
    """

    pose: gtsam.Pose3
    evidence: list[float]
    motion: MotionEstimate | None
    prior: float = 0.0


class CloudHypotheses:
    """All hypotheses, and how likely each is."""

    def __init__(self, matcher: CloudMatcher, config: Config) -> None:
        self._matcher = matcher
        self._config, self._stations = config.localization, CloudStations(config.localization)
        settings = config.cloud_localization
        self._least_stations, self._most = settings.least_stations, settings.hypotheses
        self._new_share = settings.new_share
        self._odometry_pose = gtsam.Pose3()
        self.members: list[CloudHypothesis] = []
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
        return posterior(
            np.array([self._total(member) for member in self.members]), self._config.nowhere_nats
        )

    def winner(self) -> CloudHypothesis | None:
        """The hypothesis that is sure; None while there is none."""
        probabilities = self.probabilities()
        if not self.members or len(self._stations.stations) < self._least_stations:
            return None
        best = int(probabilities.argmax())
        return self.members[best] if probabilities[best] >= self._config.sure_probability else None

    def _total(self, member: CloudHypothesis) -> float:
        """All evidence for a hypothesis, nats."""
        return member.prior + way_nats(member.evidence, self._config.kidnap_nats)

    def _settle(self, member: CloudHypothesis, station: CloudStation, predicted: gtsam.Pose3) -> None:
        """Align a hypothesis to the map near its predicted pose, and weigh the station's news."""
        member.pose, member.motion = predicted, None
        motion = self._matcher.align(station.view, predicted)
        if motion is not None:
            aligned = motion.T_reference_base
            assert isinstance(aligned, gtsam.Pose3)
            if _near(predicted, aligned, _GREATEST_CORRECTION_M, _GREATEST_CORRECTION_RAD):
                member.pose, member.motion = aligned, motion
        member.evidence.append(self._weighed(member.pose, station))

    def _weighed(self, pose: gtsam.Pose3, station: CloudStation) -> float:
        """What a station adds to the evidence for ``T_map_base``: in part it sees what others saw."""
        nats = self._new_share * self._matcher.weigh(pose, station.view)
        return min(max(nats, -_MOST_NATS), _MOST_NATS)

    def _take_in(self, pose: gtsam.Pose3, prior: float) -> None:
        """Weigh ``T_map_base`` at the newest station by all stations, unless it is known already."""
        *before, newest = self._stations.stations
        member = CloudHypothesis(pose, [], None, prior)
        self._settle(member, newest, pose)
        for other in self.members:
            if _near(member.pose, other.pose, _SAME_M, _SAME_RAD):
                other.prior = max(other.prior, prior)
                return
        way = [
            self._weighed(member.pose.compose(newest.pose.between(station.pose)), station)
            for station in before[-_BACK:]
        ]
        member.evidence = [*[0.0] * (len(before) - len(way)), *way, *member.evidence]
        self.members.append(member)

    def _prune(self) -> None:
        """Drop what has become another's double, is hopeless, or is beyond the number that is carried."""
        totals = [self._total(member) for member in self.members]
        kept: list[CloudHypothesis] = []
        for n in sorted(range(len(totals)), key=lambda n: -totals[n]):
            if len(kept) == self._most or totals[n] < max(totals) - _HOPELESS_NATS:
                break
            if not any(_near(self.members[n].pose, other.pose, _SAME_M, _SAME_RAD) for other in kept):
                kept.append(self.members[n])
        self.members = kept


def _near(one: gtsam.Pose3, other: gtsam.Pose3, way_m: float, turn_rad: float) -> bool:
    """Whether two poses are no farther apart."""
    step = one.between(other)
    turned = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
    return float(np.linalg.norm(step.translation())) < way_m and turned < turn_rad
