"""EuRoC and what is laid out like it (ASL): cameras without depth, which are told of and not read."""

from __future__ import annotations

from pathlib import Path

from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.recording import Recording
from slam.errors import DatasetError


def looks_like_euroc(path: Path, head: bytes) -> bool:
    """Whether a path is the folder of a sequence, or its ``mav0``."""
    return any((place / "cam0" / "data.csv").is_file() for place in (path / "mav0", path))


def open_euroc(path: Path, strict: bool) -> Recording:
    """Nothing.

    Raises
    ------
    DatasetError
        Always.
    """
    raise DatasetError(
        f"{path} holds stereo images and an IMU (EuRoC's layout) but neither depth nor a lidar, and nothing "
        "else is mapped; give a recording of a depth camera or of a lidar"
    )


FORMAT = DatasetFormat("EuRoC folder (refused: no depth)", looks_like_euroc, open_euroc)
