"""Count the numbers by which Scanweave could be tuned, so that they can only become fewer.

    python tools/count_numbers.py

A constant is a name in capitals that a module of the logic binds to numbers. Float literals in functions and
classes, except 0, 0.5, 1 and 2, are counted as well, because an inlined constant would be no gain. The logic
is all packages except those that read, write, display or simulate.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel

from slam.config import Config

REPO = Path(__file__).parents[1]
NO_LOGIC = {
    *("datasets", "storage", "evaluation", "viewer"),
    *("cli", "config", "simulation", "comparison", "presets"),
}
NO_PRODUCT = {"simulation", "comparison"}
_COMMON = {0.0, 0.5, 1.0, 2.0}
_CAPITALS = re.compile(r"_?[A-Z][A-Z0-9_]*")


@dataclass(frozen=True)
class Count:
    """Counts by package: module-level constants, bare float literals."""

    constants: Counter[str]
    literals: Counter[str]


def count_logic() -> Count:
    """Count by package."""
    constants, literals = Counter[str](), Counter[str]()
    for room, path in _modules():
        if room not in NO_LOGIC:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            constants[room] += sum(1 for _ in constant_names(tree))
            literals[room] += sum(1 for _ in bare_floats(tree))
    return Count(constants, literals)


def count_fields(model: type[BaseModel] = Config) -> int:
    """Fields of the configuration, without the sections that hold them."""
    inner = [field.annotation for field in model.model_fields.values()]
    return sum(
        count_fields(kind) if isinstance(kind, type) and issubclass(kind, BaseModel) else 1 for kind in inner
    )


def count_lines() -> int:
    """Lines of the product: slam and fusion without simulation and comparison."""
    return sum(
        len(path.read_text(encoding="utf-8").splitlines())
        for room, path in _modules()
        if room not in NO_PRODUCT
    )


def constant_names(tree: ast.Module) -> Iterator[str]:
    """Names in capitals that a module binds to an expression with a number in it."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign):
            targets, value = statement.targets, statement.value
        elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
            targets, value = [statement.target], statement.value
        else:
            continue
        if any(_is_number(node) for node in ast.walk(value)):
            names = (node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name))
            yield from (name for name in names if _CAPITALS.fullmatch(name))


def bare_floats(tree: ast.Module) -> Iterator[float]:
    """Float literals inside functions and classes, defaults of arguments included."""
    for statement in tree.body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            values = (node.value for node in ast.walk(statement) if isinstance(node, ast.Constant))
            yield from (one for one in values if isinstance(one, float) and one not in _COMMON)


def _is_number(node: ast.AST) -> bool:
    """Whether a node is a numeric literal."""
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    )


def _modules() -> Iterator[tuple[str, Path]]:
    """The modules of slam and fusion, each with its package."""
    for path in sorted((REPO / "slam").rglob("*.py")):
        inner = path.relative_to(REPO / "slam").parts
        yield inner[0] if len(inner) > 1 else "slam", path
    yield from (("fusion", path) for path in sorted((REPO / "fusion").rglob("*.py")))


def main() -> None:
    """Print the table."""
    logic = count_logic()
    print(f"{'room':<14}{'constants':>10}{'bare floats':>13}")
    for room, count in logic.constants.most_common():
        print(f"{room:<14}{count:>10}{logic.literals[room]:>13}")
    print(f"{'in all':<14}{logic.constants.total():>10}{logic.literals.total():>13}")
    print(f"configuration fields: {count_fields()}")
    print(f"lines of the product: {count_lines()}")


if __name__ == "__main__":
    main()
