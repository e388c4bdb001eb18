import gc
import threading
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from box_world import box_frame, box_frames

from slam.errors import ScanweaveError
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.vision.features import Features

SHAPES = [((0, 2), np.float32), ((0, 32), np.uint8), (0, np.float32), (0, np.float32)]
NONE = Features(*(np.zeros(shape, kind) for shape, kind in SHAPES))


def test_frames_come_back_in_order_with_depth_to_a_tenth_of_a_millimetre():
    T_base_camera = gtsam.Pose3(gtsam.Rot3.Rz(0.3), [0.1, 0.2, 0.3])
    frames = [replace(f, T_base_camera=T_base_camera, sensor="kinect") for f in box_frames(count=3)]
    frames[1].depth_m[10:20, 30:50] = 0.0
    spool = MapFrames(MapFile.temporary())
    assert [spool.add(frame, 0, NONE) for frame in frames] == [0, 1, 2]
    assert len(spool) == 3
    for kept, frame in zip(spool, frames, strict=True):
        assert kept.stamp_s == frame.stamp_s
        assert (kept.intrinsics, kept.sensor) == (frame.intrinsics, "kinect")
        assert kept.T_base_camera.equals(T_base_camera, 0.0)
        assert kept.depth_m.dtype == np.float32
        np.testing.assert_allclose(kept.depth_m, frame.depth_m, atol=1.01e-4)
        np.testing.assert_array_equal(kept.depth_m == 0.0, frame.depth_m == 0.0)
        assert kept.color.dtype == np.uint8
    np.testing.assert_array_equal(spool.frame(1).depth_m, list(spool)[1].depth_m)


def test_colours_keep_their_order_and_nearly_their_values():
    frame = box_frame(gtsam.Pose3())
    smooth = np.zeros_like(frame.color)
    smooth[..., 0] = np.linspace(200, 250, frame.color.shape[1])
    smooth[..., 2] = np.linspace(10, 60, frame.color.shape[0])[:, None]
    spool = MapFrames(MapFile.temporary())
    spool.add(replace(frame, color=smooth), 0, NONE)
    assert np.abs(spool.frame(0).color.astype(int) - smooth).max() <= 6


def test_a_view_into_another_image_is_kept_too():
    frame = box_frame(gtsam.Pose3())
    mirrored = replace(frame, color=frame.color[:, ::-1, ::-1], depth_m=frame.depth_m[:, ::-1])
    spool = MapFrames(MapFile.temporary())
    spool.add(mirrored, 0, NONE)
    np.testing.assert_allclose(spool.frame(0).depth_m, mirrored.depth_m, atol=1.01e-4)


@pytest.mark.parametrize(("reach_m", "step_m"), [(13.0, 0.0002), (26.214, 0.0004), (65.535, 0.001)])
def test_a_long_range_is_kept_in_coarser_steps(reach_m, step_m):
    frame = box_frame(gtsam.Pose3())
    depth_m = np.linspace(0.0, reach_m, frame.depth_m.size, dtype=np.float32).reshape(frame.depth_m.shape)
    spool = MapFrames(MapFile.temporary())
    spool.add(replace(frame, depth_m=depth_m), 0, NONE)
    np.testing.assert_allclose(spool.frame(0).depth_m, depth_m, atol=0.51 * step_m)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_depth_that_is_not_finite_is_refused(bad):
    frame = box_frame(gtsam.Pose3(), stamp_s=7.5)
    frame.depth_m[3, 4] = bad
    spool = MapFrames(MapFile.temporary())
    with pytest.raises(ScanweaveError, match=r"7\.5.* s holds (nan|inf)"):
        spool.add(frame, 0, NONE)


def test_a_temporary_map_goes_when_it_is_forgotten():
    file = MapFile.temporary()
    folder = file.path.parent
    spool = MapFrames(file)
    spool.add(box_frame(gtsam.Pose3()), 0, NONE)
    with pytest.raises(IndexError):
        spool.frame(1)
    assert folder.is_dir()
    del file, spool
    gc.collect()
    assert not folder.exists()


def test_a_temporary_map_may_be_forgotten_by_another_thread():
    kept = [MapFile.temporary()]
    folder = kept[0].path.parent
    thread = threading.Thread(target=kept.clear)
    thread.start()
    thread.join()
    assert not folder.exists()
