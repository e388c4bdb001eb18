"""Runs that take no time: commands of one line of Python, as a comparison does them."""

from __future__ import annotations

from slam.comparison.run import Run


def command_run(code: str, *, key: str = "k", timeout_s: float = 60.0, memory_mb: float = 2000.0) -> Run:
    """A run of ``python -c CODE OUT`` with its figures in OUT/figures.json."""
    return Run(
        configuration="command",
        method="command",
        dataset="",
        group="",
        log="",
        relations="",
        groundtruth="",
        seed=0,
        timeout_s=timeout_s,
        memory_mb=memory_mb,
        rpe_m=(1.0,),
        command=("{python}", "-c", code, "{out}"),
        figures="figures.json",
        key=key,
    )


TELLS = (
    "import json, pathlib, sys; figures = {'a': {'b': 2}, 'c': [1], 'd': 'x'}; "
    "(pathlib.Path(sys.argv[1]) / 'figures.json').write_text(json.dumps(figures))"
)
