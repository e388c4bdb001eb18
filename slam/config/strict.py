"""The base class of all settings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ConfigDict


class StrictModel(BaseModel):
    """Base of all stage models: unknown keys and implicit type conversions are errors; values are final."""

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Return the fields that differ from their defaults: `repr` shows only these."""
        fields = type(self).model_fields
        shown = super().__repr_args__()
        return [arg for arg in shown if arg[1] != fields[str(arg[0])].get_default(call_default_factory=True)]

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
