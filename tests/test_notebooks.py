"""The notebooks in examples/: each runs from its first cell to its last, and is stored without its outputs.

The cells run one after the other in this process, as a kernel would, without the cost of starting one.
"""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import matplotlib
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SAID = {
    "compare_settings": "mm (",
    "first_map": "keyframes",
    "fuse_scan_and_image": "right with 0.9",
    "localise": "mm RMSE",
    "what_a_loop_does": "and a false one: 4 of 5 loops are kept",
}

every_notebook = pytest.mark.parametrize(
    "notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda notebook: notebook.stem
)


def cells(notebook: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(notebook.read_text("utf-8"))["cells"]
    return found


def run_cell(source: str, name: str, names: dict[str, Any]) -> object:
    """Run a cell; the value of its last expression, which a notebook would show."""
    tree = ast.parse(source)
    shown = not source.rstrip().endswith(";") and tree.body and isinstance(tree.body[-1], ast.Expr)
    last = tree.body.pop() if shown else None
    exec(compile(tree, name, "exec"), names)
    if not isinstance(last, ast.Expr):
        return None
    return eval(compile(ast.Expression(last.value), name, "eval"), names)


@every_notebook
def test_a_notebook_runs(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    for number, cell in enumerate(cells(notebook)):
        if cell["cell_type"] == "code":
            value = run_cell("".join(cell["source"]), f"{notebook.name}, cell {number}", names)
            assert len(repr(value)) < 2000, "more than anybody wants to see"
    assert SAID[notebook.stem] in capsys.readouterr().out
    names["plt"].close("all")


@every_notebook
def test_a_notebook_is_stored_without_outputs(notebook: Path) -> None:
    assert all(
        not cell["outputs"] and cell["execution_count"] is None
        for cell in cells(notebook)
        if cell["cell_type"] == "code"
    )


def test_a_cell_that_fails_is_seen() -> None:
    with pytest.raises(NameError):
        run_cell("a = 1\nb", "cell", {})
    assert run_cell("a = 1\na + 1", "cell", {}) == 2 and run_cell("1;", "cell", {}) is None
