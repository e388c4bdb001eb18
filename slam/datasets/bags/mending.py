"""Message types that carry what a map needs and are not read: what makes of them something that is."""

from __future__ import annotations

import re

_REPUBLISH = "record it again through 'ros2 run image_transport republish {} raw'"
_REMEDIES = (
    (r"^(rslidar_msg|hesai_ros_driver)/", "record it again through its driver, as PointCloud2"),
    (r"^theora_image_transport/", _REPUBLISH.format("theora")),
    (r"^ffmpeg_image_transport", _REPUBLISH.format("ffmpeg")),
    (r"CompressedVideo$", "unpack the video to sensor_msgs/Image"),
    (r"^foxglove\.|^foxglove_msgs/", "write it as the ROS type of the same name (sensor_msgs, tf2_msgs)"),
    (r"^stereo_msgs/msg/DisparityImage$", "record depth, which stereo_image_proc makes of it"),
)


def mended(kind: str) -> str:
    """What to do about messages of a type, to stand behind why they are not read; or nothing."""
    return next((f"; {remedy}" for pattern, remedy in _REMEDIES if re.search(pattern, kind)), "")
