"""The map."""

import numpy as np

from neuroslam.mapping.actions import nearest_bound, nearest_bound_of_arrays
from neuroslam.mapping.elimination import eliminate, factored
from neuroslam.mapping.incremental import GATE, IncrementalSolver
from neuroslam.mapping.pose_graph import (
    links_of,
    mismatch_over_path,
    normal_equations,
    poses_that_follow,
    robust_cost,
)
from neuroslam.mapping.relax import Relaxation
from neuroslam.mapping.sequence import advance_costs, within_links
from tests.compiled_cases import case, with_and_without


@case("mapping.relax.relax", "mapping.relax.links_at_poses")
def _loops_of_relaxation(draw):
    n, n_links = draw.integers(2, 40), draw.integers(1, 90)
    source = draw.integers(0, n, n_links)
    links = (
        source, (source + draw.integers(1, n, n_links)) % n, draw.uniform(0.0, 3.0, n_links),
        *draw.uniform(-np.pi, np.pi, (2, n_links)),
    )  # fmt: skip
    links[4][draw.random(n_links) < 0.2] = np.nan
    poses, loops = draw.normal(size=(n, 3)), draw.integers(1, 4)

    def relaxed():
        solved, moved = Relaxation(*links).run(poses, loops, 0.4)
        turns = np.cos(solved[:, 2]), np.sin(solved[:, 2])  # pi and -pi are one heading
        return [solved[:, :2].copy(), *turns, np.array(moved)]

    return with_and_without(relaxed)


@case("mapping.actions.nearest_bound")
def _experiences_with_one_view(draw):
    torus, n = (5, 5, 7), draw.integers(0, 12)
    bound = np.round(draw.uniform(0.0, 1.0, (n, 3)) * torus * 2) / 2  # some are equally near
    views, now = draw.integers(0, 3, n), tuple(np.round(draw.uniform(-9.0, 9.0, 3) * 2) / 2)
    found = [find(bound, views, 1, now, torus) for find in (nearest_bound_of_arrays, nearest_bound)]
    return [(np.array(a), np.array(b)) for a, b in zip(*found, strict=True)]


def _a_graph(draw, n, n_links):
    """Poses, links between them (a chain and loops), weights, and which poses may move."""
    chain = np.arange(n - 1)
    loops = draw.integers(0, n, (2, n_links))
    source, target = np.concatenate([[chain, chain + 1], loops[:, loops[0] != loops[1]]], axis=1)
    poses, measured = draw.normal(size=(n, 3)), draw.normal(size=(source.size, 3))
    scale = draw.uniform(0.5, 2.0, (source.size, 3))
    scale[draw.random(source.size) < 0.2, 2] = 0.0  # the turn is not known
    moving = draw.permutation(np.arange(1, n))[: draw.integers(1, n)]
    slot = np.full(n, -1)
    slot[moving] = np.arange(len(moving))
    weights = draw.uniform(0.1, 1.0, source.size)
    return poses, moving, slot, weights, source, target, measured, scale


@case("mapping.pose_graph.normal_equations", "mapping.elimination.eliminate")
def _steps_of_a_part_of_a_graph(draw):
    graph = _a_graph(draw, draw.integers(2, 25), draw.integers(0, 40))
    poses, moving, slot, weights, *links = graph
    ends = (slot[links[0]] >= 0) | (slot[links[1]] >= 0)
    args = poses, moving, slot, np.flatnonzero(ends), weights, *links, draw.choice([0.01, 1.0])
    expected, found = normal_equations.plain(*args), normal_equations(*args)
    pairs = list(zip(expected, (part.copy() for part in found), strict=True))
    return [*pairs, (factored(*expected[:4]), eliminate(*found[:4]))]


@case(
    "mapping.pose_graph.robust_cost",
    "mapping.pose_graph.links_of",
    "mapping.pose_graph.poses_that_follow",
    "mapping.pose_graph.mismatch_over_path",
)
def _what_moves_in_a_graph(draw):
    n = draw.integers(2, 40)
    poses, moving, slot, _, source, target, measured, scale = _a_graph(
        draw, n, draw.integers(0, 30)
    )
    no = np.empty(0)
    solver = IncrementalSolver(no.astype(np.int64), no.astype(np.int64), no, no, no)
    for k in range(source.size):
        distance, heading = np.hypot(*measured[k, :2]), np.arctan2(measured[k, 1], measured[k, 0])
        facing = measured[k, 2] if scale[k, 2] else np.nan
        ends = int(source[k]), int(target[k])
        solver.add_link(*ends, distance, heading, facing, scale=tuple(scale[k]))
    lists, doubted = (
        (solver._first, solver._following, solver._ends),
        draw.random(source.size) < 0.5,
    )

    def found(links_of, cost_of, follow, mismatch):
        weights, slots = np.ones(source.size), slot.copy()
        links = links_of(moving, slots, *lists)
        cost = cost_of(poses, links, source, target, measured, scale, doubted, GATE, weights)
        known = solver._measured, solver._scale
        more = follow(poses, moving, slots, *lists, weights, *known, 0.3)
        far = mismatch(poses, source.size - 1, 0.25, *lists, weights, *known)
        return [links, np.array(cost), weights, more, slots, np.array(far)]

    steps = links_of, robust_cost, poses_that_follow, mismatch_over_path
    return list(zip(found(*(s.plain for s in steps)), found(*steps), strict=True))


@case("mapping.sequence.advance_costs_step", "mapping.sequence.within_links_step")
def _sequence(rng):
    n = int(rng.integers(1, 40))
    source, target = rng.integers(0, n, (2, int(rng.integers(0, 3 * n))))
    costs, relative = rng.normal(0, 2, (2, n))
    memory, start = float(rng.uniform(0, 0.99)), int(rng.integers(n))
    back, ahead = rng.integers(0, 6, 2).tolist()
    return with_and_without(
        lambda: [
            advance_costs(costs, relative, source, target, memory),
            within_links(start, back, ahead, source, target, n),
        ]
    )
