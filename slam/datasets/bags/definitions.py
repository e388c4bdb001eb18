"""Checks message definitions of a bag before code is generated from them: their cost must be limited.

The parser and the generated code of rosbags trust a definition: they evaluate expressions, unroll an array of
strings or records, and repeat an empty record without end.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4  # field types of rosbags
_NOTHING = "structure_needs_at_least_one_member"  # rosbags puts this into an empty type
_MOST_STEPS = 1 << 10  # to decode one message without list elements; an Odometry takes 40

# Has no influence on the byte layout: comments, annotations, constants.
_IDL_WORDS = re.compile(
    r'/\*.*?\*/|//[^\n]*|@\s*[\w:]+(?:\s*\((?:"(?:\\.|[^"\\])*"|[^()"])*\))?|\bconst\b[^;{}]*;', re.DOTALL
)
_EMPTY_MODULE = re.compile(r"\bmodule\s+\w+\s*\{\s*\}\s*;")
_PLAIN_IDL = re.compile(r"[\w\s{};:,<>\[\]]*")
_NESTED_IDL = re.compile(r"<[^<>]*<|(?:\{[^{}]*){9}")


def simple_idl(text: str) -> str:
    """Return a definition as its messages need it; ValueError if it is nested or has expressions."""
    kept = _EMPTY_MODULE.sub("", _IDL_WORDS.sub(" ", text))
    if not _PLAIN_IDL.fullmatch(kept) or _NESTED_IDL.search(kept):
        raise ValueError("a definition with expressions, or nested")
    return kept


def message_parts(types: Typesdict, kind: str) -> tuple[Typesdict, list[str]]:
    """The types that a message consists of, without constants, and the element types of its lists.

    Raises
    ------
    KeyError
        A type is missing.
    ValueError
        A type contains itself or takes too many steps to decode, or a list contains strings or empty types.
    """
    parts: dict[str, Any] = {}
    listed: list[str] = []
    sizes: dict[str, tuple[int, int]] = {}

    def single(node: int, detail: Any) -> tuple[int, int]:
        """Number of steps to decode a value, and its minimum size in bytes."""
        return measured(detail) if node == _NAME else (1, 1)

    def field(node: int, detail: Any) -> tuple[int, int]:
        """The same for a field."""
        if node not in (_ARRAY, _SEQUENCE):
            return single(node, detail)
        (inner, name), count = detail
        numbers = inner == _BASE and name[0] != "string"
        steps, least = single(inner, name)
        if node == _ARRAY:
            return (1 if numbers else count * steps), count * least
        if not numbers:
            if inner == _BASE or not least:
                raise ValueError("a list of texts, or of nothing")
            listed.append(name)
        return 1 + steps, 1

    def measured(name: str) -> tuple[int, int]:
        """The same for a type."""
        if name not in sizes:
            if name in parts:
                raise ValueError(f"{name} contains itself")
            parts[name] = [], types[name][1]
            fields = [field(*description) for own, description in types[name][1] if own != _NOTHING]
            sizes[name] = sum(steps for steps, _ in fields), sum(least for _, least in fields)
            if sizes[name][0] > _MOST_STEPS:
                raise ValueError(f"{name} takes {sizes[name][0]} steps to decode")
        return sizes[name]

    measured(kind)
    return parts, listed
