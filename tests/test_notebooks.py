"""The notebooks run, and the .ipynb beside each .py is the same notebook without outputs."""

import re
from pathlib import Path

import jupytext
import nbclient
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(notebook, kind):
    return [cell for cell in notebook.cells if cell.cell_type == kind]


def draws(cell):
    return bool(re.search(r"^(plt\.show|plot_\w+|contact_sheet)\(", cell.source, re.MULTILINE))


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == [
        "01_pose_cells",
        "02_map_a_video",
        "03_two_sessions",
        "04_cells_of_a_rat",
        "05_semantic_map",
        "06_three_dimensions",
        "07_live_fleet",
        "08_same_places",
    ]


@each_notebook
def test_the_pair_is_one_notebook_and_holds_no_outputs(path):
    source, paired = jupytext.read(path), jupytext.read(path.with_suffix(".ipynb"))
    kept = [(cell.cell_type, cell.source) for cell in paired.cells]
    assert kept == [(cell.cell_type, cell.source) for cell in source.cells], "run: make notebooks"
    for cell in cells(paired, "code"):
        assert not cell.outputs
        assert cell.execution_count is None


@each_notebook
def test_what_a_notebook_points_to_is_there(path):
    text = "\n".join(cell.source for cell in cells(jupytext.read(path), "markdown"))
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (FOLDER / target).is_file(), target


@each_notebook
def test_every_figure_has_a_sentence_that_says_what_to_see(path):
    told = False
    for cell in jupytext.read(path).cells:
        if cell.cell_type == "markdown":
            told = "**What to see:**" in cell.source
        elif draws(cell):
            assert told, cell.source
            told = False


@each_notebook
def test_it_runs_draws_every_figure_and_warns_of_nothing(path, tmp_path, monkeypatch):
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))  # not the profile of whoever runs the tests
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path))
    notebook = jupytext.read(path)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    client.execute()
    assert sum(map(draws, cells(notebook, "code"))) >= 8
    for cell in cells(notebook, "code"):
        pictures = ["image/png" in output.get("data", {}) for output in cell.outputs]
        assert sum(pictures) == draws(cell), cell.source
        said = [o.text for o in cell.outputs if o.output_type == "stream" and o.name == "stderr"]
        assert not said, said
