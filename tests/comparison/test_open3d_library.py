"""What a user reads where Open3D does not load."""

import sys

import pytest

from slam.comparison.open3d_library import load_open3d
from slam.errors import ScanweaveError


class Broken:
    """Finds Open3D, and fails to load it as where libGL is missing."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "open3d":
            raise OSError("libGL.so.1: cannot open shared object file")


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ScanweaveError, match=r"scanweave\[compare\]"):
        load_open3d()


def test_a_missing_library_is_one_line_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    with pytest.raises(ScanweaveError, match="apt-get install") as raised:
        load_open3d()
    assert "\n" not in str(raised.value)
