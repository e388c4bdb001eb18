"""Libraries that a command loads when it first uses them, wherever they are imported.

Poses are those of gtsam and many files import it; a command that only looks into a file makes none. So the
program, and it alone, has Python's import system hand out such a library before it is loaded: its own code
runs when the first name in it is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from threading import RLock
from types import ModuleType
from typing import Any

_OF_SCIPY = ("interpolate", "linalg", "ndimage", "optimize", "sparse", "spatial", "special")
# Each takes a tenth of a second or more, and up to forty megabytes; so does our own that makes maps anew.
LIBRARIES = frozenset({"gtsam", *(f"scipy.{part}" for part in _OF_SCIPY), "slam.edits.edited_file"})

_lock = RLock()


class _NotYet(ModuleType):
    """A library that was imported and not used; while its code runs, other threads wait."""

    def __getattr__(self, name: str) -> Any:
        with _lock:
            if type(self) is _NotYet and not self.__dict__.get("_running"):
                assert self.__spec__ is not None and self.__spec__.loader is not None
                self.__dict__["_running"] = True
                if (places := self.__spec__.submodule_search_locations) is not None:
                    self.__path__ = places
                try:
                    self.__spec__.loader.exec_module(self)
                    self.__class__ = ModuleType  # type: ignore[assignment]
                finally:
                    del self.__dict__["_running"]
            elif type(self) is _NotYet:
                raise AttributeError(f"module {self.__name__!r} has no attribute {name!r} yet")
        return getattr(self, name)


class _Later(Loader):
    """Leaves the code of a module to its own loader, for later."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def exec_module(self, module: ModuleType) -> None:
        """Nothing, for now."""
        assert module.__spec__ is not None
        module.__spec__.loader = module.__loader__ = self._loader
        # Whoever imports a part of it asks for its path: its own code runs before that of the part.
        module.__dict__.pop("__path__", None)
        module.__class__ = _NotYet


class _Known(Loader):
    """Hands out a part of a library that its own code has just loaded."""

    def __init__(self, module: ModuleType) -> None:
        self._module, self._spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The one that is there."""
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: it has run."""
        module.__spec__ = self._spec


class _Finder(MetaPathFinder):
    """Finds the libraries where they are, with another loader."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """How to load one of them; None of all others."""
        if target is None and name.rpartition(".")[0] in LIBRARIES and name in sys.modules:
            return ModuleSpec(name, _Known(sys.modules[name]))
        spec = PathFinder.find_spec(name, path, target) if name in LIBRARIES else None
        if spec is not None and spec.loader is not None:
            spec.loader = _Later(spec.loader)
        return spec


def load_later() -> None:
    """From now on, in this process."""
    sys.meta_path.insert(0, _Finder())
