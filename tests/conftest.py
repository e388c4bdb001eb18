"""Its presence lets every test folder import the helpers in this one: pytest puts this folder on the path."""

import gc
import os
import signal
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import browser
import hypothesis
import pytest

from slam.comparison.open3d_library import load_open3d
from slam.errors import ScanweaveError

# How long an example takes is the machine's business.
hypothesis.settings.register_profile("no deadline", deadline=None)
hypothesis.settings.load_profile("no deadline")

# A shell's background job has Ctrl-C ignored, and its children too; tests interrupt themselves and others.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Each of several workers has a core: copies of a process that think the other one free only crowd it.
if (worker := os.environ.get("PYTEST_XDIST_WORKER", "gw")[2:]) and hasattr(os, "sched_setaffinity"):
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker) % len(cores)]})


@pytest.fixture(scope="session")
def open3d() -> Any:
    """Open3D; what needs it is skipped, loudly, where a library of the system is missing."""
    try:
        return load_open3d()
    except ScanweaveError as error:
        pytest.skip(f"NOT TESTED: {error}")


@pytest.fixture(scope="session", autouse=True)
def _nobodys_own_process() -> Iterator[None]:
    """A command that a test calls here does not give up the code that the next test wants."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam.cli.commands.heap", SimpleNamespace())
        yield


@pytest.fixture(scope="module", autouse=True)
def _one_browser() -> Iterator[None]:
    """The browser that a file's tests have opened ends with them."""
    yield
    browser.close()


@pytest.fixture(autouse=True)
def _open3d_where_marked(request: pytest.FixtureRequest) -> None:
    """A test, or a case of it, that is marked ``open3d`` need not take the fixture."""
    if request.node.get_closest_marker("open3d"):
        request.getfixturevalue("open3d")


def pytest_collection_finish() -> None:
    """What 4500 tests are made of stays: a search for garbage takes a fifth of a second less."""
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes the fixture is found by the mark too."""
    for item in items:
        if "open3d" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.open3d)
