"""Write frames of a depth camera or clouds of a lidar in the layouts of public data sets and phone apps.

The writers follow the publishers' documentation, not Scanweave's readers; `tools/layout_equivalence.py` maps
their output, `tools/fuzz_seeds.py` damages it, the tests read it back.
"""

from __future__ import annotations

import json
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np

from slam.measurements import CameraIntrinsics

_SHARPEST = [
    cv2.IMWRITE_JPEG_QUALITY,
    100,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])  # its camera looks along -z, y up
_NED = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # optical axes in a body's
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Footage:
    """Frames of a camera.

    Attributes
    ----------
    stamps_s, colors, depths_mm
        (N,), N times (H, W, 3) RGB and (H, W) whole millimetres.
    poses
        N times (4, 4) camera to world, optical axes.
    lens
        Of both images.
    """

    stamps_s: list[float]
    colors: list[Any]
    depths_mm: list[Any]
    poses: list[Any]
    lens: CameraIntrinsics


def put(path: Path, content: Any) -> Path:
    """A file of text, bytes or an image, its folders made; JPEG as sharp as it gets."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_bytes(packed(content, path.suffix))
    return path


def packed(image: Any, suffix: str) -> bytes:
    """An image as the bytes of a file; colour is RGB."""
    turned = image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image
    done, content = cv2.imencode(suffix, turned, _SHARPEST if suffix == ".jpg" else [])
    assert done
    return bytes(content)


def numbers(values: Any, parted: str = " ") -> str:
    """Numbers as text without loss."""
    return parted.join(repr(float(value)) for value in np.ravel(values))


def quaternion(pose: Any) -> list[float]:
    """x, y, z, w."""
    q: Any = gtsam.Rot3(pose[:3, :3]).toQuaternion()
    return [q.x(), q.y(), q.z(), q.w()]


def tum_line(stamp: Any, pose: Any) -> str:
    """A line of a trajectory."""
    return f"{stamp} {numbers([*pose[:3, 3], *quaternion(pose)])}\n"


def _tum(folder: Path, footage: Footage, lists: bool = True) -> Path:
    """TUM's layout with what differs left to the caller."""
    names = [f"{stamp_s:.9f}" for stamp_s in footage.stamps_s]
    for name, color, depth in zip(names, footage.colors, footage.depths_mm, strict=True):
        put(folder / "rgb" / f"{name}.png", color)
        put(folder / "depth" / f"{name}.png", (depth * 5).astype(np.uint16))
    if lists:
        for kind in ("rgb", "depth"):
            put(folder / f"{kind}.txt", "".join(f"{name} {kind}/{name}.png\n" for name in names))
    truth = "".join(tum_line(name, pose) for name, pose in zip(names, footage.poses, strict=True))
    put(folder / "groundtruth.txt", truth)
    return folder


def _own_lens(folder: Path, footage: Footage) -> None:
    """Our own file, where the layout has one lens for all that there is."""
    lens = footage.lens
    fields = {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    put(folder / "calibration.yaml", f"intrinsics: {json.dumps(fields)}\n")


def tum(folder: Path, footage: Footage) -> Path:
    """TUM RGB-D; its lens is that of a Kinect."""
    _own_lens(folder, footage)
    return _tum(folder, footage)


def eth3d(folder: Path, footage: Footage) -> Path:
    """ETH3D SLAM."""
    lens = footage.lens
    put(folder / "calibration.txt", numbers([lens.fx, lens.fy, lens.cx, lens.cy]) + "\n")
    return _tum(folder, footage)


def bonn(folder: Path, footage: Footage) -> Path:
    """Bonn RGB-D Dynamic."""
    folder = folder / "rgbd_bonn_kitchen"
    _own_lens(folder, footage)
    return _tum(folder, footage)


def icl_nuim(folder: Path, footage: Footage) -> Path:
    """ICL-NUIM for TUM's tools: depth first, frames counted, y up."""
    folder = folder / "living_room_traj0_frei_png"
    lines, truth = "", ""
    for stamp_s, color, depth, pose in _frames(footage):
        number = round(30 * stamp_s)
        put(folder / "rgb" / f"{number}.png", color)
        put(folder / "depth" / f"{number}.png", (depth * 5).astype(np.uint16))
        lines += f"{number} depth/{number}.png {number} rgb/{number}.png\n"
        truth += tum_line(number, _MIRROR @ pose @ _MIRROR)
    put(folder / "associations.txt", lines)
    put(folder / "livingRoom0.gt.freiburg", truth)
    _own_lens(folder, footage)
    return folder


def _frames(footage: Footage) -> Any:
    """Stamp, colour, depth and pose of each frame."""
    return zip(footage.stamps_s, footage.colors, footage.depths_mm, footage.poses, strict=True)


def matrix(lens: CameraIntrinsics, size: int = 3) -> Any:
    """K."""
    k = np.eye(size)
    k[0, 0], k[1, 1], k[0, 2], k[1, 2] = lens.fx, lens.fy, lens.cx, lens.cy
    return k


def rows(table: Any, parted: str = " ") -> str:
    """A matrix as text."""
    return "".join(numbers(row, parted) + "\n" for row in table)


def scannet(folder: Path, footage: Footage) -> Path:
    """ScanNet, extracted."""
    for stamp_s, color, depth, pose in _frames(footage):
        number = round(30 * stamp_s)
        put(folder / "color" / f"{number}.jpg", color)
        put(folder / "depth" / f"{number}.png", depth)
        put(folder / "pose" / f"{number}.txt", rows(pose))
    for kind in ("color", "depth"):
        put(folder / "intrinsic" / f"intrinsic_{kind}.txt", rows(matrix(footage.lens, 4)))
        put(folder / "intrinsic" / f"extrinsic_{kind}.txt", rows(np.eye(4)))
    return folder


def scannet_sens(folder: Path, footage: Footage) -> Path:
    """ScanNet's .sens."""
    lens, name = matrix(footage.lens, 4), b"StructureSensor"
    content = struct.pack("<IQ", 4, len(name)) + name
    content += np.concatenate([np.ravel(one) for one in (lens, np.eye(4)) * 2]).astype("<f4").tobytes()
    sizes = (footage.lens.width, footage.lens.height) * 2
    content += struct.pack("<iiIIIIfQ", 2, 1, *sizes, 1000.0, len(footage.stamps_s))
    for stamp_s, color, depth, pose in _frames(footage):
        jpeg, deflated = packed(color, ".jpg"), zlib.compress(depth.astype("<u2").tobytes())
        ticks = round(1e6 * stamp_s)
        content += np.ravel(pose).astype("<f4").tobytes()
        content += struct.pack("<QQQQ", ticks, ticks, len(jpeg), len(deflated)) + jpeg + deflated
    return put(folder / "scene0000_00.sens", content + struct.pack("<Q", 0))


def replica(folder: Path, footage: Footage) -> Path:
    """Replica as in NICE-SLAM; frames without gaps."""
    lens = footage.lens
    fields = {"w": lens.width, "h": lens.height, "fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    put(folder / "cam_params.json", json.dumps({"camera": {**fields, "scale": 6553.5}}))
    for number, (_, color, depth, _) in enumerate(_frames(footage)):
        put(folder / "room0" / "results" / f"frame{number:06d}.jpg", color)
        steps = np.rint(np.minimum(depth * 6.5535, 65535)).astype(np.uint16)
        put(folder / "room0" / "results" / f"depth{number:06d}.png", steps)
    put(folder / "room0" / "traj.txt", rows([np.ravel(pose) for pose in footage.poses]))
    return folder / "room0"


def open3d(folder: Path, footage: Footage) -> Path:
    """Open3D's reconstruction system and Redwood's scenes."""
    lens, poses = footage.lens, ""
    for stamp_s, color, depth, pose in _frames(footage):
        number = round(30 * stamp_s)
        put(folder / "color" / f"{number:06d}.jpg", color)
        put(folder / "depth" / f"{number:06d}.png", depth)
        poses += f"{number} {number} {number + 1}\n{rows(pose)}"
    fields = {"width": lens.width, "height": lens.height}
    content = {**fields, "intrinsic_matrix": np.ravel(matrix(lens).T).tolist()}
    put(folder / "camera_intrinsic.json", json.dumps(content))
    put(folder / "trajectory.log", poses)
    return folder


def sun3d(folder: Path, footage: Footage) -> Path:
    """SUN3D: names of frame and microseconds, depth with its bits turned."""
    for number, (stamp_s, color, depth, _) in enumerate(_frames(footage), 1):
        name = f"{number:07d}-{round(1e6 * stamp_s):012d}"
        put(folder / "image" / f"{name}.jpg", color)
        turned = (depth.astype(np.uint32) << 3) | (depth.astype(np.uint32) >> 13)
        put(folder / "depth" / f"{name}.png", turned.astype(np.uint16))
    put(folder / "intrinsics.txt", rows(matrix(footage.lens)))
    return folder


def tartanair(folder: Path, footage: Footage) -> Path:
    """TartanAir; its frames are 10 Hz, ours are numbered at their own rate."""
    truth = ""
    for number, (_, color, depth, pose) in enumerate(_frames(footage)):
        put(folder / "image_left" / f"{number:06d}_left.png", color)
        (folder / "depth_left").mkdir(exist_ok=True)
        metres = (depth / 1000.0).astype(np.float32)
        np.save(folder / "depth_left" / f"{number:06d}_left_depth.npy", metres)
        body = pose @ np.linalg.inv(_NED)
        truth += numbers([*body[:3, 3], *quaternion(body)]) + "\n"
    put(folder / "pose_left.txt", truth)
    _own_lens(folder, footage)
    return folder


def tartanair2(folder: Path, footage: Footage) -> Path:
    """TartanAir V2: the floats of depth in the four bytes of a pixel."""
    tartanair(folder, footage)
    (folder / "image_left").rename(folder / "image_lcam_front")
    (folder / "pose_left.txt").rename(folder / "pose_lcam_front.txt")
    for file in sorted((folder / "depth_left").iterdir()):
        bytes_ = np.load(file).view(np.uint8).reshape(*np.load(file).shape, 4)
        name = f"{file.name[:6]}_lcam_front_depth.png"
        put(folder / "depth_lcam_front" / name, bytes_)
        file.unlink()
    (folder / "depth_left").rmdir()
    return folder


def arkitscenes(folder: Path, footage: Footage) -> Path:
    """ARKitScenes; the world is taken into the camera."""
    lens, truth = footage.lens, ""
    for stamp_s, color, depth, pose in _frames(footage):
        name = f"40753679_{stamp_s + 6845:.6f}"
        put(folder / "lowres_wide" / f"{name}.png", color)
        put(folder / "lowres_depth" / f"{name}.png", depth)
        put(folder / "confidence" / f"{name}.png", np.full(depth.shape, 2, np.uint8))
        fields = [lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy]
        put(folder / "lowres_wide_intrinsics" / f"{name}.pincam", numbers(fields))
        into = np.linalg.inv(pose)
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(into[:3, :3]))
        truth += numbers([stamp_s + 6845, *turn, *into[:3, 3]]) + "\n"
    put(folder / "lowres_wide.traj", truth)
    return folder


def stray_scanner(folder: Path, footage: Footage) -> Path:
    """Stray Scanner; the video is lossless here, HEVC on a phone."""
    lens, text = footage.lens, "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    folder.mkdir(parents=True, exist_ok=True)
    size = (lens.width, lens.height)
    video = cv2.VideoWriter(
        str(folder / "rgb.mp4"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"png "), 30, size
    )
    assert video.isOpened()
    for number, (stamp_s, color, depth, pose) in enumerate(_frames(footage)):
        video.write(np.ascontiguousarray(color[..., ::-1]))
        put(folder / "depth" / f"{number:06d}.png", depth)
        put(folder / "confidence" / f"{number:06d}.png", np.full(depth.shape, 2, np.uint8))
        phone = pose @ _ARKIT
        values = numbers([*phone[:3, 3], *quaternion(phone)], ", ")
        text += f"{stamp_s + 100:.9f}, {number:06d}, {values}\n"
    video.release()
    put(folder / "odometry.csv", text)
    put(folder / "camera_matrix.csv", rows(matrix(lens), ","))
    put(
        folder / "imu.csv",
        "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n100.0, 0, 0, -9.8, 0, 0, 0\n",
    )
    return folder


def record3d(folder: Path, footage: Footage) -> Path:
    """Record3D's .r3d."""
    import liblzfse

    lens = footage.lens
    per_frame = [[lens.fx, lens.fy, lens.cx, lens.cy]] * len(footage.stamps_s)
    phones = [pose @ _ARKIT for pose in footage.poses]
    metadata = {
        "w": lens.width,
        "h": lens.height,
        "dw": lens.width,
        "dh": lens.height,
        "fps": 30,
        "K": np.ravel(matrix(lens).T).tolist(),
        "perFrameIntrinsicCoeffs": per_frame,
        "frameTimestamps": footage.stamps_s,
        "poses": [[*quaternion(pose), *pose[:3, 3].tolist()] for pose in phones],
    }
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "scan.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for number, (_, color, depth, _) in enumerate(_frames(footage)):
            metres = np.where(depth > 0, depth / 1000.0, np.nan).astype("<f4")
            trust = np.full(depth.shape, 2, np.uint8)
            archive.writestr(f"rgbd/{number}.jpg", packed(color, ".jpg"))
            archive.writestr(f"rgbd/{number}.depth", liblzfse.compress(metres.tobytes()))
            archive.writestr(f"rgbd/{number}.conf", liblzfse.compress(trust.tobytes()))
    return folder / "scan.r3d"


def polycam(folder: Path, footage: Footage) -> Path:
    """Polycam's raw data."""
    lens = footage.lens
    fields = {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    for stamp_s, color, depth, pose in _frames(footage):
        name, phone = str(round(1e6 * (stamp_s + 1442008))), pose @ _ARKIT
        put(folder / "keyframes" / "images" / f"{name}.jpg", color)
        put(folder / "keyframes" / "depth" / f"{name}.png", depth)
        put(folder / "keyframes" / "confidence" / f"{name}.png", np.full(depth.shape, 255, np.uint8))
        transform = {f"t_{row}{column}": float(phone[row, column]) for row in range(3) for column in range(4)}
        put(folder / "keyframes" / "cameras" / f"{name}.json", json.dumps({**fields, **transform}))
    return folder


def rtabmap(folder: Path, footage: Footage, scan: bytes = b"", info: bytes = b"") -> Path:
    """A database of RTAB-Map 0.21, the tables that matter."""
    lens = footage.lens
    head = struct.pack("<11i", 0, 21, 4, 0, lens.width, lens.height, 9, 0, 0, 0, 12)
    mount = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # x forward, z up
    model = head + matrix(lens).astype("<f8").tobytes() + mount[:3].astype("<f4").tobytes()
    folder.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(folder / "rtabmap.db")
    database.executescript(
        "CREATE TABLE Node (id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT,"
        " pose BLOB,"
        " ground_truth_pose BLOB, label TEXT, PRIMARY KEY (id));"
        "CREATE TABLE Data (id INTEGER NOT NULL, image BLOB, depth BLOB, calibration BLOB, scan_info BLOB,"
        " scan BLOB, user_data BLOB, PRIMARY KEY (id));"
        "CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER);"
        "CREATE TABLE Word (id INTEGER NOT NULL, descriptor BLOB);"
        "CREATE TABLE Admin (version TEXT, preview_image BLOB);"
        "INSERT INTO Admin VALUES ('0.21.4', NULL);"
    )
    for number, (stamp_s, color, depth, pose) in enumerate(_frames(footage), 1):
        place = (pose @ np.linalg.inv(mount))[:3].astype("<f4").tobytes()
        row = (number, 0, 0, stamp_s + 1.7e9, place, place, None)
        database.execute("INSERT INTO Node VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        data = (number, packed(color, ".png"), packed(depth, ".png"), model, info or None, scan or None, None)
        database.execute("INSERT INTO Data VALUES (?, ?, ?, ?, ?, ?, ?)", data)
    database.commit()
    database.close()
    return folder / "rtabmap.db"


CAMERAS: dict[str, Callable[[Path, Footage], Path]] = {
    "tum": tum,
    "eth3d": eth3d,
    "icl_nuim": icl_nuim,
    "bonn": bonn,
    "scannet": scannet,
    "scannet_sens": scannet_sens,
    "replica": replica,
    "open3d": open3d,
    "sun3d": sun3d,
    "tartanair": tartanair,
    "tartanair2": tartanair2,
    "arkitscenes": arkitscenes,
    "stray_scanner": stray_scanner,
    "record3d": record3d,
    "polycam": polycam,
    "rtabmap": rtabmap,
}
