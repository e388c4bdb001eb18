"""Finds the clouds of a bag that come from a depth camera: they repeat its images and are no lidar's."""

from __future__ import annotations

from slam.datasets.bags.decoding import frame_name
from slam.datasets.bags.survey import Survey


def camera_clouds(survey: Survey) -> dict[str, str]:
    """Topics of such clouds, with the reason.

    Their frame is a camera's and their points have no timestamps; or all points are in a camera's field of
    view, and their axes, frame, order or stamps are a camera's. A spinning lidar sees in all directions; a
    solid-state lidar has a frame and stamps of its own.
    """
    frames = {frame_name(lens.header.frame_id): topic for topic, lens in survey.lenses.items()}
    frames |= {survey.frames[topic]: topic for topic in survey.stamps_s if topic in survey.frames}
    stamps_s = {stamp_s: topic for topic, stamps in survey.stamps_s.items() for stamp_s in stamps}
    reasons = {}
    for topic, view in survey.clouds.items():
        frame = survey.frames[topic]
        in_camera = "optical" in frame or (frame and frame in frames)
        if not view.along and (view.timed or not in_camera):
            continue
        if "optical" in frame:
            reasons[topic] = f"its frame is {frame}"
        elif frame and frame in frames:
            reasons[topic] = f"it is in the frame of {frames[frame]}"
        elif view.stamp_s in stamps_s:
            reasons[topic] = f"its stamps are those of {stamps_s[view.stamp_s]}"
        elif view.along == "z" and survey.stamps_s:
            reasons[topic] = "its view is along z, the optical axis"
        elif view.rows > 1 and survey.stamps_s:
            reasons[topic] = "its points are in the order of an image"
    return reasons
