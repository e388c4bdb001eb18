"""The recordings that tools/fuzz.py damages can still be written and read."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam.datasets import open_dataset
from tools.fuzz_seeds import BAGS, messages, write


@pytest.mark.parametrize("name", BAGS)
def test_an_undamaged_bag_has_all_of_its_readings(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / name, name, messages(), {})
    assert sum(1 for _ in open_dataset(path)) > 0
