r"""Evidence of a sequence of views: which experience the robot is at, along the links of the map.

A single view may match another place by chance, a sequence of views along a path hardly does
(SeqSLAM, Milford and Wyeth 2012). The path here is one of the map: evidence follows its links. With
:math:`e_k` the match error of a frame with experience :math:`k`, and mean and standard deviation
over all experiences,

.. math:: z_k = (e_k - \bar e) / s_e, \qquad
          c_k \leftarrow (1-\lambda)\, z_k + \lambda \min\bigl(c_k + p_0,\;
          \min_{j \to k} c_j,\; \min_{i \to j \to k} c_i + p_2\bigr)

so that :math:`-c_k` is the average lead of the best path of the last :math:`1/(1-\lambda)` frames
that ends at :math:`k`, in standard deviations.
"""

import numpy as np

from neuroslam.compiled import compiled, runs_compiled

STAY = 0.02
"""Cost :math:`p_0` of a frame in which the robot stays at an experience."""

SKIP = 0.1
"""Cost :math:`p_2` of a frame in which it passes two links."""

RANGE = (-5.0, 1.0)
"""Limits of :math:`z`: a single frame, however good or bad, decides nothing."""

UNKNOWN = 9.0
"""Cost of an experience that is not compared."""


def relative_errors(errors: np.ndarray, compared: np.ndarray) -> np.ndarray:
    """Return match errors in standard deviations from their mean, within :data:`RANGE`.

    Args:
        errors: Match error of a frame with every experience, ``(n,)``.
        compared: Which of them make up mean and deviation, ``bool``, ``(n,)``.

    Example:
        >>> relative_errors(np.array([0.1, 0.1, 0.1, 0.02]), np.ones(4, dtype=bool)).round(2)
        array([ 0.58,  0.58,  0.58, -1.73])
    """
    some = errors[compared]
    spread = float(some.std()) + 1e-6
    return np.clip((errors - some.mean()) / spread, *RANGE)


def advance_costs_of_arrays(
    costs: np.ndarray, relative: np.ndarray, source: np.ndarray, target: np.ndarray, memory: float
) -> np.ndarray:
    r"""Return the costs after a frame; the equation is at the top of this module.

    Args:
        costs: :math:`c`, ``(n,)``.
        relative: :math:`z`, ``(n,)``.
        source: Experience at which each link begins, ``(links,)``.
        target: Experience at which it ends, ``(links,)``.
        memory: :math:`\lambda`.

    Example:
        >>> ahead = np.array([0]), np.array([1])
        >>> advance_costs_of_arrays(np.array([-2.0, 0.0]), np.array([0.0, -4.0]), *ahead, 0.5)
        array([-0.99, -3.  ])
    """
    moved, before = costs + STAY, np.full(len(costs), UNKNOWN)
    np.minimum.at(before, target, costs[source])
    twice = np.full(len(costs), UNKNOWN)
    np.minimum.at(twice, target, before[source] + SKIP)
    moved = np.minimum(np.minimum(moved, before), twice)
    return (1.0 - memory) * relative + memory * moved


def within_links_of_arrays(
    start: int, back: int, ahead: int, source: np.ndarray, target: np.ndarray, n: int
) -> np.ndarray:
    """Return which experiences are at most so many links behind or ahead of one, ``(n,)``.

    Example:
        >>> chain = np.array([0, 1, 2]), np.array([1, 2, 3])
        >>> within_links_of_arrays(1, 1, 1, *chain, 4)
        array([ True,  True,  True, False])
    """
    near = np.zeros(n, dtype=np.bool_)
    near[start] = True
    for steps, first, second in ((ahead, source, target), (back, target, source)):
        front = np.zeros(n, dtype=np.bool_)
        front[start] = True
        for _ in range(steps):
            reached = np.zeros(n, dtype=np.bool_)
            reached[second[front[first]]] = True
            front = reached & ~front
            near |= reached
    return near


def advance_costs(
    costs: np.ndarray, relative: np.ndarray, source: np.ndarray, target: np.ndarray, memory: float
) -> np.ndarray:
    """Do as :func:`advance_costs_of_arrays`, compiled where that is possible."""
    if runs_compiled():
        return advance_costs_step(costs, relative, source, target, memory, STAY, SKIP, UNKNOWN)
    return advance_costs_of_arrays(costs, relative, source, target, memory)


def within_links(
    start: int, back: int, ahead: int, source: np.ndarray, target: np.ndarray, n: int
) -> np.ndarray:
    """Do as :func:`within_links_of_arrays`, compiled where that is possible."""
    if runs_compiled():
        return within_links_step(start, back, ahead, source, target, n)
    return within_links_of_arrays(start, back, ahead, source, target, n)


@compiled
def advance_costs_step(
    costs: np.ndarray,
    relative: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    memory: float,
    stay: float,
    skip: float,
    unknown: float,
) -> np.ndarray:
    """Do as :func:`advance_costs_of_arrays`, in three passes over the links."""
    n = costs.size
    before, moved = np.full(n, unknown), np.empty(n)
    for link in range(source.size):
        before[target[link]] = min(before[target[link]], costs[source[link]])
    for k in range(n):
        moved[k] = min(costs[k] + stay, before[k])
    for link in range(source.size):
        moved[target[link]] = min(moved[target[link]], before[source[link]] + skip)
    for k in range(n):
        moved[k] = (1.0 - memory) * relative[k] + memory * moved[k]
    return moved


@compiled
def within_links_step(
    start: int, back: int, ahead: int, source: np.ndarray, target: np.ndarray, n: int
) -> np.ndarray:
    """Do as :func:`within_links_of_arrays`, pass by pass until nothing is reached."""
    near = np.zeros(n, dtype=np.bool_)
    near[start] = True
    for way in range(2):
        first, second = (source, target) if way == 0 else (target, source)
        depth = np.full(n, n + 1)
        depth[start] = 0
        for step in range(ahead if way == 0 else back):
            more = False
            for link in range(first.size):
                if depth[first[link]] == step and depth[second[link]] > n:
                    depth[second[link]] = step + 1
                    near[second[link]] = True
                    more = True
            if not more:
                break
    return near
