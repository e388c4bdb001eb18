"""An extension of Griffe for the reference: text describes return values, the signature their types.

NumPy's form has the type on the first line of ``Returns``; here the signature has it, and the lines are text.
"""

from __future__ import annotations

from typing import Any

import griffe


class ReturnsInWords(griffe.Extension):
    """Read the lines of a ``Returns`` section as one text."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Correct the sections of a function's docstring."""
        for section in func.docstring.parsed if func.docstring else ():
            if section.kind is griffe.DocstringSectionKind.returns and not any(
                item.description for item in section.value
            ):
                words = " ".join(
                    f"{item.name}: {item.annotation}" if item.name else str(item.annotation)
                    for item in section.value
                )
                section.value[:] = [
                    griffe.DocstringReturn(name="", annotation=func.returns, description=words)
                ]
