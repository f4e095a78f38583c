"""What the README shows runs as it is printed; what README and docs name is there."""

import ast
import importlib
import inspect
import re
import shlex
from pathlib import Path

import pytest

from neuroslam import cli
from neuroslam.config.populations import ENTRY_POINTS

ROOT = next(path for path in Path(__file__).resolve().parents if (path / "README.md").is_file())
README = (ROOT / "README.md").read_text()
PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted(f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.py"))


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_runs_and_closes_a_loop(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program = blocks("python")[0]
    exec(compile(program, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "loop closed at experience" in printed
    assert "path to experience 10: [" in printed
    assert (tmp_path / "brain.safetensors").exists()


def test_rate_maps_of_all_cells_take_twelve_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = blocks("python")[1]
    assert len([line for line in program.splitlines() if line]) <= 12
    assert "minutes=10&" in program
    short = program.replace("minutes=10&", "minutes=0.5&")
    exec(compile(short, "README.md", "exec"), {})
    assert (tmp_path / "rate_maps.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    "line", [line for block in blocks("sh") for line in block.splitlines() if "neuroslam" in line]
)
def test_every_command_is_one_that_the_command_line_knows(line, capsys):
    words = shlex.split(line.partition("#")[0])
    assert words[0] == "neuroslam"
    options = [word for word in words if word.startswith("-")]
    assert cli.main([words[1], "--help"]) == 0
    told = capsys.readouterr().out
    assert all(option in told for option in options)


def resolve(dotted: str) -> object:
    """Import the longest part of a dotted name that is a module, and take the rest from it."""
    parts = dotted.split(".")
    for n in range(len(parts), 0, -1):
        name = ".".join(parts[:n])
        try:
            found = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise  # a module that is there imports one that is not
            continue
        for part in parts[n:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


def parts_of_the_package() -> list[tuple[str, str]]:
    """Module and name of each class or function in the table "What is in it"."""
    section = README.partition("## What is in it\n")[2].partition("\n## ")[0]
    rows = [line.split("|")[1:3] for line in section.splitlines() if line.startswith("| `")]
    return [
        (module, name)
        for modules, names in rows
        for module in re.findall(r"`([\w.]+)`", modules)
        for name in re.findall(r"`(\w+)`", names)
    ]


@pytest.mark.parametrize(("module", "name"), parts_of_the_package())
def test_what_the_table_names_can_be_imported_from_there(module, name):
    found = getattr(importlib.import_module(module), name)
    assert inspect.isclass(found) or inspect.isfunction(found)  # not a module of that name


def test_the_table_is_found():
    assert {("neuroslam.cells", "PoseCellNetwork"), ("neuroslam.spiking", "SSPSLAM")} <= set(
        parts_of_the_package()
    )


@pytest.mark.parametrize("page", PAGES)
def test_every_dotted_name_leads_to_something(page):
    text = (ROOT / page).read_text()
    files = {path.name for path in ROOT.glob("examples/*/*")}  # neuroslam.launch
    for name in set(re.findall(r"(?<![\w/.-])neuroslam(?:\.[A-Za-z_]\w*)+", text)) - files:
        assert name == ENTRY_POINTS or resolve(name) is not None, name


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS])
def test_every_import_that_is_shown_works(page):
    text = (ROOT / page).read_text()
    programs = (
        [text] if page.endswith(".py") else re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    )
    for node in (node for program in programs for node in ast.walk(ast.parse(program))):
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] == "neuroslam":
            for alias in node.names:
                resolve(f"{node.module}.{alias.name}")


@pytest.mark.parametrize("page", PAGES)
def test_every_file_that_is_named_is_there(page):
    text, folder = (ROOT / page).read_text(), (ROOT / page).parent
    for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert "://" in link or (folder / link).exists(), link
    ours = r"(?<![\w/.-])(?:neuroslam|tests|docs|notebooks|benchmarks|configs)/[\w./-]+\.\w+"
    for path in set(re.findall(ours, text)):
        assert (ROOT / path).exists() or (folder / path).exists(), path


def test_every_reference_in_a_docstring_leads_to_something():
    for path in sorted((ROOT / "neuroslam").rglob("*.py")):
        for name in set(re.findall(r":\w+:`~?(neuroslam(?:\.\w+)+)`", path.read_text())):
            assert resolve(name) is not None, f"{path}: {name}"
