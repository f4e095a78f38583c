"""Pictures of templates."""

import numpy as np

from neuroslam.config import ViewConfig
from neuroslam.figures.views import strokes, template_picture
from neuroslam.view import LocalViewCells


def test_a_stroke_lies_along_the_edge_and_only_in_its_cell():
    for o in range(4):
        template = np.zeros((8, 3), np.uint8)  # 4 orientations, 2 rows
        template[2 * o, 1] = 200
        drawn = strokes(template, 4, 9)
        assert drawn.shape == (18, 27)
        rows, columns = np.nonzero(drawn)
        assert rows.max() < 9 <= columns.min() <= columns.max() < 18
        spread = np.linalg.svd(np.stack([columns - 13.0, rows - 4.0]))[0][:, 0]  # its direction
        gradient = o * np.pi / 4
        assert abs(spread @ [np.cos(gradient), np.sin(gradient)]) < 1e-6


def test_a_picture_of_gradients_shows_edges_and_a_grey_template_itself():
    image = np.zeros((60, 80), np.uint8)
    image[:, 40:] = 200  # an upright edge
    grey = LocalViewCells(ViewConfig(template_width=8, template_height=6))
    edges = LocalViewCells(ViewConfig(template_width=8, template_height=24, orientations=4))
    for view in (grey, edges):
        view.learn(view.encode(image))
    assert (template_picture(grey, 0) == grey.template_image(0)).all()
    drawn = template_picture(edges, 0)
    assert drawn.shape == (54, 72)
    assert drawn[:, 27:45].max() > 200
    assert drawn[:, :9].max() < 60
