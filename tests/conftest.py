"""Fixtures that several test files share."""

import gc
import os
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch
from hypothesis import HealthCheck, settings

from neuroslam.cli import main, progress

# Imports and collected tests make a million objects, none of them garbage: Python searches them for
# reference cycles again and again, in a tenth of the time of all tests.
gc.disable()

# Of the hundreds of programs that tests start, the first compiles neuroslam to bytecode, not each.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

torch.set_num_threads(1)
cv2.setNumThreads(1)
# How long an example takes is the machine's affair.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")


# A command that takes long on a slow machine prints lines of progress; tests compare what it says.
progress.EVERY_S = 3600.0


def pytest_collection_finish() -> None:
    """Search for reference cycles from now on, in what the tests make."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the compiled steps: of two processes each compiles half, once for both."""
    steps = [item for item in items if item.path.name == "test_compiled.py"]
    others = [item for item in items if item.path.name != "test_compiled.py"]
    half, middle = len(steps) // 2, len(others) // 2
    items[:] = [*steps[:half], *others[:middle], *steps[half:], *others[middle:]]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real recordings and reference outputs, kept beside the checkout."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("no ../shared beside the checkout: real data and references are kept there")
    return folder


@pytest.fixture
def cases(shared) -> Path:
    """Inputs that went wrong, kept beside the checkout."""
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip("no ../shared/cases beside the checkout")
    return folder


@pytest.fixture
def call(capsys):
    """Call the command line: its exit code, what it printed and what it complained of."""

    def run(*arguments):
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return SimpleNamespace(code=code, out=out, err=err)

    return run


@pytest.fixture
def mistake(call):
    """Call the command line with a mistake in it: the one line that it says."""

    def run(*arguments) -> str:
        done = call(*arguments)
        assert done.code == 2
        assert done.err.endswith("\n")
        assert done.err.count("\n") == 1, done.err
        assert done.err.startswith(f"neuroslam {arguments[0]}: ")
        return done.err

    return run
