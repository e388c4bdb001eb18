"""A module that is loaded when something of it is first asked for."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from slam.later import load_later


def test_a_module_is_loaded_when_it_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "waits.py").write_text("import sys\nsys.begun_to_load = True\nanswer = 42\n")
    (tmp_path / "asks.py").write_text("import waits\n\ndef ask():\n    return waits.answer, waits.answer\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delattr(sys, "begun_to_load", raising=False)
    load_later("waits")
    try:
        asks = importlib.import_module("asks")
        assert not hasattr(sys, "begun_to_load")
        assert asks.ask() == (42, 42)
        assert importlib.import_module("waits").__file__ == str(tmp_path / "waits.py")
        with pytest.raises(AttributeError):
            _ = asks.waits.question
        load_later("waits")  # it is there: nothing changes
        assert sys.modules["waits"].answer == 42
    finally:
        for name in ("waits", "asks"):
            sys.modules.pop(name, None)
        monkeypatch.delattr(sys, "begun_to_load", raising=False)


def test_a_part_of_a_package_waits_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "whole" / "part"
    folder.mkdir(parents=True)
    (tmp_path / "whole" / "__init__.py").touch()
    (folder / "__init__.py").write_text("answer = 42\n")
    (folder / "deeper.py").write_text("answer = 43\n")
    monkeypatch.syspath_prepend(tmp_path)
    try:
        whole = importlib.import_module("whole")
        load_later("whole.part")
        assert not hasattr(whole.part, "__file__")
        assert importlib.import_module("whole.part.deeper").answer == 43
        assert whole.part.answer == 42 and hasattr(whole.part, "__file__")
    finally:
        for name in ("whole", "whole.part", "whole.part.deeper"):
            sys.modules.pop(name, None)
