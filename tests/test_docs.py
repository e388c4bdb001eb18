"""README.md, SECURITY.md and docs/: links, commands, settings, names and examples hold in the product."""

from __future__ import annotations

import itertools
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
from test_layering import FLOORS

import slam
from slam.cli.commands import app
from slam.comparison.experiment import load_experiment
from slam.config import Config, load_config
from slam.datasets.calibration import Calibration, read_calibration
from slam.simulation.rigs import RIGS
from slam.simulation.synthetic_log import write_synthetic_log

REPO = Path(__file__).parents[1]
TOP_PAGES = [REPO / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")]
PAGES = [*TOP_PAGES, *sorted((REPO / "docs").rglob("*.md"))]
MOST_WORDS = 900  # of the README, as `wc -w` counts
MOST_BYTES = 300_000  # of all pictures
STRANGERS = {"ns-train"}  # other programs that are named

FENCE = re.compile(r"^```(.*?)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)|<img src=\"([^\"]+)\"")
INLINE = re.compile(r"`([^`\n]+)`")

COMMANDS: Any = typer.main.get_command(app).commands  # type: ignore[attr-defined]
# Typer brings a click of its own in some versions; this is UsageError of the one in use.
USAGE_ERROR = typer.BadParameter.__bases__[0]

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))


def blocks(page: Path, language: str = "") -> list[str]:
    """The code blocks of a page whose first line begins with a language."""
    return [code for info, code in FENCE.findall(page.read_text("utf-8")) if info.startswith(language)]


def prose(page: Path) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", page.read_text("utf-8"))


def anchors(page: Path) -> set[str]:
    """What GitHub and the site make of the headings of a page."""
    heads = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    names = re.findall(r"^::: (\S+)$", prose(page), re.MULTILINE)  # what mkdocstrings makes of them
    return {*names, *(re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads)}


def command_lines(text: str, program: str) -> list[list[str]]:
    """The arguments of a program in the lines of a block, comments left out."""
    lines = (
        line.strip().removeprefix(".venv/bin/").removeprefix("PYTHONPATH=. ") for line in text.splitlines()
    )
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith(program + " ")]


def parsed(arguments: list[str]) -> None:
    """Parse a command line of scanweave as far as its options; nothing runs."""
    name, *rest = arguments
    COMMANDS[name].make_context(name, rest)


def settings(arguments: list[str]) -> list[str]:
    """The values of ``--set`` and ``-s``."""
    return [value for option, value in itertools.pairwise(arguments) if option in ("--set", "-s")]


def test_the_readme_is_short_and_its_pictures_are_small() -> None:
    assert len((REPO / "README.md").read_text("utf-8").split()) <= MOST_WORDS
    assert sum(picture.stat().st_size for picture in (REPO / "docs" / "images").iterdir()) < MOST_BYTES


@every_page
def test_links_lead_somewhere(page: Path) -> None:
    for pair in LINK.findall(prose(page)):
        target = next(filter(None, pair))
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}"


def test_the_architecture_names_every_room() -> None:
    text = (REPO / "docs" / "develop" / "architecture.md").read_text("utf-8")
    rooms = {room.removeprefix("slam.") for floor in FLOORS for room in floor}
    assert [room for room in sorted(rooms) if f"`{room}`" not in text] == []


def test_every_page_is_in_the_index() -> None:
    docs = REPO / "docs"
    stated = "".join((docs / name).read_text("utf-8") for name in ("index.md", "figures.md"))
    stated += (docs / "decisions" / "index.md").read_text("utf-8").replace("](", "](decisions/")
    names = [str(page.relative_to(docs)) for page in PAGES if page.is_relative_to(docs)]
    assert [name for name in names if f"({name}" not in stated and name != "index.md"] == []


@every_page
def test_commands_and_their_options_exist(page: Path) -> None:
    for arguments in (line for code in blocks(page) for line in command_lines(code, "scanweave")):
        try:
            parsed(arguments)
        except (KeyError, USAGE_ERROR) as error:
            pytest.fail(f"{page.name}: scanweave {shlex.join(arguments)}: {error}")
        load_config(overrides=settings(arguments))


def test_the_help_of_each_command_ends_with_an_example_that_exists() -> None:
    for name, command in COMMANDS.items():
        (arguments,) = command_lines(command.epilog.removeprefix("Example: "), "scanweave")
        assert arguments[0] == name
        parsed(arguments)
        load_config(overrides=settings(arguments))


def test_the_help_names_every_rig() -> None:
    (rig,) = (part for part in COMMANDS["simulate"].params if part.name == "rig")
    assert sorted(re.findall(r"[a-z]\w*\d\w*|turtlebot_\w+", rig.help)) == sorted(RIGS)


@every_page
def test_commands_named_in_the_text_exist(page: Path) -> None:
    options = {option for one in COMMANDS.values() for part in one.params for option in part.opts}
    options |= {"--help", "--version"}
    for span in INLINE.findall(prose(page)):
        words = shlex.split(span) if span.startswith(("scanweave ", "--")) else []
        if words[:1] == ["scanweave"]:
            assert words[1] in {*COMMANDS, "--version"}, f"{page.name}: {span}"
        load_config(overrides=settings(words))
        if span.startswith("--set ") or words[:1] == ["scanweave"]:
            assert {word for word in words if word.startswith("--")} <= options, span


@every_page
def test_settings_named_in_the_text_exist(page: Path) -> None:
    for section, key in re.findall(r"`([a-z_]+)\.([a-z0-9_]+)(?:`|=)", prose(page)):
        field = Config.model_fields.get(section)
        if field is not None and key not in ("yaml", "g2o"):  # names of files
            assert key in field.annotation.model_fields, f"{page.name}: {section}.{key}"


@every_page
def test_public_names_and_files_of_the_text_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    for name in re.findall(r"\bslam\.(?!md\b)([A-Za-z]\w*)", text):
        assert name in slam._HOMES or (REPO / "slam" / name).is_dir() or name == "cli", f"{page.name}: {name}"
    for name in re.findall(r"\b((?:tools|tests|examples|configs|slam|fusion)/[\w/]*\.(?:py|yaml))", text):
        assert (REPO / name).is_file(), f"{page.name}: {name}"


def test_every_source_that_the_code_names_is_in_the_bibliography() -> None:
    entries = re.split(r"\n- ", (REPO / "docs" / "bibliography.md").read_text("utf-8"))
    cited = re.compile(r"\b([A-Z][a-z]+)(?: et al\.| and [A-Z][a-z]+)? ?((?:19|20)\d\d)\b")
    for file in [path for room in ("slam", "fusion") for path in sorted((REPO / room).rglob("*.py"))]:
        for name, year in cited.findall(file.read_text("utf-8")):
            known = any(name in entry and year in entry for entry in entries)
            assert known or name == "Before", f"{file.name}: {name} {year}"


@every_page
def test_tools_that_use_other_tools_are_called_so_that_they_find_them(page: Path) -> None:
    for tool in re.findall(r"(?<!PYTHONPATH=\. )\bpython (tools/\w+\.py)", page.read_text("utf-8")):
        assert "\nfrom tools" not in (REPO / tool).read_text("utf-8"), f"PYTHONPATH=. python {tool}"


@every_page
def test_tools_have_the_options_that_are_shown(page: Path) -> None:
    spans = [*INLINE.findall(prose(page)), *blocks(page)]
    for arguments in (line for span in spans for line in command_lines(span, "python")):
        if arguments[0].startswith("../"):
            continue  # scripts beside data, which a clone need not have
        script = (REPO / arguments[0]).read_text("utf-8")
        for option in (word for word in arguments[1:] if word.startswith("--")):
            assert f'"{option}"' in script, f"{page.name}: {shlex.join(arguments)}"


@every_page
def test_every_block_is_looked_at(page: Path) -> None:
    # Python is run below; YAML is read, text is what a command printed; else a line is a command that exists.
    targets = re.findall(r"^([a-z]+):", (REPO / "Makefile").read_text("utf-8"), re.MULTILINE)
    extras = tomllib.loads((REPO / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    for info, code in FENCE.findall(page.read_text("utf-8")):
        assert info in ("", "python", "yaml", "text"), f"{page.name}: a block of {info}"
        for line in code.splitlines() if not info else ():
            program, *rest = shlex.split(line.removeprefix("PYTHONPATH=. "), comments=True) or [""]
            assert program in ("", "scanweave", "python", "make", "pip", *STRANGERS), f"{page.name}: {line}"
            assert program != "make" or set(rest) <= set(targets), f"{page.name}: {line}"
            for extra in re.findall(r"\[(\w+)\]", line) if program == "pip" else ():
                assert extra in extras, f"{page.name}: {line}"


def test_yaml_examples_are_read(tmp_path: Path) -> None:
    def written(page: str, name: str) -> Path:
        (code,) = blocks(REPO / "docs" / page, "yaml")
        (tmp_path / name).write_text(code, "utf-8")
        return tmp_path / name

    load_config(str(written("configure.md", "mine.yaml")))
    assert load_config(calibration=written("doctor.md", "calibration.yaml")).sensors.calibration.lidars
    load_experiment(written("compare.md", "experiment.yaml"))
    guess = Calibration(slam.CameraIntrinsics(1.0, 1.0, 0.0, 0.0, 0, 0), 1.0, assumed="no file")
    calibration = read_calibration(written("calibration.md", "calibration.yaml").parent, guess)
    assert not calibration.assumed and calibration.T_base_camera is not None


@pytest.fixture(scope="module")
def two_days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two logs of one place: what the examples are about."""
    folder = tmp_path_factory.mktemp("days")
    for seed, name, duration_s in ((1, "monday", 24.0), (2, "tuesday", 12.0)):
        write_synthetic_log(folder, seed=seed, duration_s=duration_s).log_path.rename(folder / f"{name}.log")
    return folder


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name
)
def test_examples_run(page: Path, two_days: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The blocks of a page run one after the other, as a reader would type them.
    for log in two_days.glob("*.log"):
        (tmp_path / log.name).symlink_to(log)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), names)


@pytest.mark.parametrize(
    "line",
    [
        "localize house/ a.log",
        "map a.log -o out --nothing",
        "mapp a.log -o out",
        "export out --format obj -o x",
    ],
)
def test_a_wrong_command_line_is_seen(line: str) -> None:
    with pytest.raises((KeyError, USAGE_ERROR)):
        parsed(shlex.split(line))
