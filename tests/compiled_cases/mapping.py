"""The map."""

import numpy as np

from neuroslam.mapping.actions import nearest_bound, nearest_bound_of_arrays
from neuroslam.mapping.relax import Relaxation
from neuroslam.mapping.sequence import advance_costs, within_links
from tests.compiled_cases import case, with_and_without


@case("mapping.relax.relax")
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
