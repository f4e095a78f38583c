"""Local view cells: which stored view does a picture show, and is it a new one?"""

import numpy as np
import torch
from torch import nn

from neuroslam.config import ViewConfig
from neuroslam.errors import ConfigError, MapError
from neuroslam.geometry import TWO_PI
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State, renamed
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, ViewMatch
from neuroslam.view.features import Encoder, FeatureEncoder, view_encoder
from neuroslam.view.preprocess import Encoded
from neuroslam.view.search import (
    Geometry,
    Nearest,
    distances,
    find_nearest,
    near_pairs,
    template_blocks,
)

GATE_MARGIN = 0.005
"""Added to the threshold where templates are skipped for their mean, as OpenRatSLAM does."""


_AT_ONCE = 1024
"""Comparisons in full precision that are made together: some megabytes."""


class LocalViewCells(Mergeable):
    r"""Stores views as templates and recognises them.

    The distance of a view :math:`q` to a template :math:`t` is the smallest mean absolute
    difference over the shifts :math:`s`,

    .. math:: d(q, t) = \min_s \frac{1}{|\Omega|} \sum_{(i,j) \in \Omega} |q_{i,j} - t_{i,j+s}|

    A forward view is shifted by up to ``shift_match`` columns, and :math:`\Omega` is its middle,
    without that many columns at either side; a panorama rolls through the full turn. The nearest
    template within ``threshold`` is recognised; if there is none, the view becomes a template.

    Args:
        config: Preprocessing, shifts, threshold, precision.
        features: The network, or its encoder, where ``config.features`` is ``"module"``.

    Example:
        >>> cells = LocalViewCells(ViewConfig(template_width=16, template_height=8, shift_match=2))
        >>> picture = np.arange(64 * 64, dtype=np.uint32).reshape(64, 64).astype(np.uint8)
        >>> cells(picture).is_new, cells(picture).template
        (True, 0)
    """

    def __init__(self, config: ViewConfig, features: nn.Module | Encoder | None = None) -> None:
        super().__init__()
        self.config = config
        self.encoder = view_encoder(config, features)
        self.geometry = Geometry.of(config)
        n_pixels = config.template_width * config.template_height
        columns = {
            "pixels": ((n_pixels,), torch.uint8),  # column after column
            "blocks": ((self.geometry.n_block_bytes,), torch.uint8),
        }
        self._exact = config.precision == "float64"
        if self._exact:
            columns["values"] = ((n_pixels,), torch.float64)
        if config.mean_gate:
            columns["mean"] = ((), torch.float64)
        self.templates = GrowingTable(columns)
        self.last = Scalars(template=NO_TEMPLATE)
        if config.features != "grey":
            self.network = Scalars(digest=0)  # of the network that made the templates; 0: none yet

    @property
    def n(self) -> int:
        """Number of templates."""
        return self.templates.n

    @property
    def network_digest(self) -> int:
        """Tells the networks apart that make the templates; 0: grey, or none was loaded yet."""
        if self.config.features == "grey":
            return 0
        if self.n or not isinstance(self.encoder, FeatureEncoder):
            return self.network.digest
        return self.encoder.__dict__.get("digest", 0)  # a cached property: loads nothing

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Make the template of a picture: in [0, 1], ``(template_height, template_width)``.

        Raises:
            BadFrame: If the picture is not ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
            ConfigError: If crop and template do not fit the picture, or a network that is to make
                it cannot be loaded, or is not the one that made the templates.
        """
        return self._encode(image).template

    def load_network(self) -> None:
        """Load the network that makes templates, where there is one; it must be the map's.

        Raises:
            ConfigError: If it cannot be loaded, or is not the one that made the templates.
        """
        if not isinstance(self.encoder, FeatureEncoder):
            return
        digest = self.encoder.digest
        if self.n and self.network.digest != digest:
            raise ConfigError(
                f"view.features = {self.config.features!r}: the {self.n} views of the map were "
                "made with other weights; give those, or begin a new map"
            )

    def _encode(self, image: np.ndarray) -> Encoded:
        self.load_network()
        return self.encoder(image)

    def template_image(self, template: int) -> np.ndarray:
        """Return a template as a grey picture, ``uint8``, ``(template_height, template_width)``.

        Raises:
            MapError: If there is no such template.
        """
        if not 0 <= template < self.n:
            raise MapError(f"LocalViewCells: no template {template}; there are {self.n}, from 0")
        pixels = self.templates["pixels"][template].numpy(force=True)
        return pixels.reshape(self.config.template_width, self.config.template_height).T.copy()

    def stored_view(self, template: int) -> np.ndarray:
        """Return a template as :meth:`encode` made it: grey in [0, 1], as :meth:`search` takes it.

        Raises:
            MapError: If there is no such template.
        """
        if self._exact and 0 <= template < self.n:
            values = self.templates["values"][template].numpy(force=True)
            return values.reshape(self.config.template_width, self.config.template_height).T
        return self.template_image(template) / 255.0

    def differences(self, view: np.ndarray, templates: np.ndarray) -> np.ndarray:
        """Compare a view with these templates; smallest mean difference over the shifts of each.

        Args:
            view: As :meth:`encode` makes it.
            templates: Ids, ``(m,)``.

        Returns:
            Differences in [0, 1], ``(m,)``, of views rounded to bytes.
        """
        self._check(view)
        if not len(templates):
            return np.empty(0)
        pixels = self.templates["pixels"].numpy(force=True)[templates]
        apart = distances(pixels, to_bytes(view.T), self.geometry).min(axis=0)
        return apart / (255.0 * self.geometry.n_pixels)

    def search(self, view: np.ndarray, limit: float = np.inf) -> ViewMatch:
        """Find the nearest template, without learning; the lowest id of equally near ones.

        Args:
            view: As :meth:`encode` makes it, ``(template_height, template_width)``.
            limit: Mean difference beyond which the search may stop: a farther template is then
                near the nearest, not surely the nearest.

        Returns:
            The template and its distance; ``NO_TEMPLATE`` and -1 if there is none to compare with.

        Raises:
            MapError: If the view is not of the templates' size.
        """
        self._check(view)
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
                limit * scale + 0.5,  # sums are integers: rounding loses none at the limit
                (self.last.template, self.last.template + 1),
            )
            error = found.distance / scale
        if found.id == NO_TEMPLATE:
            return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
        return ViewMatch(found.id, error, self._relative_heading(found.shift), False)

    def forward(self, image: np.ndarray) -> ViewMatch:
        """Recognise a picture, or store it as a new template.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

        Returns:
            The match; ``NO_TEMPLATE`` if the picture has too little contrast to show anything. The
            error of a new view among thousands is that of a near template, not surely the nearest.

        Raises:
            BadFrame: If the picture is of another type or shape.
            ConfigError: If crop and template do not fit the picture.
        """
        view = self.look(image)
        return ViewMatch(NO_TEMPLATE, -1.0, 0.0, False) if view is None else self.recognise(view)

    def look(self, image: np.ndarray) -> np.ndarray | None:
        """Make the template of a picture, as :meth:`encode`; ``None`` if it shows nothing.

        Raises:
            BadFrame: If the picture is of another type or shape.
            ConfigError: If crop and template do not fit the picture.
        """
        view, contrast = self._encode(image)
        return None if contrast < self.config.min_contrast else view

    def recognise(self, view: np.ndarray) -> ViewMatch:
        """Recognise a view, as :meth:`encode` makes it, or store it as a new template."""
        match = self.search(view, self.config.threshold)
        if match.template == NO_TEMPLATE or match.error > self.config.threshold:
            match = ViewMatch(self.learn(view), match.error, 0.0, True)
        self.last.template = match.template
        return match

    def learn(self, view: np.ndarray) -> int:
        """Store a view, as :meth:`encode` makes it, whatever it is like; returns its id.

        Raises:
            MapError: If the view is not of the templates' size.
        """
        self._check(view)
        columns = np.ascontiguousarray(view.T)
        pixels = to_bytes(columns)
        row = {
            "pixels": torch.from_numpy(pixels.reshape(-1)),
            "blocks": torch.from_numpy(template_blocks(pixels, self.geometry)),
        }
        if self._exact:
            row["values"] = torch.from_numpy(columns.reshape(-1))
        if self.config.mean_gate:
            row["mean"] = view.mean() if self._exact else pixels.mean() / 255.0
        if isinstance(self.encoder, FeatureEncoder):
            self.network.digest = self.encoder.digest
        return self.templates.append(**row)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Keep the loaded templates, then the partial ones that were not matched (Eq. 9)."""
        kept = torch.from_numpy(join.kept_views)
        merged = {
            name: torch.cat([loaded[name], column[kept]])
            for name, column in partial.items()
            if name.startswith("templates.")
        }
        now = {name: v for name, v in partial.items() if name.startswith("network.")}
        return merged | now | {"last.template": renamed(partial["last.template"], join.views)}

    def _check(self, view: np.ndarray) -> None:
        size = (self.geometry.height, self.geometry.width)
        if view.shape != size:
            raise MapError(
                f"LocalViewCells: view is {view.shape}; expected (template_height, template_width) "
                f"= {size}, as encode makes it"
            )

    def _search_values(self, view: np.ndarray, query: np.ndarray) -> tuple[Nearest, float]:
        """Search in full precision: bytes tell which templates and shifts can be the nearest.

        Rounding to bytes changes a pixel by at most half a level, in view and template, so a sum
        over N pixels by at most N levels: what is nearest is within 2 N of the nearest in bytes.
        """
        nothing = Nearest(NO_TEMPLATE, 0, 0), -1.0
        mask = None
        if self.config.mean_gate:
            means = self.templates["mean"].numpy(force=True)
            here = view.mean() if self._exact else query.mean() / 255.0
            mask = np.abs(means - here) <= self.config.threshold + GATE_MARGIN
            if not mask.any():
                return nothing
            mask = mask.view(np.uint8)[None]
        elif not self.n:
            return nothing
        g = self.geometry
        slack = 2 * g.n_pixels if self._exact else 0
        pixels = self.templates["pixels"].numpy(force=True)
        ids, shifts, apart = near_pairs(pixels, query, g, slack, mask)
        offsets = np.array(g.offsets)[shifts]
        errors = self._errors(ids, offsets, view) if self._exact else apart / (255.0 * g.n_pixels)
        best = np.lexsort((shifts, ids, errors))[0]
        return Nearest(int(ids[best]), 0, int(offsets[best])), float(errors[best])

    def _errors(self, ids: np.ndarray, offsets: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Mean absolute differences in full precision, for pairs of a template and an offset."""
        g = self.geometry
        values = self.templates["values"].numpy(force=True).reshape(self.n, g.width, g.height)
        part = view[g.margin : g.margin + g.overlap]
        errors = np.empty(len(ids))
        for at in range(0, len(ids), _AT_ONCE):
            some = slice(at, at + _AT_ONCE)
            columns = (offsets[some, None] + np.arange(g.overlap)) % g.width
            apart = np.abs(values[ids[some, None], columns] - part)
            errors[some] = apart.reshape(len(apart), -1).mean(axis=1)
        return errors

    def _relative_heading(self, offset: int) -> float:
        """Heading now minus heading when learnt: rolling right undoes a turn to the right."""
        if not self.config.panoramic:
            return 0.0
        width = self.config.template_width
        turned = (width - offset) % width
        return TWO_PI * (turned if 2 * turned <= width else turned - width) / width


def to_bytes(view: np.ndarray) -> np.ndarray:
    """Round grey in [0, 1] to ``uint8``, contiguous."""
    return np.ascontiguousarray(np.rint(view * 255.0).astype(np.uint8))
