"""Configuration: one typed, frozen model per stage; errors of unknown keys name the nearest valid key.

A preset is a YAML file under ``configs/``. It contains only values that differ from the defaults.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, Field
from pydantic.fields import FieldInfo

from slam.config.calibration import Calibration
from slam.config.clouds import CloudLoopConfig, CloudMapConfig, CloudOdometryConfig
from slam.config.files import ConfigLoader, StrictModel, find_file, model_of, read_tree
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
from slam.config.tags import KnownPlaces
from slam.errors import ConfigError
from slam.foreign import from_yaml

DEFAULT_PRESET = "lidar2d"

# Calibration files of other tools start with this, or contain it at the start of a line.
_FOREIGN = re.compile(
    r"\A\s*<|^(%YAML|cam\d+:|Camera1?\.|transforms:|child_frame_id:|sensor_type:|trans_matrix:|intrinsics:"
    r"|depth_steps_per_m:|T_base_(camera|lidar):|\w*(camera|intrinsic)_?matrix\w*:|[kK]:|image_width:|distortion_model:)",
    re.MULTILINE,
)
# A link to the top-level configs/, so that a wheel carries the presets as package data of slam.
_PRESET_FOLDER = Path(__file__).parents[1] / "presets"


class Config(StrictModel):
    """All settings that determine a run, besides the log itself.

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


def load_config(
    preset_or_path: str | None = None, overrides: Sequence[str] = (), *, calibration: Path | str | None = None
) -> Config:
    """Build the effective configuration: defaults, then a preset or file, then overrides.

    Parameters
    ----------
    preset_or_path
        Name of a preset, or path of a YAML file (ends in .yaml or .yml); None uses the default preset.
    overrides
        Strings like ``keyframes.distance_m=0.3``; the right side is read as YAML. Later ones take precedence.
    calibration
        File of corrections of the log's sensors (see `load_calibration`); it replaces
        ``sensors.calibration``. Or a file of camera intrinsics and mountings; it is added to
        ``sensors.calibration_files``.

    Raises
    ------
    ConfigError
        If a file is missing or malformed, a key is unknown (the message names the nearest valid key) or a
        value is invalid (the message names its limit).

    Examples
    --------
    >>> import slam
    >>> config = slam.load_config(overrides=["keyframes.distance_m=0.3"])
    >>> config.keyframes.distance_m, config.grid.resolution_m
    (0.3, 0.05)
    """
    overrides = [overrides] if isinstance(overrides, str) else overrides
    if not isinstance(preset_or_path, str | Path | None):
        kind = type(preset_or_path).__name__
        raise ConfigError(f"a {kind} is no configuration; give one by slam.load_config, or a preset or file")
    file = find_file(preset_or_path or DEFAULT_PRESET, _PRESET_FOLDER, "preset")
    tree = read_tree(file)
    # The file is validated alone first, so that a message refers to the file or to the override.
    config = model_of(Config, tree, file.name)
    config = with_settings(config, overrides) if overrides else config
    return config if calibration is None else with_calibration(config, calibration)


def config_of(config: Config | str | None) -> Config:
    """Return a configuration as it is, or load it by name with `load_config`; raises as that does."""
    return config if isinstance(config, Config) else load_config(config)


def with_calibration(config: Config, file: Path | str) -> Config:
    """Return a configuration with a file of corrections added, or of intrinsics and mountings of other tools.

    Raises
    ------
    ConfigError
        As `load_calibration`. Files of other tools are not checked here: they are read with the log.
    """
    path = Path(file)
    if path.is_file() and _FOREIGN.search(path.read_text(encoding="utf-8", errors="replace")):
        files = (*config.sensors.calibration_files, str(path.resolve()))
        sensors = config.sensors.model_copy(update={"calibration_files": files})
        return config.model_copy(update={"sensors": sensors})
    return calibrated(config, load_calibration(path))


def with_places(config: Config, file: Path | str) -> Config:
    """Return a configuration with a file of tags and surveyed points; raises as `load_calibration`."""
    if not Path(file).is_file():
        raise ConfigError(f"no file of tags at {file}; it begins with 'size_m: 0.16', the side of a tag")
    places = model_of(KnownPlaces, read_tree(Path(file)), str(file))
    return config.model_copy(update={"sensors": config.sensors.model_copy(update={"tags": places})})


def holds_places(file: Path) -> bool:
    """Whether a file found by its name describes tags; files of other programs may have the same name."""
    tree = read_tree(file) if file.is_file() else None
    return isinstance(tree, dict) and bool(tree.keys() & KnownPlaces.model_fields.keys())


def load_calibration(file: Path | str) -> Calibration:
    """Load corrections of a log's sensors from a file that ``scanweave doctor --write`` wrote.

    Raises
    ------
    ConfigError
        If the file is missing or malformed, a key is unknown or a value is invalid.
    """
    if not Path(file).is_file():
        raise ConfigError(f"no calibration file at {file}; 'scanweave doctor LOG --write {file}' makes one")
    return model_of(Calibration, read_tree(Path(file)), str(file))


def dump_calibration(calibration: Calibration) -> str:
    """Return corrections as YAML text; `load_calibration` reads it."""
    return yaml.safe_dump(calibration.plain(), sort_keys=False, default_flow_style=None)


def calibrated(config: Config, calibration: Calibration) -> Config:
    """Return a configuration with other corrections of the log's sensors."""
    sensors = config.sensors.model_copy(update={"calibration": calibration})
    return config.model_copy(update={"sensors": sensors})


def with_settings(config: Config, overrides: Sequence[str]) -> Config:
    """Return a configuration with overrides in the form that `load_config` takes; raises as that does.

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
    return model_of(Config, tree, "override")


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every setting in a nested mapping."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def dump_config(config: StrictModel) -> str:
    """Return a configuration as YAML text, each field below its description; ``load_config`` reads it.

    Examples
    --------
    >>> import slam
    >>> from slam.config import dump_config
    >>> print(dump_config(slam.load_config().grid)[:52])
    # side of a cell (>= 0.001, <= 1)
    resolution_m: 0.05
    """
    return "\n".join(_dump_lines(config, indent="")) + "\n"


def _apply_override(tree: dict[str, Any], override: str) -> None:
    """Set one ``a.b=value`` in the tree."""
    dotted, equals, text = str(override).partition("=")
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
        if not isinstance(child, dict):  # absent, or a value instead of a section, which is unknown
            child = node[name] = {}
        node = child
    node[names[-1]] = value


def _dump_lines(model: BaseModel, indent: str) -> Iterator[str]:
    """Lines of one model: a comment and a value per field, sections nested."""
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
    limits = [
        f"{sign} {getattr(limit, name):g}"
        for limit in field.metadata
        for name, sign in signs.items()
        if hasattr(limit, name)
    ]
    return f" ({', '.join(limits)})" if limits else ""
