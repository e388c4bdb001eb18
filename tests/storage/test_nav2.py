import logging
import math

import gtsam
import numpy as np
import pytest
import yaml
from PIL import Image

from slam.errors import MapFileError
from slam.measurements import row_from_pose2
from slam.storage.nav2 import read_nav2_map, write_nav2_map
from slam.storage.pgm import write_pgm

# Row 0 is the lowest y.
STATES = np.array([[100, 0, -1], [0, 0, 100]], dtype=np.int8)
GREYS = [0, 89, 90, 100, 101, 205, 206, 254, 255]


def write_grey(folder, greys=GREYS, **changes):
    """A one-row map of these greys."""
    fields = {
        "image": "m.pgm",
        "resolution": 0.05,
        "origin": [1.0, 2.0, 0.5],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | changes
    write_pgm(folder / "m.pgm", np.array([greys], dtype=np.uint8))
    path = folder / "m.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in fields.items() if value is not None}))
    return path


def as_nav2_reads(path):
    """nav2's own steps, written out a cell at a time: (x, y) of a cell's centre -> value."""
    fields = yaml.safe_load(path.read_text())
    assert (fields["mode"], fields["negate"]) == ("trinary", 0)
    image = np.asarray(Image.open(path.parent / fields["image"]))
    x, y, yaw = fields["origin"]
    cells = {}
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            p = 1.0 - image[row, col] / 255.0
            value = 100 if p >= fields["occupied_thresh"] else 0 if p <= fields["free_thresh"] else -1
            right = (col + 0.5) * fields["resolution"]
            up = (image.shape[0] - 1 - row + 0.5) * fields["resolution"]
            place = (
                x + right * math.cos(yaw) - up * math.sin(yaw),
                y + right * math.sin(yaw) + up * math.cos(yaw),
            )
            cells[tuple(np.round(place, 6))] = value
    return cells


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-12.5, 3.25, 0.0), (4.0, -1.0, 2.0)])
def test_nav2_finds_every_cell_where_it_is(tmp_path, origin):
    T_map_grid = gtsam.Pose2(*origin)
    path, image_path = write_nav2_map(tmp_path / "map", STATES, 0.1, T_map_grid, "A map.")
    assert (path.name, image_path.name) == ("map.yaml", "map.pgm")
    cells = as_nav2_reads(path)
    assert len(cells) == STATES.size
    for (row, col), state in np.ndenumerate(STATES):
        centre = T_map_grid.transformFrom(np.array([(col + 0.5) * 0.1, (row + 0.5) * 0.1]))
        assert cells[tuple(np.round(centre, 6))] == state
    back = read_nav2_map(path)
    assert np.array_equal(back.values, STATES)
    assert back.values.dtype == np.int8
    assert back.resolution_m == 0.1
    np.testing.assert_array_equal(row_from_pose2(back.T_map_grid), row_from_pose2(T_map_grid))


def test_the_files_hold_what_nav2s_saver_writes(tmp_path):
    path, image_path = write_nav2_map(tmp_path / "map", STATES, 0.05, gtsam.Pose2(-1.5, 1e-7, 0.0), "A map.")
    assert path.read_text().splitlines() == [
        "# A map.",
        "image: map.pgm",
        "mode: trinary",
        "resolution: 0.05",
        "origin: [-1.5, 0.0000001, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]
    # The top row of the image is the highest y.
    assert np.asarray(Image.open(image_path)).tolist() == [[254, 254, 0], [0, 254, 205]]


def test_a_name_of_any_kind_is_read_back(tmp_path):
    back = read_nav2_map(write_nav2_map(tmp_path / "odd name's 1", STATES, 0.2, gtsam.Pose2(), "A map.")[0])
    np.testing.assert_array_equal(back.values, STATES)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [100, 100, -1, -1, -1, -1, 0, 0, 0]),
        ({"mode": "trinary", "negate": 1}, [0, -1, -1, -1, -1, 100, 100, 100, 100]),
        ({"negate": True, "occupied_thresh": 0.9}, [0, -1, -1, -1, -1, -1, -1, 100, 100]),
        ({"mode": "raw"}, [0, 89, 90, 100, -1, -1, -1, -1, -1]),
        ({"mode": "raw", "negate": 1}, [0, 89, 90, 100, -1, -1, -1, -1, -1]),
        # p = (255 - grey) / 255; (p - 0.196) / 0.454 in percent.
        ({"mode": "scale"}, [100, 100, 99, 91, 90, 0, 0, 0, 0]),
        (
            {"mode": "scale", "negate": 1, "free_thresh": 0.1, "occupied_thresh": 0.9},
            [0, 31, 32, 37, 37, 88, 88, 100, 100],
        ),
    ],
)
def test_every_mode_reads_as_nav2_reads_it(tmp_path, changes, expected):
    read = read_nav2_map(write_grey(tmp_path, **changes))
    assert read.values[0].tolist() == expected


@pytest.mark.parametrize(
    ("changes", "count"),
    [
        ({}, 0),
        ({"free_thresh": 0.1961}, 1),
        ({"free_thresh": 0.25}, 1),
        ({"free_thresh": 0.25, "negate": 1}, 0),
    ],
)
def test_unknown_cells_read_as_free_are_warned_of(tmp_path, caplog, changes, count):
    with caplog.at_level(logging.WARNING):
        read_nav2_map(write_grey(tmp_path, **changes))
    assert len(caplog.records) == count
    assert all(
        "turns 1 unknown cells (pixel 205) into free" in record.getMessage() for record in caplog.records
    )


def test_a_png_with_holes_is_unknown_there(tmp_path):
    import cv2

    grey = np.array([[0, 254, 0, 254]], dtype=np.uint8)
    alpha = np.array([[255, 255, 0, 254]], dtype=np.uint8)
    path = write_grey(tmp_path, image="m.png")
    cv2.imwrite(str(tmp_path / "m.png"), np.dstack([grey, grey, grey, alpha]))
    assert read_nav2_map(path).values.tolist() == [[100, 0, -1, -1]]
    cv2.imwrite(str(tmp_path / "m.png"), grey)
    assert read_nav2_map(path).values.tolist() == [[100, 0, 100, 0]]
    cv2.imwrite(str(tmp_path / "m.png"), grey.astype(np.uint16) * 257)
    assert read_nav2_map(path).values.tolist() == [[100, 0, 100, 0]]
    (tmp_path / "m.png").write_bytes(b"no image")
    with pytest.raises(MapFileError, match="not an image"):
        read_nav2_map(path)


@pytest.mark.parametrize(
    "content",
    [
        b"P5 3 1 100\n\x00\x32\x64",
        b"P5 3 1 65535\n\x00\x00\x80\x00\xff\xff",
        b"P2\n# CREATOR: map_saver 0.05 m/pix\n3 1\n# no blank\n255\n0 128\n# end\n255\n",
    ],
)
def test_white_is_white_whatever_its_number(tmp_path, content):
    path = write_grey(tmp_path)
    (tmp_path / "m.pgm").write_bytes(content)
    assert read_nav2_map(path).values.tolist() == [[100, -1, 0]]


@pytest.mark.parametrize(
    "content",
    [b"", b"P5 2 2 255\n\0\0\0", b"P5 0 2 255\n", b"P5 1 1 0\n\0", b"P2 1 1 255\nx", b"P2 1 1 9\n-1"],
)
def test_a_damaged_image_is_refused(tmp_path, content):
    path = write_grey(tmp_path)
    (tmp_path / "m.pgm").write_bytes(content)
    with pytest.raises(MapFileError, match="not an image that can be read"):
        read_nav2_map(path)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"image": None}, "image = .*: field required"),
        ({"image": "absent.pgm"}, "cannot read .*absent.pgm"),
        ({"image": "absent.png"}, "cannot read .*absent.png"),
        ({"resolution": None}, "resolution = .*: field required"),
        ({"resolution": 0}, "resolution = 0: input should be greater than 0"),
        ({"resolution": "wide"}, 'resolution = "wide": .* a valid number'),
        ({"origin": [0, 0]}, "origin.2 = .*: field required"),
        ({"origin": [0, 0, "x"]}, 'origin.2 = "x": .* a valid number'),
        ({"free_thresh": None}, "free_thresh = .*: field required"),
        ({"free_thresh": 0.7}, "free_thresh must be below occupied_thresh"),
        ({"occupied_thresh": 1.5}, "occupied_thresh = 1.5: .* less than or equal to 1"),
        ({"occupied_thresh": float("nan")}, "occupied_thresh = .* a finite number"),
        ({"negate": 2}, "negate = 2: .* a valid boolean"),
        ({"mode": "binary"}, 'mode = "binary": .*trinary'),
    ],
)
def test_a_senseless_description_is_refused_in_one_line(tmp_path, changes, reason):
    with pytest.raises(MapFileError, match=reason) as caught:
        read_nav2_map(write_grey(tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_what_is_no_map_is_refused_in_one_line(tmp_path):
    path = tmp_path / "map.yaml"
    with pytest.raises(MapFileError, match="cannot read"):
        read_nav2_map(path)
    for content, reason in (("a: [1,\nb: }", "cannot read"), ("just text", "holds a str")):
        path.write_text(content)
        with pytest.raises(MapFileError, match=reason) as caught:
            read_nav2_map(path)
        assert "\n" not in str(caught.value)


def test_other_states_are_not_written(tmp_path):
    wrong = (np.array([[50]], np.int8), np.array([[356]]), np.zeros((0, 3), np.int8), np.zeros(3, np.int8))
    for states in wrong:
        with pytest.raises(MapFileError, match="needs a grid of 100, 0 and -1"):
            write_nav2_map(tmp_path / "map", states, 0.05, gtsam.Pose2(), "A map.")
    assert not list(tmp_path.iterdir())
