"""Pictures of templates: grey as it is, orientations of gradients as strokes along edges."""

import numpy as np

from neuroslam.view.templates import LocalViewCells

_HALF_WIDTH_PX = 0.6  # of a stroke


def template_picture(view: LocalViewCells, template: int) -> np.ndarray:
    """Return a picture of a template, ``uint8``, ``(h, w)``.

    Raises:
        MapError: If there is no such template.
    """
    image = view.template_image(template)
    return strokes(image, view.config.orientations) if view.config.orientations else image


def strokes(template: np.ndarray, orientations: int, cell_px: int = 9) -> np.ndarray:
    """Draw each cell of a template of gradients as strokes along its edges, bright where strong.

    Args:
        template: ``uint8``, ``(orientations * rows, columns)``: maps of the cells, one below the
            other, of gradients from 0 over half a turn.
        orientations: Number of maps.
        cell_px: Side of a cell in the picture.

    Returns:
        ``uint8``, ``(cell_px * rows, cell_px * columns)``.

    Example:
        >>> upright = np.array([[255], [0]], np.uint8)  # a gradient along x: an upright edge
        >>> strokes(upright, 2, 3).tolist()
        [[0, 255, 0], [0, 255, 0], [0, 255, 0]]
    """
    maps = template.reshape(orientations, -1, template.shape[1])
    at = np.arange(cell_px) - 0.5 * (cell_px - 1)
    angles = np.arange(orientations)[:, None, None] * np.pi / orientations
    apart = np.abs(at * np.cos(angles) + at[:, None] * np.sin(angles))  # from the edge's line
    masks = apart <= _HALF_WIDTH_PX
    drawn = np.where(masks[:, None, :, None, :], maps[:, :, None, :, None], 0).max(axis=0)
    picture: np.ndarray = drawn.reshape(maps.shape[1] * cell_px, maps.shape[2] * cell_px)
    return picture
