import numpy as np
import pytest

from fusion.depth_model import RangeNoise
from slam.mapping.lidar_layer import weigh_beams
from slam.mapping.ray_tracing import HIT, beam_ends, mark_lines

LETTERS = {0: ".", -1: "o", 2: "#"}


def draw(ranges, x=0.5, y=0.5, start=0.0, step=np.pi / 2, cells_per_m=1.0, hit_limit=50.0, clear_limit=3.0):
    """The board as text, the highest row first, and its corner."""
    ends, kinds, box = beam_ends(
        np.array(ranges, dtype=np.float32), x, y, start, step, cells_per_m, hit_limit, clear_limit
    )
    exact = (RangeNoise(1e-12), 0.0, np.array([2], np.int16), -1)
    board = weigh_beams(ends, kinds, box, (x, y), 1.0 / cells_per_m, *exact)
    return ["".join(LETTERS[value] for value in row) for row in board[::-1]], box


@pytest.mark.parametrize("row", [0, 7, -5])
@pytest.mark.parametrize("col", [0, 3, -9])
def test_four_beams_draw_a_cross_wherever_the_laser_stands(row, col):
    picture, box = draw([2.0, 1.0, 3.0, np.inf], x=col + 0.5, y=row + 0.5)
    assert picture == [
        "...#..",
        "#oooo#",
        "...o..",
        "...o..",
        "...o..",
    ]
    assert box == (row - 3, col - 3, 5, 6)


def test_a_diagonal_and_a_shallow_line():
    assert draw([4 * np.sqrt(2)], start=np.pi / 4)[0] == ["....#", "...o.", "..o..", ".o...", "o...."]
    assert draw([np.hypot(5, 2)], start=np.arctan2(2, 5))[0] == ["....o#", "..oo..", "oo...."]
    assert draw([np.hypot(5, 2)], start=np.arctan2(-2, -5))[0] == ["....oo", "..oo..", "#o...."]


def test_a_steep_line_is_a_shallow_one_turned():
    shallow = draw([np.hypot(5, 2)], start=np.arctan2(2, 5))[0][::-1]
    steep = draw([np.hypot(5, 2)], start=np.arctan2(5, 2))[0][::-1]
    assert ["".join(column) for column in zip(*shallow, strict=True)] == steep


def test_no_return_clears_up_to_the_limit_and_marks_nothing():
    assert draw([np.inf], clear_limit=4.0)[0] == ["ooooo"]
    assert draw([60.0], clear_limit=4.0)[0] == ["ooooo"]
    assert draw([2.0], hit_limit=1.0, clear_limit=4.0)[0] == ["ooo"]
    assert draw([np.inf], clear_limit=0.0)[0] == ["."]
    assert draw([np.inf], hit_limit=np.inf, clear_limit=2.0)[0] == ["ooo"]


@pytest.mark.parametrize("nothing", [np.nan, 0.0, -np.inf])
def test_an_invalid_beam_says_nothing(nothing):
    assert draw([nothing, 2.0, nothing])[0] == ["#", "o", "o"]
    assert draw([nothing])[0] == ["."]


def test_a_reading_that_was_taken_away_clears_as_before_and_marks_nothing():
    assert draw([3.0])[0] == ["ooo#"]
    assert draw([-3.0])[0] == [row.replace("#", "o") for row in draw([3.0])[0]]
    assert draw([-3.0], hit_limit=2.0)[0] == ["."]


def test_an_end_is_not_cleared_by_the_beam_that_passes_it():
    for ranges in ([1.0, 3.0], [3.0, 1.0], [1.0, np.inf], [np.inf, 1.0]):
        assert draw(ranges, step=0.0)[0][0][:3] == "o#o"
    # Nor by a beam without return whose limit lies in it.
    assert draw([2.0, np.inf], step=0.0, clear_limit=2.0)[0] == ["oo#"]
    assert draw([np.inf, 2.0], step=0.0, clear_limit=2.0)[0] == ["oo#"]


def test_an_end_in_the_lasers_own_cell_marks_it():
    assert draw([0.3])[0] == ["#"]


def test_random_lines_stay_near_the_true_one_and_are_connected():
    rng = np.random.default_rng(5)
    for _ in range(300):
        x, y, angle, reach = rng.uniform([-9, -9, -7, 0.1], [9, 9, 7, 40])
        ends, kinds, box = beam_ends(np.array([reach], dtype=np.float32), x, y, angle, 0.1, 1.0, 50.0, 3.0)
        np.testing.assert_allclose(ends[0], [x + reach * np.cos(angle), y + reach * np.sin(angle)], atol=1e-5)
        board = np.zeros(box[2:], np.int16)
        mark_lines(ends, kinds, box, x, y, -3, board.reshape(-1))
        rows, cols = np.nonzero(board)
        centres = np.column_stack([cols + box[1] + 0.5 - x, rows + box[0] + 0.5 - y])
        across = np.abs(centres @ [-np.sin(angle), np.cos(angle)])
        assert across.max() < np.sqrt(0.5) + 1e-6
        # One cell a step along the longer axis; the last step may be cut short by the border of a cell.
        assert max(board.shape) - 1 <= len(rows) <= max(board.shape)
        assert kinds[0] == HIT
        assert board[int(np.floor(ends[0, 1])) - box[0], int(np.floor(ends[0, 0])) - box[1]] == -3


def test_places_a_hair_below_a_border_stay_on_the_board():
    # -1e-20 lies in cell -1; taking the corner off rounds it to 1.0, the neighbour.
    picture, box = draw([0.5, 0.5], x=-1e-20, y=-1e-20, start=np.pi / 4, step=np.pi)
    assert (picture, box) == ([".#", "#."], (-1, -1, 2, 2))


def test_a_beam_clears_nothing_within_the_noise_of_its_end():
    ends, kinds, box = beam_ends(np.array([6.0], np.float32), 0.5, 0.5, 0.0, 0.1, 1.0, 50.0, 3.0)
    noise = RangeNoise(0.5, 0.25)  # 2 m at 6 m
    board = weigh_beams(ends, kinds, box, (0.5, 0.5), 1.0, noise, 1.0, np.array([2], np.int16), -1)
    assert board.tolist() == [[-1, -1, -1, -1, -1, 0, 2]]
