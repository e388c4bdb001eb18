"""The tool that breaks the code on purpose: what it breaks, whether tests notice, what it leaves behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.mutants import COPIED, Mutant, files_that_test, mutants_of, sample, survivors

SOURCE = '''
"""Text of 12 words."""
LIMIT = 7.5
def sign(x: int | None = 3, *, loud: bool = False) -> int:
    if not x or x < LIMIT:
        raise ValueError(f"{x + 1} is not enough")
    return tell(x - 5, loud=not loud)
def tell(x: int, loud: bool) -> None:
    """Tell it."""
    print(x)
    print(-x)
'''


def test_each_change_is_one_place_that_still_compiles() -> None:
    found = mutants_of(Path("a.py"), SOURCE)
    assert len({mutant.source for mutant in found}) == len(found)
    for mutant in found:
        compile(mutant.source, "a.py", "exec")
        assert mutant.source.count("int | None") == 1 and "x + 1" in mutant.source
    changes = [mutant.change for mutant in found]
    for expected in (
        "7.5  ->  7500.0", "3  ->  0.003", "x < LIMIT  ->  x >= LIMIT",
        "not x or x < LIMIT  ->  not x and x < LIMIT",
        "x - 5  ->  x + 5", "loud=not loud  ->  loud=loud", "print(x)  ->  None", "-x  ->  +x",
        "tell: 'print(x)'  ->  tell: 'return'",
    ):  # fmt: skip
        assert expected in changes, (expected, changes)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A room with one file, of which a test sees one half."""
    for name in COPIED:
        (tmp_path / name).mkdir()
    (tmp_path / "pyproject.toml").rmdir()
    (tmp_path / "pyproject.toml").write_text("")
    (tmp_path / "slam" / "room").mkdir()
    (tmp_path / "slam" / "room" / "sums.py").write_text(
        "def total(a, b):\n    return a + b\n\n\ndef other(a, b):\n    return a + b\n"
    )
    (tmp_path / "tests" / "room").mkdir()
    (tmp_path / "tests" / "room" / "test_sums.py").write_text(
        "from slam.room.sums import total\n\n\ndef test_it():\n    assert total(1, 2) == 3\n"
    )
    (tmp_path / "tests" / "room" / "test_else.py").write_text("def test_it():\n    pass\n")
    return tmp_path


def test_what_no_test_sees_survives_and_the_tree_is_left_alone(tree: Path) -> None:
    before = {path: path.read_bytes() for path in tree.rglob("*") if path.is_file()}
    mutants = sample(tree, ["slam/room"], 10, 0)
    assert [mutant.line for mutant in mutants] == [2, 6]
    assert files_that_test(mutants[0].path, tree) == ["tests/room/test_sums.py"]
    assert [mutant.line for mutant in survivors(tree, mutants, 60.0)] == [6]
    assert {path: path.read_bytes() for path in tree.rglob("*") if path.is_file()} == before


def test_tests_that_fail_anyway_say_nothing(tree: Path) -> None:
    (tree / "tests" / "room" / "test_sums.py").write_text("def test_it():\n    assert False\n")
    with pytest.raises(SystemExit, match="without a mutant"):
        list(survivors(tree, [Mutant(Path("slam/room/sums.py"), 1, "", "")], 60.0))


def test_the_sample_is_seeded(tree: Path) -> None:
    drawn = [sample(tree, ["slam/room/sums.py"], 1, seed)[0].line for seed in (0, 0, 1, 2, 3, 4)]
    assert drawn[0] == drawn[1] and set(drawn) == {2, 6}
