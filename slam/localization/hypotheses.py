"""Pose hypotheses of the robot: they move with the odometry, and all readings weight them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic

import numpy as np

from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.poses import Measured, as_place, mixture, same_place, separation, squared_mahalanobis
from slam.localization.sensor import Keyframe, N, Sensor, V
from slam.measurements import FloatArray, Pose, composed, motion_between


@dataclass(slots=True)
class Hypothesis:
    """A possible pose of the robot.

    Attributes
    ----------
    pose
        ``T_map_base`` at the newest keyframe.
    evidence
        Nats per keyframe, oldest first, one for each keyframe.
    motion
        The alignment of the newest keyframe; None if there was nothing to align to.
    prior
        Prior evidence in nats.
    """

    pose: Pose
    evidence: list[float]
    motion: MotionEstimate | None
    prior: float = 0.0

    @property
    def determined(self) -> bool:
        """Return whether it was aligned in all directions."""
        return self.motion is not None and not self.motion.degenerate

    @property
    def measured(self) -> Measured:
        """Return the aligned pose; if not aligned in all directions, with three sigmas of one place."""
        if self.motion is not None and self.determined:
            return Measured(self.pose, self.motion.covariance)
        return as_place(self.pose)

    def total(self, kidnap_nats: float) -> float:
        """Return the evidence of the path, or only of its end if the robot was kidnapped in between."""
        total = best = 0.0
        for nats in reversed(self.evidence):
            total += nats
            best = max(best, total)
        return self.prior + max(total, best - kidnap_nats)


def correction(
    sensor: Sensor[V, N], view: V, expected: Pose, config: LocalizationConfig
) -> MotionEstimate | None:
    """Align near an expected pose; return None with too few inliers, or if it found another place."""
    motion = sensor.align(view, expected)
    if motion is None or motion.inlier_share < config.least_inlier_share:
        return None
    return motion if same_place(expected, motion.T_reference_base) else None


class KeyframeLog(Generic[V, N]):
    """The localisation keyframes of the last stretch of the path, in the odometry frame."""

    def __init__(self, sensor: Sensor[V, N], window_m: float) -> None:
        self._sensor, self._window_m = sensor, window_m
        self.keyframes: list[Keyframe[N]] = []

    def due(self, view: V, pose: Pose) -> bool:
        """Return whether a reading at ``T_odom_base`` should be weighted."""
        return self._sensor.sees_new(view, self.keyframes[-1].pose if self.keyframes else None, pose)

    def add(self, view: V, pose: Pose) -> int:
        """Add a reading at ``T_odom_base`` as a keyframe; return how many of the oldest were dropped."""
        travelled_m = 0.0
        if self.keyframes:
            newest = self.keyframes[-1]
            travelled_m = newest.travelled_m + separation(newest.pose, pose)[0]
        kept = [earlier for earlier in self.keyframes if travelled_m - earlier.travelled_m <= self._window_m]
        dropped = len(self.keyframes) - len(kept)
        self.keyframes = [*kept, Keyframe(pose, travelled_m, self._sensor.novel(view, pose, kept))]
        return dropped


class HypothesisSet(Generic[V, N]):
    """All hypotheses with their probabilities."""

    def __init__(self, sensor: Sensor[V, N], config: LocalizationConfig) -> None:
        self._sensor, self._config = sensor, config
        self._log = KeyframeLog(sensor, config.window_m)
        self._view: V | None = None
        self.members: list[Hypothesis] = []
        self._search: tuple[Iterator[Pose | None], Pose] | None = None
        self._search_at_m = 0.0
        self._reachable: Measured | None = None
        self._led_nats = 0.0

    def clear(self) -> None:
        """Remove all hypotheses: nothing is known."""
        self._log.keyframes.clear()
        self.members.clear()
        self._search, self._search_at_m = None, 0.0

    def due(self, view: V, pose: Pose) -> bool:
        """Return whether a reading at ``T_odom_base`` should be weighted."""
        return self._log.due(view, pose)

    def add_keyframe(
        self, view: V, pose: Pose, dead_reckoned: Measured | None, *, bound: bool = False
    ) -> None:
        """Move all hypotheses to a reading, weight them by its new part, and search for new hypotheses.

        Parameters
        ----------
        pose
            ``T_odom_base``.
        dead_reckoned
            ``T_map_base`` by odometry from the last tracked pose; None if there is none.
        bound
            Whether the robot must be there, within the covariance; otherwise any place is as likely.
        """
        self._reachable = dead_reckoned if bound else None
        last = self._log.keyframes[-1].pose if self._log.keyframes else None
        dropped = self._log.add(view, pose)
        newest, self._view = self._log.keyframes[-1], view
        if dead_reckoned is not None:
            self._led_nats = self._weighed(dead_reckoned.pose, newest.novel, None)
        if last is not None:
            step = motion_between(last, pose)
            for member in self.members:
                del member.evidence[:dropped]
                self._settle(member, composed(member.pose, step))
        elif dead_reckoned is not None and not bound:
            self._take_in(dead_reckoned.pose, self._config.nowhere_nats)
        if self._search is None and newest.travelled_m >= self._search_at_m:
            self._search_at_m = newest.travelled_m + self._sensor.search_every_m
            self._search = iter(self._sensor.propose(view, self._log.keyframes, self._reachable)), pose
        self.seek()
        self._prune()

    @property
    def seeking(self) -> bool:
        """Return whether a search is running."""
        return self._search is not None

    def seek(self) -> None:
        """Continue the running search, by as much as one reading may cost."""
        if self._search is None:
            return
        search, searched_at = self._search
        for proposal in search:
            if proposal is None:
                break
            self._take_in(composed(proposal, motion_between(searched_at, self._log.keyframes[-1].pose)), 0.0)
        else:
            self._search = None
            self._prune()

    def propose(self, pose: Pose, odometry_pose: Pose) -> None:
        """Add ``T_map_base`` that another sensor has found, with ``T_odom_base`` at that time."""
        if self._log.keyframes:
            step = motion_between(odometry_pose, self._log.keyframes[-1].pose)
            self._take_in(composed(pose, step), self._config.nowhere_nats)
            self._prune()

    @property
    def newest_nats(self) -> float:
        """Return the newest keyframe's evidence for its best pose, nats, including outside the map."""
        return max([self._led_nats, *(member.evidence[-1] for member in self.members)])

    def probabilities(self) -> FloatArray:
        """Return the posterior of each hypothesis; the rest to one is that of being outside the map."""
        totals = np.array([self._total(member) for member in self.members])
        nowhere_nats = self._config.nowhere_nats
        greatest = max(nowhere_nats, totals.max(initial=-math.inf))
        weights = np.exp(totals - greatest)
        return np.asarray(weights / (weights.sum() + math.exp(nowhere_nats - greatest)))

    def winner(self) -> Hypothesis | None:
        """Return the confident hypothesis; None if there is none, or a running search may find a rival."""
        probabilities = self.probabilities()
        if (
            not self.members
            or self._search is not None
            or len(self._log.keyframes) < self._sensor.least_keyframes
        ):
            return None
        best = int(probabilities.argmax())
        return self.members[best] if probabilities[best] >= self._config.confident_probability else None

    def together(self) -> Measured | None:
        """Combine all hypotheses that dead reckoning connects, if no others are likely.

        Along a corridor they are in a row; if there are too many for the set, they give no pose.
        """
        probabilities = self.probabilities()
        crowded = len(self.members) == self._config.hypotheses
        if (
            self._reachable is None
            or self._search is not None
            or crowded
            or probabilities.sum() < self._config.confident_probability
        ):
            return None
        poses = [member.measured for member in self.members]
        return mixture(self._reachable.pose, poses, probabilities / probabilities.sum())

    def _total(self, member: Hypothesis) -> float:
        """Return the evidence for a hypothesis, with its distance to dead reckoning, limited by surprise."""
        nats = member.total(self._config.nowhere_nats)
        if self._reachable is None:
            return nats
        return nats + self._config.nowhere_nats - 0.5 * self._squares(member.pose)

    def _squares(self, pose: Pose) -> float:
        """Return the squared Mahalanobis distance of a place from dead reckoning; 0 without it."""
        if self._reachable is None:
            return 0.0
        return squared_mahalanobis(self._reachable, as_place(pose))

    def _settle(self, member: Hypothesis, predicted: Pose) -> None:
        """Align a hypothesis to the map near its predicted pose, and weight it by the new part."""
        assert self._view is not None
        member.motion = correction(self._sensor, self._view, predicted, self._config)
        member.pose = predicted if member.motion is None else member.motion.T_reference_base
        novel = self._log.keyframes[-1].novel
        member.evidence.append(self._weighed(member.pose, novel, member.motion))

    def _weighed(self, pose: Pose, novel: N, motion: MotionEstimate | None) -> float:
        """Return a keyframe's evidence for a pose, nats: alone it drops no pose if several must agree."""
        most = self._config.lost_nats / self._sensor.least_keyframes
        return min(max(self._sensor.weigh(pose, novel, motion), -most), most)

    def _take_in(self, pose: Pose, prior: float) -> None:
        """Add a pose at the newest keyframe and weight it by all keyframes, unless it is known already."""
        *before, newest = self._log.keyframes
        member = Hypothesis(pose, [], None, prior)
        self._settle(member, pose)
        if self._squares(member.pose) > self._config.gate_sigmas**2:
            return
        for other in self.members:
            if same_place(member.pose, other.pose):
                other.prior = max(other.prior, prior)
                return
        path = [0.0] * len(before)
        for n in range(max(len(before) - self._sensor.weighs_back, 0), len(before)):
            at = composed(member.pose, motion_between(newest.pose, before[n].pose))
            path[n] = self._weighed(at, before[n].novel, None)
        member.evidence = path + member.evidence
        self.members.append(member)

    def _prune(self) -> None:
        """Keep the most likely hypotheses, without duplicates, hopeless ones, and those above the limit."""
        gate = self._config.gate_sigmas**2
        self.members = [member for member in self.members if self._squares(member.pose) <= gate]
        totals = [self._total(member) for member in self.members]
        kept: list[Hypothesis] = []
        for n in sorted(range(len(totals)), key=lambda n: -totals[n]):
            if len(kept) == self._config.hypotheses or totals[n] < max(totals) - self._config.lost_nats:
                break
            if not any(same_place(self.members[n].pose, other.pose) for other in kept):
                kept.append(self.members[n])
        self.members = kept
