"""A module that is loaded when it is first used."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any


class _Later(ModuleType):
    """Stands in for a module until then, and for who has it by then."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # the machinery of imports asks
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        self.__dict__.update(importlib.import_module(self.__name__).__dict__)
        if name not in self.__dict__:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return self.__dict__[name]


def load_later(name: str) -> None:
    """Let later imports of a module wait for its first use: for what does mostly without.

    The package that it is a part of is loaded.
    """
    module = sys.modules.setdefault(name, _Later(name))
    package, _, part = name.rpartition(".")
    if package:
        setattr(sys.modules[package], part, module)
