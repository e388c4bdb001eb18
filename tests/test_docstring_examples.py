"""The examples in the docstrings of all public names run as they stand, and none lacks where it is wanted."""

from __future__ import annotations

import doctest
import inspect
from pathlib import Path

import pytest

import fusion
import slam

PUBLIC = [
    *((f"slam.{name}", getattr(slam, name)) for name in slam._HOMES),
    *((f"fusion.{name}", getattr(fusion, name)) for name in fusion.__all__),
]
# Every public function has an example, and each class that does something; the others are records.
CLASSES = {"slam.Localizer", "slam.PoseGraph", "fusion.Rig"}


def examples_of(name: str, found: object) -> list[doctest.DocTest]:
    """The docstrings with examples of a function or a class and its methods, which name all they use."""
    tests = doctest.DocTestFinder().find(found, name, globs={})
    return [test for test in tests if test.examples]


@pytest.mark.parametrize(("name", "found"), PUBLIC, ids=[name for name, _ in PUBLIC])
def test_the_examples(name: str, found: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # where the examples write
    reported: list[str] = []
    for test in examples_of(name, found):
        doctest.DocTestRunner().run(test, out=reported.append)
    assert not reported, "".join(reported)


@pytest.mark.parametrize(("name", "found"), PUBLIC, ids=[name for name, _ in PUBLIC])
def test_an_example_is_there_and_runs(name: str, found: object) -> None:
    if not (inspect.isfunction(found) or name in CLASSES):
        return
    run = [
        example
        for test in examples_of(name, found)
        for example in test.examples
        if not example.options.get(doctest.SKIP)
    ]
    assert run, f"{name} has no example that runs"
