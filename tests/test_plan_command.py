import gtsam
import numpy as np
from typer.testing import CliRunner

from slam.cli.commands import app
from slam.errors import ScanweaveError
from slam.storage.nav2 import write_nav2_map


def run(tmp_path, *arguments):
    states = np.zeros((40, 60), dtype=np.int8)
    states[:, 30] = 100
    states[30:36, 30] = 0
    write_nav2_map(tmp_path / "map", states, 0.1, gtsam.Pose2(-1.0, -2.0, 0.0), "A map.")
    return CliRunner().invoke(app, ["plan", *arguments, "--out", str(tmp_path / "plan.png")])


def test_plan_draws_a_path_of_a_folder_its_map_and_a_yaml(tmp_path):
    for place in (tmp_path, tmp_path / "map.db", tmp_path / "map.yaml"):
        done = run(tmp_path, str(place), "--from", "-0.5,-1.5", "--to", "4,-1.5")
        assert done.exit_code == 0, done.output
        assert "from obstacles" in done.output
        assert "A map." in done.output  # what the map says of how it was made
        assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_plan_says_where_there_is_no_way_and_what_a_point_is(tmp_path):
    ends = ("--from", "-0.5,-1.5", "--to", "4,-1.5")
    narrow = run(tmp_path, str(tmp_path), *ends, "--radius", "0.4")
    assert isinstance(narrow.exception, ScanweaveError)
    assert "no path" in str(narrow.exception)
    for wrong in ("here", "nan,0", "inf,0"):
        assert run(tmp_path, str(tmp_path), "--from", wrong, "--to", "4,0").exit_code == 2


def test_plan_says_where_a_folder_holds_no_map(tmp_path):
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "empty" / "map.db"):
        done = run(tmp_path, str(place), "--from", "0,0", "--to", "1,0")
        assert isinstance(done.exception, ScanweaveError)
        assert f"no map.yaml in {tmp_path / 'empty'}; 'scanweave map'" in str(done.exception)
    done = run(tmp_path, str(tmp_path / "nowhere"), "--from", "0,0", "--to", "1,0")
    assert isinstance(done.exception, ScanweaveError) and "cannot read" in str(done.exception)
