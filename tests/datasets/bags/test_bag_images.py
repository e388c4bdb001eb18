"""Images of bags in all encodings, with and without lenses."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from bag_writing import START_S, Sent, image, info, packed_image, png, rvl, transforms, write_bag

from slam.datasets import open_dataset
from slam.datasets.bags.images import BAD_ENCODING, BAD_SIZE
from slam.datasets.bags.run_length_depth import DAMAGED_RUNS
from slam.datasets.dataset import Dataset
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH
from slam.datasets.image_files import DAMAGED
from slam.measurements import RgbdFrame

RNG = np.random.default_rng(3)
COLOR = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
DEPTH = RNG.integers(400, 4000, (48, 64), dtype=np.uint16)
DEPTH[0] = 0
METRES = DEPTH / 1000.0
C, D = "/camera/color/image_raw", "/camera/depth/image_raw"
BGR = np.ascontiguousarray(COLOR[..., ::-1])


def frames(path: Path, *sent: Sent, writer: str = "mcap_plain") -> tuple[list[RgbdFrame], Dataset]:
    dataset = open_dataset(
        write_bag(path / "log", writer, [info("/camera/depth/camera_info", 64, 48), *sent])
    )
    return [m for m in dataset if isinstance(m, RgbdFrame)], dataset


def alpha(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels, np.full(pixels.shape[:2], 9, np.uint8)])


def tiff(metres: np.ndarray) -> bytes:
    """Depth as image_transport compresses floats."""
    return cv2.imencode(".tiff", metres.astype(np.float32))[1].tobytes()


def inverse_depth(packing: Callable[[np.ndarray], bytes] = png) -> bytes:
    """What the transport makes of 32FC1: a header, and an image of quantised inverse depth."""
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
    with np.errstate(divide="ignore"):
        steps = np.where(DEPTH > 0, np.rint(a / METRES + b), 0.0)
    return struct.pack("<iff", 0, a, b) + packing(steps.astype(np.uint16))


@pytest.mark.parametrize(
    "color",
    [
        image(C, COLOR, "rgb8"),
        image(C, BGR, "bgr8"),
        image(C, BGR, "8UC3"),
        image(C, alpha(COLOR), "rgba8"),
        image(C, alpha(BGR), "bgra8"),
        packed_image(C + "/compressed", png(BGR), "rgb8; png compressed bgr8"),
        packed_image(C + "/compressed", png(BGR), "png"),
    ],
    ids=lambda sent: str(sent.fields.get("encoding") or sent.fields["format"]),
)
def test_colour_is_read_to_the_bit(tmp_path: Path, color: Sent) -> None:
    (frame,), _ = frames(tmp_path, color, image(D, DEPTH, "16UC1"))
    assert (frame.color == COLOR).all()


def test_grey_is_spread_and_jpeg_is_near(tmp_path: Path) -> None:
    (frame,), _ = frames(tmp_path, image(C, COLOR[..., 0], "mono8"), image(D, DEPTH, "16UC1"))
    assert (frame.color == COLOR[..., :1]).all()
    smooth = cv2.resize(COLOR[:3, :4], (64, 48), interpolation=cv2.INTER_LINEAR)
    content = cv2.imencode(".jpg", smooth[..., ::-1])[1].tobytes()
    packed = packed_image(C + "/compressed", content, "bgr8; jpeg compressed bgr8")
    (frame,), _ = frames(tmp_path, packed, image(D, DEPTH, "16UC1"))
    assert np.abs(frame.color.astype(int) - smooth).mean() < 6.0


@pytest.mark.parametrize(
    ("depth", "tolerance_m"),
    [
        (image(D, DEPTH, "16UC1"), 1e-6),
        (image(D, DEPTH, "mono16"), 1e-6),
        (image(D, METRES.astype("<f4"), "32FC1"), 1e-6),
        (packed_image(D + "/compressedDepth", bytes(12) + png(DEPTH), "16UC1; compressedDepth"), 1e-6),
        (packed_image(D + "/compressedDepth", bytes(12) + png(DEPTH), "16UC1; compressedDepth png"), 1e-6),
        (packed_image(D + "/compressedDepth", inverse_depth(), "32FC1; compressedDepth"), 2e-3),
        (packed_image(D + "/compressedDepth", bytes(12) + rvl(DEPTH), "16UC1; compressedDepth rvl"), 1e-6),
        (packed_image(D + "/compressedDepth", inverse_depth(rvl), "32FC1; compressedDepth rvl"), 2e-3),
        (packed_image(D + "/compressed", png(DEPTH), "16UC1; png compressed "), 1e-6),
        (packed_image(D + "/compressed", tiff(METRES), "32FC1; tiff compressed "), 1e-6),
    ],
    ids=lambda value: (
        str(value.fields.get("encoding") or value.fields["format"]) if isinstance(value, Sent) else ""
    ),
)
def test_depth_is_in_metres_and_invalid_readings_are_zero(
    tmp_path: Path, depth: Sent, tolerance_m: float
) -> None:
    (frame,), _ = frames(tmp_path, image(C, COLOR, "rgb8"), depth)
    assert np.abs(frame.depth_m - METRES).max() < tolerance_m
    assert (frame.depth_m[0] == 0.0).all()


def test_bad_floats_are_invalid_and_big_endian_is_turned(tmp_path: Path) -> None:
    metres = METRES.astype("<f4")
    metres[1, :3] = math.nan, -1.0, math.inf
    (frame,), _ = frames(tmp_path, image(C, COLOR, "rgb8"), image(D, metres, "32FC1"))
    assert (frame.depth_m[1, :3] == 0.0).all()
    swapped = image(D, DEPTH.byteswap(), "16UC1")
    swapped.fields["is_bigendian"] = 1
    (frame,), _ = frames(tmp_path, image(C, COLOR, "rgb8"), swapped)
    assert np.abs(frame.depth_m - METRES).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"step": 10}, BAD_SIZE),
        ({"height": 4000}, BAD_SIZE),
        ({"encoding": "unheard_of"}, BAD_ENCODING),
        ({"data": np.zeros(5)}, BAD_SIZE),
    ],
)
def test_an_image_that_cannot_be_read_is_counted(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    bad = image(C, COLOR, "rgb8", START_S + 0.1)
    bad.fields |= change
    pairs = [image(C, COLOR, "rgb8"), image(D, DEPTH, "16UC1"), bad, image(D, DEPTH, "16UC1", START_S + 0.1)]
    found, dataset = frames(tmp_path, *pairs)
    assert len(found) == 1
    assert {why: tally.count for why, tally in dataset.report.dropped.items()} == {reason: 1}


def test_a_cut_png_is_counted(tmp_path: Path) -> None:
    packed = [png(BGR), png(BGR)[:900]]
    sent = [
        message
        for k, content in enumerate(packed)
        for message in (
            packed_image(C + "/compressed", content, "png", START_S + k),
            image(D, DEPTH, "16UC1", START_S + k),
        )
    ]
    found, dataset = frames(tmp_path, *sent)
    assert len(found) == 1 and dataset.report.dropped[DAMAGED].count == 1


@pytest.mark.parametrize(
    "content",
    [b"", rvl(DEPTH)[:7], rvl(DEPTH)[:900], struct.pack("<II", 64, 0), struct.pack("<II", 1 << 20, 1 << 20)]
    + [rvl(DEPTH)[:8] + word * 500 for word in (bytes(4), b"\xff" * 4, b"\x11" * 4)],
)
def test_damaged_run_lengths_are_counted(tmp_path: Path, content: bytes) -> None:
    form, topic = "16UC1; compressedDepth rvl", D + "/compressedDepth"
    good, bad = (
        packed_image(topic, bytes(12) + runs, form, START_S + k)
        for k, runs in enumerate((rvl(DEPTH), content))
    )
    found, dataset = frames(
        tmp_path, image(C, COLOR, "rgb8"), good, image(C, COLOR, "rgb8", START_S + 1), bad
    )
    assert len(found) == 1 and dataset.report.dropped[DAMAGED_RUNS].count == 1


def test_images_are_paired_by_nearest_stamp_and_the_rest_is_counted(tmp_path: Path) -> None:
    sent = []
    for k in range(20):
        late = image(D, DEPTH + k, "16UC1", START_S + 0.1 * k + 0.008)
        sent += [image(C, COLOR, "rgb8", START_S + 0.1 * k), late]
    del sent[10], sent[20]  # a colour image, and a depth image
    found, dataset = frames(tmp_path, *sent)
    assert len(found) == 18
    for frame in found:
        k = round((frame.stamp_s - START_S) / 0.1)
        assert frame.depth_m[1, 1] == pytest.approx((DEPTH[1, 1] + k) / 1000.0)
    assert {why: tally.count for why, tally in dataset.report.dropped.items()} == {NO_COLOR: 1, NO_DEPTH: 1}
    assert any("at most 0.0080 s apart" in note for note in dataset.report.notes)


def lens_points(model: str, d: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens shows points: pixels with and without its distortion."""
    k = np.array([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]])
    rays = np.array([[x, y, 1.0] for x in (-0.5, 0.0, 0.4) for y in (-0.4, 0.0, 0.3)])
    if model == "equidistant":
        seen, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), k, np.array(d))
    else:
        seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), k, np.array(d))
    return seen.reshape(-1, 2), (rays @ k.T)[:, :2]


def test_a_distortion_that_is_not_known_is_a_warning(tmp_path: Path) -> None:
    known = info("/camera/depth/camera_info", 64, 48, 40.0, distortion_model="ftheta", d=[0.1, 0.2])
    small = np.full((48, 64), 900, np.uint16)
    sent = image(C, np.zeros((48, 64, 3), np.uint8), "rgb8"), image(D, small, "16UC1")
    dataset = open_dataset(write_bag(tmp_path / "lens", "mcap", [known, *sent]))
    assert len(list(dataset)) == 1
    assert any(note.startswith("warning: ") and "ftheta is unknown" in note for note in dataset.report.notes)


@pytest.mark.parametrize(
    ("model", "d"), [("plumb_bob", [-0.3, 0.1, 0.002, -0.001, 0.0]), ("equidistant", [0.2, -0.05, 0.0, 0.0])]
)
def test_distortion_is_taken_out(tmp_path: Path, model: str, d: list[float]) -> None:
    distorted, straight = lens_points(model, d)
    depth = np.full((48, 64), 1000, np.uint16)
    for k, (u, v) in enumerate(np.rint(distorted).astype(int)):
        depth[v - 1 : v + 2, u - 1 : u + 2] = 2000 + 100 * k
    lens = [
        info(f"/camera/{kind}/camera_info", 64, 48, 40.0, distortion_model=model, d=d)
        for kind in ("color", "depth")
    ]
    bag = write_bag(tmp_path / "lens", "mcap", [*lens, image(C, COLOR, "rgb8"), image(D, depth, "16UC1")])
    dataset = open_dataset(bag)
    (frame,) = dataset
    assert isinstance(frame, RgbdFrame)
    for k, (u, v) in enumerate(np.rint(straight).astype(int)):
        assert frame.depth_m[v, u] == pytest.approx(2.0 + 0.1 * k), (k, u, v)
    assert any("distortion taken out" in note for note in dataset.report.notes)


def test_colour_of_another_lens_is_brought_into_the_depth_cameras_view(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(128, dtype=np.uint8)[None, :, None], (96, 1, 3))
    sent = [
        transforms(
            {"optical": gtsam.Pose3(), "color_optical": gtsam.Pose3(gtsam.Rot3(), np.array([0.05, 0, 0]))}
        ),
        info("/camera/color/camera_info", 128, 96, 80.0, frame="color_optical"),
        info("/camera/depth/camera_info", 64, 48, 50.0),
        image(C, ramp, "rgb8", frame="color_optical"),
        image(D, DEPTH, "16UC1"),
    ]
    dataset = open_dataset(write_bag(tmp_path / "two", "mcap", sent))
    (frame,) = dataset
    assert isinstance(frame, RgbdFrame) and frame.color.shape == (48, 64, 3)
    column = np.arange(64)
    away_m = frame.depth_m[20]
    seen = away_m > 0.1
    wanted = 64.0 + 80.0 * ((column - 32.0) / 50.0 - 0.05 / np.where(seen, away_m, 1.0))
    inside = seen & (wanted > 2.0) & (wanted < 125.0)
    assert inside.sum() > 40
    assert np.abs(frame.color[20, :, 0] - wanted)[inside].max() <= 1.0
    assert any("colour is 0.050 m from depth" in note for note in dataset.report.notes)
