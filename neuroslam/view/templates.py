"""Local view cells: match an image with the stored templates, or store it as a new one."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.compiled import plain_array, runs_compiled
from neuroslam.config import ViewConfig
from neuroslam.errors import ConfigError, MapError
from neuroslam.geometry import TWO_PI
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State, renamed
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, ViewMatch
from neuroslam.view.features import Encoder, FeatureEncoder, view_encoder
from neuroslam.view.preprocess import Encoded
from neuroslam.view.search import (
    Coarse,
    Geometry,
    Nearest,
    distances,
    find_nearest,
    learn_step,
    limit_of,
    near_pairs,
    nearest_step,
    plan_of,
    template_blocks,
)

GATE_MARGIN = 0.005
"""Added to the threshold when templates are skipped by their mean, as in OpenRatSLAM."""

_NO_VALUES, _NO_MEANS = np.empty((0, 0)), np.empty(0)

_BATCH = 1024  # comparisons in full precision at a time: a few megabytes


class _Last(Scalars):
    """Template of the last view."""

    template: int


class _Network(Scalars):
    """Digest of the network that made the templates; 0 before the first template."""

    digest: int


class LocalViewCells(Mergeable):
    r"""Stores views as templates and matches images with them.

    The distance of a view :math:`q` to a template :math:`t` is the smallest mean absolute
    difference over the shifts :math:`s`,

    .. math:: d(q, t) = \min_s \frac{1}{|\Omega|} \sum_{(i,j) \in \Omega} |q_{i,j} - t_{i,j+s}|

    A forward view is shifted by up to ``shift_match`` columns, and :math:`\Omega` is its middle,
    without that many columns at either side; a panorama is rolled through the full turn. A view
    matches its nearest template if the distance is at most ``threshold``; otherwise it becomes a
    new template.

    Args:
        config: Preprocessing, shifts, threshold and precision.
        features: The network, or its encoder, if ``config.features`` is ``"module"``.

    Example:
        >>> cells = LocalViewCells(ViewConfig(template_width=16, template_height=8, shift_match=2))
        >>> image = np.arange(64 * 64, dtype=np.uint32).reshape(64, 64).astype(np.uint8)
        >>> cells(image).is_new, cells(image).template
        (True, 0)
    """

    def __init__(self, config: ViewConfig, features: nn.Module | Encoder | None = None) -> None:
        super().__init__()
        self.config = config
        self.encoder = view_encoder(config, features)
        self.geometry = Geometry.of(config)
        n_pixels = config.template_width * config.template_height
        columns: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "pixels": ((n_pixels,), torch.uint8),  # column after column
            "blocks": ((self.geometry.n_block_bytes,), torch.uint8),
        }
        self._exact = config.precision == "float64"
        if self._exact:
            columns["values"] = ((n_pixels,), torch.float64)
        if config.mean_gate:
            columns["mean"] = ((), torch.float64)
        self.templates = GrowingTable(columns)
        self._coarse = Coarse()
        self.last = _Last(template=NO_TEMPLATE)
        if config.features != "grey":
            self.network = _Network(digest=0)

    @property
    def n(self) -> int:
        """Number of templates."""
        return self.templates.n

    @property
    def network_digest(self) -> int:
        """Digest of the network that makes the templates; 0: grey, or not loaded yet."""
        if self.config.features == "grey":
            return 0
        if self.n or not isinstance(self.encoder, FeatureEncoder):
            return self.network.digest
        digest: int = self.encoder.__dict__.get("digest", 0)  # cached; reading it loads nothing
        return digest

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Make the template of an image: in [0, 1], ``(template_height, template_width)``.

        Raises:
            BadFrame: If the image is not ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
            ConfigError: If crop and template do not fit the image, or the network cannot be
                loaded, or is not the one that made the stored templates.
        """
        return self._encode(image).template

    def load_network(self) -> None:
        """Load the network that makes the templates, if any, and check that it is the map's.

        Raises:
            ConfigError: If it cannot be loaded, or is not the one that made the stored templates.
        """
        if not isinstance(self.encoder, FeatureEncoder):
            return
        digest = self.encoder.digest
        if self.n and self.network.digest != digest:
            raise ConfigError(
                f"view.features = {self.config.features!r}: the {self.n} views of the map were "
                "made with other weights; pass those, or start a new map"
            )

    def _encode(self, image: np.ndarray) -> Encoded:
        self.load_network()
        return self.encoder(image)

    def template_image(self, template: int) -> np.ndarray:
        """Return a template as a grey image, ``uint8``, ``(template_height, template_width)``.

        Raises:
            MapError: If there is no such template.
        """
        if not 0 <= template < self.n:
            raise MapError(
                f"LocalViewCells: no template {template}; there are {self.n}, numbered from 0"
            )
        pixels = self.templates["pixels"][template].numpy(force=True)
        return pixels.reshape(self.config.template_width, self.config.template_height).T.copy()

    def stored_view(self, template: int) -> np.ndarray:
        """Return a template as :meth:`encode` made it: in [0, 1], an input of :meth:`search`.

        Raises:
            MapError: If there is no such template.
        """
        if self._exact and 0 <= template < self.n:
            values = self.templates["values"][template].numpy(force=True)
            return values.reshape(self.config.template_width, self.config.template_height).T
        return self.template_image(template) / 255.0

    def differences(self, view: np.ndarray, templates: np.ndarray) -> np.ndarray:
        """Return the match error of a view with given templates: the smallest over the shifts.

        Args:
            view: Result of :meth:`encode`.
            templates: Ids, ``(m,)``.

        Returns:
            Mean absolute differences in [0, 1], ``(m,)``, of views rounded to bytes.
        """
        return self.differences_and_turns(view, templates)[0]

    def differences_and_turns(
        self, view: np.ndarray, templates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`differences`, and present minus learnt heading in radians, ``(m,)``."""
        self._check(view)
        if not len(templates):
            return np.empty(0), np.empty(0)
        pixels = self.templates["pixels"].numpy(force=True)[templates]
        sums = distances(pixels, to_bytes(view.T), self.geometry)
        best = sums.argmin(axis=0)
        turns = np.array([self._relative_heading(offset) for offset in self.geometry.offsets])
        errors = sums[best, np.arange(len(best))] / (255.0 * self.geometry.n_pixels)
        return errors, turns[best]

    def compare(self, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return match error and relative heading of a view with every template.

        Args:
            view: Result of :meth:`encode`.

        Returns:
            Mean absolute differences in [0, 1] at the best shift, of views rounded to bytes, and
            headings in radians, 0 for forward views; each ``(n,)``.
        """
        self._check(view)
        if not self.n:
            return np.empty(0), np.empty(0)
        sums = distances(self.templates.array("pixels"), to_bytes(view.T), self.geometry)
        errors = sums.min(axis=0) / (255.0 * self.geometry.n_pixels)
        if not self.config.panoramic:
            return errors, np.zeros(self.n)
        of_shift = np.array([self._relative_heading(offset) for offset in self.geometry.offsets])
        return errors, of_shift[sums.argmin(axis=0)]

    def search(self, view: np.ndarray, limit: float = np.inf) -> ViewMatch:
        """Find the nearest template, without learning; the lowest id of equally near ones.

        Args:
            view: Result of :meth:`encode`, ``(template_height, template_width)``.
            limit: Largest match error of interest: beyond it the search may stop early, with an
                error that is not always the smallest.

        Returns:
            The template and its match error; ``NO_TEMPLATE`` and -1 without templates to compare.

        Raises:
            MapError: If the view does not have the size of the templates.
        """
        self._check(view)
        columns = self._arrays()
        if columns is not None:
            return self._search_compiled(view, limit, columns)
        query = to_bytes(view.T)
        if self._exact or self.config.mean_gate:
            found, error = self._search_values(np.ascontiguousarray(view.T), query)
        else:
            scale = 255.0 * self.geometry.n_pixels
            found = find_nearest(
                self.templates["pixels"].numpy(force=True),
                self.templates["blocks"].numpy(force=True),
                query,
                self.geometry,
                limit * scale + 0.5,  # sums are integers: 0.5 keeps those at the limit
                (self.last.template, self.last.template + 1),
            )
            error = found.distance / scale
        if found.id == NO_TEMPLATE:
            return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
        return ViewMatch(found.id, error, self._relative_heading(found.shift), False)

    if TYPE_CHECKING:

        def __call__(self, image: np.ndarray) -> ViewMatch:
            """Call :meth:`forward`."""
            ...

    def forward(self, image: np.ndarray) -> ViewMatch:
        """Match an image with the templates, or store it as a new template.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

        Returns:
            The match; ``NO_TEMPLATE`` if the image has too little contrast. The match error of a
            new view among thousands of templates is not always the smallest, see :meth:`search`.

        Raises:
            BadFrame: If the image has another type or shape.
            ConfigError: If crop and template do not fit the image.
        """
        view = self.usable_view(image)
        if view is None:
            return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
        return self.match_or_learn(view)

    def usable_view(self, image: np.ndarray) -> np.ndarray | None:
        """Make the template of an image, as :meth:`encode`; ``None`` if its contrast is too low.

        Raises:
            BadFrame: If the image has another type or shape.
            ConfigError: If crop and template do not fit the image.
        """
        view, contrast = self._encode(image)
        return None if contrast < self.config.min_contrast else view

    def match_or_learn(self, view: np.ndarray, hidden: np.ndarray | None = None) -> ViewMatch:
        """Match a view, the result of :meth:`encode`, or store it as a new template.

        Args:
            view: The view.
            hidden: Templates that cannot match, ``bool (n,)``; ``None``: all can.
        """
        match = self.search(view, self.config.threshold)
        if hidden is not None and match.template != NO_TEMPLATE and hidden[match.template]:
            match = self._search_among(view, np.flatnonzero(~hidden))
        if match.template == NO_TEMPLATE or match.error > self.config.threshold:
            match = ViewMatch(self.learn(view), match.error, 0.0, True)
        self.last.template = match.template
        return match

    def _search_among(self, view: np.ndarray, templates: np.ndarray) -> ViewMatch:
        """Find the nearest of some templates; error and heading as of :meth:`differences`."""
        errors, turns = self.differences_and_turns(view, templates)
        if not len(errors):
            return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
        best = int(errors.argmin())
        return ViewMatch(int(templates[best]), float(errors[best]), float(turns[best]), False)

    def learn(self, view: np.ndarray) -> int:
        """Store a view, the result of :meth:`encode`, as a new template, and return its id.

        Raises:
            MapError: If the view does not have the size of the templates.
        """
        self._check(view)
        if isinstance(self.encoder, FeatureEncoder):
            self.network.digest = self.encoder.digest
        if runs_compiled(*self.templates.storage().values()):
            return self._learn_compiled(view)
        columns = np.ascontiguousarray(view.T)
        pixels = to_bytes(columns)
        row: dict[str, float | Tensor] = {
            "pixels": torch.from_numpy(pixels.reshape(-1)),
            "blocks": torch.from_numpy(template_blocks(pixels, self.geometry)),
        }
        if self._exact:
            row["values"] = torch.from_numpy(columns.reshape(-1))
        if self.config.mean_gate:
            row["mean"] = float(view.mean() if self._exact else pixels.mean() / 255.0)
        return self.templates.append(**row)

    def _learn_compiled(self, view: np.ndarray) -> int:
        """Learn as :meth:`learn` does, in one compiled step."""
        template, plan = self.templates.append_empty(), plan_of(self.geometry)
        columns = self._arrays()
        assert columns is not None
        level = learn_step(
            plain_array(view),
            template,
            columns["pixels"],
            columns["blocks"],
            columns["values"],
            self.geometry.core[0],
            plan.sizes[3:7],
        )
        if self.config.mean_gate:
            columns["mean"][template] = view.mean() if self._exact else level / 255.0
        return template

    def renumber(self, change: Renumbering) -> None:
        """Drop the templates that are not kept."""
        columns = {
            name: change.rows_of_views(self.templates[name]) for name in self.templates.columns
        }
        self.templates.replace(**columns)
        self.last.template = change.view(self.last.template)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Append the partial session's unmatched templates to the loaded ones (Eq. 9)."""
        kept = torch.from_numpy(join.kept_views)
        merged = {
            name: torch.cat([loaded[name], column[kept]])
            for name, column in partial.items()
            if name.startswith("templates.")
        }
        network = {name: v for name, v in partial.items() if name.startswith("network.")}
        return merged | network | {"last.template": renamed(partial["last.template"], join.views)}

    def _check(self, view: np.ndarray) -> None:
        size = (self.geometry.height, self.geometry.width)
        if view.shape != size:
            raise MapError(
                f"LocalViewCells: view is {view.shape}; expected (template_height, template_width) "
                f"= {size}, the result of encode"
            )

    def _arrays(self) -> dict[str, np.ndarray] | None:
        """Return the columns of the templates for compiled steps, or ``None`` if none may run."""
        storage = self.templates.storage()
        if not runs_compiled(*storage.values()):
            return None
        found = {name: column.numpy() for name, column in storage.items()}
        found.setdefault("values", _NO_VALUES)
        found.setdefault("mean", _NO_MEANS)
        return found

    def _search_compiled(
        self, view: np.ndarray, limit: float, columns: dict[str, np.ndarray]
    ) -> ViewMatch:
        """Search as :meth:`search` does, in one compiled step."""
        n, config, geometry = self.n, self.config, self.geometry
        scale = 255.0 * geometry.n_pixels
        if self._exact or config.mean_gate:
            limit = np.inf
        found, distance, shift = nearest_step(
            plain_array(view),
            columns["pixels"],
            columns["blocks"],
            columns["values"],
            columns["mean"],
            self._coarse.of(self.templates.storage()["pixels"], n, geometry),
            n,
            *plan_of(geometry),
            config.threshold + GATE_MARGIN,
            limit_of(n, limit * scale + 0.5),  # sums are integers: 0.5 keeps those at the limit
            self.last.template,
        )
        if found == NO_TEMPLATE:
            return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
        heading = self._relative_heading(geometry.offsets[shift])
        return ViewMatch(found, distance / scale, heading, False)

    def _search_values(self, view: np.ndarray, query: np.ndarray) -> tuple[Nearest, float]:
        """Search in full precision; the bytes select the templates and shifts to compare.

        Rounding to bytes changes a pixel of view and of template by at most half a level, and a sum
        over N pixels by at most N levels: the nearest is within 2 N of the nearest in bytes.
        """
        nothing = Nearest(NO_TEMPLATE, 0, 0), -1.0
        mask = None
        if self.config.mean_gate:
            means = self.templates["mean"].numpy(force=True)
            mean = view.mean() if self._exact else query.mean() / 255.0
            mask = np.abs(means - mean) <= self.config.threshold + GATE_MARGIN
            if not mask.any():
                return nothing
            mask = mask.view(np.uint8)[None]
        elif not self.n:
            return nothing
        g = self.geometry
        slack = 2 * g.n_pixels if self._exact else 0
        pixels = self.templates["pixels"].numpy(force=True)
        ids, shifts, sums = near_pairs(pixels, query, g, slack, mask)
        offsets = np.array(g.offsets)[shifts]
        errors = self._errors(ids, offsets, view) if self._exact else sums / (255.0 * g.n_pixels)
        best = np.lexsort((shifts, ids, errors))[0]
        return Nearest(int(ids[best]), 0, int(offsets[best])), float(errors[best])

    def _errors(self, ids: np.ndarray, offsets: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Return mean absolute differences of pairs of a template and an offset, as ``float64``."""
        g = self.geometry
        values = self.templates["values"].numpy(force=True).reshape(self.n, g.width, g.height)
        part = view[g.margin : g.margin + g.overlap]
        errors = np.empty(len(ids))
        for at in range(0, len(ids), _BATCH):
            batch = slice(at, at + _BATCH)
            columns = (offsets[batch, None] + np.arange(g.overlap)) % g.width
            difference = np.abs(values[ids[batch, None], columns] - part)
            errors[batch] = difference.reshape(len(difference), -1).mean(axis=1)
        return errors

    def _relative_heading(self, offset: int) -> float:
        """Return present minus learnt heading: a roll to the right undoes a turn to the right."""
        if not self.config.panoramic:
            return 0.0
        width = self.config.template_width
        turned = (width - offset) % width
        return TWO_PI * (turned if 2 * turned <= width else turned - width) / width


def to_bytes(view: np.ndarray) -> np.ndarray:
    """Round grey in [0, 1] to ``uint8``, contiguous."""
    return np.ascontiguousarray(np.rint(view * 255.0).astype(np.uint8))
