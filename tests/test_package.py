"""The package as others install it: what is in the wheel, what it needs, and one version everywhere."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import slam
from tools.licences import Package, bill_of_materials, forbidden, needed_by

REPO = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
GCC = "BSD-3-Clause AND GPL-3.0-or-later WITH GCC-exception-3.1"
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])(sys.argv[2])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built of the sdist, which is built of what git would hand out."""
    if Version(version("setuptools")) < Version("77"):
        pytest.skip(
            "setuptools is older than the build wants: the wheel stays UNTESTED; make test installs it"
        )
    work = tmp_path_factory.mktemp("package")
    clone = work / "clone"
    clone.mkdir()
    for folder in ("slam", "fusion", "configs", "tests"):
        shutil.copytree(
            REPO / folder, clone / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPO / file, clone)

    def build(kind: str, source: Path) -> Path:
        subprocess.run(
            [sys.executable, "-c", BUILD, kind, str(work)], cwd=source, check=True, capture_output=True
        )
        (built,) = work.glob("*.tar.gz" if kind == "build_sdist" else "*.whl")
        return built

    sdist = build("build_sdist", clone)
    with tarfile.open(sdist) as archive:
        # Debian's Python 3.11.2 knows no filters, newer ones warn without.
        archive.extractall(work, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    return build("build_wheel", work / sdist.name.removesuffix(".tar.gz"))


def test_the_wheel_holds_the_product_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    files = [file for top in ("slam", "fusion") for file in (REPO / top).rglob("*") if file.is_file()]
    wanted = {file.relative_to(REPO).as_posix() for file in files if "__pycache__" not in file.parts}
    # Path.rglob does not follow slam/presets, a link to configs/.
    wanted |= {
        f"slam/presets/{file.relative_to(REPO / 'configs')}" for file in (REPO / "configs").rglob("*.yaml")
    }
    assert held == wanted
    assert {"slam/py.typed", "fusion/py.typed", "slam/presets/lidar2d.yaml"} <= held


def test_the_wheel_runs_far_from_the_clone(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "import sys, slam, fusion\n"
        "from slam.cli import main\n"
        "assert all(sys.argv[1] in one.__file__ for one in (slam, fusion)), slam.__file__\n"
        "print(slam.load_config('lidar2d').seed)\n"
        "sys.argv[1:] = ['--version']\n"
        "main()\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "site")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
    )
    assert found.stdout.splitlines() == [str(slam.load_config().seed), f"scanweave {slam.__version__}"], (
        found.stderr
    )


def test_one_version_everywhere(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        stated = archive.read(metadata).decode()
    assert re.search(r"^Version: (.+)$", stated, re.M)[1] == slam.__version__


def test_the_changelog_and_the_citation_are_of_this_version() -> None:
    headings = re.findall(r"^## \[(.+?)\]( - \d{4}-\d\d-\d\d)?$", (REPO / "CHANGELOG.md").read_text(), re.M)
    assert headings[0] == ("Unreleased", "")
    newest, day = headings[1]
    citation = yaml.safe_load((REPO / "CITATION.cff").read_text(encoding="utf-8"))
    assert newest == citation["version"] == slam.__version__
    assert day == f" - {citation['date-released']}"
    # What version 1.2.0 of the format requires.
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["license"] == PROJECT["license"]


def test_the_forms_of_issues_ask_for_something() -> None:
    forms = sorted((REPO / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    for form in (yaml.safe_load(file.read_text(encoding="utf-8")) for file in forms if file.stem != "config"):
        assert {"name", "description", "body"} <= form.keys()
        assert {part["type"] for part in form["body"]} <= {"textarea", "input", "markdown", "dropdown"}
        assert all(
            {"id", "attributes"} <= part.keys() and part["attributes"]["label"] for part in form["body"]
        )
    jobs = yaml.safe_load((REPO / ".github/workflows/tests.yml").read_text(encoding="utf-8"))["jobs"]
    named = {
        f"Programming Language :: Python :: {one}" for one in jobs["release"]["strategy"]["matrix"]["python"]
    }
    assert named <= set(PROJECT["classifiers"])


def test_the_container_holds_what_the_package_is_built_of() -> None:
    kept = {line[1:] for line in (REPO / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {
        word
        for line in (REPO / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY") and "--from" not in line
        for word in line.split()[1:-1]
    }
    assert copied == kept and all((REPO / name).exists() for name in kept)
    as_root, as_user = (REPO / "Dockerfile").read_text().split("\nUSER scanweave\n")
    # What it compiles while it is built lies where it looks for it.
    assert (
        "NUMBA_CACHE_DIR=/tmp/numba " in as_root
        and "find /tmp/numba " in as_user.partition("scanweave demo")[2]
    )


def test_the_bill_of_materials() -> None:
    stated = bill_of_materials([Package("numpy", "2.4.6", "BSD-3-Clause"), Package("odd", "1", "")])
    assert stated["bomFormat"] == "CycloneDX" and stated["specVersion"] == "1.6"
    first, second = stated["components"]
    assert first["purl"] == "pkg:pypi/numpy@2.4.6" and "licenses" not in second


def test_no_part_that_runs_is_under_the_gpl() -> None:
    extras = frozenset(PROJECT["optional-dependencies"]) - {"dev"}
    found = needed_by("scanweave", extras)
    assert {"numpy", "gtsam", "llvmlite"} <= {one.name for one in found}  # what is brought by others, too
    assert [one for one in found if forbidden(one.licence)] == []


def test_what_is_forbidden() -> None:
    for text in ("GPL-3.0-or-later", "GNU General Public License v3 (GPLv3)", "AGPL-3.0", "GPLv2 AND MIT"):
        assert forbidden(text)
    for text in (
        "",
        "MIT",
        "BSD-3-Clause AND LGPL-2.1",
        "GNU Lesser General Public License v3 (LGPLv3)",
        GCC,
    ):
        assert not forbidden(text)
    assert not forbidden("GPL-2.0-only OR MIT")


def test_the_lock_fits_the_bounds() -> None:
    text = (REPO / "requirements.lock").read_text(encoding="utf-8")
    locked = re.findall(r"^([a-z0-9-]+)==(\S+)", text, re.M)
    for line in PROJECT["dependencies"]:
        wanted = Requirement(line)
        found = [number for name, number in locked if name == canonicalize_name(wanted.name)]
        assert found and all(wanted.specifier.contains(number) for number in found), f"{line}: {found}"
    assert text.count("--hash=sha256:") > len(locked)
