"""The program that the commands belong to, and the options that they share."""

from __future__ import annotations

import json
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
        help="the log: a CARMEN file (.log, .clf, plain or .gz), a ROS bag (.bag, .db3, .mcap), or a folder "
        "(simulated, TUM, 7-Scenes, OpenLORIS-Scene, Robot@Home, KITTI, point clouds)"
    ),
]
ConfigOption = Annotated[
    str | None, typer.Option("--config", "-c", help="preset name or a YAML file of your own")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", "-s", help="one value, as in grid.resolution_m=0.1; repeatable")
]
RecordOption = Annotated[
    Path | None,
    typer.Option(
        "--record", help="also write a recording for the Rerun viewer here (.rrd); wants scanweave[viewer]"
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON instead of text")]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option("--topics", help="of a bag with several topics of a sort: those to read; with commas"),
]
StrictOption = Annotated[bool, typer.Option("--strict", help="stop at the first bad record")]


def topics_of(option: list[str] | None) -> tuple[str, ...]:
    """The topics of a ``--topics`` option, each once."""
    return tuple(
        dict.fromkeys(name for text in option or [] for part in text.split(",") if (name := part.strip()))
    )


def topics_override(option: list[str] | None) -> list[str]:
    """The option as a setting, which the map keeps; none where it is not given."""
    topics = topics_of(option)
    return [f"sensors.topics={json.dumps(topics)}"] if topics else []


@app.callback()
def _logging(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="one line an event, on stderr")] = False,
) -> None:
    """Set up logging before any command."""
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
