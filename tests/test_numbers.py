"""The numbers by which Scanweave could be tuned become fewer, never more: lower a ceiling where you can."""

from __future__ import annotations

import ast

from tools.count_numbers import bare_floats, constant_names, count_fields, count_lines, count_logic

MOST_CONSTANTS = 322
MOST_BARE_FLOATS = 111
MOST_FIELDS = 141
MOST_LINES = 70_744


def test_constants_of_the_logic_do_not_grow() -> None:
    counted = count_logic()
    assert counted.constants.total() <= MOST_CONSTANTS, dict(counted.constants)
    assert counted.literals.total() <= MOST_BARE_FLOATS, dict(counted.literals)


def test_settings_do_not_grow() -> None:
    assert count_fields() <= MOST_FIELDS


def test_lines_of_the_product_do_not_grow() -> None:
    assert count_lines() <= MOST_LINES


def test_what_counts_as_a_constant_and_as_a_bare_float() -> None:
    tree = ast.parse(
        "_WIDE, _NARROW = 0.3, 0.06\n"
        "RAMP: object = np.array([[1, 2]])\n"
        "_PATH = Path('a')\n"
        "_ON = True\n"
        "lower = 3.0\n"
        "def f(x=0.25):\n"
        "    return 0.5 * x + 1e-9 + math.pi / 3.0 + 7\n"
    )
    assert list(constant_names(tree)) == ["_WIDE", "_NARROW", "RAMP"]
    assert sorted(bare_floats(tree)) == [1e-9, 0.25, 3.0]
