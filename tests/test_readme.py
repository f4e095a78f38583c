"""What the README shows runs as it is printed."""

import re
import shlex
from pathlib import Path

import pytest

from neuroslam import cli

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_runs_and_closes_a_loop(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (program,) = blocks("python")
    exec(compile(program, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "back at place" in printed
    assert "way to place 10: [" in printed
    assert (tmp_path / "brain.safetensors").exists()


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
