r"""Recognise places in change: small regions of the view, each looked for near its own position.

A template that is compared as a whole fails where the robot drives beside its earlier path: near
things move in the view, far ones do not. Here every region :math:`i` of the view, 3 x 3 cells of
gradients, is looked for on its own in the window :math:`W_i` around its position in each stored
view :math:`r`, and counts only as far as it distinguishes that view from the others:

.. math:: s_{ir} = \max_{j \in W_i} \langle q_i, r_j \rangle, \qquad
          e_r = 1 - \frac{1}{n} \sum_i \big[ s_{ir} - b_i \big]_+

with :math:`b_i` the similarity that a tenth of the stored views exceed. Regions of gradients that
are searched for by convolution are those of CoHOG (M. Zaffar et al., RA-L 5, 2020); what counts is
the lead over the background, as for local naive Bayes nearest neighbours (S. McCann, D. G. Lowe,
CVPR 2012). Descriptors are whitened by the regions of the map itself, so that a structure that is
everywhere, as the border of the camera or a skirting board, says little.
"""

import numpy as np
import torch

from neuroslam.errors import MapError
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable
from neuroslam.view.preprocess import directed_gradients

CELLS = 14, 18, 8
"""Rows, columns and directions of the cells of gradients."""

WINDOW = 4, 8
"""Rows and columns, in cells, by which a region may have moved in the view."""

DIMENSIONS = 32
"""Values of a whitened region."""

BACKGROUND = 0.1
"""Share of the stored views, the most similar ones, that are above the background of a region."""

_SIZE = 3  # cells across a region
_FLOOR = 0.02  # variance, as a share of the largest, that is added to each before whitening
_AT_ONCE = 128  # stored views compared at a time: 10 MB


def regions_of(cells: np.ndarray) -> np.ndarray:
    """Return all regions of 3 x 3 cells.

    Args:
        cells: Cells of gradients, ``(n, rows, columns, directions)``.

    Returns:
        ``(n, (rows - 2) * (columns - 2), 9 * directions)``.

    Example:
        >>> regions_of(np.zeros((2, 14, 18, 8))).shape
        (2, 192, 72)
    """
    n, rows, columns = len(cells), cells.shape[1] - _SIZE + 1, cells.shape[2] - _SIZE + 1
    parts = [cells[:, y : y + rows, x : x + columns] for y in range(_SIZE) for x in range(_SIZE)]
    return np.concatenate(parts, axis=-1).reshape(n, rows * columns, -1)


def whitening(regions: np.ndarray, dimensions: int = DIMENSIONS) -> tuple[np.ndarray, np.ndarray]:
    r"""Return mean and basis that whiten the regions of a map.

    .. math:: W = V \, (\Lambda + \epsilon \lambda_1)^{-1/2}

    with the largest eigenvalues :math:`\Lambda` of the covariance and their eigenvectors; the sign
    of an eigenvector does not matter to a product of two regions.

    Args:
        regions: ``(n, size)``.
        dimensions: Number of eigenvalues.

    Returns:
        Mean ``(size,)`` and basis ``(size, dimensions)``, ``float32``.
    """
    mean = regions.mean(axis=0)
    centred = (regions - mean).astype(np.float64)
    values, vectors = np.linalg.eigh(centred.T @ centred / max(len(centred) - 1, 1))
    values, vectors = values[::-1][:dimensions], vectors[:, ::-1][:, :dimensions]
    scale = np.sqrt(np.maximum(values, 0.0) + _FLOOR * max(values[0], 1e-12))
    return mean.astype(np.float32), (vectors / scale).astype(np.float32)


def window_mask(rows: int, columns: int, window: tuple[int, int]) -> np.ndarray:
    """Return 0 where two of ``rows * columns`` regions lie in one window, else -2, ``float32``.

    Example:
        >>> window_mask(1, 3, (0, 1)).tolist()
        [[0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]
    """
    y, x = (a.ravel() for a in np.mgrid[:rows, :columns])
    down, across = np.abs(y[:, None] - y), np.abs(x[:, None] - x)
    return np.where((down <= window[0]) & (across <= window[1]), 0.0, -2.0).astype(np.float32)


def region_errors(similar: np.ndarray, share: float = BACKGROUND) -> np.ndarray:
    """Return match errors from the similarity of each region; the equation is at the top.

    Args:
        similar: :math:`s`, in [-1, 1], ``(n views, regions)``.
        share: Share of the views that is above the background.

    Returns:
        ``(n views,)``, in [-1, 1]; 1: no region is more similar than the background.

    Example:
        >>> region_errors(np.array([[0.9, 0.2], [0.3, 0.2], [0.1, 0.2]])).round(2).tolist()
        [0.6, 0.9, 1.0]
    """
    n = len(similar)
    if not n:
        return np.empty(0)
    rank = min(max(3, int(share * n)), n - 1)
    background = np.partition(similar, n - 1 - rank, axis=0)[n - 1 - rank]
    return 1.0 - np.maximum(similar - background, 0.0).mean(axis=1, dtype=np.float64)


class RegionMatcher(Mergeable):
    """Stores views as cells of gradients and compares images with all of them, by regions.

    The whitening is computed from all stored views when an image is compared after a change, so
    store many before. An image costs 6 ms for a hundred stored views; the time grows with them.
    It needs a map of which an image shows a small part: with fewer than ten views, little can
    stand out from the others.

    Example:
        >>> from neuroslam import open_source
        >>> matcher, drive = RegionMatcher(), open_source("world:corridor?frames_per_lap=40")
        >>> for frame in drive.frames(0, 20):
        ...     _ = matcher.learn(frame.image)
        >>> darker = open_source("world:corridor?frames_per_lap=40&gain=0.5").frames(0, 20)
        >>> [int(matcher(frame.image).argmin()) for frame in darker] == list(range(20))
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self.views = GrowingTable({"cells": (CELLS, torch.uint8)})
        rows, columns = CELLS[0] - _SIZE + 1, CELLS[1] - _SIZE + 1
        self._mask = window_mask(rows, columns, WINDOW)
        self._forget()
        self.register_load_state_dict_post_hook(_whiten_again)

    def _forget(self) -> None:
        self._mean, self._basis = np.empty(0, np.float32), np.empty((0, 0), np.float32)
        self._regions = np.empty((0, 0, 0), np.float32)

    @property
    def n(self) -> int:
        """Number of stored views."""
        return self.views.n

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Return the cells of gradients of an image, ``uint8``, of shape :data:`CELLS`.

        Raises:
            BadFrame: If the image is not ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        """
        check_image(image, "RegionMatcher")
        found = directed_gradients(to_grey(image), *CELLS)
        return np.asarray(np.floor(255.0 * found + 0.5).astype(np.uint8))

    def learn(self, image: np.ndarray) -> int:
        """Store the view of an image; return its number.

        Raises:
            BadFrame: As :meth:`encode`.
        """
        return self.views.append(cells=torch.from_numpy(self.encode(image)))

    def forward(self, image: np.ndarray) -> np.ndarray:
        """Return the match errors of an image with all stored views, ``(n,)``: see the top.

        Raises:
            BadFrame: As :meth:`encode`.
            MapError: If no view is stored.
        """
        if not self.n:
            raise MapError("RegionMatcher: no stored view to compare with; call learn() before")
        view = self.encode(image)
        self._prepare()
        regions = self._whitened(view[None])[0]
        similar = np.empty((self.n, len(regions)), np.float32)
        for first in range(0, self.n, _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            products = np.matmul(self._regions[some], regions.T)
            products += self._mask
            products.max(axis=1, out=similar[some])
        return region_errors(similar)

    def _prepare(self) -> None:
        """Whiten the regions of all stored views, if their number has changed."""
        if len(self._regions) == self.n:
            return
        cells = self.views["cells"].numpy(force=True)
        regions = regions_of(cells).reshape(-1, _SIZE * _SIZE * CELLS[2])
        self._mean, self._basis = whitening(regions[::3])
        self._regions = self._whitened(cells)

    def _whitened(self, cells: np.ndarray) -> np.ndarray:
        """Return the regions of cells, whitened and of length 1."""
        found = (regions_of(cells) - self._mean) @ self._basis
        length = np.linalg.norm(found, axis=-1, keepdims=True)
        return np.asarray(found / np.maximum(length, 1e-6))

    def renumber(self, change: Renumbering) -> None:
        """Views are numbered in their own order, which a change of the map leaves as it is."""

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Put the views of both together, those of the loaded one first."""
        return {name: torch.cat([loaded[name], partial[name]]) for name in partial}


def _whiten_again(module: RegionMatcher, _keys: object) -> None:
    """Compute the regions of the views that were loaded, when an image is compared."""
    module._forget()
