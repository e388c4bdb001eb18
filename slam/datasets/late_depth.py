"""Gives colour images the depth images of their own time, where depth images have another clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from slam.measurements import Measurement, RgbdFrame


def with_depth_in_time(log: Iterable[Measurement], ahead_s: Mapping[str, float]) -> Iterator[Measurement]:
    """Combine the colour images of some cameras with the depth images that are nearest in time.

    Parameters
    ----------
    ahead_s
        By camera, how far the stamps of its depth images are ahead of those of its colour images. A frame
        waits until the depth image of its time has arrived.
    """
    past, waiting = ({name: list[RgbdFrame]() for name in ahead_s} for _ in range(2))

    def ready(name: str, wait_s: float) -> Iterator[RgbdFrame]:
        frames = waiting[name]
        while frames and frames[0].stamp_s + wait_s <= frames[-1].stamp_s:
            frame = frames.pop(0)
            since_s = frame.stamp_s - 2.0 * abs(ahead_s[name])
            past[name] = [*(one for one in past[name] if one.stamp_s > since_s), frame]
            off_s = [abs(one.stamp_s - ahead_s[name] - frame.stamp_s) for one in past[name] + frames]
            yield replace(frame, depth_m=(past[name] + frames)[int(np.argmin(off_s))].depth_m)

    for measurement in log:
        if isinstance(measurement, RgbdFrame) and measurement.sensor in ahead_s:
            waiting[measurement.sensor].append(measurement)
            yield from ready(measurement.sensor, max(ahead_s[measurement.sensor], 0.0))
        else:
            yield measurement
    for name in ahead_s:
        yield from ready(name, -np.inf)
