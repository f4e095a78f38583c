"""A type checker accepts a user's code: that of the README and the docs, in files of its own."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CODE = {
    "readme.py": ("README.md", 0),
    "own_population.py": ("docs/own_population.md", 0),
    "own_population_in_python.py": ("docs/own_population.md", 1),
}


@pytest.mark.parametrize("name", CODE)
def test_a_checked_file_is_the_code_of_its_page(name):
    page, number = CODE[name]
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)
    assert (HERE / name).read_text() == blocks[number]


def test_pyright_accepts_the_code_of_a_user():
    done = subprocess.run(
        [
            sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable,
            *(str(HERE / name) for name in CODE),
        ],
        cwd=ROOT, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    try:
        found = json.loads(done.stdout)
    except json.JSONDecodeError:
        pytest.skip(f"pyright cannot run here, it needs its Node.js: {done.stderr[-200:]}")
    assert found["summary"]["filesAnalyzed"] == len(CODE)
    wrong = [
        f"{Path(d['file']).name}:{d['range']['start']['line'] + 1}: {d['message']}"
        for d in found["generalDiagnostics"]
        if d["severity"] == "error"
    ]
    assert wrong == []
