"""Every recipe of docs/cookbook.md is run as it is printed."""

import re
import warnings
from importlib import import_module
from inspect import signature
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

ROOT = next(
    path for path in Path(__file__).resolve().parents if (path / "pyproject.toml").is_file()
)
PAGE = (ROOT / "docs" / "cookbook.md").read_text("utf-8")
RECIPES = {
    head.strip(): code
    for head, code in re.findall(r"^## ([^\n]*)\n```python\n(.*?)^```", PAGE, re.M | re.S)
}


@pytest.fixture
def cook(tmp_path, monkeypatch):
    """Run a recipe in an empty folder, with all warnings but those of other packages as errors."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    def run(name):
        names = {}
        exec(compile(RECIPES[name], name, "exec"), names)
        return names

    yield run
    torch.set_num_threads(threads)
    plt.close("all")


def numbers(text):
    return [float(word) for word in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", text)]


def test_there_are_ten_recipes_of_at_most_15_lines():
    assert len(RECIPES) == 10
    assert len(re.findall(r"^## ", PAGE, re.M)) == 10
    for name, code in RECIPES.items():
        lines = [line for line in code.splitlines() if line.strip() and not line.startswith("#")]
        assert len(lines) <= 15, name


def test_rate_maps_of_a_rat_in_a_box(cook):
    names = cook("A rat in a box, to rate maps")
    assert {name: len(maps) for name, maps in names["maps"].items()}.items() >= {
        "boundary": 168, "grid": 96
    }.items()  # fmt: skip
    assert all(maps.shape[1:] == names["bins"].shape for maps in names["maps"].values())
    for name in ("boundary", "grid", "place", "raster"):
        assert Path(f"{name}.png").stat().st_size > 10_000


def test_a_track_drives_the_cells(cook):
    names = cook("My track to cells")
    log = names["log"]
    assert log.names == ("boundary", "grid", "place", "head_direction")
    assert [log[name].shape for name in ("boundary", "head_direction")] == [(600, 168), (600, 120)]
    assert sum(int(log[name].any(axis=0).sum()) for name in log.names) > 200
    assert np.ptp(log.position_m, axis=0) == pytest.approx([0.6, 0.6], abs=0.01)  # cm to m


def test_a_larger_spacing_spreads_the_fields(cook, capsys):
    cook("Change one parameter and see")
    narrow, found_narrow, wide, found_wide = numbers(capsys.readouterr().out)
    assert found_narrow == pytest.approx(narrow, rel=0.05)
    assert found_wide == pytest.approx(wide, rel=0.05)


def test_position_is_decoded(cook, capsys):
    cook("Decode position")
    assert numbers(capsys.readouterr().out)[0] < 0.05


def test_grid_cells_shift_between_boxes_and_boundary_cells_do_not(cook, capsys):
    cook("Remapping between two boxes")
    boundary, grid = numbers(capsys.readouterr().out)
    assert boundary > 0.6
    assert grid < 0.3


def test_without_correction_by_walls_the_error_grows(cook, capsys):
    cook("Lesion a population")
    intact, lesioned = numbers(capsys.readouterr().out)
    assert lesioned > 3.0 * intact


def test_ratinabox_drives_and_draws_the_cells(cook):
    pytest.importorskip("ratinabox", reason="needs the extra rodent")
    cook("Drive the cells with RatInABox")
    assert all(Path(f"{name}.png").stat().st_size > 3000 for name in ("grid", "heads", "time"))


def test_the_spacing_is_learnt(cook):
    names = cook("Learn a parameter by gradient")
    assert names["guess"].spacing_m.item() == pytest.approx(0.5, abs=0.003)


def test_nwb_is_opened_by_pynapple(cook, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pynwb, hdmf and pynapple on import
        pytest.importorskip("pynwb", reason="needs the extra neuro")
        pytest.importorskip("pynapple", reason="needs the extra neuro")
        cook("Export to NWB and open in pynapple")
    assert re.search(r"\(601, 96\) \d+ units", capsys.readouterr().out)


def test_a_figure_of_each_paper(cook, capsys, monkeypatch):
    from neuroslam import experiments

    run, asked = experiments.run_experiment, []

    def only_the_shortest(name, data, out, arguments):
        module, function, _ = experiments.EXPERIMENTS[name]
        signature(getattr(import_module(module), function)).bind(data, out, **arguments)
        asked.append(name)
        if name == "ssp-3d":  # the others take longer; tests/experiments runs them
            run(name, data, out, arguments=arguments)

    monkeypatch.setattr(experiments, "run_experiment", only_the_shortest)
    cook("Reproduce a figure of each paper")
    assert asked == ["virtual-tour", "boundary-scenarios", "ssp-3d"]
    assert "ssp-3d ['path.png']" in capsys.readouterr().out
