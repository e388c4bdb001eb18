"""Folders and files of depth cameras: those of `tools/pack_layouts.py`, and others."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam.measurements import CameraIntrinsics
from tools.layouts.samples import CameraTruth, Sample, layout
from tools.layouts.world import OPTICAL, looked_at, placed, way
from tools.pack_layouts import CAMERAS, Footage, matrix, put, tum_line
from tools.pack_scenes import SCENES, three_r_scan

COUNT = 6
_HELD = placed(0.0, 0.0, 1.3, pitch=0.15) @ OPTICAL  # a camera in a hand


def hand(count: int = COUNT) -> list[Any]:
    """Poses of a camera that is carried."""
    return [base @ _HELD for base in way(count)]


def footage(
    lens: CameraIntrinsics, rate_hz: float = 30.0, count: int = COUNT, first_s: float = 0.0
) -> Footage:
    """What a camera records that is carried through the room."""
    poses = hand(count)
    seen = [looked_at(lens, pose) for pose in poses]
    depths = [np.rint(1000.0 * one.depth_m).astype(np.uint16) for one in seen]
    stamps = [first_s + k / rate_hz for k in range(count)]
    return Footage(stamps, [one.color for one in seen], depths, poses, lens)


def recorded(
    path: Path, taken: Footage, lens: CameraIntrinsics | None = None, *, truth: bool = True
) -> Sample:
    """A sample of one camera alone."""
    camera = CameraTruth(lens or taken.lens, taken.stamps_s, taken.poses)
    return Sample(path, (camera,), moved=taken.poses if truth else None)


def bare(path: Path) -> Path:
    """Without the file of our own that names the lens: the publisher's must do."""
    for folder in (one for one in (path, path.parent) if one.is_dir()):
        (folder / "calibration.yaml").unlink(missing_ok=True)
    return path


VGA = {
    "eth3d": (726.287, 726.287, 354.65, 186.47, 739, 458, 27.0),
    "scannet": (577.87, 577.87, 319.5, 239.5, 640, 480, 30.0),
    "scannet_sens": (577.87, 577.87, 319.5, 239.5, 640, 480, 30.0),
    "replica": (600.0, 600.0, 599.5, 339.5, 1200, 680, 30.0),
    "open3d": (525.0, 525.0, 319.5, 239.5, 640, 480, 30.0),
    "sun3d": (570.3, 570.3, 320.0, 240.0, 640, 480, 30.0),
    "tartanair": (320.0, 320.0, 320.0, 240.0, 640, 480, 10.0),
    "tartanair2": (320.0, 320.0, 320.0, 320.0, 640, 640, 10.0),
    "icl_nuim": (481.2, 480.0, 319.5, 239.5, 640, 480, 30.0),
    "bonn": (542.82, 542.58, 315.59, 237.76, 640, 480, 30.0),
    "arkitscenes": (211.9, 211.9, 127.5, 95.6, 256, 192, 10.0),
    "stray_scanner": (212.3, 212.3, 127.9, 95.7, 256, 192, 60.0),
    "record3d": (216.1, 216.1, 126.4, 95.0, 256, 192, 30.0),
    "polycam": (213.4, 213.4, 128.2, 95.9, 256, 192, 2.0),
}
_NAMES = {
    "eth3d": ("ETH3D SLAM", "eth3d.net/slam_documentation"),
    "scannet": ("ScanNet, extracted", "github.com/ScanNet/ScanNet SensReader"),
    "scannet_sens": ("ScanNet .sens", "github.com/ScanNet/ScanNet SensReader/sensorData.h"),
    "replica": ("Replica of NICE-SLAM", "github.com/cvg/nice-slam src/utils/datasets.py"),
    "open3d": ("Open3D reconstruction system", "open3d.org docs, reconstruction system: make fragments"),
    "sun3d": ("SUN3D", "sun3d.cs.princeton.edu, SUN3DCppReader"),
    "tartanair": ("TartanAir", "github.com/castacks/tartanair_tools data_type.md"),
    "tartanair2": ("TartanAir V2", "tartanair.org modalities"),
    "icl_nuim": ("ICL-NUIM for TUM's tools", "doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html"),
    "bonn": ("Bonn RGB-D Dynamic", "ipb.uni-bonn.de/data/rgbd-dynamic-dataset"),
    "arkitscenes": ("ARKitScenes", "github.com/apple/ARKitScenes DATA.md"),
    "stray_scanner": ("Stray Scanner", "github.com/strayrobots/scanner docs/format.md"),
    "record3d": ("Record3D .r3d", "github.com/marek-simonik/record3d"),
    "polycam": ("Polycam raw data", "github.com/PolyCam/polyform"),
}


def _packed(name: str) -> Any:
    """The writer of a layout that is packed elsewhere."""
    fx, fy, cx, cy, width, height, rate_hz = VGA[name]
    lens = CameraIntrinsics(fx, fy, cx, cy, int(width), int(height))

    def write(folder: Path) -> Sample:
        taken = footage(lens, float(rate_hz))
        if name == "icl_nuim":  # it numbers frames of 30 Hz from 1
            taken = footage(lens, first_s=1 / 30)
        path = CAMERAS[name](folder, taken)
        return recorded(bare(path), taken, truth=name != "sun3d")

    return write


for _name, (_title, _source) in _NAMES.items():
    layout(_title, "RGB-D folders", _source)(_packed(_name))


@layout("TUM RGB-D, freiburg1", "RGB-D folders", "cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats")
def _tum_freiburg1(folder: Path) -> Sample:
    taken = footage(CameraIntrinsics(517.3, 516.5, 318.6, 255.3, 640, 480), first_s=1305031102.0)
    place = folder / "rgbd_dataset_freiburg1_xyz"
    return recorded(bare(CAMERAS["tum"](place, taken)), taken)


@layout("7-Scenes", "RGB-D folders", "microsoft.com/research/project/rgb-d-dataset-7-scenes")
def _seven_scenes(folder: Path) -> Sample:
    taken = footage(CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480))
    place = SCENES["seven_scenes"](folder / "chess", taken)
    (place / "camera-intrinsics.txt").unlink()
    return recorded(place, taken)


@layout("3RScan sequence", "RGB-D folders", "github.com/WaldJohannaU/3RScan README: sequence.zip, _info.txt")
def _scan_of_3r(folder: Path) -> Sample:
    """Colour of another lens and size."""
    lenses = (
        CameraIntrinsics(176.594, 176.594, 114.613, 85.7053, 224, 172),
        CameraIntrinsics(756.832, 756.026, 492.889, 270.419, 960, 540),
    )
    taken, wide = (footage(lens) for lens in lenses)
    both = Footage(taken.stamps_s, wide.colors, taken.depths_mm, taken.poses, lenses[0])
    return recorded(three_r_scan(folder, both, lenses[1]), taken)


@layout(
    "RGB-D Scenes v2",
    "RGB-D folders",
    "rgbd-scenes-v2; github.com/ardaduz/deep-video-mvs issue 8: 1e4 a metre",
)
def _washington_scenes(folder: Path) -> Sample:
    taken = footage(CameraIntrinsics(570.3, 570.3, 320.0, 240.0, 640, 480))
    place = SCENES["washington"](folder / "imgs", taken)
    (place / "camera-intrinsics.txt").unlink()
    return recorded(place, taken, truth=False)


@layout("Redwood, augmented ICL-NUIM", "RGB-D folders", "redwood-data.org/indoor/fileformat.html")
def _redwood(folder: Path) -> Sample:
    taken = footage(CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480))
    made = CAMERAS["open3d"](folder / "livingroom1", taken)
    for old, new in (
        ("color", "livingroom1-color"),
        ("depth", "livingroom1-depth-clean"),
        ("trajectory.log", "livingroom1-traj.txt"),
    ):
        (made / old).rename(made / new)
    (made / "camera_intrinsic.json").unlink()
    return recorded(made, taken)


@layout(
    "CoRBS", "RGB-D folders", "corbs.dfki.uni-kl.de: Kinect v2, registered images, TUM's lists, factor 5000"
)
def _corbs(folder: Path) -> Sample:
    lens = CameraIntrinsics(468.60, 468.61, 318.27, 243.99, 640, 480)
    taken = footage(lens, first_s=1416305861.0)
    place = bare(CAMERAS["tum"](folder / "E1_pre_registereddata", taken))
    sample = recorded(place, taken)
    put(folder / "lens.yaml", _opencv(lens))
    return Sample(
        place, sample.cameras, moved=sample.moved, mend=("--calibration", str(folder / "lens.yaml"))
    )


def _opencv(lens: CameraIntrinsics) -> str:
    """A lens as OpenCV's FileStorage has it."""
    k = ", ".join(repr(float(value)) for value in matrix(lens).ravel())
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {lens.width}\nimage_height: {lens.height}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {k} ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
        "   data: [ 0., 0., 0., 0., 0. ]\n"
    )


# camera_params.m: focal lengths and centre; k1, k2, p1, p2, k3; the turn.
_NYU_COLOR = (
    (5.1885790117450188e02, 5.1946961112127485e02, 3.2558244941119034e02, 2.5373616633400465e02),
    (
        2.0796615318809061e-01,
        -5.8613825163911781e-01,
        7.2231363135888329e-04,
        1.0479627195765181e-03,
        4.9856986684705107e-01,
    ),
)
_NYU_DEPTH = (
    (5.8262448167737955e02, 5.8269103270988637e02, 3.1304475870804731e02, 2.3844389626620386e02),
    (
        -9.9897236553084481e-02,
        3.9065324602765344e-01,
        1.9290592870229277e-03,
        -1.9422022475975055e-03,
        -5.1031725053400578e-01,
    ),
)
_NYU_TURN = (
    (9.9997798940829263e-01, 5.0518419386157446e-03, 4.3011152014118693e-03),
    (-5.0359919480810989e-03, 9.9998051861143999e-01, -3.6879781309514218e-03),
    (-4.3196624923060242e-03, 3.6662365748484798e-03, 9.9998394948385538e-01),
)


def nyu_to_color() -> Any:
    """(4, 4) that brings points of the depth camera to the colour camera, as the toolbox does."""
    to_color = np.eye(4)  # the toolbox calls the second number z and the third y
    to_color[:3, :3] = np.linalg.inv(np.array(_NYU_TURN))
    to_color[:3, 3] = -np.array([2.5031875059141302e-02, -2.9342312935846411e-04, 6.6238747008330102e-04])
    return to_color


@layout(
    "NYU Depth V2, raw dumps",
    "RGB-D folders",
    "cs.nyu.edu/~silberman nyu_depth_v2: raw, toolbox camera_params.m",
)
def _nyu_raw(folder: Path) -> Sample:
    """Depth and colour of two bent lenses, no lists, depth in the Kinect's own steps with swapped bytes."""
    place, poses, stamps = folder / "basement_0001a", hand(), []
    depth, color = (CameraIntrinsics(*values, 640, 480) for values in (_NYU_DEPTH[0], _NYU_COLOR[0]))
    for k, pose in enumerate(poses):
        stamps.append(1316653580.471513 + k / 30)
        ticks = 1316138413 + k * 2000000
        seen = looked_at(color, pose @ np.linalg.inv(nyu_to_color()), _NYU_COLOR[1])
        put(place / f"r-{stamps[k]:.6f}-{ticks}.ppm", seen.color)
        depth_m = looked_at(depth, pose, _NYU_DEPTH[1]).depth_m
        steps = np.rint(1092.5 - 351.3 / depth_m).astype(np.uint16)
        steps[:8] = 2047
        put(place / f"d-{stamps[k] + 0.004:.6f}-{ticks + 9}.pgm", steps.byteswap())
        put(place / f"a-{stamps[k]:.6f}-{ticks}.dump", bytes(40))
    put(place / "INDEX.txt", "\n".join(sorted(one.name for one in place.iterdir())) + "\n")
    return Sample(place, (CameraTruth(depth, stamps, poses),))


@layout(
    "Stray Scanner, first version",
    "RGB-D folders",
    "Stray Scanner Data Model: depth/*.npy, odometry.csv of seven values",
)
def _stray_scanner_npy(folder: Path) -> Sample:
    taken = footage(CameraIntrinsics(212.3, 212.3, 127.9, 95.7, 256, 192), 60.0)
    place = CAMERAS["stray_scanner"](folder / "71de12f9", taken)
    for file in sorted((place / "depth").glob("*.png")):
        np.save(file.with_suffix(".npy"), cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        file.unlink()
    shutil.rmtree(place / "confidence")
    (place / "imu.csv").unlink()
    return recorded(place, taken)


@layout(
    "RTAB-Map database",
    "RGB-D folders",
    "github.com/introlab/rtabmap corelib/src/resources/DatabaseSchema.sql.in",
)
def _rtabmap(folder: Path) -> Sample:
    lens = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
    poses = hand()
    seen = [looked_at(lens, pose) for pose in poses]
    depths = [np.rint(1000.0 * one.depth_m).astype(np.uint16) for one in seen]
    taken = Footage([k / 10 for k in range(COUNT)], [one.color for one in seen], depths, poses, lens)
    path = CAMERAS["rtabmap"](folder, taken)
    base = [pose @ np.linalg.inv(OPTICAL) for pose in poses]
    return Sample(path, (CameraTruth(lens, taken.stamps_s, poses, OPTICAL),), moved=base)


@layout(
    "OpenLORIS-Scene folder",
    "RGB-D folders",
    "lifelong-robotic-vision.github.io/dataset/scene: package files",
)
def _open_loris(folder: Path) -> Sample:
    lens = CameraIntrinsics(611.4, 611.2, 433.2, 249.5, 848, 480)
    mount = placed(0.22, 0.0, 0.9) @ OPTICAL
    bases, place = way(16), folder / "home1-1"
    lists: dict[str, str] = {"color": "", "aligned_depth": ""}
    odometry, truth, poses = "", "#Time px py pz qx qy qz qw\n", []
    for k, base in enumerate(bases):
        stamp, pose = f"{1560000075.1 + k / 10:.6f}", base @ mount
        poses.append(pose)
        seen = looked_at(lens, pose)
        put(place / "color" / f"{stamp}.png", seen.color)
        put(place / "aligned_depth" / f"{stamp}.png", np.rint(1000 * seen.depth_m).astype(np.uint16))
        for name in lists:
            lists[name] += f"{stamp} {name}/{stamp}.png\n"
        truth += tum_line(stamp, base)
        x, y, yaw = base[0, 3], base[1, 3], float(np.arctan2(base[1, 0], base[0, 0]))
        odometry += f"{stamp} {x} {y} 0 0 0 {np.sin(yaw / 2)} {np.cos(yaw / 2)} 0.9 0 0 0 0 0.3\n"
    for name, text in lists.items():
        put(place / f"{name}.txt", "#Time Filename\n" + text)
    put(place / "odom.txt", "#Time pose.x pose.y pose.z q.x q.y q.z q.w twist.x y z ang.x y z\n" + odometry)
    put(place / "groundtruth.txt", truth)
    put(place / "sensors.yaml", _loris_sensors(lens))
    put(place / "trans_matrix.yaml", _loris_mounts(mount))
    stamps = [k / 10 for k in range(len(bases))]
    return Sample(place, (CameraTruth(lens, stamps, poses, mount),), wheels=len(bases), moved=bases)


def _loris_sensors(lens: CameraIntrinsics) -> str:
    """Lenses as the data set writes them."""
    head = "%YAML:1.0\n---\n"
    return head + (
        "d400_color_optical_frame:\n"
        "    #This camera ...\n"
        "    type: camera\n    frame_id: d400_color_optical_frame\n    fps: 30\n"
        f"    width: {lens.width}\n    height: {lens.height}\n"
        "    intrinsics: !!opencv-matrix\n        rows: 1\n        cols: 4\n        dt: d\n"
        f"        data: [ {lens.fx}, {lens.cx}, {lens.fy}, {lens.cy} ]\n"
        "    distortion_model: brown\n"
        "    distortion_coefficients: !!opencv-matrix\n        rows: 1\n        cols: 5\n        dt: d\n"
        "        data: [ 0., 0., 0., 0., 0. ]\n"
    )


def _loris_mounts(mount: Any) -> str:
    """Where the colour camera sits, as the data set writes it."""
    data = ", ".join(repr(float(value)) for value in mount.ravel())
    return (
        "%YAML:1.0\n---\ntrans_matrix:\n"
        "- parent_frame: base_link\n  child_frame: d400_color_optical_frame\n"
        f"  matrix: !!opencv-matrix\n    rows: 4\n    cols: 4\n    dt: d\n    data: [ {data} ]\n"
    )
