"""Hooks for mkdocs when it builds the documentation site: see mkdocs.yml."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parents[1]))

from slam.config import dump_config, load_config

MEASURED = re.compile(r"^( *)<!-- measured: (\w+) ([\d-]+)(, earlier version)? -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace comments in the files of figures by visible text."""
    return MEASURED.sub(r'\n\1<p class="measured">oldest row: commit \2 of \3\4</p>\n', markdown)


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the page of all settings, generated from their descriptions."""
    files.append(File.generated(config, "settings.md", content="\n".join(_settings())))
    return files


def _settings() -> Iterator[str]:
    """A table for each section of the configuration, as ``scanweave config`` prints it."""
    yield "# All settings\n\nWhat `scanweave config` prints: defaults, with their limits in brackets.\n"
    yield "| setting | default | meaning |\n|---|---|---|"
    path, comment = list[str](), ""
    for line in filter(str.strip, dump_config(load_config()).splitlines()):
        text = line.strip()
        if text.startswith("#"):
            comment = text.strip(" #").replace("|", "\\|")
            continue
        name, _, value = text.partition(":")
        path = [*path[: (len(line) - len(text)) // 2], name]
        if value:
            yield f"| `{'.'.join(path)}` | `{value.strip()}` | {comment} |"
        elif len(path) == 1:
            yield f"\n## {name}\n\n{comment}\n\n| setting | default | meaning |\n|---|---|---|"
