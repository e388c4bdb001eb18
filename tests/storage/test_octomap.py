import re
import shutil
import subprocess
import sys

import gtsam
import numpy as np
import pytest
from box_world import box_frame, box_frames, camera_poses, distances

from slam.errors import ConfigError, MapFileError, ScanweaveError
from slam.storage.octomap import write_octomap

ELSEWHERE = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, -0.4, 1.1), [12.3, -7.1, 2.9])
RESOLUTION_M = 0.05


def read_back(path, resolution_m=RESOLUTION_M):
    octomap = pytest.importorskip("octomap", reason="the extra scanweave[octomap] is not installed")
    tree = octomap.OcTree(0.1)
    assert tree.readBinary(str(path))
    assert tree.getResolution() == resolution_m
    return tree


@pytest.fixture(scope="module", params=[gtsam.Pose3(), ELSEWHERE], ids=["at the origin", "elsewhere"])
def written(request, tmp_path_factory):
    pytest.importorskip("octomap", reason="the extra scanweave[octomap] is not installed")
    path = tmp_path_factory.mktemp("octomap") / "box.bt"
    write_octomap(path, box_frames(), camera_poses(request.param), RESOLUTION_M, range_max_m=4.0)
    return path, request.param


def test_occupied_voxels_lie_on_the_surfaces(written):
    path, T_map_world = written
    occupied, _ = read_back(path).extractPointCloud()
    T = T_map_world.inverse()
    world = occupied @ T.rotation().matrix().T + T.translation()
    # A voxel is marked where the surface passes through it: its centre is within half its diagonal.
    assert np.minimum(*distances(world)).max() <= 0.5 * np.sqrt(3.0) * RESOLUTION_M + 1e-6
    assert len(occupied) > 800


def test_space_is_free_before_a_surface_and_unknown_behind_it(written):
    path, T_map_world = written
    tree = read_back(path)

    def occupied(x, y, z):
        import octomap

        try:
            return bool(tree.isNodeOccupied(tree.search(T_map_world.transformFrom(np.array([x, y, z])))))
        except octomap.NullPointerException:
            return None

    assert occupied(0.0, 0.0, 1.4) is True
    assert occupied(0.0, 0.0, 1.0) is False
    assert occupied(0.7, 0.0, 1.7) is False
    assert occupied(0.0, 0.0, 1.65) is None  # inside the box
    assert occupied(0.0, 0.0, 2.3) is None  # behind the wall


def test_the_tree_is_pruned(written):
    tree = read_back(written[0])
    assert max(leaf.getSize() for leaf in tree.begin_leafs()) >= 4.0 * RESOLUTION_M
    size = tree.size()
    tree.updateInnerOccupancy()
    assert tree.size() == size < 0.3 * tree.volume() / RESOLUTION_M**3


def test_octomaps_own_client_reads_the_file(written, tmp_path):
    client = shutil.which("bt2vrml")
    if client is None:
        pytest.skip("bt2vrml of octomap-tools is not installed")
    path = tmp_path / "box.bt"
    shutil.copy(written[0], path)
    reported = subprocess.run([client, str(path)], capture_output=True, text=True, check=True)
    assert "error" not in (reported.stdout + reported.stderr).lower()
    boxes = len(re.findall(r"Transform", path.with_suffix(".bt.wrl").read_text()))
    tree = read_back(path)
    assert boxes == sum(tree.isNodeOccupied(leaf) for leaf in tree.begin_leafs())


def test_beyond_the_maximal_range_space_is_freed_but_not_filled(tmp_path):
    path = tmp_path / "near.bt"
    frame = box_frame(gtsam.Pose3())
    write_octomap(path, [frame], [gtsam.Pose3()], RESOLUTION_M, range_max_m=0.8)
    occupied, free = read_back(path).extractPointCloud()
    assert len(occupied) == 0
    assert 0.7 < np.linalg.norm(free, axis=1).max() < 0.8 + RESOLUTION_M


def test_thinned_rays_stay_where_they_were(tmp_path):
    path = tmp_path / "thin.bt"
    # 0.09 m at 1.6 m are 8 pixels: every second one is used.
    write_octomap(path, [box_frame(gtsam.Pose3())], [gtsam.Pose3()], 0.09, range_max_m=1.6)
    occupied, _ = read_back(path, resolution_m=0.09).extractPointCloud()
    assert distances(occupied)[1].max() <= 0.5 * np.sqrt(3.0) * 0.09 + 1e-6
    assert len(occupied) > 25


def test_a_missing_extra_is_one_line_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "octomap", None)
    with pytest.raises(ScanweaveError, match=r"pip install 'scanweave\[octomap\]'") as reported:
        write_octomap(tmp_path / "a.bt", box_frames(), camera_poses())
    assert "\n" not in str(reported.value)


def test_input_that_gives_no_map_is_refused(tmp_path):
    pytest.importorskip("octomap", reason="the extra scanweave[octomap] is not installed")
    path, frame = tmp_path / "a.bt", box_frame(gtsam.Pose3())
    with pytest.raises(ConfigError, match="must be above 0"):
        write_octomap(path, [frame], [gtsam.Pose3()], resolution_m=0.0)
    with pytest.raises(ValueError, match="longer"):
        write_octomap(path, [frame], [gtsam.Pose3()] * 2)
    with pytest.raises(ScanweaveError, match="use a larger resolution"):
        write_octomap(path, [frame], [gtsam.Pose3(gtsam.Rot3(), [0.0, 5000.0, 0.0])])
    frame.depth_m[:] = 0.0
    with pytest.raises(ScanweaveError, match="no keyframe has depth"):
        write_octomap(path, [frame], [gtsam.Pose3()])
    assert not list(tmp_path.iterdir())
    with pytest.raises(MapFileError, match="cannot write"):
        write_octomap(tmp_path / "none" / "a.bt", box_frames(count=1), camera_poses(count=1))
