"""Keyframes with their optimised poses, checked before they are used in a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import gtsam
import numpy as np

from slam.errors import ScanweaveError
from slam.measurements import RgbdFrame


def posed_frames(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3]
) -> Iterator[tuple[RgbdFrame, gtsam.Pose3]]:
    """Yield (frame, T_map_camera) pairs; ``poses`` are T_map_camera in the order of the frames.

    Raises
    ------
    ScanweaveError
        Before the first pair, if a pose is not finite.
    """
    refuse_lost(poses)
    yield from zip(frames, poses, strict=True)


def refuse_lost(poses: Sequence[gtsam.Pose3]) -> None:
    """Raise a `ScanweaveError` if a keyframe pose is not finite."""
    for index, pose in enumerate(poses):
        if not np.isfinite(pose.matrix()).all():
            raise ScanweaveError(f"pose {index} of {len(poses)} keyframes is not finite; see the report")
