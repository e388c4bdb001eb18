"""Hand-eye calibration: pose of a camera on a robot from paired motions, some of which are outliers.

``T_base X = X T_camera`` for every pair of motions (Tsai 1989), solved for X = ``T_base_camera`` by
Gauss-Newton on all pairs at once. Twists are in GTSAM's order, rotation first, perturbations on the right.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST, ROUNDS, gate
from slam.measurements import BoolArray, FloatArray

# Typical distance of a camera from the base, only for the weights of the search.
_SEARCH_LEVER_M = 0.3
_LONGEST_TURN_RAD = 0.6
_LONGEST_SHIFT_M = 1.0
# No sensor is ten times better than its stated noise: keeps a perfect simulation solvable.
_LEAST_SCALE = 0.1


@dataclass(frozen=True, slots=True)
class Motions:
    """Paired motions of base and camera.

    Attributes
    ----------
    R_base, R_camera
        (N, 3, 3) rotations of the steps, each in the frame where its step starts.
    t_base, t_camera
        (N, 3) their translations, metres.
    covariance_base, covariance_camera
        (N, 6, 6) each in the frame where its step ends.
    """

    R_base: FloatArray
    t_base: FloatArray
    covariance_base: FloatArray
    R_camera: FloatArray
    t_camera: FloatArray
    covariance_camera: FloatArray

    def significant(self) -> tuple[BoolArray, BoolArray]:
        """Which base steps turn, and which move, by more than their noise; (N,) each."""
        variances = np.diagonal(self.covariance_base, axis1=1, axis2=2)
        angles = np.linalg.norm(_rotation_vectors(self.R_base), axis=1)
        lengths = np.linalg.norm(self.t_base, axis=1)
        # A motion that may be noise must not count as excitation.
        sigmas = math.sqrt(gate())
        turning: BoolArray = angles > sigmas * np.sqrt(variances[:, :3].max(axis=1))
        moving: BoolArray = lengths > sigmas * np.sqrt(variances[:, 3:].max(axis=1))
        return turning, moving


@dataclass(frozen=True, slots=True)
class Fit:
    """A mounting and the residuals of the pairs.

    Attributes
    ----------
    R, t
        Rotation (3, 3) and translation (3,) of ``T_base_camera``.
    information
        (6, 6) in the camera's frame, from significant motions of the inliers; zero if nothing is reported.
    errors
        (N, 6) predicted minus measured camera motion.
    inliers
        (N,) pairs within the gate.
    scale
        Measured noise over stated noise, standard deviations, from the inliers.
    last_step
        (6,) last twist of the iteration, camera frame; small if it converged.
    """

    R: FloatArray
    t: FloatArray
    information: FloatArray
    errors: FloatArray
    inliers: BoolArray
    scale: float
    last_step: FloatArray


def linearise(motions: Motions, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return errors and Jacobians for one mounting or many.

    Parameters
    ----------
    R, t
        (..., 3, 3) and (..., 3).

    Returns
    -------
    (..., N, 6) rotation vector and shift from the measured camera step to the predicted one, and
    (..., N, 6, 6) by the twist of the mount, to first order in the errors; of a motion within its noise zero.
    """
    turning, moving = motions.significant()
    back = np.swapaxes(R, -1, -2)[..., None, :, :]
    # The camera step that the base step predicts: inverse(X) T_base X.
    R_step = back @ motions.R_base @ R[..., None, :, :]
    shifted = np.einsum("nij,...j->...ni", motions.R_base, t) + motions.t_base - t[..., None, :]
    t_step = np.einsum("...ij,...nj->...ni", back[..., 0, :, :], shifted)
    to_camera = np.swapaxes(motions.R_camera, -1, -2)
    turns = to_camera @ R_step
    errors = np.empty((*t_step.shape[:-1], 6))
    errors[..., :3] = _rotation_vectors(turns.reshape(-1, 3, 3)).reshape(t_step.shape)
    errors[..., 3:] = np.einsum("nij,...nj->...ni", to_camera, t_step - motions.t_camera)
    jacobians = np.zeros((*t_step.shape[:-1], 6, 6))
    excitation = np.where(turning[:, None, None], R_step - np.eye(3), 0.0)
    jacobians[..., :3, :3] = -np.swapaxes(excitation, -1, -2)
    jacobians[..., 3:, :3] = to_camera @ np.where((moving | turning)[:, None, None], _cross(t_step), 0.0)
    jacobians[..., 3:, 3:] = to_camera @ excitation
    return errors, jacobians


def covariances(motions: Motions, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return (N, 6, 6) covariances of the errors: the camera's, plus the base's in the camera frame."""
    back = np.zeros((6, 6))
    back[:3, :3] = back[3:, 3:] = R.T
    back[3:, :3] = -R.T @ _cross(t)
    return motions.covariance_camera + back @ motions.covariance_base @ back.T


def search(motions: Motions, R_start: FloatArray, t_start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find a rough mounting by Gauss-Newton from the start and from all right-angled mountings at once.

    Outliers distort it, and ``refine`` rejects them: annealing here as well changed no result. Each pair has
    one variance for rotation and one for translation, so that the noise of the lever arm favours no mounting.

    Returns
    -------
    Rotation (3, 3) and translation (3,).
    """
    R, t = _seeds(R_start, t_start)
    weights = _search_weights(motions)
    for _ in range(ROUNDS):
        errors, jacobians = linearise(motions, R, t)
        weighted = jacobians * weights[..., None]
        information = np.einsum("snki,snkj->sij", weighted, jacobians)
        R, t, _ = _moved(R, t, information, np.einsum("snki,snk->si", weighted, errors))
    errors, _ = linearise(motions, R, t)
    cost = np.minimum(np.einsum("snk,nk->sn", errors**2, weights), gate(6)).sum(axis=1)
    # Among seeds that cost little more than the best, the first is used.
    best = int(np.flatnonzero(cost <= cost.min() + gate())[0])
    return R[best], t[best]


def refine(motions: Motions, R: FloatArray, t: FloatArray) -> Fit:
    """Refine a rough mounting by Gauss-Newton with the full covariances and the Geman-McClure loss.

    The median of the residuals sets the width of the loss: wide at a bad start, narrow at the end, as in the
    schedule of graduated non-convexity (Yang 2020, Sec. IV).
    """
    limit = gate(6, 0.99)
    step = np.full(6, np.inf)
    for _ in range(ROUNDS):
        errors, jacobians = linearise(motions, R, t)
        precisions = np.linalg.inv(covariances(motions, R, t))
        distances = np.einsum("ni,nij,nj->n", errors, precisions, errors)
        # The stated noise may be too small; the median shows it.
        spread = max(float(np.median(distances)) / gate(6, 0.5), 1.0)
        bend = spread * limit
        weighted = np.einsum("n,nki,nkl->nil", (bend / (distances + bend)) ** 2, jacobians, precisions)
        information = np.einsum("nil,nlj->ij", weighted, jacobians)
        gradient = np.einsum("nil,nl->i", weighted, errors)
        R_new, t_new, steps = _moved(R[None], t[None], information[None], gradient[None])
        R, t, step = R_new[0], t_new[0], steps[0]
        if np.abs(step).max() < 1e-6:
            break
    errors, jacobians = linearise(motions, R, t)
    precisions = np.linalg.inv(covariances(motions, R, t))
    distances = np.einsum("ni,nij,nj->n", errors, precisions, errors)
    inliers = distances < bend
    left_over = max(6 * int(inliers.sum()) - 6, 1)
    scale = float(np.sqrt(distances[inliers].sum() / left_over))
    # Few pairs determine their own noise poorly.
    least = _LEAST_SCALE if inliers.sum() >= FEWEST else 1.0
    return Fit(
        R=R,
        t=t,
        information=np.einsum("nki,nkl,nlj->ij", jacobians[inliers], precisions[inliers], jacobians[inliers]),
        errors=errors,
        inliers=inliers,
        scale=max(scale, least),
        last_step=step,
    )


def _seeds(R_start: FloatArray, t_start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the given start, then the 24 right-angled mountings."""
    mounts = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            mount = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(mount) > 0.0:
                mounts.append(mount)
    R, t = np.array([R_start, *mounts]), np.zeros((len(mounts) + 1, 3))
    t[0] = t_start
    return R, t


def _search_weights(motions: Motions) -> FloatArray:
    """Return (N, 6) inverse variances that do not depend on the mounting."""
    camera = np.diagonal(motions.covariance_camera, axis1=1, axis2=2)
    base = np.diagonal(motions.covariance_base, axis1=1, axis2=2)
    turn = camera[:, :3].max(axis=1) + base[:, :3].max(axis=1)
    shift = camera[:, 3:].max(axis=1) + base[:, 3:].max(axis=1) + _SEARCH_LEVER_M**2 * base[:, :3].max(axis=1)
    return 1.0 / np.column_stack([turn, turn, turn, shift, shift, shift])


def _moved(
    R: FloatArray, t: FloatArray, information: FloatArray, gradient: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return every mounting after one damped step, and its twist; undetermined directions do not move."""
    damping = 1e-6 * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-9
    step = -np.linalg.solve(information + damping * np.eye(6), gradient[:, :, None])[:, :, 0]
    for part, longest in ((slice(0, 3), _LONGEST_TURN_RAD), (slice(3, 6), _LONGEST_SHIFT_M)):
        length = np.linalg.norm(step[:, part], axis=1, keepdims=True)
        step[:, part] *= longest / np.maximum(length, longest)
    t = t + np.einsum("sij,sj->si", R, step[:, 3:])
    from scipy.spatial.transform import Rotation

    return R @ Rotation.from_rotvec(step[:, :3]).as_matrix(), t, step


# SciPy takes 0.1 s to load, and most runs need no mounting estimate.
def _rotation_vectors(matrices: FloatArray) -> FloatArray:
    """Return (N, 3) rotation vectors of rotations (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_rotvec())


def _cross(vectors: FloatArray) -> FloatArray:
    """Return (..., 3, 3) the cross product matrix of each vector."""
    return np.cross(np.eye(3), vectors[..., None, :])
