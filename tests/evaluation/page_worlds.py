"""Small finished maps whose every name is hostile: a room seen on two rounds, loops, images, a cloud."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from flat_worlds import room, sweep

from slam.config import Config
from slam.datasets import ReadReport
from slam.estimates import MotionEstimate, Trajectory
from slam.evaluation.map_report import Beside, ReportData, RunCost
from slam.graph.edge import Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import CameraRecord, ScanRecord
from slam.mapping.dense_map import ColoredCloud
from slam.mapping.layered_map import DEPTH, OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import CameraIntrinsics, FloatArray, RgbdFrame, pose2_from_row
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.map_frames import FrameHead

EVIL = '</script><script>window.harmed = 1</script>"><img src=x onerror="window.harmed = 1">\x1b[31mred\u202e'
LENS = CameraIntrinsics(50.0, 50.0, 32.0, 24.0, 64, 48)
_A_ROUND = 30


@dataclass
class Frames:
    """Camera keyframes that lie in no file."""

    nodes: list[int]

    def __len__(self) -> int:
        return len(self.nodes)

    def head(self, index: int) -> FrameHead:
        node = self.nodes[index]
        return FrameHead(node, float(node), EVIL, 1000.0, LENS, gtsam.Pose3())

    def frame(self, index: int) -> RgbdFrame:
        color = np.full((LENS.height, LENS.width, 3), 3 * self.nodes[index] % 255, np.uint8)
        depth = np.ones((LENS.height, LENS.width), np.float32)
        return RgbdFrame(float(self.nodes[index]), color, depth, LENS, gtsam.Pose3(), EVIL)


def way(rounds: int = 2) -> FloatArray:
    """(K, 3) round the room, twice."""
    turn = 2.0 * np.pi / _A_ROUND * np.arange(_A_ROUND * rounds)
    return np.column_stack([1.5 * np.cos(turn), 1.2 * np.sin(turn), turn + np.pi / 2])


def grid(shift: int = 0) -> OccupancyGrid:
    """The room in cells of 10 cm; the depth layer sees a table more."""
    odds = np.zeros((80, 80), np.float32)
    odds[11:69, 11:69], odds[10, 10:70], odds[69, 10:70], odds[10:70, 10], odds[10:70, 69] = -4, 4, 4, 4, 4
    odds[30 : 30 + shift, 30 : 30 + shift] = 4.0
    return OccupancyGrid.of_log_odds(odds, 0.1, gtsam.Pose2(-4.0, -4.0, 0.0))


def contents(rounds: int = 2, **changes: Any) -> MapContents:
    """The map."""
    poses = [pose2_from_row(row) for row in way(rounds)]
    count = len(poses)
    scans = [sweep(room(), row, beams=121, stamp_s=float(key)) for key, row in enumerate(way(rounds))]
    repaired = [
        replace(scan, ranges_m=np.where(np.arange(scan.ranges_m.size) < 5, np.float32(1.0), scan.ranges_m))
        for scan in scans
    ]
    steps, loops = np.diag([0.01, 0.01, 0.005]) ** 2, np.diag([0.02, 0.02, 0.01]) ** 2
    factors = [
        SavedFactor(Edge(k, k + 1, poses[k].between(poses[k + 1]), steps, EVIL, trusted=True), kept=True)
        for k in range(count - 1)
    ]
    factors.append(
        SavedFactor(Edge(0, 1, gtsam.Pose2(1, 0, 0), steps, EdgeKind.WHEEL, trusted=False), kept=False)
    )
    found = list[LoopCandidate]()
    for k in range(_A_ROUND, count, 3):
        good = k % 2 == 0
        motion = MotionEstimate(
            poses[k - _A_ROUND].between(poses[k]), loops, 0.9, 0.8, 0.01, True, False, np.zeros(3)
        )
        found.append(
            LoopCandidate(
                k - _A_ROUND,
                k,
                1.0,
                0.3,
                0.8,
                motion if k % 4 else None,
                good and k % 4 != 0,
                "" if good and k % 4 else EVIL,
            )
        )
    for number, loop in enumerate(found):
        if loop.accepted:
            factors.append(SavedFactor(loop.edge(number), kept=True))
    stamps_s = np.arange(count, dtype=np.float64)
    covariances = np.repeat([np.diag([0.02, 0.03, 0.01]) ** 2], count, axis=0) * (
        1.0 + stamps_s[:, None, None]
    )
    made = MapContents(
        node_poses=poses,
        stamps_s=stamps_s,
        readings=np.arange(count),
        trajectory=Trajectory.from_planar(stamps_s, way(rounds)),
        factors=factors,
        loops=found,
        measured_scans=scans,
        keyframe_scans=repaired,
        grids={OCCUPANCY: grid(), DEPTH: grid(8)},
        frames=Frames(list(range(0, count, 5))),  # type: ignore[arg-type]
        covariances=covariances,
    )
    return replace(made, **changes)


def cloud() -> ColoredCloud:
    """Two walls and a floor, the brighter the farther along x."""
    steps = np.linspace(-3.0, 3.0, 40)
    u, v = (one.ravel() for one in np.meshgrid(steps, steps))
    parts = [
        np.column_stack([u, v, 0 * u]),
        np.column_stack([u, 0 * u + 3, v + 3]),
        np.column_stack([0 * u + 3, u, v + 3]),
    ]
    points = np.vstack(parts).astype(np.float32)
    colors = np.repeat(np.array([[120, 90, 60], [60, 120, 200], [60, 200, 120]], np.uint8), len(u), axis=0)
    normals = np.repeat(np.array([[0, 0, 1], [0, -1, 0], [-1, 0, 0]], np.float32), len(u), axis=0)
    return ColoredCloud(points, colors, normals, points[:, 0] + 3.0)


def report(found: MapContents | None = None, beside: Beside | None = None) -> ReportData:
    """Of the map, with every name hostile."""
    made = found or contents()
    stamps_s = made.trajectory.stamps_s
    wave = 0.5 + 0.4 * np.sin(0.3 * stamps_s)
    record = ScanRecord(
        stamps_s, 0.002 + 0.001 * wave, wave, 0.01 * wave, (wave > 0.85).astype(float), wave, 100 * wave, wave
    )
    reading = ReadReport()
    reading.note(EVIL, 3)
    result = MapResult(
        made,
        record,
        {EVIL: 1.0, "map": 2.0},
        [EVIL],
        [EVIL],
        cameras={EVIL: CameraRecord(record)},
    )
    return ReportData(
        EVIL, reading, result, Config(), RunCost(4.0, 3.0), beside or Beside(cloud=cloud()), digest="0" * 64
    )
