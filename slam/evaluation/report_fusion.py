"""The part of report.html about scans and depth images that repaired each other (Xu2024)."""

from __future__ import annotations

import numpy as np

from fusion import Grade
from slam.evaluation.pages import render
from slam.mapper.keyframe_fusion import FusionSummary


def fusion_section(fused: FusionSummary) -> str:
    """What the pairs told of the rig, and what was repaired, as HTML."""
    return render(
        "fusion.html",
        fused=fused,
        grades=_grade_rows(fused) if fused.pairs else [],
        repaired=sum(pair.repaired is not None for pair in fused.pairs),
    )


def _grade_rows(fused: FusionSummary) -> list[tuple[str, ...]]:
    """Pairs by grade, and how far they are from what all of them tell together."""
    rows: list[tuple[str, ...]] = []
    for grade in sorted(Grade, reverse=True):
        offsets = np.array([pair.u for pair in fused.pairs if pair.grade == grade])
        apart = "–"
        if fused.estimate is not None and offsets.size:
            apart = f"{np.median(np.abs(offsets - fused.estimate.u)):.1f}"
        share = f"{offsets.size / len(fused.pairs):.0%}"
        rows.append((grade.name.lower(), f"{offsets.size:,}", share, apart))
    return rows
