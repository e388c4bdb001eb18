"""Messages of ROS 2 Humble for several files, written without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import gtsam
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rosbags.interfaces import Qos
    from rosbags.typesys.store import Typestore

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
# Datatypes of a PointField.
_FIELD_KINDS = {4: "<u2", 6: "<u4", 7: "<f4"}
BAG_VERSION: Final = 8  # the newest that ROS 2 Humble reads


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Humble; loaded once, when first needed."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def nanoseconds(stamp_s: float) -> int:
    """A stamp in nanoseconds, to the microsecond that stamps are rounded to."""
    return round(stamp_s * 1e6) * 1000


def transforms(stamp_s: float, parent: str, children: Mapping[str, gtsam.Pose3]) -> Any:
    """A TFMessage: where each child frame sits in the parent frame."""
    return new(
        TRANSFORMS,
        transforms=[
            new(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp_s, parent),
                child_frame_id=child,
                transform=new(
                    "geometry_msgs/msg/Transform",
                    translation=vector(pose.translation()),
                    rotation=quaternion(pose.rotation()),
                ),
            )
            for child, pose in children.items()
        ],
    )


def cloud_message(rows: NDArray[np.void], stamp_s: float, frame_id: str) -> Any:
    """A PointCloud2 message of rows of little-endian floats and whole numbers, one unordered row."""
    kinds = {np.dtype(kind): number for number, kind in _FIELD_KINDS.items()}
    fields: Mapping[str, tuple[Any, ...]] = rows.dtype.fields or {}
    return new(
        POINT_CLOUD,
        header=header(stamp_s, frame_id),
        height=1,
        width=len(rows),
        fields=[
            new("sensor_msgs/msg/PointField", name=name, offset=place[1], datatype=kinds[place[0]], count=1)
            for name, place in fields.items()
        ],
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def pose_message(pose: gtsam.Pose3) -> Any:
    """A Pose."""
    x, y, z = map(float, pose.translation())
    position = new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return new("geometry_msgs/msg/Pose", position=position, orientation=quaternion(pose.rotation()))


def new(kind: str, **fields: Any) -> Any:
    """A message of a type."""
    return typestore().types[kind](**fields)


def header(stamp_s: float, frame_id: str) -> Any:
    """A Header."""
    seconds, rest = divmod(nanoseconds(stamp_s), 1_000_000_000)
    return new(
        "std_msgs/msg/Header",
        stamp=new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest),
        frame_id=frame_id,
    )


def vector(values: NDArray[np.float64]) -> Any:
    """A Vector3."""
    x, y, z = map(float, values)
    return new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def quaternion(rotation: gtsam.Rot3) -> Any:
    """A Quaternion."""
    q: Any = rotation.toQuaternion()
    return new("geometry_msgs/msg/Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w())


def latched() -> Qos:
    """What late listeners of /tf_static need: the publisher keeps its message for them."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
