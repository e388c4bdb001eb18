"""Which of many claims about places agree with each other: pairwise consistency, in sets.

Mangelson, Dominic, Eustice and Vasudevan, "Pairwise consistent measurement set maximization for robust
multi-robot map merging", ICRA 2018. Two claims are consistent where the cycle through both and the chain between
their ends closes within its covariance, Eq. (7). The largest set of claims that are all consistent is a maximum
clique; it is found greedily here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.matching.motion import Motion
from slam.matching.planar import adjoint, between, compose, rotate_covariance
from slam.measurements import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Claim:
    """Somebody says where a keyframe is, seen from a place.

    Attributes
    ----------
    place, keyframe
        Node numbers.
    motion
        Pose of the keyframe in the frame of the place; its covariance in the frame of the keyframe.
    """

    place: int
    keyframe: int
    motion: Motion


def consistent(one: Claim, other: Claim, of_places: Motion, of_keyframes: Motion) -> bool:
    """Whether the cycle of two claims and two pieces of the chain closes.

    Parameters
    ----------
    of_places, of_keyframes
        What the chain says of the way from the place of the one claim to that of the other, and likewise of
        their keyframes; covariances at the end of the way.
    """
    first = compose(one.motion.pose, of_keyframes.pose)
    second = compose(of_places.pose, other.motion.pose)
    back = [adjoint(between(pose, np.zeros(3))) for pose in (of_keyframes.pose, other.motion.pose)]
    covariance = rotate_covariance(back[0], one.motion.covariance) + of_keyframes.covariance
    covariance = covariance + rotate_covariance(back[1], of_places.covariance) + other.motion.covariance
    return Motion(first, covariance).holds(second)


def largest_sets(agree: BoolArray) -> list[list[int]]:
    """Disjoint sets of claims that all agree, the largest first; (n, n) symmetric.

    Each begins with the claim that most others agree with, and takes those in the order of how many of the
    rest they agree with.
    """
    left = np.ones(len(agree), np.bool_)
    np.fill_diagonal(agree := agree.copy(), False)
    sets = []
    while left.any():
        counts = np.where(left, (agree & left).sum(axis=1), -1)
        members = [int(counts.argmax())]
        open_to = agree[members[0]] & left
        while open_to.any():
            inner = np.where(open_to, (agree & open_to).sum(axis=1), -1)
            members.append(int(inner.argmax()))
            open_to &= agree[members[-1]]
        left[members] = False
        sets.append(sorted(members))
    return sorted(sets, key=len, reverse=True)
