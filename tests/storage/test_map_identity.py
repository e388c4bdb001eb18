"""What decides a map: any change of log, settings or versions is seen, and named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.app.mapping import Measured
from slam.config import Config, load_config
from slam.errors import ConfigError, DatasetError
from slam.measurements import LaserScan
from slam.storage.map_identity import MapIdentity, fingerprint_of, identity_of


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "log"
    (folder / "rgb").mkdir(parents=True)
    (folder / "rgb" / "1.png").write_bytes(b"image")
    (folder / "rgb.txt").write_text("1 rgb/1.png\n")
    return folder


def test_the_same_is_the_same(log: Path) -> None:
    one = identity_of(log, Config())
    assert one.difference(identity_of(log, Config())) is None
    assert MapIdentity.from_meta(one.to_meta(), log) == one
    assert {"scanweave", "gtsam", "numpy", "code"} <= set(one.versions)


def test_a_map_with_settings_of_an_earlier_version_is_read(log: Path) -> None:
    one = identity_of(log, Config())
    meta = one.to_meta()
    settings = json.loads(meta["config"])
    settings["localization"]["lag_nodes"] = 10
    settings["lidar_odometry"] = {"method": "kiss_icp", "kiss_voxel_m": 0.3}
    settings["loops"] |= {"candidates": 5}
    meta["config"] = json.dumps({**settings, "bundle": {"enabled": False}})
    assert MapIdentity.from_meta(meta, log) == one
    with pytest.raises(ConfigError, match="unknown key 'bundle'"):
        load_config(None, ["bundle.enabled=true"])


def test_every_setting_of_a_map_of_november_is_known_or_left_out(log: Path) -> None:
    """237 settings as the version before the shared ones wrote them."""
    meta = identity_of(log, Config()).to_meta()
    meta["config"] = (Path(__file__).parent / "earlier_settings.json").read_text("utf-8")
    assert MapIdentity.from_meta(meta, log).config.seed == Config().seed


@pytest.mark.parametrize(
    ("name", "content"),
    [("rgb.txt", "1 rgb/2.png\n"), ("rgb/1.png", "larger image"), ("rgb/2.png", "another"), ("more", "")],
)
def test_another_log_is_another(log: Path, name: str, content: str) -> None:
    before = identity_of(log, Config())
    (log / name).write_text(content)
    assert before.difference(identity_of(log, Config())) == "it was begun with another log, log"


def test_what_maps_have_left_is_no_part_of_it(log: Path) -> None:
    before = fingerprint_of(log)
    for name in ("map.db", "report.html", "layers/decision.pgm", "out/map.db", "out/more/mesh.ply"):
        (log / name).parent.mkdir(parents=True, exist_ok=True)
        (log / name).write_text("left")
    assert fingerprint_of(log) == before
    (log / "notes").write_text("not left by a map")
    assert fingerprint_of(log) != before


def test_a_file_and_a_session_inside_a_file(log: Path) -> None:
    file = log / "rgb.txt"
    assert len({fingerprint_of(path) for path in (file, file / "first", file / "second", log)}) == 4


def test_what_lies_in_no_file_is_known_by_its_stamps(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by the folder that one happens to stand in, all of which was read once."""
    monkeypatch.chdir(log)
    scan = LaserScan(1.0, np.ones(4, np.float32), 0.0, 0.1, 20.0)
    monkeypatch.setattr("slam.storage.map_identity.fingerprint_of", lambda _: pytest.fail("files were read"))
    first, same, later = (
        identity_of(Measured([scan, replace(scan, stamp_s=stamp_s)], "rgb.txt"), Config()).log_fingerprint
        for stamp_s in (2.0, 2.0, 3.0)
    )
    assert first == same != later


def test_what_differs_is_named(log: Path) -> None:
    before = identity_of(log, Config())
    finer = identity_of(log, load_config(None, ["grid.resolution_m=0.02"]))
    assert before.difference(finer) == "it was begun with grid.resolution_m=0.05, not 0.02"
    newer = replace(before, versions={**before.versions, "gtsam": "9"})
    assert newer.difference(before) == f"it was begun with gtsam 9, not {before.versions['gtsam']}"
    assert "begun with new None" in str(
        before.difference(replace(before, versions={**before.versions, "new": "1"}))
    )


def test_a_log_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "log").write_text("a")

    def refuse(self: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(DatasetError, match=r"cannot read .*Permission denied"):
        fingerprint_of(tmp_path / "log")
