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
    from slam.config import Config, dump_calibration, load_calibration
    from slam.datasets import open_dataset
    from slam.datasets.corrections import Corrected
    from slam.doctor.diagnosis import diagnose
    from slam.doctor.finding import remedied
    from slam.storage.files import write_bytes

    known = load_calibration(calibration) if calibration else Config().sensors.calibration
    dataset = open_dataset(log, strict=strict, topics=topics_of(topics))
    findings = diagnose(Corrected(dataset, known))
    if as_json:
        print(json.dumps([finding.plain() for finding in findings], indent=2))
    else:
        print("\n".join(finding.line for finding in findings) or "nothing is wrong as far as the log tells")
    if write is not None:
        write_bytes(write, dump_calibration(remedied(known, findings, only_sure=False)).encode())
        say(f"wrote {write}")
