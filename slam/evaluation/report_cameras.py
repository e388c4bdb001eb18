"""What the report tells of a camera."""

from __future__ import annotations

import numpy as np

from slam.mapper.scan_record import CameraRecord
from slam.measurements import FloatArray


def camera_cells(name: str, record: CameraRecord) -> tuple[str, ...]:
    """The numbers of a camera as text; what was never measured is a dash."""
    frames = record.frames
    medians = [
        (frames.overlaps, "{:.2f}"),
        (frames.feature_counts, "{:.0f}"),
        (frames.residuals_px, "{:.2f}"),
        (1000.0 * frames.residuals_m, "{:.1f}"),
    ]
    return (
        name,
        f"{frames.stamps_s.size:,}",
        f"{np.count_nonzero(frames.unmatched):,}",
        f"{np.count_nonzero(frames.degenerate):,}",
        f"{record.motions:,}" if record.motions else "–",
        f"{record.refused_motions:,}" if record.motions else "–",
        *(_median(values, style) for values, style in medians),
    )


def _median(values: FloatArray, style: str) -> str:
    """Median of what was measured."""
    known = values[np.isfinite(values)]
    return style.format(float(np.median(known))) if known.size else "–"
