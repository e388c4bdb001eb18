"""scanweave doctor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import (
    CalibrationOption,
    JsonOption,
    LogArgument,
    StrictOption,
    TopicsOption,
    command,
    say,
    tell,
    topics_of,
)


@command()
def doctor(
    log: LogArgument,
    write: Annotated[
        Path | None,
        typer.Option("--write", help="write what mends it here, for --calibration of the other commands"),
    ] = None,
    as_json: JsonOption = False,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Tell what the sensors of a log say of each other that cannot be, and what mends it."""
    from slam.config import load_config
    from slam.datasets import open_dataset
    from slam.datasets.corrections import Corrected
    from slam.doctor.diagnosis import examine
    from slam.doctor.finding import calibration_text, remedied
    from slam.storage.files import write_bytes

    sensors = load_config(calibration=calibration).sensors
    known, files = sensors.calibration, sensors.calibration_files
    dataset = open_dataset(log, strict=strict, topics=topics_of(topics), calibration=files)
    diagnosis = examine(Corrected(dataset, known))
    findings = diagnosis.findings
    if as_json:
        found = [finding.plain() for finding in findings]
        tell(json.dumps({"findings": found, "open": diagnosis.open}, indent=2))
    else:
        tell("\n".join(finding.line for finding in findings) or "nothing is wrong as far as the log tells")
        for line in diagnosis.open:
            tell(f"not judged: {line}")
    if write is not None:
        mended = remedied(known, findings, only_sure=False)
        write_bytes(write, calibration_text(mended, findings).encode())
        say(f"wrote {write}")
