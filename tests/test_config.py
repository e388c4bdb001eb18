"""Presets, overrides and the words in which a bad configuration is refused."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from slam.config import Config, StrictModel, dump_config, holds_places, load_config, with_places
from slam.errors import ConfigError

CONFIGS = Path(__file__).parents[1] / "configs"


def models(model: type[BaseModel] = Config) -> list[type[BaseModel]]:
    """Every stage model, Config first."""
    sections = [field.annotation for field in model.model_fields.values()]
    nested = [models(s) for s in sections if isinstance(s, type) and issubclass(s, BaseModel)]
    return [model, *itertools.chain.from_iterable(nested)]


@pytest.fixture
def write(tmp_path: Path):
    def write_file(text: str) -> str:
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        return str(file)

    return write_file


def test_every_shipped_preset_loads_and_is_found_by_name() -> None:
    for file in CONFIGS.glob("*.yaml"):
        assert isinstance(load_config(file.stem), Config)


def test_a_preset_states_only_what_differs_from_the_defaults() -> None:
    def leaves(tree: dict, prefix: str = "") -> dict[str, object]:
        found: dict[str, object] = {}
        for key, value in tree.items():
            found |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        return found

    defaults = leaves(Config().model_dump(mode="json"))
    for file in CONFIGS.glob("*.yaml"):
        repeated = {
            k: v for k, v in leaves(yaml.safe_load(file.read_text()) or {}).items() if defaults[k] == v
        }
        assert not repeated, f"{file.name} repeats defaults"


def test_no_argument_takes_the_default_preset() -> None:
    assert load_config() == load_config("lidar2d") == load_config(None, [])


def test_file_then_overrides_and_the_last_one_wins(write) -> None:
    path = write("keyframes: {distance_m: 0.7, angle_rad: 0.2}\nseed: 3\n")
    config = load_config(
        path, ["keyframes.distance_m=0.9", "keyframes.distance_m = 0.4", "grid.resolution_m=2e-2"]
    )
    assert (config.keyframes.distance_m, config.keyframes.angle_rad) == (0.4, 0.2)
    assert (config.seed, config.grid.resolution_m) == (3, 0.02)


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "0.001", "1.0e-03"])
def test_every_way_to_write_a_number_is_a_number(text: str) -> None:
    assert load_config(overrides=[f"grid.resolution_m={text}"]).grid.resolution_m == 0.001


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("keyframes.distnce_m=1", "unknown key 'keyframes.distnce_m'; did you mean 'keyframes.distance_m'?"),
        ("keyframs.distance_m=1", "unknown key 'keyframs'; did you mean 'keyframes'?"),
        ("distance_m=1", "unknown key 'distance_m'; did you mean 'keyframes.distance_m'?"),
        ("grid.distance_m=1", "unknown key 'grid.distance_m'; did you mean 'keyframes.distance_m'?"),
        ("grid.resolution=1", "unknown key 'grid.resolution'; did you mean 'grid.resolution_m'?"),
        (
            "sensors.calibration.lidars.front.upsidedown=true",
            "unknown key 'sensors.calibration.lidars.front.upsidedown'; "
            "did you mean 'sensors.calibration.lidars.NAME.upside_down'?",
        ),
        ("grid.qqqq=1", "unknown key 'grid.qqqq'; valid here: grid."),
    ],
)
def test_an_unknown_key_names_the_nearest_valid_one(override: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(overrides=[override])
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "grid.resolution_m=-1",
            "override: grid.resolution_m = -1: input should be greater than or equal to",
        ),
        ("layers.climb_m=0.7", "climb_m leaves no obstacle to a robot of robot_height_m"),
        ("grid.resolution_m=true", "grid.resolution_m = true: input should be a valid number"),
        ("grid.resolution_m='0.1'", 'grid.resolution_m = "0.1": input should be a valid number'),
        ("grid.resolution_m=.nan", "grid.resolution_m = NaN: input should be a finite number"),
        ("seed=1.5", "seed = 1.5: input should be a valid integer"),
        ("layers.rule=any", 'layers.rule = "any": input should be \''),
        ("keyframes=3", "keyframes = 3: input should be an object"),
        ("seed.x=1", 'seed = {"x": 1}: input should be a valid integer'),
        ("seed", "override 'seed' is not of the form section.field=value"),
        ("a..b=1", "override 'a..b=1' is not of the form section.field=value"),
        ("seed=[1", "override 'seed=[1': '[1' is not a YAML value"),
    ],
)
def test_a_bad_value_is_reported_in_one_line_with_its_limit(override: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(overrides=[override])
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "grid: {resolution_m: 0}\nseed: -1\n",
            "mine.yaml: seed = -1: input should be greater than or equal to 0; grid",
        ),
        ("- 1\n- 2\n", "holds a list; write 'section:'"),
        ("grid: [1\n", "cannot read"),
        ("2024-01-01: 3\n", "mine.yaml: not plain keys and values"),
        ("seed: &a [*a]\n", "mine.yaml: aliases are not read"),
    ],
)
def test_a_bad_file_is_blamed_by_name(write, text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(write(text), ["seed=1"])
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_preset_or_file_names_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no preset 'lidar2'; did you mean 'lidar2d'\?; presets are: "):
        load_config("lidar2")
    with pytest.raises(ConfigError, match=r"no configuration file at .*none\.yaml; presets are: .*lidar2d"):
        load_config(str(tmp_path / "none.yaml"))


def test_the_dump_is_read_back_as_the_same_configuration(write) -> None:
    config = load_config(overrides=["keyframes.distance_m=1e-5", "layers.rule=printed", "seed=7"])
    text = dump_config(config)
    assert load_config(write(text)) == config
    assert yaml.safe_load(text) == config.model_dump(mode="json")
    assert "# side of a cell (>= 0.001, <= 1)\n  resolution_m: 0.05" in text


def test_every_field_is_described_and_every_model_strict_and_final() -> None:
    for model in models():
        assert issubclass(model, StrictModel) and model.__doc__
        for name, field in model.model_fields.items():
            is_section = isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
            assert is_section or field.description, f"{model.__name__}.{name} needs a description"
    with pytest.raises(ValidationError, match="frozen"):
        Config().seed = 1  # type: ignore[misc]


def test_a_file_of_tags_of_another_program_beside_a_log_is_none_of_ours(tmp_path: Path) -> None:
    """The ROS package apriltag_ros has a file of that name."""
    file = tmp_path / "tags.yaml"
    assert not holds_places(file)
    file.write_text("apriltag:\n  ros__parameters: {family: 36h11, size: 0.16}\n")
    assert not holds_places(file)
    file.write_text("- kitchen\n- hall\n")  # a list, of another program
    assert not holds_places(file)
    file.write_text("size_m: 0.16\nsurveyd: []\n")
    assert holds_places(file)
    with pytest.raises(ConfigError, match="surveyd"):
        with_places(load_config(None, []), file)
