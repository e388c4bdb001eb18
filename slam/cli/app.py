"""The program that the commands belong to, and the options that they share."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Offline SLAM from lidar and RGB-D logs: one trajectory, one map, no ROS.",
)

LogArgument = Annotated[
    Path,
    typer.Argument(
        help="the log: a CARMEN file (.log, .clf, plain or .gz), or a folder (simulated, TUM, 7-Scenes, "
        "OpenLORIS-Scene, Robot@Home)"
    ),
]
ConfigOption = Annotated[
    str | None, typer.Option("--config", "-c", help="preset name or a YAML file of your own")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", "-s", help="one value, as in grid.resolution_m=0.1; repeatable")
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON instead of text")]
StrictOption = Annotated[bool, typer.Option("--strict", help="stop at the first bad record")]


@app.callback()
def _logging(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="one line an event, on stderr")] = False,
) -> None:
    """Set up logging before any command."""
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
