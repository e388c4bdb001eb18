"""What decides a map: log, configuration, versions. A run is resumed by its like alone."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

import fusion
from slam.config import Config
from slam.errors import DatasetError, MapFileError
from slam.storage.map_file import MAP_NAME

_LIBRARIES = ("scanweave", "gtsam", "numpy", "numba", "scipy", "kiss-icp", "opencv-python-headless")
# Images are known by name and size; anything else by its content.
_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm"})
_BLOCK = 1 << 20
# Sections and settings that earlier versions had: what they decided is in the map.
_RETIRED_BY_SECTION = {
    "sensors": "greatest_excess",
    "prediction": "surprise_sigmas",
    "match": "coarse_cell_m fine_cell_m coarse_kernel_m fine_kernel_m",
    "rgbd_odometry": (
        "method local_keyframes iterations coarse_iterations least_inlier_share sure_inlier_share "
        "least_overlap floor_m floor_rad degenerate_sigma_m keyframe_angle_rad lost_after ransac_px"
    ),
    "visual_loops": "enabled near by_looks least_inlier_share least_overlap keyframes_cached",
    "loops": (
        "greatest_half_yaw_rad least_half_width_m least_half_yaw_rad wide_half_width_m "
        "wide_half_yaw_rad candidates submap_half_keyframes submap_half_m submaps_cached field_cell_m "
        "field_sigma_m points least_score"
    ),
    "fusion": "examples",
    "cloud_map": "enabled voxel_m ground_sigma_m",
    "grid": "hit_range_m",
    "dense_map": "octomap_cell_m farthest_m",
    "cloud_odometry": (
        "use_wheel_odometry local_map_keyframes keyframe_angle_rad points_a_voxel iterations "
        "least_inlier_share floor_m floor_rad minimal_residual_m degenerate_share degenerate_sigma_m"
    ),
    "cloud_loops": (
        "enabled caution every_voxels sigmas near by_looks half_keyframes places_cached least_overlap "
        "least_inlier_share"
    ),
    "localization": (
        "lag_nodes field_sigma_m unknown_likelihood search_back_m search_points tile_m tile_reach_m "
        "station_m station_rad news_cell_m kidnap_nats carried_nats looks_nats"
    ),
    "cloud_localization": (
        "tile_voxels tile_keyframes space_voxels tiles_cached thickness_m looks looks_apart_voxels "
        "looks_beside_voxels coarseness arrive_voxels refined hypotheses on_plane_voxels least_stations "
        "map_sigma_m map_sigma_rad"
    ),
}
_RETIRED = frozenset(
    {"bundle", "lidar_odometry"}
    | {
        "visual_loops.near_unlikeness",
        "cloud_loops.greatest_unlikeness",
        "localization.sure_probability",
        "graph.sure_inlier_share",
    }
) | {f"{section}.{name}" for section, names in _RETIRED_BY_SECTION.items() for name in names.split()}
# What a run leaves in the folder of its log where it is told to write there.
_OUTPUTS = frozenset(
    {f"{MAP_NAME}{ending}" for ending in ("", "-wal", "-shm", "-journal")}
    | {"trajectory.tum", "graph.g2o", "map.yaml", "map.pgm", "map.bt", "mesh.ply", "cloud.ply", "lidar.ply"}
    | {"report.html", "layers"}
)


@dataclass(frozen=True, slots=True)
class MapIdentity:
    """What decided a map.

    Attributes
    ----------
    config
        The effective configuration, with the seed.
    log_name, log_fingerprint
        Of the log, see `fingerprint_of`.
    versions
        Of the libraries, and under ``code`` the digest of Scanweave's own source.
    """

    config: Config
    log_name: str
    log_fingerprint: str
    versions: Mapping[str, str]

    def to_meta(self) -> dict[str, str]:
        """As rows of the file."""
        return {
            "config": self.config.model_dump_json(),
            "seed": str(self.config.seed),
            "log_name": self.log_name,
            "log_fingerprint": self.log_fingerprint,
            "versions": json.dumps(dict(self.versions)),
        }

    @classmethod
    def from_meta(cls, meta: Mapping[str, str], path: Path) -> MapIdentity:
        """From rows of the file.

        Raises
        ------
        MapFileError
            Where a row is missing, or the configuration is that of another version.
        """
        try:
            config = Config.model_validate_json(json.dumps(_without_retired(json.loads(meta["config"]))))
            versions = json.loads(meta["versions"])
            return cls(config, meta["log_name"], meta["log_fingerprint"], versions)
        except KeyError as error:
            raise MapFileError(f"{path} does not tell its {error.args[0]}; make the map anew") from error
        except ValidationError as error:
            raise MapFileError(
                f"{path} was made with settings that this version does not know "
                f"({error.errors()[0]['loc'][0]}); make the map anew"
            ) from error
        except ValueError as error:
            raise MapFileError(
                f"{path}: settings or versions cannot be read ({error}); make the map anew"
            ) from error

    def difference(self, now: MapIdentity) -> str | None:
        """What of a run that goes on now is not as it was, in a few words; None where all is the same."""
        if now.log_fingerprint != self.log_fingerprint:
            return f"it was begun with another log, {self.log_name}"
        before, after = (dict(_leaves(one.config.model_dump(mode="json"))) for one in (self, now))
        for name, value in after.items():
            if before[name] != value:
                return f"it was begun with {name}={before[name]}, not {value}"
        for name in {**self.versions, **now.versions}:
            if self.versions.get(name) != now.versions.get(name):
                return f"it was begun with {name} {self.versions.get(name)}, not {now.versions.get(name)}"
        return None


def _without_retired(settings: Any, prefix: str = "") -> Any:
    """Settings as this version knows them."""
    if not isinstance(settings, dict):
        return settings
    return {
        name: _without_retired(value, f"{prefix}{name}.")
        for name, value in settings.items()
        if f"{prefix}{name}" not in _RETIRED
    }


def identity_of(log: Path, config: Config) -> MapIdentity:
    """What decides the map of a log."""
    return MapIdentity(config, log.name, fingerprint_of(log), current_versions())


def current_versions() -> dict[str, str]:
    """Versions of the libraries that decide a result, and the digest of Scanweave's own source."""
    return {**_versions(), "code": _code_digest()}


def fingerprint_of(log: Path) -> str:
    """Digest of a log: the names, sizes and contents of its files, of images name and size alone.

    What an earlier run has written into the folder of its log is passed over.

    Raises
    ------
    DatasetError
        Where it cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        root = log
        while not root.exists():  # a session in a database: DATABASE/SESSION
            digest.update(root.name.encode())
            root = root.parent
        for file in _files(root) if root.is_dir() else [root]:
            name = file.relative_to(root).as_posix() if root.is_dir() else ""
            digest.update(f"{name}\0{file.stat().st_size}\0".encode())
            if file.suffix.lower() not in _IMAGES:
                with file.open("rb") as stream:
                    while block := stream.read(_BLOCK):
                        digest.update(block)
    except OSError as error:
        raise DatasetError(f"cannot read {log}: {error.strerror or error}") from error
    return digest.hexdigest()


def _files(root: Path) -> list[Path]:
    """The files of a log's folder, without those of maps that were made of it."""
    maps = {found.parent for found in root.rglob(MAP_NAME)} - {root}
    return [
        file
        for file in sorted(root.rglob("*"))
        if file.is_file()
        and maps.isdisjoint(file.parents)
        and file.relative_to(root).parts[0] not in _OUTPUTS
    ]


def _versions() -> dict[str, str]:
    """Versions of the libraries."""
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


@cache
def _code_digest() -> str:
    """Digest of Scanweave's own source, as it is when first asked for: later edits are not what runs."""
    digest = hashlib.blake2b(digest_size=8)
    for root in (Path(__file__).parents[1], Path(fusion.__file__).parent):
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every setting."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
