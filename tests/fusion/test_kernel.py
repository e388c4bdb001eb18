"""The kernels' decorator: compiled code is found again only where it still is the right one."""

import importlib
import logging
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numba
import pytest
from numba.core import caching

from fusion import compiling
from fusion.kernel import kernel

CONSTANT = """
OFFSET = {offset}
"""
HELPER = """
from fusion.kernel import kernel

@kernel
def grow(x):
    return x {sign} 1
"""
CALLER = """
from fusion.kernel import kernel
from constant_of_kernel import OFFSET
from helper_of_kernel import grow

@kernel
def grown(x):
    return grow(x) + OFFSET
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for modules, with a cache of its own."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path


def loaded(folder: Path, offset: int, sign: str) -> ModuleType:
    """The caller, as a new process sees it."""
    sources = {
        "constant_of_kernel": CONSTANT.format(offset=offset),
        "helper_of_kernel": HELPER.format(sign=sign),
        "caller_of_kernel": CALLER,
    }
    for name, source in sources.items():
        (folder / f"{name}.py").write_text(source)
        sys.modules.pop(name, None)
    compiling._stamps.clear()
    importlib.invalidate_caches()
    return importlib.import_module("caller_of_kernel")


def found(module: ModuleType) -> int:
    """How often the caller's code was found on disk."""
    return sum(module.grown.stats.cache_hits.values())


def test_compiled_code_is_found_again(folder: Path) -> None:
    first, second = loaded(folder, 10, "+"), loaded(folder, 10, "+")
    assert [first.grown(1), found(first)] == [12, 0]
    assert [second.grown(1), found(second)] == [12, 1]
    assert list((folder / "cache").rglob("*.nbi"))


@pytest.mark.parametrize(("offset", "sign", "expected"), [(20, "+", 22), (10, "-", 10)])
def test_what_is_taken_from_another_file_makes_it_stale(
    folder: Path, offset: int, sign: str, expected: int
) -> None:
    assert loaded(folder, 10, "+").grown(1) == 12
    changed = loaded(folder, offset, sign)
    assert [changed.grown(1), found(changed)] == [expected, 0]


def test_a_file_that_was_edited_after_it_was_loaded_gives_nothing_to_others(folder: Path) -> None:
    early = loaded(folder, 10, "+")
    source = (folder / "helper_of_kernel.py").read_text()
    (folder / "helper_of_kernel.py").write_text(source.replace("+ 1", "- 1"))
    assert early.grown(1) == 12
    later = loaded(folder, 10, "-")
    assert [later.grown(1), found(later)] == [10, 0]


def test_where_nothing_can_be_written_it_is_said_once_and_kernels_run(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(self: caching._CacheLocator) -> None:
        raise PermissionError(13, "read-only")

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuse)
    compiling._warn.cache_clear()
    with caplog.at_level(logging.WARNING):
        doubled, halved = kernel(lambda x: 2 * x), kernel(lambda x: x / 2, error_model="numpy")
    assert [doubled(4), halved(4.0)] == [8, 2.0]
    assert [record.getMessage() for record in caplog.records] == [
        "numba cannot keep compiled code, neither beside the source nor in the user's cache folder; "
        "set NUMBA_CACHE_DIR to a writable folder; every run compiles anew"
    ]


def test_other_programs_kernels_are_kept_as_ever() -> None:
    assert not numba.config.CACHE_LOCATOR_CLASSES


def test_what_another_process_compiles_is_waited_for(folder: Path) -> None:
    """Two begin at once, and one of them compiles."""
    loaded(folder, 10, "+")
    stated = "import sys, caller_of_kernel as c; print(c.grown(1), sum(c.grown.stats.cache_misses.values()))"
    code = f"import sys; sys.path[:0] = {[str(folder), str(Path.cwd())]!r}; {stated}"
    where = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
    both = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=where)
        for _ in range(2)
    ]
    assert sorted(one.communicate()[0].split() for one in both) == [["12", "0"], ["12", "1"]]
