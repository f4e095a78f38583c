"""Quickest and shortest paths through a map."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class Plan(NamedTuple):
    """A path through the map.

    Attributes:
        path: Experiences from start to goal, both included; empty if there is no path.
        duration_s: Sum of the durations of its links; infinite if there is no path.
        reason: Why there is no path; empty if there is one.
    """

    path: list[int]
    duration_s: float
    reason: str = ""


def quickest_path(
    links: tuple[np.ndarray, ...], n: int, start: int, goal: int, forward: bool = False
) -> Plan:
    """Find the quickest path by link time (Dijkstra).

    Args:
        links: ``source``, ``target``, ..., ``duration_s`` last, as in
            :class:`neuroslam.mapping.tables.Links`.
        n: Number of experiences.
        start: Id to start from.
        goal: Id to reach.
        forward: Follow links from source to target only; default: in both directions.

    Returns:
        The plan; of an unreachable goal it has the ``reason``, and nothing is raised.

    Example:
        >>> links = (np.array([0, 1]), np.array([1, 2]), np.array([5.0, 1.0]))
        >>> quickest_path(links, 3, 2, 0).path
        [2, 1, 0]
    """
    for name, experience in (("start", start), ("goal", goal)):
        if not 0 <= experience < n:
            return Plan([], np.inf, f"{name} {experience} is not in a map of {n} experiences")
    from scipy.sparse.csgraph import dijkstra  # slow to import, not always needed

    graph = _graph(links[0], links[1], links[-1], n, forward)
    distance, before = dijkstra(graph, indices=start, return_predecessors=True)
    if not np.isfinite(distance[goal]):
        return Plan([], np.inf, f"no links lead from experience {start} to {goal}")
    path = [goal]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return Plan(path[::-1], float(distance[goal]))


def shortest_path_lengths(links: tuple[np.ndarray, ...], n: int, start: int) -> np.ndarray:
    """Return the shortest-path length to every experience, links in both directions (Dijkstra).

    Args:
        links: ``source``, ``target``, ``distance_m``, ..., as for :func:`quickest_path`.
        n: Number of experiences.
        start: Id to start from.

    Returns:
        Metres, ``(n,)``; infinite where there is no path.

    Example:
        >>> links = (np.array([0, 1]), np.array([1, 2]), np.array([5.0, 1.0]))
        >>> shortest_path_lengths(links, 3, 2).tolist()
        [6.0, 1.0, 0.0]
    """
    from scipy.sparse.csgraph import dijkstra

    source, target, distance_m = links[:3]
    lengths: np.ndarray = dijkstra(_graph(source, target, distance_m, n), indices=start)
    return lengths


def leads_to(links: tuple[np.ndarray, ...], n: int, goal: int) -> np.ndarray:
    """Return which experiences lead to a goal along links from source to target, ``(n,)`` bool.

    Args:
        links: As for :func:`quickest_path`.
        n: Number of experiences.
        goal: Id to reach.

    Example:
        >>> links = (np.array([0, 1]), np.array([1, 2]), np.array([5.0, 1.0]))
        >>> leads_to(links, 3, 1).tolist()
        [True, True, False]
    """
    from scipy.sparse.csgraph import dijkstra

    graph = _graph(links[1], links[0], links[-1], n, forward=True)
    return np.asarray(np.isfinite(dijkstra(graph, indices=goal)))


def on_loops(links: tuple[np.ndarray, ...], n: int) -> np.ndarray:
    """Return the experiences of the largest part in which each leads to each other, ascending.

    Args:
        links: As for :func:`quickest_path`; followed from source to target.
        n: Number of experiences.

    Example:
        >>> on_loops((np.array([0, 1, 2]), np.array([1, 2, 1]), np.ones(3)), 3).tolist()
        [1, 2]
    """
    from scipy.sparse.csgraph import connected_components

    graph = _graph(links[0], links[1], links[-1], n, forward=True)
    part = connected_components(graph, connection="strong")[1]
    return np.flatnonzero(part == np.bincount(part).argmax())


def _graph(
    source: np.ndarray, target: np.ndarray, weight: np.ndarray, n: int, forward: bool = False
) -> "csr_array":
    """Return the graph of links; weights are above 0, as csgraph reads 0 as no edge."""
    from scipy.sparse import coo_array

    both = [source * n + target, target * n + source]
    pairs = both[0] if forward else np.concatenate(both)
    weights = np.maximum(weight if forward else np.concatenate([weight, weight]), 1e-9)
    order = np.lexsort((weights, pairs))  # coo sums duplicates: keep the least of each pair
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pairs[order]) != 0
    pairs, weights = pairs[order][first], weights[order][first]
    return coo_array((weights, (pairs // n, pairs % n)), shape=(n, n)).tocsr()
