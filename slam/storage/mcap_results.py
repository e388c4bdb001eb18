"""Results of a map as a ROS 2 bag in MCAP for Foxglove and RViz: plan, path, frames and clouds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError
from slam.estimates import Trajectory
from slam.mapping.occupancy_grid import StateGrid
from slam.measurements import Float32Array, FloatArray
from slam.storage import ros_messages as ros
from slam.storage.files import make_folder
from slam.temporary import TemporaryFolder

_MAP, _BASE = "map", "base_link"
_GRID, _PATH, _POSE = "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped"
_TOPICS = {
    "/map": _GRID,
    "/path": _PATH,
    "/pose": _POSE,
    "/tf": ros.TRANSFORMS,
    "/tf_static": ros.TRANSFORMS,
    "/points": ros.POINT_CLOUD,
}


def write_results_bag(
    folder: Path,
    plan: StateGrid | None,
    trajectory: Trajectory,
    mounts: Mapping[str, gtsam.Pose3],
    points: Iterable[tuple[float, FloatArray, NDArray[np.uint8] | None, Float32Array | None]],
) -> Path:
    """Write a bag: ``/map`` and ``/path`` once, ``/pose`` and ``/tf`` at each reading, ``/points`` in it.

    Parameters
    ----------
    folder
        Must not exist yet.
    mounts
        Mounting of each sensor on the base, for ``/tf_static``.
    points
        Stamp, (N, 3) in the map frame, and (N, 3) RGB and (N,) intensities of each cloud, if it has any.

    Raises
    ------
    MapFileError
        If the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

    store = ros.typestore()
    poses, stamps_s = trajectory.poses(), trajectory.stamps_s.tolist()
    begin_s = min(stamps_s)
    if folder.exists():
        raise MapFileError(f"cannot write {folder}: it exists; give a folder that is not there yet")
    make_folder(folder.parent)
    try:
        kept_in = TemporaryFolder(folder.parent)
        bag_path = kept_in.path / folder.name
        with Writer(bag_path, version=ros.BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            connections = {
                topic: bag.add_connection(
                    topic,
                    kind,
                    typestore=store,
                    offered_qos_profiles=[ros.latched()] if topic in ("/map", "/path", "/tf_static") else (),
                )
                for topic, kind in _TOPICS.items()
            }

            def send(topic: str, stamp_s: float, message: Any) -> None:
                content = store.serialize_cdr(message, _TOPICS[topic])
                bag.write(connections[topic], ros.nanoseconds(stamp_s), content)

            if plan is not None:
                send("/map", begin_s, _grid(plan, begin_s))
            stamped = [
                ros.new(_POSE, header=ros.header(stamp_s, _MAP), pose=ros.pose_message(pose))
                for stamp_s, pose in zip(stamps_s, poses, strict=True)
            ]
            send("/path", begin_s, ros.new(_PATH, header=ros.header(begin_s, _MAP), poses=stamped))
            send("/tf_static", begin_s, ros.transforms(begin_s, _BASE, mounts))
            for stamp_s, pose, message in zip(stamps_s, poses, stamped, strict=True):
                send("/pose", stamp_s, message)
                send("/tf", stamp_s, ros.transforms(stamp_s, _MAP, {_BASE: pose}))
            for stamp_s, placed, colors, intensities in points:
                rows = _rows(placed, colors, intensities)
                send("/points", stamp_s, ros.cloud_message(rows, stamp_s, _MAP))
        bag_path.rename(folder)
        kept_in.remove()
    except (WriterError, OSError) as error:
        why = getattr(error, "strerror", error)
        raise MapFileError(f"cannot write {folder}: {why}; check the folder and its free space") from error
    return folder / f"{folder.name}.mcap"


def _grid(plan: StateGrid, stamp_s: float) -> Any:
    """Return the message of the navigation map."""
    header = ros.header(stamp_s, _MAP)
    rows, columns = plan.states.shape
    about = ros.new(
        "nav_msgs/msg/MapMetaData",
        map_load_time=header.stamp,
        resolution=plan.resolution_m,
        width=columns,
        height=rows,
        origin=ros.pose_message(gtsam.Pose3(plan.T_map_grid)),
    )
    return ros.new(_GRID, header=header, info=about, data=plan.states.astype(np.int8).ravel())


def _rows(
    points: FloatArray, colors: NDArray[np.uint8] | None, intensities: Float32Array | None
) -> NDArray[np.void]:
    """Return points with intensities, and their colours in the viewers' format: 0x00RRGGBB."""
    names = [(name, "<f4") for name in "xyz"]
    names += [] if colors is None else [("rgb", "<u4")]
    rows = np.zeros(len(points), names if intensities is None else [*names, ("intensity", "<f4")])
    if intensities is not None:
        rows["intensity"] = intensities
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    if colors is not None:
        rows["rgb"] = colors.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    return rows
