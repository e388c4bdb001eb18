"""Reads the imports of slam/ and fusion/ and keeps the floors of the house true."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

REPO = Path(__file__).parents[1]

# From the roof down; a file imports only from floors below its own, rooms on one floor do not meet.
FLOORS: tuple[frozenset[str], ...] = (
    frozenset({"slam.cli"}),
    frozenset({"slam.comparison"}),
    frozenset({"slam.simulation"}),  # the laboratory ends here: nothing below imports it or comparison
    frozenset({"slam.app"}),  # use cases
    frozenset({"slam.sessions"}),
    frozenset({"slam.evaluation", "slam.viewer"}),
    frozenset({"slam.localization"}),
    frozenset({"slam.outputs"}),  # a finished map and its files
    frozenset({"slam.edits"}),  # a finished map made anew, as a person wants it
    frozenset({"slam.mapper"}),  # the main loop
    frozenset({"slam.doctor", "slam.storage"}),
    frozenset({"slam.odometry", "slam.graph", "slam.mapping", "slam.datasets", "slam.trajectory"}),
    # kernels shared by odometry, graph and localization
    frozenset({"slam.matching", "slam.vision", "slam.earth"}),
    frozenset({"slam.estimates"}),
    frozenset({"slam.config", "slam.measurements", "slam.spool"}),
    frozenset({"slam.errors", "slam.result_cache", "fusion"}),
    frozenset({"slam.foreign", "slam.forked", "slam.heap", "slam.later", "slam.temporary", "slam.zstandard"}),
    frozenset({"slam"}),  # the package's own __init__: it names what is public, and loads none of it
    frozenset({"slam.version"}),
)
MAX_LINES = 400
NEVER_IMPORTED = {"evo", "plyfile", "tools", "tests", "conftest"}  # GPL oracles; people's scripts
# Slow or heavy to load, and not every run needs them; or extras that need not be there.
LAZY_ONLY = {"open3d", "embreex", "cv2", "matplotlib", "kiss_icp", "distributed", "pyarrow", "rerun", "ezdxf"}


@dataclass(frozen=True)
class Import:
    """One imported module as written, and whether it runs when the importing file is loaded."""

    target: str
    line: int
    at_load: bool
    typing_only: bool


def violations(root: Path) -> list[str]:
    """Every broken rule under ``root``, one line each."""
    files = {
        module_name(f, root): f for top in ("slam", "fusion") for f in sorted((root / top).rglob("*.py"))
    }
    found: list[str] = []
    arrows: dict[str, set[str]] = {}
    for module, file in files.items():
        source = file.read_text(encoding="utf-8")
        tree = ast.parse(source)
        imports = list(imports_of(tree, module, is_package=file.name == "__init__.py", known=set(files)))
        arrows[module] = {i.target for i in imports if i.target in files and i.target != module}
        found += [f"{module}: {fault}" for fault in file_faults(module, source, tree)]
        found += [f"{module}:{i.line}: {fault}" for i in imports if (fault := import_fault(module, i))]
    # One import statement may name several things of one module; one line is enough.
    return list(dict.fromkeys(found)) + [
        f"circle of imports: {' -> '.join(circle)}" for circle in circles(arrows)
    ]


def module_name(file: Path, root: Path) -> str:
    """Dotted name of a file; a package's __init__ bears the package's name."""
    parts = file.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """The part of a module's name that has a floor: slam.graph, fusion."""
    parts = module.split(".")
    return parts[0] if parts[0] == "fusion" else ".".join(parts[:2])


def floor_of(module: str) -> int | None:
    """Index into FLOORS, larger is lower."""
    return next((i for i, rooms in enumerate(FLOORS) if room_of(module) in rooms), None)


def imports_of(tree: ast.Module, module: str, *, is_package: bool, known: set[str]) -> Iterator[Import]:
    """Every import of a file, relative ones resolved, ``from slam import graph`` read as slam.graph."""
    for node, at_load, typing_only in walk(tree, at_load=True, typing_only=False):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, at_load, typing_only)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".") if is_package else module.split(".")[:-1]
                package = package[: len(package) - node.level + 1]
                base = ".".join([*package, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield Import(inner if inner in known else base, node.lineno, at_load, typing_only)


def walk(node: ast.AST, *, at_load: bool, typing_only: bool) -> Iterator[tuple[ast.AST, bool, bool]]:
    """All nodes; a function's body does not run at load, TYPE_CHECKING's never runs."""
    for child in ast.iter_child_nodes(node):
        yield child, at_load, typing_only
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from walk(child, at_load=False, typing_only=typing_only)
        elif isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            for statement in child.body:
                yield statement, at_load, True
                yield from walk(statement, at_load=at_load, typing_only=True)
            for statement in child.orelse:
                yield statement, at_load, typing_only
                yield from walk(statement, at_load=at_load, typing_only=typing_only)
        else:
            yield from walk(child, at_load=at_load, typing_only=typing_only)


def file_faults(module: str, source: str, tree: ast.Module) -> Iterator[str]:
    """Faults of a file by itself: its place, its length, its prints."""
    if floor_of(module) is None:
        yield f"room {room_of(module)} has no floor; give it one in FLOORS"
    if (lines := len(source.splitlines())) >= MAX_LINES:
        yield f"{lines} lines, the limit is {MAX_LINES}"
    calls = [
        node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]
    if room_of(module) != "slam.cli" and any(call.func.id == "print" for call in calls):
        yield "prints; only slam.cli may"


def import_fault(module: str, item: Import) -> str | None:
    """Why this import may not stand, or None."""
    top = item.target.split(".")[0]
    if module == "slam" and item.typing_only:
        return None  # the public names for type checkers; what runs loads them when they are asked for
    if top in NEVER_IMPORTED:
        return f"imports {top}, which the product never does"
    if top in LAZY_ONLY and item.at_load and not item.typing_only:
        return f"imports {top} at load; import it inside the function that needs it"
    if top not in {"slam", "fusion"} or room_of(item.target) == room_of(module):
        return None
    here, there = floor_of(module), floor_of(item.target)
    if there is None:
        return f"imports {item.target}, a room without a floor"
    if here is not None and there <= here:
        return f"imports {item.target}, which is not below it"
    return None


def circles(arrows: dict[str, set[str]]) -> Iterator[list[str]]:
    """One circle for every arrow that closes one, by depth-first search."""
    done: set[str] = set()
    path: list[str] = []

    def visit(module: str) -> Iterator[list[str]]:
        if module in path:
            yield [*path[path.index(module) :], module]
            return
        if module in done:
            return
        path.append(module)
        for target in sorted(arrows[module]):
            yield from visit(target)
        path.pop()
        done.add(module)

    for module in sorted(arrows):
        yield from visit(module)


def test_the_floors_and_habits_hold() -> None:
    assert violations(REPO) == []


def test_the_reader_of_imports_sees_the_house() -> None:
    # Guards against a test that passes since it looked at nothing.
    names = {module_name(f, REPO) for f in (REPO / "slam").rglob("*.py")}
    assert {"slam", "slam.errors", "slam.measurements"} <= names


SOUND = {
    "slam/cli/__init__.py": "from slam.mapper.pipeline import run\nprint(run())\n",
    "slam/mapper/pipeline.py": (
        "from slam import graph, errors\nfrom slam.graph.poses import chain\nrun = chain\n"
    ),
    "slam/graph/__init__.py": "",
    "slam/graph/poses.py": (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import matplotlib\n"
        "from ..matching.kernel import match\nfrom . import poses_math\n"
        "def chain():\n    import cv2\n    return match, poses_math, cv2\n"
    ),
    "slam/graph/poses_math.py": "import numpy\nimport fusion.bayes\n",
    "slam/matching/kernel.py": "from slam.measurements import LaserScan\nmatch = LaserScan\n",
    "slam/measurements.py": "class LaserScan: ...\n",
    "slam/errors.py": "",
    "slam/__init__.py": "",
    "fusion/bayes.py": "import numpy\n",
}


def build(root: Path, files: dict[str, str]) -> Path:
    for name, source in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(source)
    return root


def test_a_sound_tree_has_no_violations(tmp_path: Path) -> None:
    assert violations(build(tmp_path, SOUND)) == []


BAD = "slam/graph/bad.py"


@pytest.mark.parametrize(
    ("file", "source", "expected"),
    [
        (BAD, "from slam.mapper.pipeline import run\n", "slam.graph.bad:1: imports slam.mapper.pipeline"),
        (BAD, "from slam.mapper import pipeline\n", "imports slam.mapper.pipeline, which is"),
        (BAD, "from ..mapper import pipeline\n", "imports slam.mapper.pipeline, which is"),
        (BAD, "def f():\n    import slam.cli\n", "slam.graph.bad:2: imports slam.cli"),
        (
            "slam/mapping/bad.py",
            "from slam.graph.poses import chain\n",
            "imports slam.graph.poses, which is not",
        ),
        ("slam/matching/bad.py", "import slam.graph\n", "imports slam.graph, which is not below"),
        (
            "slam/config/__init__.py",
            "from slam.measurements import LaserScan\n",
            "imports slam.measurements, which",
        ),
        (
            "fusion/bad.py",
            "from slam.errors import ScanweaveError\n",
            "imports slam.errors, which is not below",
        ),
        (
            "slam/__init__.py",
            "from slam.mapper.pipeline import run\n",
            "slam:1: imports slam.mapper.pipeline",
        ),
        ("slam/attic.py", "", "slam.attic: room slam.attic has no floor"),
        (BAD, "import slam.attic\n", "imports slam.attic, a room without a floor"),
        (
            "slam/graph/poses_math.py",
            "from slam.graph import poses\n",
            "circle of imports: slam.graph.poses -> ",
        ),
        (BAD, "x = 1\n" * MAX_LINES, "400 lines, the limit is 400"),
        (BAD, "def f():\n    print(1)\n", "prints; only slam.cli may"),
        (BAD, "def f():\n    from evo.core import metrics\n", "imports evo, which the product"),
        (BAD, "import plyfile\n", "imports plyfile, which the product"),
        (BAD, "import tools.benchmark\n", "imports tools, which the product"),
        ("fusion/bad.py", "from tests.conftest import x\n", "imports tests, which the product"),
        (BAD, "import open3d as o3d\n", "imports open3d at load"),
        (BAD, "try:\n    import cv2\nexcept ImportError: ...\n", "imports cv2 at load"),
        (BAD, "class A:\n    from matplotlib.figure import Figure\n", "imports matplotlib at load"),
        ("fusion/bad.py", "from kiss_icp.mapping import VoxelHashMap\n", "imports kiss_icp at load"),
    ],
)
def test_each_rule_can_fail(tmp_path: Path, file: str, source: str, expected: str) -> None:
    found = violations(build(tmp_path, {**SOUND, file: source}))
    assert any(expected in line for line in found), found
