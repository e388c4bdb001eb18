import gtsam
import numpy as np
from typer.testing import CliRunner

from slam.cli import app
from slam.errors import ScanweaveError
from slam.storage.nav2 import write_nav2_states


def run(tmp_path, *arguments):
    states = np.zeros((40, 60), dtype=np.int8)
    states[:, 30] = 100
    states[30:36, 30] = 0
    write_nav2_states(tmp_path / "decision", states, 0.1, gtsam.Pose2(-1.0, -2.0, 0.0))
    return CliRunner().invoke(app, ["plan", *arguments, "--out", str(tmp_path / "plan.png")])


def test_plan_draws_a_path_of_a_folder_and_of_a_yaml(tmp_path):
    for place in (tmp_path, tmp_path / "decision.yaml"):
        done = run(tmp_path, str(place), "--from", "-0.5,-1.5", "--to", "4,-1.5")
        assert done.exit_code == 0, done.output
        assert "from obstacles" in done.output
        assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_plan_says_where_there_is_no_way_and_what_a_point_is(tmp_path):
    ends = ("--from", "-0.5,-1.5", "--to", "4,-1.5")
    narrow = run(tmp_path, str(tmp_path), *ends, "--radius", "0.4")
    assert isinstance(narrow.exception, ScanweaveError)
    assert "no way" in str(narrow.exception)
    assert run(tmp_path, str(tmp_path), "--from", "here", "--to", "4,0").exit_code == 2
