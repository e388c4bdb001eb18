"""Cameras that are mounted oddly: does registration find them, or refuse, or is it sure and wrong?

    python tools/odd_rigs.py [--homes 31 32] [--seed 5] [--pairs 40]

A Turtlebot with a lidar of 240 degrees and one camera of 57 in the mounting that each line says; the yaw is
never given, the tilt is unless the line says otherwise. Of single pairs: how many are of high grade,
and how many of these are more than two samples (2 degrees) off. Of drives: by how much yaw, height and offset
are off.
"""

from __future__ import annotations

import dataclasses
import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import dataclass

import gtsam
import numpy as np
from xu2024_pairs import TruePair, simulate_pairs

import fusion
from fusion.curves import NEAR_SAMPLES, SAMPLE_STEP_RAD
from slam.simulation.drive import prepare_drive
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS, Rig, camera_pose

_SAME_HEIGHT_M = 0.10


@dataclass(frozen=True)
class Mounting:
    """Of the camera on the robot, and whether its tilt is given."""

    name: str
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.96
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    is_given: bool = True

    def rig(self) -> Rig:
        """The robot with it."""
        plain = RIGS["turtlebot_low"]
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        pose = camera_pose((self.x_m, self.y_m, self.z_m), yaw, pitch, roll)
        return dataclasses.replace(
            plain, cameras=(dataclasses.replace(plain.cameras[0], T_base_camera=pose),)
        )

    def turn(self, pair: TruePair, rig: Rig) -> fusion.DepthImage:
        """The image without the yaw, and without the tilt if it is not given."""
        image = pair.images[0].depth
        mounted = rig.cameras[0].T_base_camera.rotation().matrix()
        turned = image.R_level_camera @ mounted.T
        own = camera_pose((0.0, 0.0, 0.0)).rotation().matrix()
        if self.is_given:
            own = gtsam.Rot3.Rz(-math.radians(self.yaw_deg)).matrix() @ mounted
        return dataclasses.replace(image, R_level_camera=turned @ own)


MOUNTINGS = (
    Mounting("level, 0.7 m over the lidar"),
    *(Mounting(f"{angle} degrees down", pitch_deg=angle) for angle in (5, 10, 20)),
    *(Mounting(f"{angle} degrees down, not given", pitch_deg=angle, is_given=False) for angle in (5, 10, 20)),
    *(Mounting(f"{angle} degrees up", z_m=0.3, pitch_deg=-angle) for angle in (10, 20)),
    Mounting("rolled by 10 degrees", roll_deg=10),
    Mounting("rolled by 10 degrees, not given", roll_deg=10, is_given=False),
    Mounting("0.5 m in front", x_m=0.6),
    Mounting("0.5 m behind", x_m=-0.4),
    Mounting("0.5 m to the side", y_m=0.5),
    *(Mounting(f"{angle} degrees to the left", yaw_deg=angle) for angle in (30, 60)),
    Mounting("60 degrees to the left, 0.5 m to the side, 20 down", y_m=0.5, yaw_deg=60, pitch_deg=20),
    Mounting("half of the view outside the lidar's", yaw_deg=120),
    Mounting("nearly all of the view outside", yaw_deg=140),
)


def main() -> None:
    """One line a mounting."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, nargs="+", default=[31, 32])
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=40, help="most pairs a drive, evenly spread")
    arguments = parser.parse_args()
    print(
        "| camera | high grade | of them off by more than 2 degrees | rig: yaw off, degrees "
        "| height off, m | offset off, m |"
    )
    print("|---|---|---|---|---|---|")
    for mounting in MOUNTINGS:
        print(line(mounting, arguments.homes, arguments.seed, arguments.pairs), flush=True)


def line(mounting: Mounting, homes: list[int], seed: int, most: int) -> str:
    """What a mounting comes to, drive by drive."""
    rig = mounting.rig()
    assert rig.lidar is not None
    T_laser_camera = rig.lidar.T_base_laser.between(rig.cameras[0].T_base_camera)
    yaw_rad, count, high, wrong = math.radians(mounting.yaw_deg), 0, 0, 0
    drives: list[tuple[str, str, str]] = []
    for home in homes:
        together = fusion.Rig()
        for pair in simulate_pairs(prepare_drive(generate_home(home), rig, seed), most):
            count += 1
            try:
                found = fusion.register(pair.scan, mounting.turn(pair, rig))
            except ValueError:
                continue
            together.add(found)
            if found.grade == fusion.Grade.HIGH:
                high += 1
                wrong += abs(found.yaw_rad - yaw_rad) > (NEAR_SAMPLES + 0.5) * SAMPLE_STEP_RAD
        estimate = together.estimate()
        if estimate is None or estimate.alignments[0] is None:
            drives.append(("refused",) * 3)
            continue
        T = estimate.alignments[0].T_laser_level
        yaw = math.atan2(T[1, 0], T[0, 0])
        offset = np.hypot(*(T[:2, 2] - T_laser_camera.translation()[:2]))
        height = estimate.height_m + T_laser_camera.z()
        drives.append((f"{math.degrees(yaw - yaw_rad):.1f}", f"{height:.2f}", f"{offset:.2f}"))
    cells = " | ".join(", ".join(column) for column in zip(*drives, strict=True))
    return f"| {mounting.name} | {high / max(count, 1):.2f} | {wrong} | {cells} |"


if __name__ == "__main__":
    main()
