"""Break the code on purpose, one place at a time, and check whether its tests fail.

    python tools/mutants.py slam/graph slam/mapper/planar_mapper.py --count 60 --seed 1

A mutant swaps a comparison, plus and minus, or ``and`` and ``or``, drops ``not`` or a call, returns early, or
scales a constant by 1000 or 1/1000. The tests of a file are those of its name, those that import it, and
those of `BESIDE`. All changes are made in a copy of the tree, which is deleted afterwards.
"""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

COPIED = ("slam", "fusion", "tests", "tools", "configs", "pyproject.toml")
# Tests of a package or a file besides those of its name and those that import it.
_BELIEVED = ("tests/mapper/test_whom_to_believe*.py",)
BESIDE = {
    "slam/odometry": _BELIEVED,
    "slam/odometry/turn_matcher.py": ("tests/odometry/test_cloud_*.py",),
    "slam/graph": (*_BELIEVED, "tests/mapper/test_pipeline.py"),
    "slam/mapper": (*_BELIEVED, "tests/mapper/test_planar_*.py", "tests/mapper/test_pipeline*.py"),
    "slam/mapper/lidar3d.py": ("tests/mapper/test_cloud_*.py",),
    "slam/mapper/cloud_cameras.py": ("tests/mapper/test_cloud_*.py",),
    "slam/mapper/rgbd.py": ("tests/mapper/test_camera_alone.py",),
}
_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """A file with one place broken: where, how, and the whole broken source."""

    path: Path
    line: int
    change: str
    source: str


def mutants_of(path: Path, text: str) -> list[Mutant]:
    """All mutants of a file; annotations, decorators and messages are left alone."""
    tree, found = ast.parse(text), []
    nodes = list(ast.walk(tree))
    untouched = {id(inner) for node in nodes for part in _untouched(node) for inner in ast.walk(part)}
    for node in nodes:
        for apply in [] if id(node) in untouched else _changes(node):
            before, whole = _reported(node), dict(vars(node))
            apply()
            change = f"{before}  ->  {_reported(node)}"
            source = ast.unparse(ast.fix_missing_locations(tree))
            vars(node).update(whole)
            found.append(Mutant(path, getattr(node, "lineno", 0), change, source))
    return found


def _reported(node: ast.AST) -> str:
    """A node in one line; of a function the first two statements."""
    if isinstance(node, ast.FunctionDef):
        return f"{node.name}: {ast.unparse(node.body[1])[:50]!r}"
    return " ".join(ast.unparse(node).split())[:100]


def _untouched(node: ast.AST) -> Iterator[ast.AST]:
    """Parts of a node whose change no test should see."""
    if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation:
        yield node.annotation
    if isinstance(node, ast.FunctionDef):
        yield from [*node.decorator_list, *([node.returns] if node.returns else [])]
    if isinstance(node, ast.ClassDef):
        yield from [*node.decorator_list, *node.bases]
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        yield node


def _changes(node: ast.AST) -> list[Callable[[], None]]:
    """Ways to break a node where it stands."""

    def put(name: str, value: object) -> Callable[[], None]:
        return lambda: setattr(node, name, value)

    match node:
        case ast.Compare(ops=[operator]) if type(operator) in _SWAPS:
            return [put("ops", [_SWAPS[type(operator)]()])]
        case ast.BinOp(op=operator) | ast.BoolOp(op=operator) if type(operator) in _SWAPS:
            return [put("op", _SWAPS[type(operator)]())]
        case ast.UnaryOp(op=ast.USub()):
            return [put("op", ast.UAdd())]
        case ast.If(test=ast.UnaryOp(op=ast.Not(), operand=operand)):
            return [put("test", operand)]
        case ast.keyword(value=ast.UnaryOp(op=ast.Not(), operand=operand)):
            return [put("value", operand)]
        case ast.Constant(value=int() | float() as value) if value not in (0, 1, 2):
            return [put("value", value * 1000), put("value", value / 1000)]
        case ast.Expr(value=ast.Call()):
            return [put("value", ast.Constant(None))]
        case ast.FunctionDef(returns=ast.Constant(value=None), body=[first, _, *_] as body):
            return [put("body", [first, ast.Return(), *body[1:]])]
    return []


def files_that_test(path: Path, tree: Path) -> list[str]:
    """Test files of a file of the tree, the nearest first."""
    module = ".".join(path.with_suffix("").parts)
    named = sorted((tree / "tests").rglob(f"test_{path.stem}*.py"))
    every = sorted((tree / "tests").rglob("test_*.py"))
    importing = [test for test in every if f"{module} import" in test.read_text()]
    globs = BESIDE.get(str(path), BESIDE.get(str(path.parent), ()))
    beside = [test for glob in globs for test in sorted(tree.glob(glob))]
    return list(dict.fromkeys(str(test.relative_to(tree)) for test in (*named, *importing, *beside)))


def killed(mutant: Mutant, tree: Path, timeout_s: float) -> bool:
    """Whether a test of its file fails, or takes too long, while a mutant stands in a copy of the tree."""
    file = tree / mutant.path
    whole = file.read_text()
    try:
        file.write_text(mutant.source)
        return not passed(files_that_test(mutant.path, tree), tree, timeout_s)
    finally:
        file.write_text(whole)


def passed(tests: Sequence[str], tree: Path, timeout_s: float | None = None) -> bool:
    """Whether test files of a copy of the tree pass, and soon enough."""
    paths = {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(tree / "numba"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "-p", "no:cacheprovider", *tests]
    try:
        ended = subprocess.run(
            command,
            cwd=tree,
            env={**os.environ, **paths},
            capture_output=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return ended.returncode == 0


def sample(root: Path, wanted: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """A number of mutants of files and packages of the tree, by file and line."""
    files = [
        file
        for name in wanted
        for file in ([root / name] if name.endswith(".py") else (root / name).glob("*.py"))
    ]
    paths = sorted({file.relative_to(root) for file in files})
    every = [mutant for path in paths for mutant in mutants_of(path, (root / path).read_text())]
    chosen = np.random.default_rng(seed).permutation(len(every))[:count]
    return sorted((every[n] for n in chosen), key=lambda mutant: (mutant.path, mutant.line))


def survivors(root: Path, mutants: Sequence[Mutant], timeout_s: float) -> Iterator[Mutant]:
    """Those that no test notices."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        tree = Path(name)
        for one in COPIED:
            copied = shutil.copytree if (root / one).is_dir() else shutil.copy
            copied(root / one, tree / one)
        tests = {test for mutant in mutants for test in files_that_test(mutant.path, tree)}
        if not passed(sorted(tests), tree):
            raise SystemExit("the tests fail without a mutant")
        for mutant in mutants:
            dead = killed(mutant, tree, timeout_s)
            verdict = "killed  " if dead else "SURVIVED"
            print(f"{verdict} {mutant.path}:{mutant.line}  {mutant.change}", flush=True)
            if not dead:
                yield mutant


def main() -> None:
    """Try a sample of mutants, and print how many were detected in each file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", nargs="+", help="packages or files of the tree, such as slam/graph")
    parser.add_argument("--count", type=int, default=60, help="number of mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample")
    parser.add_argument("--timeout-s", type=float, default=300.0, help="limit of a mutant")
    reported = parser.parse_args()
    root = Path(__file__).resolve().parents[1]
    mutants = sample(root, reported.paths, reported.count, reported.seed)
    alive = Counter(mutant.path for mutant in survivors(root, mutants, reported.timeout_s))
    print(f"\n{'file':45s} mutants survived")
    for path, tried in Counter(mutant.path for mutant in mutants).items():
        print(f"{path!s:45s} {tried:7d} {alive[path]:8d}")
    print(f"{1.0 - alive.total() / max(1, len(mutants)):.0%} of {len(mutants)} killed")


if __name__ == "__main__":
    main()
