"""What a user reads where Open3D does not load."""

import sys

import pytest

from slam.comparison.open3d_library import load_open3d
from slam.errors import ScanweaveError


def test_a_missing_library_is_one_line_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ScanweaveError, match="apt-get install") as raised:
        load_open3d()
    assert "\n" not in str(raised.value)
