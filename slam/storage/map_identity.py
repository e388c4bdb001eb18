"""What determines a map: log, configuration, versions. A run is only resumed if they are the same."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

import fusion
from slam.config import Config, leaves
from slam.datasets.dataset import Dataset
from slam.errors import DatasetError, MapFileError
from slam.foreign import from_json, plain
from slam.storage.map_file import MAP_NAME
from slam.version import __version__

_LIBRARIES = ("gtsam", "numpy", "numba", "scipy", "opencv-python-headless")
# The fact that contains the settings.
CONFIG = "config"
# Images are identified by name and size, other files by their content.
_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm"})
_BLOCK = 1 << 20
# Files of a run that writes into the folder of its log.
_OUTPUTS = frozenset(
    {f"{MAP_NAME}{ending}" for ending in ("", "-wal", "-shm", "-journal")}
    | {"trajectory.tum", "graph.g2o", "map.yaml", "map.pgm", "map.bt", "mesh.ply", "cloud.ply", "lidar.ply"}
    | {"report.html", "layers", "trajectory_covariance.csv", "edits.yaml"}
    | {f"{name}_mask.{ending}" for name in ("keepout", "speed") for ending in ("yaml", "pgm")}
)


@dataclass(frozen=True, slots=True)
class MapIdentity:
    """What determines a map.

    Attributes
    ----------
    config
        The configuration, with the seed.
    log_name, log_fingerprint
        Name and digest of the log, see `fingerprint_of`.
    versions
        Versions of the libraries, and under ``code`` the digest of Scanweave's own source.
    """

    config: Config
    log_name: str
    log_fingerprint: str
    versions: Mapping[str, str]

    def to_meta(self) -> dict[str, str]:
        """Return the rows of the file."""
        return {
            CONFIG: self.config.model_dump_json(),
            "seed": str(self.config.seed),
            "log_name": self.log_name,
            "log_fingerprint": self.log_fingerprint,
            "versions": json.dumps(dict(self.versions)),
        }

    @classmethod
    def from_meta(cls, meta: Mapping[str, str], path: Path) -> MapIdentity:
        """Create it from rows of the file.

        Raises
        ------
        MapFileError
            If a row is missing, or the configuration is of another version.
        """
        try:
            config = Config.model_validate_json(json.dumps(_known(from_json(meta[CONFIG]))))
            versions = from_json(meta["versions"])
            if not isinstance(versions, dict) or not all(isinstance(one, str) for one in versions.values()):
                raise ValueError("versions are names and texts")
            return cls(config, meta["log_name"], meta["log_fingerprint"], versions)
        except KeyError as error:
            raise MapFileError(f"{path} does not contain its {error.args[0]}; make the map anew") from error
        except ValidationError as error:
            raise MapFileError(
                f"{path} was made with settings that this version does not take "
                f"({'.'.join(map(str, error.errors()[0]['loc'])) or 'no settings'}); make the map anew"
            ) from error
        except ValueError as error:
            raise MapFileError(
                f"{path}: settings or versions cannot be read ({error}); make the map anew"
            ) from error

    def difference(self, now: MapIdentity) -> str | None:
        """Describe what differs from an interrupted run in a few words; None if nothing differs."""
        if now.log_fingerprint != self.log_fingerprint:
            return f"it was begun with another log, {self.log_name}"
        before, after = (dict(leaves(identity.config.model_dump(mode="json"))) for identity in (self, now))
        for name in {**before, **after}:
            if before.get(name) != after.get(name):
                return f"it was begun with {name}={before.get(name)}, not {after.get(name)}"
        for name in {**self.versions, **now.versions}:
            if self.versions.get(name) != now.versions.get(name):
                return f"it was begun with {name} {self.versions.get(name)}, not {now.versions.get(name)}"
        return None


def _known(settings: Any, model: type[BaseModel] = Config) -> Any:
    """Keep the settings that this version knows; the effects of others are already in the map."""
    if not isinstance(settings, dict):
        return settings
    kinds = {name: field.annotation for name, field in model.model_fields.items() if name in settings}
    return {
        name: _known(settings[name], kind)
        if isinstance(kind, type) and issubclass(kind, BaseModel)
        else settings[name]
        for name, kind in kinds.items()
    }


def identity_of(log: Path | Dataset, config: Config) -> MapIdentity:
    """Return the identity of a map; a log without file is identified by its stamps and sensors."""
    path = log if isinstance(log, Path) else log.path
    if isinstance(log, Path) or path.exists() or any(at.is_file() for at in path.parents):
        fingerprint = fingerprint_of(path)
    else:
        digest = hashlib.blake2b(digest_size=16)
        for measurement in log:
            digest.update(f"{measurement.sensor}\0{measurement.stamp_s!r}\0".encode())
        fingerprint = digest.hexdigest()
    return MapIdentity(config, plain(path.name), fingerprint, current_versions())


def current_versions() -> dict[str, str]:
    """Return versions of the libraries that affect a result, and the digest of Scanweave's own source."""
    return {**_versions(), "code": _code_digest()}


def fingerprint_of(log: Path) -> str:
    """Return the digest of a log: names, sizes and checksums of its files; for images only name and size.

    It distinguishes logs, but is no protection against forgery: it uses a checksum of each block, at a fifth
    of the cost of a cryptographic digest. Files that an earlier run wrote into the folder of the log are
    ignored.

    Raises
    ------
    DatasetError
        If it cannot be read.
    """
    digest, block = hashlib.blake2b(digest_size=16), memoryview(bytearray(_BLOCK))
    try:
        root = log
        while not root.exists():  # a session in a database: DATABASE/SESSION
            digest.update(os.fsencode(root.name))
            root = root.parent
        for file in _files(root) if root.is_dir() else [root]:
            name = file.relative_to(root).as_posix() if root.is_dir() else ""
            digest.update(os.fsencode(f"{name}\0{file.stat().st_size}\0"))
            if file.suffix.lower() not in _IMAGES:
                with file.open("rb") as stream:
                    while count := stream.readinto(block):
                        digest.update(zlib.crc32(block[:count]).to_bytes(4, "little"))
    except OSError as error:
        raise DatasetError(f"cannot read {log}: {error.strerror or error}") from error
    return digest.hexdigest()


def _files(root: Path) -> list[Path]:
    """Return the files of a log's folder, without those of its maps."""
    maps = {entry.parent for entry in root.rglob(MAP_NAME)} - {root}
    return [
        file
        for file in sorted(root.rglob("*"))
        if file.is_file()
        and maps.isdisjoint(file.parents)
        and file.relative_to(root).parts[0] not in _OUTPUTS
    ]


def _versions() -> dict[str, str]:
    """Return the versions of the libraries."""
    versions = {"scanweave": __version__}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "unknown"
    return versions


@cache
def _code_digest() -> str:
    """Return the digest of Scanweave's own source at the first call: later edits are not what runs."""
    digest = hashlib.blake2b(digest_size=8)
    for root in (Path(__file__).parents[1], Path(fusion.__file__).parent):
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


# Warnings and notes of the run, as rows of the file.
NOTES, WARNINGS = "notes", "warnings"


def lines_of(meta: Mapping[str, str], key: str, path: Path) -> list[str]:
    """Return lines of text from a row of the file; none in a map of an older version."""
    try:
        return TypeAdapter(list[str]).validate_json(meta.get(key, "[]"), strict=True)
    except ValidationError as error:
        raise MapFileError(f"{path} has no {key} ({error.errors()[0]['msg']}); make the map anew") from error
