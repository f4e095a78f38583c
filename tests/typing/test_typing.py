"""A type checker follows the package, and the code of README and docs as a user would write it.

``python tests/typing/test_typing.py`` writes the programs of README and docs anew.
"""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = next(path for path in HERE.parents if (path / "pyproject.toml").is_file())
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def programs() -> dict[str, str]:
    """Return what README and docs print as whole programs, by the name of its file here.

    A part of a program, which takes its names from the text around it, begins with no import.
    """
    found = {}
    for page in PAGES:
        stem = "readme" if page.name == "README.md" else f"docs_{page.stem}"
        blocks = re.findall(r"^```python[^\n]*\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
        for number, block in enumerate(filter(stands_alone, blocks), start=1):
            found[f"{stem}_{number}.py"] = block
    return found


def stands_alone(block: str) -> bool:
    return re.match(r'(""".*?"""\s+)?(from|import) ', block, re.S) is not None


def written() -> dict[str, str]:
    files = [*HERE.glob("readme*.py"), *HERE.glob("docs_*.py")]
    return {file.name: file.read_text("utf-8") for file in files}


@pytest.mark.parametrize("name", sorted(programs()))
def test_a_program_of_readme_or_docs_is_checked_as_it_is_printed(name):
    assert written().get(name) == programs()[name], f"run python {Path(__file__).name}"


def test_no_program_is_checked_that_is_printed_nowhere():
    assert written().keys() <= programs().keys()


def test_pyright_finds_no_error():
    if importlib.util.find_spec("pyright") is None:
        pytest.skip("pyright is not installed: pip install neuroslam[dev]")
    # It comes with what it runs: with nothing to fetch, it works without a network.
    quiet = {"PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | quiet, capture_output=True, text=True, check=False
    )
    try:
        report = json.loads(done.stdout)
    except ValueError:
        if re.search(r"node|network|resolve|connect|timed out", done.stderr + done.stdout, re.I):
            pytest.skip(f"pyright has no Node.js to run on: {done.stderr.strip()[-200:]}")
        raise
    assert report["summary"]["filesAnalyzed"] > 200  # it has looked at the package
    faults = [
        f"{Path(fault['file']).relative_to(ROOT)}:{fault['range']['start']['line'] + 1}: "
        f"{fault['message']}"
        for fault in report["generalDiagnostics"]
        if fault["severity"] == "error"
    ]
    assert faults == []


if __name__ == "__main__":
    for file in written().keys() - programs().keys():
        (HERE / file).unlink()
    for file, text in programs().items():
        (HERE / file).write_text(text, encoding="utf-8")
