"""What is given and is no log, or not the log itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from rgbd_files import frames

from slam.datasets import open_dataset
from slam.errors import DatasetError
from tools.pack_layouts import put


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scans.tar.gz", "archive; unpack it"),
        ("output.mkv", r"azure_kinect_mkv_reader\.py --input .*output\.mkv --output FOLDER"),
        ("frames.mov", "a video, without depth"),
        ("room.svo2", "svo_path"),
        ("day.rawlog", "rawlog_play_node"),
        ("scan.ply", "a single cloud"),
        ("room.usdz", "a single cloud or mesh"),
        ("poses.graph", "a map or a setting"),
        ("map.pbstream", "a map or a setting"),
        ("what.xyz", "no known format"),
    ],
)
def test_a_file_that_is_no_log_is_named(name: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=words) as caught:
        open_dataset(put(tmp_path / name, b"\x00\x01\x02\x03" * 100))
    text = str(caught.value)
    assert "\n" not in text and len(text) < len(str(tmp_path)) + 250  # once it named 32 formats


def test_a_calibration_reaches_the_only_recording_in_a_folder(tmp_path: Path) -> None:
    from test_seven_scenes import write_scene

    write_scene(tmp_path / "download" / "seq-01")
    lens = "image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    given = put(tmp_path / "lens.yaml", f"{lens}  data: [50, 0, 30, 0, 51, 20, 0, 0, 1]\n")
    for place in ("download/seq-01", "download"):
        found = list(open_dataset(tmp_path / place, calibration=[given]))
        assert frames(found)[0].intrinsics.fx == 50.0
