"""An error of a sensor, and its remedies."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import gtsam
import numpy as np

from slam.config import dump_calibration
from slam.config.calibration import Calibration

# Corrections in the form of a calibration file: type of sensor, its name, the entries.
Remedy = Mapping[str, Mapping[str, Mapping[str, Any]]]


@dataclass(frozen=True, slots=True)
class Finding:
    """An error of a sensor.

    Attributes
    ----------
    kind
        The type of error in a word or two, the same for every log.
    text
        The finding in one line, with its interval.
    remedies
        Remedies as entries of a calibration file, the most likely first. Several if the log does not
        determine which is right, none if no calibration helps.
    sure
        Whether it is certain; then the mapper uses the remedy automatically.
    value, interval
        The measured value and its 95 % interval; None if nothing is measured.
    """

    sensor: str
    kind: str
    text: str
    effect: str
    remedies: tuple[Remedy, ...] = ()
    sure: bool = False
    value: float | None = None
    interval: tuple[float, float] | None = None

    @property
    def line(self) -> str:
        """The finding in one line of text."""
        trust = "" if self.sure else "perhaps "
        mend = " or ".join(remedy_text(remedy) for remedy in self.remedies)
        text = f"{self.sensor}: {trust}{self.text}; {self.effect}"
        return f"{text}; calibration: {mend}" if mend else text

    def plain(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        interval = self.interval and list(self.interval)
        return {**asdict(self), "remedies": list(self.remedies), "interval": interval}

    @classmethod
    def from_plain(cls, row: dict[str, Any]) -> Finding:
        """Create from the result of `plain`."""
        interval = row["interval"] and tuple(row["interval"])
        return cls(**{**row, "remedies": tuple(row["remedies"]), "interval": interval})


def remedy_text(remedy: Remedy) -> str:
    """A remedy in the form of a calibration file, in one line."""
    return ", ".join(
        f"{kind}: {{{name}: {{{', '.join(f'{key}: {_shown(value)}' for key, value in entries.items())}}}}}"
        for kind, sensors in remedy.items()
        for name, entries in sensors.items()
    )


def remedied(calibration: Calibration, findings: Iterable[Finding], *, only_sure: bool) -> Calibration:
    """A calibration with the most likely remedies of findings; existing entries are kept."""
    for finding in findings:
        if finding.remedies and (finding.sure or not only_sure):
            calibration = calibration.merged(finding.remedies[0])
    return calibration


def calibration_text(calibration: Calibration, findings: Sequence[Finding]) -> str:
    """A calibration file; uncertain entries are followed by alternatives."""
    lines = [dump_calibration(calibration)]
    for finding in findings:
        if not finding.sure and finding.remedies:
            others = " or ".join(remedy_text(remedy) for remedy in finding.remedies[1:])
            lines.append(f"# not sure: {finding.text}\n")
            lines += [f"# instead of {remedy_text(finding.remedies[0])} perhaps {others}\n"] if others else []
    return "".join(lines)


def mounting_entry(rotation: gtsam.Rot3, place_m: Sequence[float]) -> dict[str, float]:
    """The pose of a sensor in the form of a calibration file."""
    names = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
    values = [*(round(float(one), 3) for one in place_m), *np.degrees(rotation.rpy()).round(2).tolist()]
    return dict(zip(names, values, strict=True))


def _shown(value: Any) -> str:
    """A value as YAML text."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_shown(one)}' for key, one in value.items())}}}"
    return json.dumps(value)
