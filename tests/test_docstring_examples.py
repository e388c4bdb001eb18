"""The examples in docstrings run as they stand, and no public name lacks one."""

from __future__ import annotations

import doctest
import importlib
import inspect
from functools import cached_property
from pathlib import Path

import pytest

import fusion
import slam

REPO = Path(__file__).parents[1]
FILES = [file for top in ("slam", "fusion") for file in sorted((REPO / top).rglob("*.py"))]
MODULES = [
    ".".join(file.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__")
    for file in FILES
    if ">>>" in file.read_text(encoding="utf-8")
]
PUBLIC = {
    **{f"slam.{name}": getattr(slam, name) for name in slam._HOMES},
    **{f"fusion.{name}": getattr(fusion, name) for name in fusion.__all__},
}
# What is returned by a function is shown in its example; so is what these methods do.
RETURNED = {"slam.Difference", "slam.GridMap", "slam.Joined", "slam.Localization", "slam.Merged"}
RETURNED |= {"fusion.ClockOffset", "fusion.Denoised", "fusion.Registration", "fusion.RigEstimate"}
# The mapper's and the command line's own.
INNER = {"slam.Map.parts", "slam.Map.write_files"}
INNER_PROPERTIES = {"fusion.Registration.first_yaw_step", "slam.GridMap.contents"}


def examples_of(found: object) -> list[doctest.Example]:
    """Those in the docstring of a function or a class, without the class's methods."""
    return doctest.DocTestParser().get_examples(inspect.getdoc(found) or "")


def methods() -> dict[str, object]:
    """The public methods of the public classes."""
    return {
        f"{name}.{own}": getattr(method, "__func__", method)
        for name, found in PUBLIC.items()
        if inspect.isclass(found)
        for own, method in vars(found).items()
        if not own.startswith("_") and inspect.isfunction(getattr(method, "__func__", method))
    }


def properties() -> list[str]:
    """The public properties of the public classes."""
    return [
        f"{name}.{own}"
        for name, found in PUBLIC.items()
        if inspect.isclass(found)
        for own, stated in vars(found).items()
        if not own.startswith("_") and isinstance(stated, (property, cached_property))
    ]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []
    for test in doctest.DocTestFinder().find(importlib.import_module(name), globs={}):
        if test.examples:
            folder = tmp_path / test.name
            folder.mkdir()
            monkeypatch.chdir(folder)  # where the examples write
            doctest.DocTestRunner().run(test, out=reported.append)
    assert not reported, "".join(reported)


@pytest.mark.parametrize("name", sorted(PUBLIC.keys() - RETURNED))
def test_every_public_name_has_an_example(name: str) -> None:
    assert any(not one.options.get(doctest.SKIP) for one in examples_of(PUBLIC[name])), name


def test_every_public_method_and_property_is_in_an_example_that_runs() -> None:
    everything = {**PUBLIC, **methods()}
    text = "".join(
        one.source
        for found in everything.values()
        for one in examples_of(found)
        if not one.options.get(doctest.SKIP)
    )
    lacking = [name for name in methods() if f".{name.rsplit('.', 1)[1]}(" not in text]
    assert sorted(lacking) == sorted(INNER)
    lacking = [name for name in properties() if f".{name.rsplit('.', 1)[1]}" not in text]
    assert sorted(lacking) == sorted(INNER_PROPERTIES)


def test_what_is_returned_is_shown_where_it_is_returned() -> None:
    returning = [PUBLIC[name] for name in PUBLIC if inspect.isfunction(PUBLIC[name])]
    returning += [found for name, found in methods().items() if name.startswith("fusion.Rig.")]
    stated = " ".join(str(inspect.signature(one).return_annotation) for one in returning)
    assert not [name for name in RETURNED if name.rsplit(".", 1)[1] not in stated]
