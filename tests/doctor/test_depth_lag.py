"""Depth images that are late are seen by their edges while the camera turns."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.doctor.camera_samples import CameraSamples
from slam.doctor.depth_lag import DepthLag
from slam.doctor.finding import remedied
from slam.doctor.in_space import camera_findings, late_depth
from slam.measurements import CameraIntrinsics, Measurement, RgbdFrame, WheelOdometry

HEIGHT, WIDTH, FAR = 120, 160, 900
STEPS = 0.1 * np.arange(81)


def panorama() -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth (H, FAR) of boxes before a wall, and a pattern that is no edge in depth."""
    rng = np.random.default_rng(3)
    gray, depth_m = np.full((HEIGHT, FAR), 90, np.uint8), np.full((HEIGHT, FAR), 4.0, np.float32)
    for number in range(120):
        row, column = int(rng.integers(0, HEIGHT - 30)), int(rng.integers(0, FAR - 40))
        part = slice(row, row + int(rng.integers(8, 30))), slice(column, column + int(rng.integers(8, 40)))
        gray[part] = rng.integers(20, 240)
        if number % 2:
            depth_m[part] = rng.uniform(1.0, 3.0)
    return gray, depth_m


def lag(late_s: float, swing_px: float = 300.0, aside_px: int = 0) -> DepthLag:
    """What is seen of the panorama by a camera that turns to and fro."""
    gray, depth_m = panorama()
    samples = DepthLag()
    for time_s in STEPS.tolist():
        at, then = (int(370 + swing_px * math.sin(0.9 * one_s)) for one_s in (time_s, time_s - late_s))
        samples.add(time_s, gray[:, at : at + WIDTH], depth_m[:, then + aside_px : then + aside_px + WIDTH])
    return samples


@pytest.mark.parametrize("late_s", [0.04, -0.07])
@pytest.mark.parametrize("aside_px", [0, 3])
def test_the_delay_of_depth_follows_from_its_edges(late_s: float, aside_px: int) -> None:
    found_s, sigma_s = lag(late_s, aside_px=aside_px).estimate() or (math.nan, math.nan)
    assert found_s == pytest.approx(late_s, abs=0.007) and sigma_s < 0.01
    (finding,) = late_depth("camera", (found_s, sigma_s))
    assert finding.kind == "depth clock" and finding.sure
    assert ("later" if late_s > 0 else "earlier") in finding.text


@pytest.mark.parametrize("aside_px", [0, 3])
def test_depth_of_the_same_time_has_no_delay(aside_px: int) -> None:
    assert late_depth("camera", lag(0.0, aside_px=aside_px).estimate()) == []
    assert late_depth("camera", (0.025, 0.003)) == []


def test_a_camera_that_stands_still_shows_no_delay() -> None:
    samples = CameraSamples(count=5, lag=lag(0.04, swing_px=0.0))
    assert camera_findings("camera", samples, np.empty((0, 4))) == []
    assert DepthLag().estimate() is None and late_depth("camera", None) == []


def test_frames_of_the_samples_are_compared() -> None:
    gray, depth_m = panorama()
    samples = CameraSamples()
    for time_s in STEPS[:12].tolist():
        at = int(100.0 * time_s)
        color = np.repeat(gray[:, at : at + WIDTH, None], 3, axis=2)
        lens = CameraIntrinsics(140.0, 140.0, 79.5, 59.5, WIDTH, HEIGHT)
        samples.add(RgbdFrame(time_s, color, depth_m[:, at : at + WIDTH], lens), compared=False)
    assert len(samples.lag.fits) == 1 and samples.lag.fits[0].max() > 0.0


@pytest.mark.parametrize("late_s", [0.04, -0.07, 0.1, 0.22])
def test_colour_gets_the_depth_that_is_nearest_in_time(late_s: float) -> None:
    gray, depth_m = panorama()
    lens, log = CameraIntrinsics(140.0, 140.0, 79.5, 59.5, WIDTH, HEIGHT), list[Measurement]()
    for time_s in STEPS.tolist():
        at, then = (int(370 + 300 * math.sin(0.9 * one_s)) for one_s in (time_s, time_s - late_s))
        color = np.repeat(gray[:, at : at + WIDTH, None], 3, axis=2)
        log.append(RgbdFrame(time_s, color, depth_m[:, then : then + WIDTH].copy(), lens))
        log.append(WheelOdometry(time_s, gtsam.Pose2()))
    by = remedied(Calibration(), late_depth("camera", (late_s, 0.003)), only_sure=True)
    found = list(corrected(log, by))
    frames = [one for one in found if isinstance(one, RgbdFrame)]
    assert [one.stamp_s for one in found] == sorted(one.stamp_s for one in log)
    assert [one.stamp_s for one in frames] == STEPS.tolist()
    for one in frames[3:-3]:
        at = int(370 + 300 * math.sin(0.9 * (one.stamp_s + round(10 * late_s) / 10 - late_s)))
        assert np.array_equal(one.depth_m, depth_m[:, at : at + WIDTH])
    still = Calibration.model_validate({"cameras": {"camera": {"depth_clock_offset_s": late_s}}})
    (alone,) = corrected(log[:1], still)
    assert isinstance(alone, RgbdFrame) and isinstance(log[0], RgbdFrame)
    assert np.array_equal(alone.depth_m, log[0].depth_m)
