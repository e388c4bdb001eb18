"""Intrinsics and mountings of a bag's sensors from calibration files, in addition to the bag's own."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from slam.datasets.bags.lens import Lens
from slam.datasets.bags.survey import Survey
from slam.datasets.bags.topics import CLOUDS
from slam.datasets.bags.transforms import differs
from slam.datasets.calibration_files import KnownCalibration, contradiction
from slam.datasets.calibration_formats import FileTransform


@dataclass(slots=True)
class FileFacts:
    """What calibration files contain about a bag's sensors.

    Attributes
    ----------
    notes
        What was used from which file, and where a file contradicts the bag.
    used
        Names of the files of which something was used.
    """

    known: KnownCalibration
    notes: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def place(self, survey: Survey) -> None:
        """Add the mountings to a bag's frame tree; files that have priority replace the bag's own."""
        self.notes += self.known.notes
        names = self._frames_of_names(survey)
        for tf in self.known.transforms:
            parent, child = names.get(tf.parent, tf.parent), names.get(tf.child, tf.child)
            in_tree = survey.tree.between(parent, child)
            file_wins = tf.source in self.known.sure
            if in_tree is None or file_wins:
                survey.tree.set(parent, child, tf.pose)
                self.used.add(tf.source)
            if in_tree is not None:
                self._compare(f"{child} on {parent}", tf, in_tree, file_wins=file_wins)
        for source in sorted(self.used):
            self.notes.append(f"mountings by {source}")

    def lens(self, survey: Survey, topic: str, own: Lens | None) -> Lens | None:
        """The lens of an image topic: from a file with priority, else from the bag, else from any file."""
        role = "depth" if survey.depths.get(topic) else "color"
        names = [topic, survey.frames.get(topic, "")]
        file_lens = self.known.lens(role, names, survey.sizes.get(topic))
        if file_lens is None or file_lens.lens is None:
            return own
        file_wins = file_lens.source in self.known.sure
        if own is not None:
            file, bag = (file_lens.lens, file_lens.source), (own, "the bag")
            warning = contradiction(topic, file, bag) if file_wins else contradiction(topic, bag, file)
            self.notes += [warning] if warning else []
        if own is not None and not file_wins:
            return own
        self.used.add(file_lens.source)
        self.notes.append(f"{topic}: lens by {file_lens.source}")
        return file_lens.lens

    def mount(self, kind: str, topic: str, own: gtsam.Pose3 | None, *, only: bool) -> gtsam.Pose3 | None:
        """Pose of the only "camera" or "lidar": from a `calibration.yaml`, else from the bag."""
        file_mount = self.known.T_base_camera if kind == "camera" else self.known.T_base_lidar
        if file_mount is None or not only:
            return own
        pose, source = file_mount
        self.used.add(source)
        self.notes.append(f"{topic}: mounting by {source}")
        if own is not None:
            self._compare(topic, FileTransform("", "", pose, source), own, file_wins=True)
        return pose

    def depth_steps_per_m(self, name: str, own: float | None) -> float | None:
        """Depth units per metre of a camera's depth images, None if unknown."""
        file_steps = self.known.depth_steps_per_m()
        if file_steps is None:
            return own
        steps, source = file_steps
        if own is not None and source not in self.known.sure:
            return own
        self.used.add(source)
        self.notes.append(f"{name}: {steps:g} steps of depth a metre by {source}")
        return steps

    def unused(self) -> list[str]:
        """Files that the user gave and of which nothing was used."""
        return [
            f"warning: {source} describes no sensor that is read"
            for source in sorted(self.known.sure - self.used)
        ]

    def _frames_of_names(self, survey: Survey) -> dict[str, str]:
        """The bag's frames for frame names in files: cameras by topic, a single lidar or IMU by type."""
        names = {}
        for camera in self.known.cameras:
            if camera.frame and (
                frame := survey.frames.get(camera.topic) or survey.frames.get(f"/{camera.topic}")
            ):
                names[camera.frame] = frame
        kinds = {topic: survey.channels[topic].kind for topic in survey.frames}
        lidars = {frame for topic, frame in survey.frames.items() if kinds[topic] in CLOUDS}
        imus = {frame for topic, frame in survey.frames.items() if kinds[topic].endswith("/Imu")}
        for name, frames in (("lidar", lidars), ("imu", imus)):
            if len(frames) == 1 and name not in survey.tree:
                names[name] = next(iter(frames))
        return names

    def _compare(self, what: str, mount: FileTransform, in_bag: gtsam.Pose3, *, file_wins: bool) -> None:
        """Report both values if a file and the bag contradict each other."""
        if differs(mount.pose, in_bag):
            self.notes.append(
                f"warning: {what}: {mount.source} says {_text(mount.pose)}, the bag says {_text(in_bag)}; "
                f"that of {mount.source if file_wins else 'the bag'} is used"
            )


def _text(pose: gtsam.Pose3) -> str:
    """A mounting as text for the user."""
    x, y, z = pose.translation()
    roll, pitch, yaw = np.degrees(pose.rotation().rpy())
    return f"x {x:.3f} y {y:.3f} z {z:.3f} m, roll {roll:.1f} pitch {pitch:.1f} yaw {yaw:.1f} degrees"
