r"""Candidate pairs of experiences of two maps: views that are alike, and alike nowhere else.

A view proves a place only if it is not seen elsewhere too. For the views :math:`q` of experience
:math:`z` and :math:`t` of experience :math:`u`, with match error :math:`d`, let :math:`d'` be the
smallest error of :math:`q` with a view of the other map far from :math:`u`, or of :math:`t` with
one far from :math:`z`. The pair is a candidate if

.. math:: d \le 1.3\,\tau, \qquad d \le 0.85\,d', \qquad d' > \tau

with :math:`\tau` the threshold of the views. A candidate may exceed the threshold, because it is
not believed alone.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from neuroslam.merging.limits import spacing_m
from neuroslam.merging.mapped import Mapped
from neuroslam.state.match import Pairs
from neuroslam.types import NO_TEMPLATE, ViewMatch

SOFT = 1.3
"""Largest match error of a candidate, in units of ``view.threshold``."""

DISTINCT = 0.85
"""Largest match error of a candidate, in units of the smallest error elsewhere."""

FAR = 3.0
"""Distance from which views count as elsewhere, in units of the spacing of experiences."""


class Candidates(NamedTuple):
    """Pairs of experiences whose views are alike.

    Attributes:
        pairs: The distinct ones, sorted by experience.
        alike: Number of partial experiences with a view within the threshold of a loaded one.
        best: Smallest match error; ``None`` without views.
    """

    pairs: Pairs
    alike: int
    best: float | None


class _Side:
    """One map and the match errors of its views with the other's experiences.

    Args:
        queries: The map.
        memory: The other map.
        far_m: Distance from which experiences are elsewhere.
    """

    def __init__(self, queries: Mapped, memory: Mapped, far_m: float) -> None:
        self.queries, self.memory, self.far_m = queries.view, memory.view, far_m
        self.other = memory
        self.xy_m = queries.map.poses[:, :2]
        self.templates = queries.map.experiences["template"].numpy()
        self.repeated = _repeated(self.templates, self.xy_m, far_m)
        self._rows: dict[int, np.ndarray] = {}

    def nearest(self, view: int, limit: float) -> ViewMatch:
        """Return the template of the other map that is nearest to a view."""
        match = self.memory.search(self.queries.stored_view(view), limit)
        if match.template != NO_TEMPLATE and match.error <= limit:
            self.memory.last.template = match.template  # the next match is likely next to it
        return match

    def errors(self, view: int) -> np.ndarray:
        """Return the match errors of a view with all experiences of the other map."""
        if view not in self._rows:
            self._rows[view] = view_errors(self.other, self.queries.stored_view(view))
        return self._rows[view]

    def away_from(self, experience: int) -> np.ndarray:
        """Return which experiences of this map are elsewhere."""
        away: np.ndarray = np.linalg.norm(self.xy_m - self.xy_m[experience], axis=1) > self.far_m
        return away


def view_errors(of: Mapped, view: np.ndarray) -> np.ndarray:
    """Return the match errors of a view with all experiences of a map; infinite without views.

    Args:
        of: The map.
        view: A view, as :meth:`~neuroslam.view.templates.LocalViewCells.stored_view` returns it.
    """
    templates = of.map.experiences["template"].numpy()
    known = templates != NO_TEMPLATE
    used, place = np.unique(templates[known], return_inverse=True)
    row = np.full(len(known), np.inf)
    if len(used):
        row[known] = of.view.differences(view, used)[place]
    return row


def find_candidates(loaded: Mapped, partial: Mapped) -> Candidates:
    """Compare the views of two maps in both directions; see the equation of this module.

    With ``sessions.check_residuals`` off, every view within the threshold is a candidate.
    """
    threshold = partial.config.view.threshold
    checked = partial.config.sessions.check_residuals
    limit = SOFT * threshold if checked else threshold
    far_m = FAR * spacing_m((loaded.map, partial.map), partial.config)
    one, other = _Side(partial, loaded, far_m), _Side(loaded, partial, far_m)
    found: dict[tuple[int, int], tuple[float, float]] = {}
    best: float | None = None
    alike: set[int] = set()
    for here, there in ((one, other), (other, one)):
        for view in np.unique(here.templates[here.templates != NO_TEMPLATE]).tolist():
            match = here.nearest(view, limit)
            if match.template == NO_TEMPLATE:
                continue
            best = match.error if best is None else min(best, match.error)
            ends = (
                np.flatnonzero(here.templates == view),
                np.flatnonzero(there.templates == match.template),
            )
            if match.error <= threshold:
                alike.update(ends[0 if here is one else 1].tolist())
            if match.error > limit:
                continue
            if checked and not _distinct(here, there, ends, match, threshold):
                continue
            turn = match.relative_heading_rad
            for z, u in product(*(end.tolist() for end in ends)):
                key, row = ((z, u), (turn, match.error)) if here is one else (
                    (u, z), (-turn, match.error))  # fmt: skip
                if key not in found or row[1] < found[key][1]:
                    found[key] = row
    rows = [(*key, *row) for key, row in sorted(found.items())]
    return Candidates(Pairs.of(rows), len(alike), best)


def _distinct(
    here: _Side,
    there: _Side,
    ends: tuple[np.ndarray, np.ndarray],
    match: ViewMatch,
    threshold: float,
) -> bool:
    """Return whether two views are alike nowhere else on either map."""
    if here.repeated[ends[0]].any() or there.repeated[ends[1]].any():
        return False
    view = int(here.templates[ends[0][0]])
    elsewhere = min(
        here.errors(view)[there.away_from(int(ends[1][0]))].min(initial=np.inf),
        there.errors(match.template)[here.away_from(int(ends[0][0]))].min(initial=np.inf),
    )
    return elsewhere > threshold and match.error <= DISTINCT * elsewhere


def _repeated(templates: np.ndarray, xy_m: np.ndarray, far_m: float) -> np.ndarray:
    """Return which experiences share their template with one far away."""
    repeated = np.zeros(len(templates), dtype=bool)
    order = np.argsort(templates, kind="stable")
    _, starts = np.unique(templates[order], return_index=True)
    for group in np.split(order, starts[1:]):
        repeated[group] = np.linalg.norm(np.ptp(xy_m[group], axis=0)) > far_m
    return repeated
