"""What an IMU is worth to a camera in the hand: does the map come out upright?

    python tools/handheld_imu.py FOLDER [--home N] [--seconds S]

Somebody carries an RGB-D camera (Kinect, 15 frames a second) along a simulated tour of a home: bobbing,
swaying, looking up and down, held askew at the start. Written are a folder that ``scanweave map`` reads and
its truth; it is mapped with its IMU (EuRoC's, usual faults) and without. Each row has how far the upright
of the map leans from the true one, and the error of the way as laid on the truth.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

import slam
from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error, associate
from slam.measurements import FloatArray, RgbdFrame
from slam.simulation.home import generate_home
from slam.simulation.imu import ADIS_16448, ImuFaults, MountedImu, record_imu, write_euroc
from slam.simulation.ordered_pool import OrderedPool
from slam.simulation.rigs import camera_pose
from slam.simulation.scene import Scene
from slam.simulation.sensor_clock import generator
from slam.simulation.sensor_models import KINECT_V1
from slam.simulation.sensors import render_rgbd
from slam.simulation.tour import Tour, plan_tour
from slam.simulation.tum_writer import TumWriter
from slam.storage.tum import read_tum, write_tum

FIRST_S, RATE_HZ = 1000.0, 15.0
T_DEVICE_CAMERA = camera_pose((0.0, 0.0, 0.0))
IMU = MountedImu(ADIS_16448, gtsam.Pose3(gtsam.Rot3.Ypr(0.2, 0.1, -0.3), np.array([-0.02, 0.01, -0.03])))


def held(tour: Tour, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and positions (N, 3) of the device in the map."""
    turns, places = tour.smooth_poses(times_s)
    places[:, 2] = 1.3 + 0.03 * np.sin(9.0 * times_s)
    roll = 0.12 + 0.08 * np.sin(2.1 * times_s) + 0.02 * np.sin(9.0 * times_s + 1.0)
    pitch = 0.2 + 0.12 * np.sin(1.1 * times_s + 0.5)
    yaw = 0.15 * np.sin(1.7 * times_s)
    sway = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    return turns @ sway.as_matrix(), places


def record(folder: Path, home: int, seconds: float) -> Trajectory:
    """Write the walk; its truth."""
    building = generate_home(home)
    tour = plan_tour(building, 0.25, 1.6, home, seconds)
    scene, times_s = Scene(building), np.arange(0.1, seconds - 0.1, 1.0 / RATE_HZ)
    turns, places = held(tour, times_s)
    imu = record_imu(
        IMU, lambda at_s: held(tour, at_s), ImuFaults(0.002, 0.07, 0.002), seconds, FIRST_S, home
    )
    folder.mkdir(parents=True)
    write_euroc(folder / "imu0", imu, IMU.T_body_imu)
    with (
        OrderedPool(2, 24) as pool,
        TumWriter(folder / "rgbd_camera", KINECT_V1.intrinsics, T_DEVICE_CAMERA, pool) as writer,
    ):
        for n, time_s in enumerate(times_s.tolist()):
            T_map_camera = gtsam.Pose3(gtsam.Rot3(turns[n]), places[n]).compose(T_DEVICE_CAMERA)
            seen = render_rgbd(scene, T_map_camera, KINECT_V1, generator(home, "camera", 1, n))
            stamp_s = round(FIRST_S + time_s, 6)
            writer.write(RgbdFrame(stamp_s, seen.color, seen.depth_m, KINECT_V1.intrinsics))
    truth = Trajectory(np.round(FIRST_S + times_s, 6), places, Rotation.from_matrix(turns).as_quat())
    write_tum(folder / "groundtruth.txt", truth)
    return truth


def lean_degrees(found: Trajectory, truth: Trajectory) -> FloatArray:
    """How far the map's upright is from the true one, by each pose."""
    mapped, true = (Rotation.from_quat(one.quaternions_xyzw) for one in associate(found, truth))
    up = (true * mapped.inv()).apply([0.0, 0.0, 1.0])
    return np.asarray(np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0))))


def main() -> None:
    """Run the trial."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--home", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    log = arguments.folder
    truth = (
        read_tum(log / "groundtruth.txt") if log.exists() else record(log, arguments.home, arguments.seconds)
    )
    for imu in (True, False):
        found = slam.map_log(
            log, config=slam.load_config(None, [f"sensors.imu={imu}", "sensors.motion=spatial"])
        )
        lean = lean_degrees(found.trajectory, truth)
        error = absolute_error(found.trajectory, truth).translation_m
        print(
            f"IMU {imu}: leans {lean.mean():.2f}, at worst {lean.max():.2f} degrees; "
            f"ATE {error.rmse:.4f}, worst {error.max:.4f} m",
            flush=True,
        )
        for note in found.notes:
            if "imu" in note:
                print("   ", note)


if __name__ == "__main__":
    main()
