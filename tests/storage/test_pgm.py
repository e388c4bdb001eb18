import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam.errors import MapFileError
from slam.storage.pgm import read_pgm, write_pgm

IMAGES = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9))


@given(image=IMAGES)
def test_what_is_written_is_read_back_and_understood_by_opencv(tmp_path_factory, image):
    import cv2

    path = tmp_path_factory.mktemp("pgm") / "map.pgm"
    write_pgm(path, image)
    assert np.array_equal(read_pgm(path), image)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image)


@given(image=IMAGES, comment=st.sampled_from(["", "# CREATOR: map_saver 0.05 m/pix\n"]))
def test_plain_text_is_read_with_comments_anywhere(tmp_path_factory, image, comment):
    path = tmp_path_factory.mktemp("pgm") / "map.pgm"
    rows, cols = image.shape
    numbers = "\n".join(" ".join(map(str, row)) for row in image)
    path.write_text(f"P2\n{comment}{cols} {rows}\n{comment}255\n{comment}{numbers}\n{comment}")
    assert np.array_equal(read_pgm(path), image)


def test_white_is_white_whatever_its_number(tmp_path):
    path = tmp_path / "map.pgm"
    path.write_bytes(b"P5 3 1 100\n\x00\x32\x64")
    assert read_pgm(path).tolist() == [[0, 128, 255]]
    path.write_bytes(b"P5 2 1 65535\n\xff\xff\x80\x80")
    assert read_pgm(path).tolist() == [[255, 128]]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a PGM"),
        (b"P6 1 1 255\n\x00\x00\x00", "not a PGM"),
        (b"P5 2 2 255\n\x00\x00\x00", "cut off, 3 of 2 x 2"),
        (b"P5 0 2 255\n", "0 x 2 pixels"),
        (b"P5 1 1 0\n\x00", "white 0"),
        (b"P5 1 1 100\n\x65", "101 is brighter than white, 100"),
        (b"P2 1 1 255\nx", "whole numbers"),
        (b"P2 1 1 255\n-1", "whole numbers"),
    ],
)
def test_a_damaged_image_is_refused(tmp_path, content, reason):
    path = tmp_path / "map.pgm"
    path.write_bytes(content)
    with pytest.raises(MapFileError, match=reason):
        read_pgm(path)
