"""The scores of a trajectory, said to people."""

from __future__ import annotations

import math
from typing import Any


def score_text(scores: dict[str, Any]) -> str:
    """A few lines for people; angles in degrees."""
    lines = []
    for name, values in scores.items():
        if values is None:
            lines.append(f"{name}: none: the drive is shorter than delta")
            continue
        lines.append(f"{name}:")
        lines += _lines(values, "  ")
    return "\n".join(lines)


def _lines(values: dict[str, Any], indent: str) -> list[str]:
    """Nested figures, one line a group of statistics."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict) and "mean" in value:
            scale, unit = (math.degrees(1.0), "deg") if name.endswith("_rad") else (1.0, "m")
            shown = ", ".join(
                f"{key} {scale * value[key]:.4f}" for key in ("mean", "std", "median", "rmse", "max")
            )
            lines.append(f"{indent}{name.rsplit('_', 1)[0]} [{unit}]: {shown}")
        elif isinstance(value, dict):
            lines.append(f"{indent}{name}:")
            lines += _lines(value, indent + "  ")
        elif value is not None and not isinstance(value, list):
            lines.append(f"{indent}{name}: {value}")
    return lines
