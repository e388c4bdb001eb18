"""Create single-file HTML pages without network access, and texts, from the templates in this folder.

`parts` are the pieces of ``templates/parts.html`` as functions that return HTML.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from slam.datasets.sensor_choice import SensorUse, use_lines
from slam.foreign import plain_lines
from slam.storage.files import replacing

TEMPLATES = Path(__file__).parent / "templates"
_TELLING_S = 0.02  # smaller differences of two median times are not significant


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write what `page_parts` gives.

    Raises
    ------
    MapFileError
        If the folder is missing, not writable or full; an older page then stays as it was.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(page_parts(template, **values))


def page_parts(
    template: str,
    *,
    scripts: Sequence[str] = (),
    styles: Sequence[str] = (),
    connect: str = "'none'",
    **values: Any,
) -> Iterator[str]:
    """Yield a page part by part; every text is escaped, an image is PNG bytes.

    A policy in its head allows the browser only these scripts, and no requests.

    Parameters
    ----------
    scripts, styles
        Names of templates that are included unchanged.
    connect
        What scripts may connect to, as a Content-Security-Policy names it.
    """
    sources = [(TEMPLATES / name).read_text(encoding="utf-8") for name in scripts]
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in sources]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes) or "'none'"
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; "
        f"worker-src blob:; connect-src {connect}; base-uri 'none'; form-action 'none'"
    )
    values |= {
        "policy": policy,
        "scripts": [Markup(text) for text in sources],
        "styles": [Markup((TEMPLATES / name).read_text(encoding="utf-8")) for name in styles],
    }
    return _environment().get_template(template).generate(**values)


def render(template: str, **values: Any) -> Markup:
    """Render a template as a piece of a page."""
    return Markup(_environment().get_template(template).render(**values))


def inspection_text(log: dict[str, Any]) -> str:
    """Return the content of a log, see `slam.datasets.inspection.inspect_dataset`, as plain text."""
    uses = use_lines(SensorUse(**use) for use in log["uses"])
    return str(render("inspection.txt", log=log, uses=uses, telling_s=_TELLING_S)).rstrip("\n")


def parts() -> Any:
    """Return the macros of a page: ``parts().table(head, rows)``."""
    return _environment().get_template("parts.html").module


@cache
def _environment() -> Environment:
    """Create templates that sanitise and escape their values, and fail on missing ones."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=lambda name: name is None or not name.endswith(".txt"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        finalize=lambda value: plain_lines(value) if type(value) is str else value,
    )
    # No negative zero.
    environment.filters["degrees"] = lambda angle, decimals=9: round(math.degrees(angle), decimals) + 0.0
    environment.filters["base64"] = lambda png: base64.b64encode(png).decode("ascii")
    return environment
