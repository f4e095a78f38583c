"""The gallery shows every figure once, with a command that exists."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from neuroslam.cli import app
from neuroslam.experiments import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "gallery.md").read_text("utf-8")
ENTRIES = re.findall(r"!\[([^\]]+)\]\(img/([\w.]+)\)\n(.+)\n", PAGE)
COMMANDS = typer.main.get_command(app).commands


def test_every_figure_is_shown_once():
    shown = [name for _, name, _ in ENTRIES]
    assert sorted(shown) == sorted(path.name for path in (ROOT / "docs/img").glob("*.png"))
    assert PAGE.count("![") == len(ENTRIES)


@pytest.mark.parametrize(("name", "line"), [(name, line) for _, name, line in ENTRIES])
def test_the_command_of_a_figure_exists(name, line):
    if program := re.match(r"The program of \[[^\]]+\]\(([\w.]+)(?:#[\w-]+)?\)", line):
        text = (ROOT / "docs" / program[1]).read_text("utf-8")
        assert "```python" in text
        assert "savefig(" in text or "save(" in text
        return
    command = re.match(r"`([^`]+)`", line)
    assert command is not None, line
    words = shlex.split(command[1])
    if words[0] == "python":
        is_module = words[1] == "-m"
        file = words[2].replace(".", "/") + ".py" if is_module else words[1]
        assert name in (ROOT / file).read_text("utf-8") or "--draw" in words
        return
    assert words[0] == "neuroslam"
    known = {option for each in COMMANDS[words[1]].params for option in each.opts}
    assert {word for word in words if re.match(r"--?[a-z]", word)} <= known
    if words[1] != "experiment":
        return
    module, _, recordings = EXPERIMENTS[words[2]]
    assert ("--data" in words) == (recordings is not None)
    source = (ROOT / f"{module.replace('.', '/')}.py").read_text("utf-8")
    written = re.search(r"`(\w+)\.png`", line)
    if written and f"{written[1]}.png" not in source:  # the name is put together
        assert written[1].replace("_", " ") in source
