"""Pages of one file that ask nothing of the network, and texts, from the templates beside this file.

`parts` are the pieces of ``templates/parts.html`` as functions that give HTML.
"""

from __future__ import annotations

import base64
import math
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from slam.datasets.sensor_choice import SensorUse, use_lines
from slam.foreign import plain_lines
from slam.storage.files import replacing

_TELLING_S = 0.02  # medians of two clocks that are nearer to each other than that tell nothing


def write_page(path: Path, template: str, **values: Any) -> None:
    """Fill a template in; every text is escaped, a picture is bytes of PNG.

    Raises
    ------
    MapFileError
        Where the folder is missing, not writable or full; an older page then stays as it was.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(_environment().get_template(template).generate(**values))


def render(template: str, **values: Any) -> Markup:
    """A template filled in, as a piece of a page."""
    return Markup(_environment().get_template(template).render(**values))


def inspection_text(log: dict[str, Any]) -> str:
    """What a log holds, see `slam.datasets.inspection.inspect_dataset`, as plain text."""
    uses = use_lines(SensorUse(**use) for use in log["uses"])
    return str(render("inspection.txt", log=log, uses=uses, telling_s=_TELLING_S)).rstrip("\n")


def parts() -> Any:
    """The pieces of a page, by name: ``parts().table(head, rows)``."""
    return _environment().get_template("parts.html").module


@cache
def _environment() -> Environment:
    """Templates that make plain and escape what they are given, and fail on what they are not given."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=lambda name: name is None or not name.endswith(".txt"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        finalize=lambda value: plain_lines(value) if type(value) is str else value,
    )
    # No minus zero.
    environment.filters["degrees"] = lambda angle, decimals=9: round(math.degrees(angle), decimals) + 0.0
    environment.filters["base64"] = lambda png: base64.b64encode(png).decode("ascii")
    return environment
