"""Handle foreign text safely before it is shown or used: sanitised text, YAML and JSON of limited size."""

from __future__ import annotations

import json
from typing import Any

import yaml

# The same in C, where it was built: twenty times as fast.
Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

MOST_TEXT = 1 << 20  # letters of YAML; the index of a bag in a thousand parts has a fifth of that
_DEEPEST = 32


def plain(text: object, longest: int = 256) -> str:
    """One line that a terminal shows as it is: what would steer it, turn the writing or is no text is a "?".

    Parameters
    ----------
    longest
        Where it is cut, with dots behind.
    """
    whole = str(text)
    if whole.isprintable() and len(whole) <= longest:
        return whole
    shown = "".join(sign if sign.isprintable() else "?" for sign in whole[:longest])
    return shown + ("..." if len(whole) > longest else "")


def plain_lines(text: str) -> str:
    """Text of several lines, each as by `plain` but of any length."""
    return "\n".join(plain(line, len(line)) for line in text.split("\n"))


def from_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises
    ------
    ValueError
        It is none, or is nested so deep that nobody wrote it.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def from_yaml(text: str, loader: Any = Loader) -> Any:
    """The value of a YAML text.

    Raises
    ------
    ValueError
        It is none, is long, nested deep, or repeats itself by aliases: a few lines could grow without end.
    """
    if len(text) > MOST_TEXT:
        raise ValueError(f"{len(text)} letters of YAML, at most {MOST_TEXT} are read")
    try:
        depth = 0
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST or isinstance(event, yaml.AliasEvent):
                raise ValueError("aliases are not read" if depth <= _DEEPEST else "nested too deep")
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        raise ValueError(plain(" ".join(str(error).split()))) from error
    except RecursionError:
        raise ValueError("nested too deep") from None
