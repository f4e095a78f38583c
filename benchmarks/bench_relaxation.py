"""The map's solvers: loops of the paper's relaxation, and whole least-squares solutions."""

import numpy as np
import pytest
import torch

from benchmarks.timing import Row, cpu_ms
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.mapping.relax import Relaxation

LARGE, SMALL = (20_000, 2_000), (233, 34)  # experiences, loop links


def laps(n: int, n_loops: int):
    """Ten noisy laps of a circle with loops between neighbouring laps, and bent poses of them."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 20.0 * np.pi, n, endpoint=False)
    truth = np.column_stack([50.0 * np.cos(angle), 50.0 * np.sin(angle), angle + np.pi / 2])
    again = np.sort(rng.choice(np.arange(n // 10, n), n_loops, replace=False))
    source, target = np.append(np.arange(n - 1), again), np.append(np.arange(1, n), again - n // 10)
    apart = truth[target] - truth[source]
    noise = rng.normal(0.0, 0.01, (2, len(source)))
    links = (
        source,
        target,
        np.hypot(apart[:, 0], apart[:, 1]) + noise[0],
        np.arctan2(apart[:, 1], apart[:, 0]) - truth[source, 2],
        apart[:, 2] + noise[1] * 0.1,
    )
    drift = np.cumsum(rng.normal(0.0, 0.01, (n, 3)), axis=0)
    return truth + drift, links


def rows() -> list[Row]:
    poses, links = laps(*LARGE)
    relaxation = Relaxation(*links)
    ms = cpu_ms(lambda: relaxation.run(poses, 1, 0.5), 50)
    many_ms = cpu_ms(lambda: relaxation.run(poses, 20, 0.5), 5) / 20
    size = f"{LARGE[0]} experiences"
    found = [
        Row("map relaxation, one loop", size, ms),
        Row("map relaxation, a loop of 20", size, many_ms),
    ]
    poses, links = laps(*SMALL)
    relaxation = Relaxation(*links)
    size = f"{SMALL[0]} experiences"
    ms = cpu_ms(lambda: relaxation.run(poses, 20, 0.5), 200)
    found.append(Row("map relaxation, 20 loops", size, ms))
    ms = cpu_ms(lambda: Relaxation(*links), 500)
    found.append(Row("map relaxation, after a new link", size, ms))
    ms = cpu_ms(lambda: solve_pose_graph(poses, *links), 5)
    found.append(Row("map least squares, to the end", size, ms))
    return found


@pytest.mark.parametrize(("size", "loops"), [(LARGE, 1), (SMALL, 20)])
def test_relaxation(benchmark, size, loops):
    torch.set_num_threads(1)
    poses, links = laps(*size)
    relaxation = Relaxation(*links)
    benchmark(relaxation.run, poses, loops, 0.5)


def test_least_squares(benchmark):
    torch.set_num_threads(1)
    poses, links = laps(*SMALL)
    benchmark(solve_pose_graph, poses, *links)
