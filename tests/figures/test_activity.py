"""Figures of the sheet of boundary cells and of the bump of place cells."""

import math

import numpy as np
import pytest
import torch

from neuroslam.cells import BoundarySheet
from neuroslam.config import BoundaryCellConfig
from neuroslam.figures.activity import plot_bump, plot_sheet
from neuroslam.figures.style import render

BEARINGS = np.arange(8) * (math.pi / 4.0)
DISTANCES = np.array([0.1, 0.2, 0.4])


def test_layers_are_on_one_scale_and_a_wall_is_at_its_bearing_and_distance():
    layers = {"a": np.eye(8, 3), "b": np.full((8, 3), 4.0)}
    figure = plot_sheet(layers, BEARINGS, DISTANCES, np.array([[0.2, -math.pi / 2.0]]), "sheet")
    panels = figure.axes[:2]
    assert [axes.get_title(loc="left") for axes in panels] == ["a", "b"]
    for axes in panels:
        assert axes.collections[0].get_clim() == (0.0, 4.0)
        assert axes.lines[0].get_xydata()[0] == pytest.approx((270.0, 0.2))
    assert panels[0].get_ylim() == pytest.approx((0.0, 0.5))
    assert render(figure).std() > 10.0


def test_silent_cells_without_walls_are_drawn_too():
    figure = plot_sheet({"a": np.zeros((8, 3))}, BEARINGS, DISTANCES, np.empty((0, 2)), "sheet")
    assert not figure.legends
    assert render(figure).std() > 1.0


def test_excitation_and_inhibition_are_what_the_response_is_made_of():
    sheet = BoundarySheet(BoundaryCellConfig())
    tuned = torch.rand(72, len(sheet.warped_m), generator=torch.Generator().manual_seed(0))
    tuned = tuned.to(sheet.warped_m)
    excitation, inhibition = sheet.interactions(tuned)
    assert bool((excitation >= 0.0).all())
    assert bool((inhibition > 0.0).any())
    expected = (tuned + excitation - inhibition).clamp_min(0.0)
    torch.testing.assert_close(sheet.interact_by_convolution(tuned), expected)


def test_the_bump_is_coloured_and_the_estimate_is_marked():
    centres, bump = np.array([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]), np.array([0.0, 0.25, 0.75])
    figure = plot_bump(centres, bump, np.array([1.8, 0.1]), np.array([1.75, 0.0]))
    silent, active = figure.axes[0].collections
    assert silent.get_offsets().tolist() == [[0.0, 0.0]]
    assert active.get_offsets().tolist() == [[1.0, 0.0], [2.0, 0.0]]
    assert np.asarray(active.get_array()).tolist() == [0.25, 0.75]
    assert figure.axes[0].get_title(loc="left") == "2 cells active"
    assert figure.axes[0].get_title(loc="right") == "0.112 m apart"
    assert render(figure).std() > 5.0
