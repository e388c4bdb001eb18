"""The base class of all settings; read YAML files of them, with errors of one line."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from slam.errors import ConfigError
from slam.foreign import Loader, from_yaml, plain

Model = TypeVar("Model", bound=BaseModel)


class ConfigLoader(Loader):  # type: ignore[misc]
    """Safe YAML 1.1, but ``1e-3`` is a number as everywhere else."""


ConfigLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def find_file(name_or_path: str, folder: Path, kind: str) -> Path:
    """Path of a file of the user (ends in .yaml or .yml), or of a named one in a folder.

    Raises
    ------
    ConfigError
        If there is no such file.
    """
    names = sorted(file.stem for file in folder.glob("*.yaml"))
    if Path(name_or_path).suffix in {".yaml", ".yml"}:
        file = Path(name_or_path)
        if not file.is_file():
            raise ConfigError(f"no configuration file at {file}; {kind}s are: {', '.join(names)}")
        return file
    if name_or_path not in names:
        raise ConfigError(
            f"no {kind} '{name_or_path}'{nearest(name_or_path, names)}; {kind}s are: {', '.join(names)}; "
            "a file of your own must end in .yaml"
        )
    return folder / f"{name_or_path}.yaml"


def read_tree(file: Path) -> Any:
    """Read a YAML file; an empty file gives an empty mapping."""
    try:
        tree = from_yaml(file.read_text(encoding="utf-8"), ConfigLoader)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {file}: {' '.join(str(error).split())}") from error
    return {} if tree is None else tree


def model_of(
    kind: type[Model],
    tree: Any,
    source: str,
    hint: Callable[[str], str] | None = None,
    *,
    most: int | None = None,
) -> Model:
    """Validate plain values as a model.

    Parameters
    ----------
    source
        Where they came from; used in messages.
    hint
        Text to add for an unknown dotted key; None suggests a similar key of the model.
    most
        Largest number of errors in the message; the rest are counted.

    Raises
    ------
    ConfigError
        If the values are no mapping, a key is unknown or a value is invalid.
    """
    if not isinstance(tree, dict):
        raise ConfigError(f"{source} holds a {type(tree).__name__}; write 'section:' and its keys under it")
    try:
        # Via JSON, because strict mode then still accepts a list for a tuple.
        return kind.model_validate_json(json.dumps(tree, default=str))
    except ValidationError as error:
        # An unknown key is more informative than the missing key that it replaces.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
        texts = [_described(fault, hint or partial(_nearest_key, kind)) for fault in faults[:most]]
        more = [f"and {len(faults) - len(texts)} more"] if len(faults) > len(texts) else []
        raise ConfigError(f"{source}: {'; '.join(texts + more)}") from None
    except (TypeError, ValueError, RecursionError) as error:  # a date as a key, a recursive anchor
        raise ConfigError(f"{source}: not plain keys and values ({error})") from error


def _described(fault: ErrorDetails, hint: Callable[[str], str]) -> str:
    """Describe one pydantic error for users: dotted path, value, limit."""
    dotted = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"unknown key '{dotted}'{hint(dotted)}"
    problem = fault["msg"].removeprefix("Value error, ")
    shown = plain(json.dumps(fault["input"], default=str), longest=60)
    return f"{dotted} = {shown}: {problem[0].lower()}{problem[1:]}" if dotted else problem


def nearest(name: str, candidates: Sequence[str]) -> str:
    """Return a hint at the most similar candidate, or an empty text."""
    match = difflib.get_close_matches(name, candidates, n=1)
    return f"; did you mean '{match[0]}'?" if match else ""


def _nearest_key(model: type[BaseModel], dotted: str) -> str:
    """Suggest a key: the same name elsewhere, else a similar name in the same section, else anywhere."""
    section, _, name = dotted.rpartition(".")
    paths = list(_all_paths(model))
    # Only last names are compared: a long shared section would make every key in it look similar.
    anywhere = {path.rpartition(".")[2]: path for path in paths}
    in_section = {path.rpartition(".")[2]: path for path in paths if path.rpartition(".")[0] == section}
    for candidates in ({name: anywhere[name]} if name in anywhere else {}, in_section, anywhere):
        match = difflib.get_close_matches(name, candidates, n=1)
        if match:
            return f"; did you mean '{candidates[match[0]]}'?"
    return f"; valid here: {', '.join(in_section.values())}"


def _all_paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield the dotted path of every section and field."""
    for name, field in model.model_fields.items():
        yield prefix + name
        named = get_origin(field.annotation) is dict  # sensors by their names
        section = get_args(field.annotation)[-1] if named else field.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            yield from _all_paths(section, f"{prefix}{name}.{'NAME.' if named else ''}")


def nearest_field(models: Iterable[type[BaseModel]]) -> Callable[[str], str]:
    """Return a function that suggests the most similar field name of some models."""
    names = sorted({name for model in models for name in model.model_fields})
    return lambda dotted: nearest(dotted.rpartition(".")[2], names)


class StrictModel(BaseModel):
    """Base of all stage models: unknown keys and implicit type conversions are errors; values are final."""

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Return the fields that differ from their defaults: `repr` shows only these."""
        fields = type(self).model_fields
        shown = super().__repr_args__()
        return [arg for arg in shown if arg[1] != fields[str(arg[0])].get_default(call_default_factory=True)]

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
