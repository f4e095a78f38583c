"""The notebooks run, and the .ipynb beside each .py is the same notebook without outputs."""

from pathlib import Path

import jupytext
import nbclient
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["01_pose_cells", "02_map_a_video"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_pair_is_one_notebook_and_holds_no_outputs(path):
    source, paired = jupytext.read(path), jupytext.read(path.with_suffix(".ipynb"))
    kept = [(cell.cell_type, cell.source) for cell in paired.cells]
    assert kept == [(cell.cell_type, cell.source) for cell in source.cells], "run: make notebooks"
    assert not any(cell.get("outputs") for cell in paired.cells)


@pytest.mark.filterwarnings("default")  # of the kernel's own libraries
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs_and_every_figure_is_drawn(path):
    notebook = jupytext.read(path)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    figures = sum("image/png" in output.get("data", {}) for output in outputs)
    asked = sum(
        "plt.show()" in cell.source or cell.source.rstrip().splitlines()[-1].startswith("figure")
        for cell in notebook.cells
        if cell.cell_type == "code"
    )
    assert figures >= max(asked, 6)
    errors = [o.text for o in outputs if o.output_type == "stream" and o.name == "stderr"]
    assert not errors, errors
