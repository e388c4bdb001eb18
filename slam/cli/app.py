"""The program that the commands belong to, and the options that they share."""

from __future__ import annotations

import inspect
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TextIO, TypeVar

import typer

from slam.foreign import plain_lines
from slam.version import __version__

_Command = TypeVar("_Command", bound=Callable[..., None])
verbosity = {"quiet": False}


def tell(text: str, stream: TextIO | None = None) -> None:
    """Print lines at once, to the standard output or another stream; what files say is made plain."""
    print(plain_lines(text), file=stream or sys.stdout, flush=True)


def say(text: str) -> None:
    """Print a message of a command, unless only warnings and errors are wanted."""
    if not verbosity["quiet"]:
        tell(text)


class _PlainFormatter(logging.Formatter):
    """Messages as `tell` prints them."""

    def format(self, record: logging.LogRecord) -> str:
        return plain_lines(super().format(record))


def command(example: str) -> Callable[[_Command], _Command]:
    """Make a function a command, named by the first word of its example, with the options that all share."""

    def register(function: _Command) -> _Command:
        def run(*, verbose: bool, quiet: bool, **arguments: Any) -> None:
            _set_verbosity(verbose, quiet)
            function(**arguments)

        own = inspect.signature(function, eval_str=True).parameters.values()
        shared = [
            inspect.Parameter(one, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
            for one, kind in (("verbose", VerboseOption), ("quiet", QuietOption))
        ]
        parameters = [*(part.replace(kind=inspect.Parameter.KEYWORD_ONLY) for part in own), *shared]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {part.name: part.annotation for part in parameters}
        run.__name__, run.__doc__ = function.__name__, function.__doc__
        app.command(example.split()[0], epilog=f"Example: scanweave {example}")(run)
        return function

    return register


def _set_verbosity(verbose: bool, quiet: bool) -> None:
    """What was asked for before or after the command's name."""
    if verbose:
        logging.getLogger().setLevel(logging.INFO)
    verbosity["quiet"] |= quiet


def folder_of(text: str) -> Path:
    """A folder that results may go to."""
    if not text:
        raise typer.BadParameter("give a folder; '.' is the current one")
    return Path(text)


app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Offline SLAM from lidar and RGB-D logs: one trajectory, one map, no ROS.",
)

LogArgument = Annotated[
    Path,
    typer.Argument(
        metavar="LOG",
        help="a CARMEN file (.log, .clf, plain or .gz), a ROS bag (.bag, .db3, .mcap), or a folder (TUM, "
        "KITTI, point clouds and others: docs/formats.md)",
    ),
]
KnownMapArgument = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="output folder of 'scanweave map', its map.db, or a nav2 map (.yaml)"),
]
OutOption = Annotated[
    Path, typer.Option("--out", "-o", parser=folder_of, help="output folder; created if missing")
]
ConfigOption = Annotated[
    str | None, typer.Option("--config", "-c", help="preset name, or your own YAML file")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="set one value, e.g. grid.resolution_m=0.1; repeatable"),
]
RecordOption = Annotated[
    Path | None,
    typer.Option(
        "--record",
        help="also write a recording for the Rerun viewer (.rrd); needs the extra 'viewer' of scanweave",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="print JSON instead of text")]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="sensor corrections from 'scanweave doctor', or camera intrinsics and mountings: "
        "camera_info, Kalibr, URDF, tf, OpenCV",
    ),
]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option("--topics", help="topics to read if a bag has several of one kind; comma-separated"),
]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="log every event to stderr")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="print only warnings and errors")]
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


def _show_version(wanted: bool) -> None:
    """Print the version and stop."""
    if wanted:
        tell(f"scanweave {__version__}")
        raise typer.Exit


@app.callback()
def _before_any_command(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="print the version and exit"),
    ] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Set up what is reported before any command."""
    logging.basicConfig()
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_PlainFormatter("%(message)s"))
    logging.getLogger().setLevel(logging.WARNING)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a home that cannot be written to
    verbosity["quiet"] = False
    _set_verbosity(verbose, quiet)
