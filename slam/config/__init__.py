"""One typed, frozen model a stage; unknown keys are errors that name the nearest valid one.

A preset is a YAML file under ``configs/`` that states only what differs from the defaults below.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from slam.config.calibration import Calibration
from slam.config.clouds import CloudLoopConfig, CloudMapConfig, CloudOdometryConfig
from slam.config.localization import CloudLocalizationConfig, LocalizationConfig
from slam.config.stages import (
    DenseMapConfig,
    FusionConfig,
    GraphConfig,
    GridConfig,
    KeyframeConfig,
    LayersConfig,
    LoopConfig,
    MatchConfig,
    PredictionConfig,
    RgbdConfig,
    RgbdOdometryConfig,
    ScanConfig,
    SensorsConfig,
    VisualLoopConfig,
    WheelConfig,
)
from slam.config.strict import StrictModel
from slam.config.tags import KnownPlaces
from slam.errors import ConfigError
from slam.foreign import Loader, from_yaml

DEFAULT_PRESET = "lidar2d"

# What files of lenses and mountings begin with, or have at the beginning of a line.
_FOREIGN = re.compile(
    r"\A\s*<|^(%YAML|cam\d+:|Camera1?\.|transforms:|child_frame_id:|sensor_type:|trans_matrix:|intrinsics:"
    r"|depth_steps_per_m:|T_base_(camera|lidar):|\w*(camera|intrinsic)_?matrix\w*:|[kK]:|image_width:|distortion_model:)",
    re.MULTILINE,
)
# A link to the top-level configs/, so that a wheel carries the presets as package data of slam.
_PRESET_FOLDER = Path(__file__).parents[1] / "presets"


class Config(StrictModel):
    """Everything that decides a run, besides the log itself.

    Examples
    --------
    >>> import slam
    >>> config = slam.load_config(overrides=["grid.resolution_m=0.1"])
    >>> config  # what differs from the defaults
    Config(grid=GridConfig(resolution_m=0.1))
    >>> config.keyframes.distance_m == slam.Config().keyframes.distance_m
    True
    """

    seed: int = Field(default=0, ge=0, description="seed of every random generator of the run")
    sensors: SensorsConfig = SensorsConfig()
    scan: ScanConfig = ScanConfig()
    match: MatchConfig = MatchConfig()
    prediction: PredictionConfig = PredictionConfig()
    wheels: WheelConfig = WheelConfig()
    rgbd: RgbdConfig = RgbdConfig()
    rgbd_odometry: RgbdOdometryConfig = RgbdOdometryConfig()
    visual_loops: VisualLoopConfig = VisualLoopConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    loops: LoopConfig = LoopConfig()
    graph: GraphConfig = GraphConfig()
    fusion: FusionConfig = FusionConfig()
    grid: GridConfig = GridConfig()
    layers: LayersConfig = LayersConfig()
    dense_map: DenseMapConfig = DenseMapConfig()
    cloud_odometry: CloudOdometryConfig = CloudOdometryConfig()
    cloud_loops: CloudLoopConfig = CloudLoopConfig()
    cloud_map: CloudMapConfig = CloudMapConfig()
    localization: LocalizationConfig = LocalizationConfig()
    cloud_localization: CloudLocalizationConfig = CloudLocalizationConfig()


def preset_names() -> list[str]:
    """Names that ``load_config`` takes instead of a path, sorted.

    Examples
    --------
    >>> from slam.config import preset_names
    >>> preset_names()
    ['lidar2d']
    """
    return sorted(file.stem for file in _PRESET_FOLDER.glob("*.yaml"))


def load_config(
    preset_or_path: str | None = None,
    overrides: Sequence[str] = (),
    *,
    calibration: Path | str | None = None,
) -> Config:
    """Build the effective configuration: defaults, then a preset or file, then overrides.

    Parameters
    ----------
    preset_or_path
        Name of a preset, or path of a YAML file (ends in .yaml or .yml); None takes the default preset.
    overrides
        Texts like ``keyframes.distance_m=0.3``; the right side is read as YAML. Later ones win.
    calibration
        File of corrections of the log's sensors, see `load_calibration`, which takes the place of
        ``sensors.calibration``; or one of lenses and mountings, which is added to
        ``sensors.calibration_files``.

    Raises
    ------
    ConfigError
        For a missing or malformed file, an unknown key (with the nearest valid one) or a bad value
        (with its limit).

    Examples
    --------
    >>> import slam
    >>> config = slam.load_config(overrides=["keyframes.distance_m=0.3"])
    >>> config.keyframes.distance_m, config.grid.resolution_m
    (0.3, 0.05)
    """
    overrides = [overrides] if isinstance(overrides, str) else overrides
    file = _find_file(preset_or_path or DEFAULT_PRESET)
    tree = _read_tree(file)
    # The file is judged alone first, so that a message blames the file or the override, not both.
    config = _validated(tree, source=file.name)
    if overrides:
        for override in overrides:
            _apply_override(tree, override)
        config = _validated(tree, source="override")
    return config if calibration is None else with_calibration(config, calibration)


def config_of(config: Config | str | None) -> Config:
    """A configuration, or what `load_config` makes of a preset's or a file's name; errors as there."""
    return config if isinstance(config, Config) else load_config(config)


def with_calibration(config: Config, file: Path | str) -> Config:
    """A configuration with a file of corrections, or with one of lenses and mountings by other tools.

    Raises
    ------
    ConfigError
        As `load_calibration`, unless the file is of the other sort: those are read with the log.
    """
    path = Path(file)
    if path.is_file() and _FOREIGN.search(path.read_text(encoding="utf-8", errors="replace")):
        files = (*config.sensors.calibration_files, str(path.resolve()))
        sensors = config.sensors.model_copy(update={"calibration_files": files})
        return config.model_copy(update={"sensors": sensors})
    return calibrated(config, load_calibration(path))


def with_places(config: Config, file: Path | str) -> Config:
    """A configuration with a file of tags and surveyed places; `ConfigError` as `load_calibration`."""
    if not Path(file).is_file():
        raise ConfigError(f"no file of tags at {file}; it begins with 'size_m: 0.16', the side of a tag")
    try:
        places = _validated({"sensors": {"tags": _read_tree(Path(file))}}, str(file)).sensors.tags
    except ConfigError as error:
        raise ConfigError(str(error).replace("sensors.tags.", "")) from None
    return config.model_copy(update={"sensors": config.sensors.model_copy(update={"tags": places})})


def holds_places(file: Path) -> bool:
    """Whether a file that nobody has named tells of tags; other programs have files of that name, too."""
    return file.is_file() and bool(_read_tree(file).keys() & KnownPlaces.model_fields.keys())


def load_calibration(file: Path | str) -> Calibration:
    """Corrections of a log's sensors, as ``scanweave doctor --write`` writes them.

    Raises
    ------
    ConfigError
        For a missing or malformed file, an unknown key or a bad value.
    """
    if not Path(file).is_file():
        raise ConfigError(f"no calibration file at {file}; 'scanweave doctor LOG --write {file}' makes one")
    tree = {"sensors": {"calibration": _read_tree(Path(file))}}
    try:
        return _validated(tree, str(file)).sensors.calibration
    except ConfigError as error:
        raise ConfigError(str(error).replace("sensors.calibration.", "")) from None


def dump_calibration(calibration: Calibration) -> str:
    """YAML text of corrections; `load_calibration` reads it back."""
    return yaml.safe_dump(calibration.plain(), sort_keys=False, default_flow_style=None)


def calibrated(config: Config, calibration: Calibration) -> Config:
    """A configuration with other corrections of the log's sensors."""
    sensors = config.sensors.model_copy(update={"calibration": calibration})
    return config.model_copy(update={"sensors": sensors})


def with_settings(config: Config, overrides: Sequence[str]) -> Config:
    """A configuration with other values, given as `load_config` takes them; `ConfigError` as there.

    Examples
    --------
    >>> import slam
    >>> from slam.config import with_settings
    >>> with_settings(slam.Config(), ["grid.resolution_m=0.02"]).grid.resolution_m
    0.02
    """
    tree = config.model_dump(mode="json")
    for override in overrides:
        _apply_override(tree, override)
    return _validated(tree, source="override")


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every setting of a nested mapping."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def dump_config(config: StrictModel) -> str:
    """YAML text of a configuration, each field under its description; ``load_config`` reads it back.

    Examples
    --------
    >>> import slam
    >>> from slam.config import dump_config
    >>> print(dump_config(slam.load_config().grid)[:52])
    # side of a cell (>= 0.001, <= 1)
    resolution_m: 0.05
    """
    return "\n".join(_dump_lines(config, indent="")) + "\n"


class ConfigLoader(Loader):  # type: ignore[misc]
    """Safe YAML 1.1, but ``1e-3`` is a number as everywhere else."""


ConfigLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def _find_file(preset_or_path: str) -> Path:
    """Path of a preset or of a file of one's own."""
    if not isinstance(preset_or_path, str | Path):
        given = type(preset_or_path).__name__
        raise ConfigError(f"a {given} is no configuration; give one by slam.load_config, or a preset or file")
    if Path(preset_or_path).suffix in {".yaml", ".yml"}:
        file = Path(preset_or_path)
        if not file.is_file():
            raise ConfigError(f"no configuration file at {file}; presets are: {', '.join(preset_names())}")
        return file
    names = preset_names()
    if preset_or_path not in names:
        hint = nearest(preset_or_path, names)
        raise ConfigError(
            f"no preset '{preset_or_path}'{hint}; presets are: {', '.join(names)}; "
            "a file of your own must end in .yaml"
        )
    return _PRESET_FOLDER / f"{preset_or_path}.yaml"


def _read_tree(file: Path) -> dict[str, Any]:
    """Nested mapping in a YAML file; an empty file is an empty mapping."""
    try:
        tree = from_yaml(file.read_text(encoding="utf-8"), ConfigLoader)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {file}: {' '.join(str(error).split())}") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{file} holds a {type(tree).__name__}; write 'section:' and its keys under it")
    return tree


def _apply_override(tree: dict[str, Any], override: str) -> None:
    """Set one ``a.b=value`` in the tree."""
    dotted, equals, text = override.partition("=")
    names = [name.strip() for name in dotted.split(".")]
    if not equals or not all(names):
        raise ConfigError(f"override '{override}' is not of the form section.field=value")
    try:
        value = from_yaml(text, ConfigLoader)
    except ValueError as error:
        raise ConfigError(f"override '{override}': '{text}' is not a YAML value") from error
    node = tree
    for name in names[:-1]:
        child = node.get(name)
        if not isinstance(child, dict):  # absent, or a value where a section belongs: the latter is unknown
            child = node[name] = {}
        node = child
    node[names[-1]] = value


def _validated(tree: Mapping[str, Any], source: str) -> Config:
    """Turn a tree into a Config, or all its faults into one line."""
    try:
        # By way of JSON, since there strict mode still takes a list for a tuple.
        return Config.model_validate_json(json.dumps(tree, default=str))
    except ValidationError as error:
        raise ConfigError(f"{source}: " + "; ".join(map(_describe, error.errors()))) from None
    except (TypeError, ValueError) as error:  # a date as a key, an anchor that holds itself
        raise ConfigError(f"{source}: not plain keys and values ({error})") from error


def _describe(fault: ErrorDetails) -> str:
    """One fault of pydantic's in the words of a user: dotted path, value, limit."""
    dotted = ".".join(str(part) for part in fault["loc"])
    if fault["type"] != "extra_forbidden":
        value = json.dumps(fault["input"], default=str)
        return f"{dotted} = {value}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
    return f"unknown key '{dotted}'{_nearest_key(dotted)}"


def _nearest_key(dotted: str) -> str:
    """A hint at the key meant: the same name elsewhere, else a similar one beside it, else anywhere."""
    section, _, name = dotted.rpartition(".")
    paths = list(_all_paths(Config))
    # Only last names are compared: a long shared section would make every key in it look similar.
    anywhere = {path.rpartition(".")[2]: path for path in paths}
    beside = {path.rpartition(".")[2]: path for path in paths if path.rpartition(".")[0] == section}
    for candidates in ({name: anywhere[name]} if name in anywhere else {}, beside, anywhere):
        match = difflib.get_close_matches(name, candidates, n=1)
        if match:
            return f"; did you mean '{candidates[match[0]]}'?"
    return f"; valid here: {', '.join(beside.values())}"


def nearest(name: str, candidates: Sequence[str]) -> str:
    """A hint at the most similar candidate, or nothing.

    Examples
    --------
    >>> from slam.config import nearest
    >>> nearest("resolution", ["resolution_m", "margin_m"])
    "; did you mean 'resolution_m'?"
    """
    match = difflib.get_close_matches(name, candidates, n=1)
    return f"; did you mean '{match[0]}'?" if match else ""


def _all_paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Dotted path of every section and field."""
    for name, field in model.model_fields.items():
        yield prefix + name
        section = field.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            yield from _all_paths(section, f"{prefix}{name}.")


def _dump_lines(model: BaseModel, indent: str) -> Iterator[str]:
    """Lines of one model: a comment and a value a field, sections nested."""
    values = model.model_dump(mode="json")
    for name, field in type(model).model_fields.items():
        section = getattr(model, name)
        if isinstance(section, BaseModel):
            yield f"\n{indent}# {(type(section).__doc__ or '').strip().splitlines()[0]}"
            yield f"{indent}{name}:"
            yield from _dump_lines(section, indent + "  ")
            continue
        yield f"{indent}# {field.description or name}{_limits(field)}"
        text = yaml.safe_dump(values[name], default_flow_style=True, width=2**20).splitlines()[0]
        yield f"{indent}{name}: {text}"


def _limits(field: FieldInfo) -> str:
    """The limits of a field as text, `` (> 0, <= 1)``, or nothing."""
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    found = [
        f"{sign} {getattr(limit, name):g}"
        for limit in field.metadata
        for name, sign in signs.items()
        if hasattr(limit, name)
    ]
    return f" ({', '.join(found)})" if found else ""
