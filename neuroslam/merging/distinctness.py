r"""How distinctive the places are by which two maps were matched.

Views prove that two places are one only if places that look the same are rare. How rare, the two
maps show themselves: in the frame of their match, :math:`m` places were seen (a place is as large
as the distance at which views count as elsewhere), and at :math:`k` of them a view is within the
threshold of one that was seen elsewhere: farther off than a place, and than ``sessions.drift`` of
the path between the two, for odometry moves a place that is visited again. There are two kinds of
buildings, and :math:`k` decides between them:

.. math:: w = \frac{w_0 B_1}{w_0 B_1 + (1 - w_0) B_0}, \qquad B_1 = \frac{1}{m + 1}, \qquad
   B_0 = \binom{m}{k} \varepsilon^k (1 - \varepsilon)^{m - k}

A building that repeats itself (:math:`w_0` = 0.1 of all) has any share of repeated places, and
repeats them together: one of the two maps lies in a copy with the probability
:math:`(k + 1) / (m + 2)`, by the rule of succession, however many places match. In any other,
places look the same by chance (:math:`\varepsilon` = 0.02), each for itself, at a rate that
:math:`m` places without a like bound only so far. The probability that :math:`n` matched places are
others that look the same is

.. math:: P = w\, \frac{k + 1}{m + 2} + (1 - w) \prod_{i=0}^{n-1} \frac{i + 1}{m + 2 + i}

It must not exceed ``sessions.coincidence``. Short maps cannot reach it, nor maps of buildings that
repeat: what they saw can be seen elsewhere. What no map has seen, a second building that is equal
wherever both were, no test can exclude.
"""

import math
from typing import NamedTuple

import numpy as np

from neuroslam.geometry import wrap_angles
from neuroslam.merging.candidates import FAR, view_errors
from neuroslam.merging.limits import spacing_m
from neuroslam.merging.mapped import Mapped
from neuroslam.state.match import Pairs
from neuroslam.types import NO_TEMPLATE

REPEATING = 0.1
"""Share of buildings that repeat themselves, before the maps are looked at."""

CHANCE = 0.02
"""Share of places that look like another one in a building that does not repeat itself."""

SAME_HEADING_RAD = math.pi / 4
"""Largest difference of heading within a place."""

MOST_VIEWS = 256
"""Views that are compared with all others; of larger maps a sample."""


class Distinctness(NamedTuple):
    """How distinctive matched places are.

    Attributes:
        places: Places that were seen, on both maps together.
        alike: Those that look like another one.
        matched: Matched places.
        coincidence: Probability that the matched places are others that look the same.
    """

    places: int
    alike: float
    matched: int
    coincidence: float


def coincidence(alike: float, places: int, matched: int) -> float:
    """Return the probability that matched places are others that look the same; see the module.

    Args:
        alike: Places that look like another one, 0 to ``places``.
        places: Places that were seen.
        matched: Places that match.

    Example:
        >>> round(coincidence(0, 20, 5), 4)  # 20 places, no two of which look the same
        0.0004
        >>> round(coincidence(15, 20, 5), 2)  # rooms in a row
        0.73
        >>> round(coincidence(0, 3, 3), 2)  # a short session
        0.03
    """
    k, m = min(float(alike), float(places)), float(places)
    ways = math.lgamma(m + 1.0) - math.lgamma(k + 1.0) - math.lgamma(m - k + 1.0)
    by_chance = math.exp(ways + k * math.log(CHANCE) + (m - k) * math.log1p(-CHANCE))
    repeats = REPEATING / (m + 1.0)
    weight = repeats / (repeats + (1.0 - REPEATING) * by_chance)
    i = np.arange(matched)
    each = float(np.prod((i + 1.0) / (m + 2.0 + i)))
    return weight * (k + 1.0) / (m + 2.0) + (1.0 - weight) * each


def count_places(poses: np.ndarray, size_m: float) -> int:
    """Count the places of a path, each at most ``size_m`` and 45 degrees from its first pose.

    Args:
        poses: x, y in metres and heading in radians, ``(n, 3)``.
        size_m: Size of a place in metres.

    Example:
        >>> count_places(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 3.1]]), 1.0)
        3
    """
    left, n = poses, 0
    while len(left):
        off = left - left[0]
        far = np.hypot(off[:, 0], off[:, 1]) > size_m
        left = left[far | (np.abs(wrap_angles(off[:, 2])) > SAME_HEADING_RAD)]
        n += 1
    return n


def distinctness(
    loaded: Mapped,
    partial: Mapped,
    solved: tuple[np.ndarray, np.ndarray],
    matched: Pairs,
    contradicted: int,
) -> Distinctness:
    """Count the places of two maps and those that look alike; see the module.

    Args:
        loaded: One brain; it is not altered.
        partial: The other.
        solved: Poses of the experiences of both in one frame, ``(n, 3)`` and ``(m, 3)``.
        matched: The pairs that were matched.
        contradicted: Loop closures that odometry contradicts: places that look alike too.
    """
    size_m = FAR * spacing_m((loaded.map, partial.map), partial.config)
    places = count_places(np.vstack(solved), size_m)
    alike = _share_alike((loaded, partial), solved, matched, size_m) * places + contradicted
    n = count_places(solved[1][np.unique(matched.partial)], size_m)
    alike = min(alike, float(places))
    return Distinctness(places, alike, n, coincidence(alike, places, n))


class _Paths:
    """Path lengths between experiences of two maps, by their matched pairs.

    Args:
        maps: Both.
        matched: The pairs.
    """

    def __init__(self, maps: tuple[Mapped, Mapped], matched: Pairs) -> None:
        self.maps, self.ends = maps, (matched.loaded, matched.partial)
        self._known: dict[tuple[int, int], np.ndarray] = {}

    def lengths_m(self, which: int, experience: int, to: int) -> np.ndarray:
        """Return the path lengths from an experience to all of its own or of the other map.

        They are infinite where no path is known.
        """
        own = self._on_one(which, experience)
        if to == which:
            return own
        nearest = int(np.argmin(own[self.ends[which]]))
        there = self._on_one(to, int(self.ends[to][nearest]))
        total: np.ndarray = there + own[self.ends[which][nearest]]
        return total

    def _on_one(self, which: int, experience: int) -> np.ndarray:
        key = which, experience
        if key not in self._known:
            self._known[key] = self.maps[which].map.path_lengths_m(experience)
        return self._known[key]


def _share_alike(
    maps: tuple[Mapped, Mapped],
    solved: tuple[np.ndarray, np.ndarray],
    matched: Pairs,
    size_m: float,
) -> float:
    """Return the share of experiences with a view within the threshold of one elsewhere."""
    config, paths = maps[1].config, _Paths(maps, matched)
    known = [
        (which, experience, int(template))
        for which, one in enumerate(maps)
        for experience, template in enumerate(one.map.experiences["template"].numpy().tolist())
        if template != NO_TEMPLATE
    ]
    chosen = np.linspace(0, len(known) - 1, min(len(known), MOST_VIEWS)).round().astype(int)
    alike = 0
    for index in chosen.tolist():
        which, experience, template = known[index]
        view = maps[which].view.stored_view(template)
        here = solved[which][experience, :2]
        for to, poses in enumerate(solved):
            off_m = np.hypot(poses[:, 0] - here[0], poses[:, 1] - here[1])
            like = (off_m > size_m) & (view_errors(maps[to], view) <= config.view.threshold)
            if like.any():
                path_m = paths.lengths_m(which, experience, to)
                linked = np.isfinite(path_m)  # what no path explains is not the same place
                like[linked] &= off_m[linked] > config.sessions.drift * path_m[linked]
            if like.any():
                alike += 1
                break
    return alike / max(len(chosen), 1)
