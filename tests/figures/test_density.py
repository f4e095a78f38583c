"""Figures of densities: axes in metres, ellipses as wide as their standard deviations."""

import math

import numpy as np
import pytest
import torch
from matplotlib.patches import Ellipse

from neuroslam.errors import SpaceError
from neuroslam.figures.density import Spread, ellipse_axes, plot_densities
from neuroslam.spiking import SSPSpace
from neuroslam.spiking.density import rectified_density
from neuroslam.spiking.gaussian import encode_gaussian


def test_a_density_is_drawn_to_scale_where_its_samples_are():
    space = SSPSpace.hexagonal()
    z = encode_gaussian(space, torch.tensor([0.5, -0.25]), 0.01 * torch.eye(2))
    f = rectified_density(space, z, 40)
    spread = Spread(np.array([0.5, -0.25]), np.diag([0.04, 0.01]))
    figure = plot_densities({"One": f, "Same": f}, np.array([[0.5, -0.25]]), [spread], "Two")
    left, right = figure.axes[:2]
    for ax in (left, right):
        assert ax.get_aspect() == 1.0
        np.testing.assert_allclose((*ax.get_xlim(), *ax.get_ylim()), (-1, 1, -1, 1), atol=1e-6)
        image = ax.images[0].get_array()
        row, column = np.unravel_index(image.argmax(), image.shape)
        at = (np.array([column, row]) + 0.5) / 40 * 2.0 - 1.0
        np.testing.assert_allclose(at, (0.5, -0.25), atol=0.05)
        ellipses = [p for p in ax.patches if isinstance(p, Ellipse)]
        assert [(round(e.width, 6), round(e.height, 6)) for e in ellipses] == [
            (0.4, 0.2), (0.8, 0.4),
        ]  # fmt: skip
    assert left.get_xlabel() == "x (m)"
    assert left.get_ylabel() == "y (m)"
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["samples", "1 and 2 standard deviations"]


def test_the_axes_of_an_ellipse_are_those_of_the_covariance():
    turn = 0.3
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    large, small, angle = ellipse_axes(axes @ np.diag([0.09, 0.01]) @ axes.T)
    assert (large, small) == pytest.approx((0.3, 0.1))
    assert math.tan(angle) == pytest.approx(math.tan(turn))


def test_only_densities_of_a_plane_are_drawn():
    line = SSPSpace.random(1, n_frequencies=10)
    f = rectified_density(line, line.encode_fourier(torch.zeros(1)))
    with pytest.raises(SpaceError, match="of 1 dimensions; expected one of a plane"):
        plot_densities({"Line": f}, np.zeros((1, 2)), [], "Line")
