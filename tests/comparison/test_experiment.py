"""An experiment file becomes runs, each under the hash of what decides it; faults are one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from slam.comparison import runs
from slam.comparison.experiment import find_experiment, load_experiment
from slam.comparison.runs import Plan, plan_of
from slam.errors import ConfigError, DatasetError

LOG = "PARAM robot_frontlaser_offset 0.0\nODOM 0 0 0 0 0 0 1.0 host 1.0\n"


def plan(folder: Path, content: dict[str, Any]) -> Plan:
    (folder / "a.log").write_text(LOG)
    (folder / "b.log").write_text(LOG + "ODOM 1 0 0 0 0 0 2.0 host 2.0\n")
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump({"name": "x", **content}))
    return plan_of(load_experiment(file), folder, folder / "cache")


def test_data_sets_times_configurations_times_seeds(tmp_path: Path) -> None:
    made = plan(
        tmp_path,
        {
            "datasets": [{"path": "a.log"}, {"path": "b.log", "name": "second"}],
            "configurations": [
                {"name": "one", "overrides": {"loops.enabled": False}},
                {"name": "swept", "sweep": {"grid.resolution_m": [0.05, 0.1], "loops.reach_m": [2, 3.5]}},
            ],
            "baselines": ["wheels", "no_loops", "kiss_matching"],
            "common": {"keyframes.distance_m": 0.3},
            "seeds": [3, 4],
        },
    )
    ours = [run for run in made.runs if run.method == "scanweave"]
    assert len(ours) == (1 + 4 + 1) * 2 * 2
    assert len([run for run in made.runs if run.method == "wheels"]) == 2  # no seed decides it
    by_kiss = [run for run in made.runs if run.method == "kiss_matching"]
    assert len(by_kiss) == 2 * 2 and all('"distance_m":0.3' in run.config for run in by_kiss)
    assert len({run.key for run in made.runs}) == len(made.runs)
    assert {run.dataset for run in made.runs} == {"a", "second"}
    configs = {(run.configuration, run.seed): json.loads(run.config) for run in ours}
    assert {config["keyframes"]["distance_m"] for config in configs.values()} == {0.3}
    assert {config["seed"] for (_, seed), config in configs.items() if seed == 4} == {4}
    assert not configs["one", 3]["loops"]["enabled"] and not configs["no loops", 3]["loops"]["enabled"]
    swept = configs["swept, resolution_m=0.1, reach_m=3.5", 3]
    assert (swept["grid"]["resolution_m"], swept["loops"]["reach_m"]) == (0.1, 3.5)
    assert made.reference == "one"


def test_a_key_follows_what_decides_a_result_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content: dict[str, Any] = {
        "datasets": [{"path": "a.log", "groundtruth": "true.tum"}],
        "configurations": [{"name": "one"}],
    }
    (tmp_path / "true.tum").write_text("1 0 0 0 0 0 0 1\n")

    def key(**changes: Any) -> str:
        return plan(tmp_path, {**content, **changes}).runs[0].key

    known = key()
    assert key() == known
    assert key(timeout_s=5.0, memory_mb=77.0, description="other") == known
    different = [key(common={"loops.reach_m": 2.0}), key(seeds=[1]), key(rpe_m=[3.0])]
    (tmp_path / "true.tum").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    different.append(key())
    different.append(key(datasets=[{"path": "b.log", "name": "a", "groundtruth": "true.tum"}]))
    monkeypatch.setattr(runs, "current_versions", lambda: {"code": "another"})
    different.append(key())
    assert len({known, *different}) == 7


def test_drives_are_named_by_what_decides_them(tmp_path: Path) -> None:
    simulate = {"rig": "sick2d", "homes": [1, 2], "seeds": [0, 1], "duration_s": 15}
    made = plan(tmp_path, {"datasets": [{"simulate": simulate}], "configurations": [{"name": "one"}]})
    assert [source.name for source in made.sources] == [
        f"sick2d home {home} drive {seed}" for home in (1, 2) for seed in (0, 1)
    ]
    assert {source.group for source in made.sources} == {"home 1", "home 2"}
    assert len({source.path for source in made.sources}) == 4
    longer = plan(
        tmp_path,
        {"datasets": [{"simulate": {**simulate, "duration_s": 16}}], "configurations": [{"name": "one"}]},
    )
    assert {source.path for source in longer.sources}.isdisjoint(source.path for source in made.sources)


def test_others_trajectories_globs_and_commands(tmp_path: Path) -> None:
    made = plan(
        tmp_path,
        {
            "datasets": [{"glob": "?.log"}],
            "external": [{"name": "theirs", "trajectory": "theirs/{dataset}.tum"}],
            "commands": [
                {"name": "own", "command": ["x", "{dataset}", "{out}"], "on_datasets": True},
                {"name": "once", "command": ["y", "{data}"]},
            ],
        },
    )
    assert {Path(run.trajectory).name for run in made.runs if run.method == "external"} == {
        "a.log.tum",
        "b.log.tum",
    }
    commands = [run.command for run in made.runs if run.configuration == "own"]
    assert [command[1:] for command in commands] == [
        (str(tmp_path / name), "{out}") for name in ("a.log", "b.log")
    ]
    assert [run.command for run in made.runs if run.configuration == "once"] == [("y", str(tmp_path))]


ONE = {"datasets": [{"path": "a.log"}], "configurations": [{"name": "one"}]}


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"seads": [1]}, ["unknown key 'seads'", "did you mean 'seeds'"]),
        ({"datasets": [{"path": "a.log", "relation": "r"}]}, ["did you mean 'relations'"]),
        ({"datasets": [{"path": "a.log", "glob": "*"}]}, ["path and glob", "give one"]),
        ({"datasets": [{"glob": "*.log", "name": "n"}]}, ["name belongs to one log"]),
        ({"datasets": []}, ["has no datasets"]),
        ({"configurations": []}, ["has no configurations"]),
        ({"configurations": [{"name": "one"}, {"name": "one"}]}, ["'one' names two configurations"]),
        ({"configurations": [{"name": "one", "sweep": {"seed": []}}]}, ["sweep of 'seed' has no values"]),
        ({"baselines": ["weels"]}, ["baselines.0", "'wheels'"]),
        ({"reference": "on"}, ["reference 'on'", "one"]),
        ({"rpe_m": [0.0]}, ["rpe_m"]),
        ({"timeout_s": 0}, ["timeout_s", "greater than 0"]),
        ({"configurations": [{"name": "one", "overrides": {"grid.resolution": 1}}]}, ["grid.resolution_m"]),
        ({"datasets": [{"simulate": {"rig": "sick", "homes": [1]}}]}, ["simulate.rig is 'sick'", "sick2d"]),
    ],
)
def test_faults_of_a_file_are_one_line(tmp_path: Path, changes: dict[str, Any], parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        plan(tmp_path, {**ONE, **changes})
    assert [part for part in parts if part not in str(caught.value)] == []
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("datasets", "part"),
    [
        ([{"path": "none.log"}], "none.log does not exist"),
        ([{"path": "a.log", "relations": "r"}], "r does not exist"),
        ([{"glob": "*.none"}], "nothing matches *.none"),
        ([{"path": "a.log"}, {"path": "b.log", "name": "a"}], "two data sets are called 'a'"),
    ],
)
def test_missing_data_is_named(tmp_path: Path, datasets: list[dict[str, Any]], part: str) -> None:
    with pytest.raises(DatasetError, match=r".*") as caught:
        plan(tmp_path, {**ONE, "datasets": datasets})
    assert part in str(caught.value)


@pytest.mark.parametrize("text", ["- a\n", "name: [\n", "1: {2: 3}\n", "\xff"])
def test_what_is_no_experiment_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError):
        load_experiment(tmp_path / "x.yaml")


def test_the_ready_experiments_are_sound() -> None:
    folder = Path(__file__).parents[2] / "configs" / "experiments"
    names = [file.stem for file in sorted(folder.glob("*.yaml"))]
    loaded = {name: load_experiment(find_experiment(name)) for name in names}
    with pytest.raises(ConfigError, match=r"no experiment 'ablatio'; did you mean 'ablation'\?"):
        find_experiment("ablatio")
    assert set(loaded) == {"ablation", "lidar2d", "papers"}
    assert loaded["ablation"].datasets[0].simulate is not None
    assert len(loaded["papers"].commands) == 3
