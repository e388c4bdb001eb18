"""Its presence lets every test folder import the helpers in this one: pytest puts this folder on the path."""

import signal
from typing import Any

import pytest

from slam.errors import ScanweaveError
from slam.open3d_library import load_open3d

# A shell's background job has Ctrl-C ignored, and its children too; tests interrupt themselves and others.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def open3d() -> Any:
    """Open3D; what needs it is skipped, loudly, where a library of the system is missing."""
    try:
        return load_open3d()
    except ScanweaveError as error:
        pytest.skip(f"NOT TESTED: {error}")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes Open3D needs more than a bare machine has."""
    for item in items:
        if "open3d" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.system)
