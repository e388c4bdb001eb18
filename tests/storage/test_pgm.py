import cv2
import numpy as np
from hypothesis import given
from hypothesis.extra import numpy as hnp

from slam.storage.pgm import write_pgm


@given(image=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_what_is_written_is_understood_by_opencv(tmp_path_factory, image):
    path = tmp_path_factory.mktemp("pgm") / "map.pgm"
    write_pgm(path, image)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image)
