"""``scanweave doctor``: a log looked at, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterable

from fusion.estimation import FEWEST
from slam.doctor.finding import Finding
from slam.doctor.samples import Samples
from slam.measurements import Measurement


def diagnose(log: Iterable[Measurement]) -> list[Finding]:
    """What the sensors of a log say of each other that cannot be.

    The log is read once; what is matched is a bounded number of stretches spread over it.

    Parameters
    ----------
    log
        A dataset, or measurements in the order in which they came.

    Returns
    -------
    What is wrong; nothing of a sound log.

    Raises
    ------
    DatasetError
        Where the log cannot be read.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> slam.diagnose(slam.open_dataset(write_synthetic_log("monday", duration_s=20.0).log_path))
    []
    """
    return _repeated_scans(Samples.of(log))


def _repeated_scans(samples: Samples) -> list[Finding]:
    """Lidars that tell the same scan again and again."""
    return [
        Finding(
            name,
            "repeated scans",
            f"{lidar.repeated} of {lidar.count} scans are the scan before, to the bit",
            "the map takes it that the robot stands",
            ({"lidars": {name: {"drop_repeated": True}}},),
            sure=True,
            value=lidar.repeated / lidar.count,
        )
        for name, lidar in samples.lidars.items()
        if lidar.repeated >= FEWEST and 2 * lidar.repeated > lidar.count
    ]
