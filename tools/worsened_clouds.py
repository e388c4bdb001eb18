"""Map real clouds of a 3D lidar in the hand after making them worse, and score them against their reference.

PYTHONPATH=. python tools/worsened_clouds.py FOLDER      a KITTI folder with its groundtruth.txt
"""

from __future__ import annotations

import dataclasses
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

import slam
from slam.config import load_config
from slam.datasets import open_dataset
from slam.datasets.dataset import Dataset
from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error
from slam.measurements import Float32Array, Measurement, PointCloud
from slam.storage.tum import read_tum

Points = Float32Array
RINGS, SEED = 64, 1
ON_ITS_SIDE = gtsam.Pose3(gtsam.Rot3.Roll(0.5 * np.pi), np.zeros(3))


def rings(points: Points, every: int) -> Points:
    """Every second ring, third and so on, of rings that lie evenly in elevation."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    low, high = np.percentile(elevation, [0.1, 99.9])
    ring = np.round((elevation - low) / (high - low) * (RINGS - 1)).astype(np.int64)
    return points[ring % every == 0]


def near(points: Points, range_m: float) -> Points:
    """Those within a range."""
    return points[np.linalg.norm(points, axis=1) < range_m]


def ahead(points: Points, view_rad: float) -> Points:
    """Those within a field of view."""
    return points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.5 * view_rad]


def noisy(points: Points, sigma_m: float, rng: np.random.Generator) -> Points:
    """With noise along the beams."""
    ranges_m = np.linalg.norm(points, axis=1, keepdims=True)
    return (points * (1.0 + rng.normal(0.0, sigma_m, ranges_m.shape) / ranges_m)).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class Kind:
    """What is done to a log: which of its clouds come, in which order, and what to each.

    ``anew`` spaces their stamps evenly.
    """

    name: str
    order: Callable[[int, np.random.Generator], Sequence[int]] = lambda count, _: range(count)
    points: Callable[[Points, np.random.Generator], Points] = lambda points, _: points
    turned: gtsam.Pose3 = dataclasses.field(default_factory=gtsam.Pose3)
    anew: bool = False


def without(count: int, lost: int) -> list[int]:
    """Clouds without some in the middle."""
    return [n for n in range(count) if not count // 2 <= n < count // 2 + lost]


KINDS = (
    Kind("as recorded"),
    Kind("backward", lambda count, _: range(count)[::-1], anew=True),
    Kind("there and back", lambda count, _: [*range(count), *range(count)[::-1]], anew=True),
    Kind("the lidar on its side", turned=ON_ITS_SIDE),
    Kind("four clouds lost", lambda count, _: without(count, 4)),
    Kind("every second cloud", lambda count, _: range(0, count, 2)),
    Kind(
        "two of three, by chance", lambda count, rng: sorted(rng.choice(count, 2 * count // 3, replace=False))
    ),
    Kind("every second ring", points=lambda points, _: rings(points, 2)),
    Kind("every fourth ring", points=lambda points, _: rings(points, 4)),
    Kind("120 degrees of view", points=lambda points, _: ahead(points, np.radians(120.0))),
    Kind("every thirtieth point", points=lambda points, rng: points[rng.random(len(points)) < 1 / 30]),
    Kind("3 cm of range noise", points=lambda points, rng: noisy(points, 0.03, rng)),
    Kind("range cut to 15 m", points=lambda points, _: near(points, 15.0)),
    Kind("range cut to 8 m", points=lambda points, _: near(points, 8.0)),
)


class Worse:
    """A log of clouds, made worse."""

    def __init__(self, log: Dataset, kind: Kind, truth: Trajectory) -> None:
        clouds = [one for one in log if isinstance(one, PointCloud)]
        rng = np.random.default_rng(SEED)
        self.name, self.path, self.report = log.name, Path(log.path), log.report
        self._kind, self._rng = kind, rng
        self._clouds = [clouds[n] for n in kind.order(len(clouds), rng)]
        told_s = np.array([cloud.stamp_s for cloud in self._clouds])
        step_s = float(np.median(np.diff([cloud.stamp_s for cloud in clouds])))
        self._stamps_s = told_s[0] + step_s * np.arange(len(told_s)) if kind.anew else told_s
        rows = np.abs(truth.stamps_s[:, None] - told_s).argmin(axis=0)
        turns = Rotation.from_quat(truth.quaternions_xyzw[rows])
        turned = turns * Rotation.from_matrix(kind.turned.rotation().matrix()).inv()
        self._truth = Trajectory(self._stamps_s, truth.positions_m[rows], turned.as_quat())

    def __iter__(self) -> Iterator[Measurement]:
        """The clouds."""
        for stamp_s, cloud in zip(self._stamps_s, self._clouds, strict=True):
            points = self._kind.points(cloud.points_lidar, self._rng)
            turned = self._kind.turned.transformFrom(points.T.astype(np.float64)).T.astype(np.float32)
            yield PointCloud(float(stamp_s), turned)

    def groundtruth(self) -> Trajectory:
        """Where each cloud was."""
        return self._truth


def main() -> None:
    """Map each kind and print a row."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", action="append", choices=[kind.name for kind in KINDS])
    arguments = parser.parse_args()
    truth = read_tum(arguments.folder / "groundtruth.txt")
    print("| | ATE, m | worst | says |\n|---|---|---|---|", flush=True)
    for kind in KINDS:
        if arguments.kind and kind.name not in arguments.kind:
            continue
        log = Worse(open_dataset(arguments.folder), kind, truth)
        made = slam.map_log(log, config=load_config(None, []))
        error = absolute_error(made.trajectory, log.groundtruth()).translation_m
        print(
            f"| {kind.name} | {error.rmse:.3f} | {error.max:.2f} | {'; '.join(made.warnings)} |", flush=True
        )
        made.close()


if __name__ == "__main__":
    main()
