"""Clouds as E57 for survey programs: each with the pose of its scanner."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError, needs
from slam.measurements import AnyFloatArray, Float32Array
from slam.storage.files import replacing


def write_e57(
    path: Path,
    scans: Iterable[tuple[str, gtsam.Pose3, AnyFloatArray, NDArray[np.uint8] | None, Float32Array | None]],
) -> None:
    """Write scans.

    Parameters
    ----------
    scans
        Name, ``T_map_scanner``, (N, 3) points in the scanner's frame, and if known (N, 3) RGB and (N,)
        intensities.

    Raises
    ------
    LibraryError
        If pye57 is not installed.
    MapFileError
        If the file cannot be written.
    """
    with needs("E57 needs pye57", "e57"):
        import pye57
    try:
        with replacing(path) as temporary:
            file = pye57.E57(str(temporary), mode="w")
            for name, pose, points, colors, intensities in scans:
                columns: dict[str, Any] = {f"cartesian{axis}": points[:, k] for k, axis in enumerate("XYZ")}
                if intensities is not None:
                    columns["intensity"] = intensities
                if colors is not None:
                    columns |= {
                        f"color{name}": colors[:, k] for k, name in enumerate(("Red", "Green", "Blue"))
                    }
                turn: Any = pose.rotation().toQuaternion()
                file.write_scan_raw(
                    columns,
                    name=name,
                    rotation=np.array([turn.w(), turn.x(), turn.y(), turn.z()]),
                    translation=pose.translation(),
                )
            file.close()
    except (pye57.libe57.E57Exception, TypeError) as error:
        why = "pye57 needs a UTF-8 name" if isinstance(error, TypeError) else str(error).split("\n")[0]
        raise MapFileError(f"cannot write {path}: {why}; check the folder and its free space") from error
