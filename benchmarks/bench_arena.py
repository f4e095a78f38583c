"""Arenas: the walls near many positions, lidar scans, and the walls found in one scan."""

import numpy as np
import pytest

from benchmarks.timing import Row, cpu_ms
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.worlds.arena import Arena, named_arena

N, REACH_M, BEAMS = 100_000, 0.3, 180


def places(arena: Arena, n: int) -> np.ndarray:
    """Random positions inside."""
    rng = np.random.default_rng(0)
    x_min, x_max, y_min, y_max = arena.bounds
    found = rng.uniform([x_min, y_min], [x_max, y_max], (2 * n + 100, 2))
    return found[arena.contains(found)][:n]


def rows() -> list[Row]:
    found = []
    targets = [
        (Arena.regular(50, 1.0, "convex"), "<= 50 ms"),
        (Arena.rooms(12, name="12 rooms with doors"), ""),
        (named_arena("pillar"), ""),
    ]
    for arena, target in targets:
        positions = places(arena, N)
        ms = cpu_ms(lambda a=arena, p=positions: a.walls_near(p, REACH_M), 1)
        size = f"{len(positions)} x {arena.n_walls}, {arena.name}"
        found.append(Row("walls near", size, ms, target))
    arena = named_arena("square")
    one = places(arena, 1)
    ms = cpu_ms(lambda: arena.walls_near(one, REACH_M), 1000)
    found.append(Row("walls near", "1 x 4", ms))
    ms = cpu_ms(lambda: arena.ranges(one, [0.0], BEAMS, np.inf), 500)
    found.append(Row("one scan cast", f"{BEAMS} beams, 4 walls", ms))
    scans = noisy_scans(arena, 1000)
    for where, some in (
        ("anywhere", scans),
        ("wall in reach", scans[scans.min(axis=1) < REACH_M]),
    ):
        ms = cpu_ms(lambda some=some: [walls_in_scan(s, REACH_M) for s in some], 1) / len(some)
        size = f"{BEAMS} beams, {where}"
        found.append(Row("walls in a scan", size, ms, "<= 150 µs"))
    return found


def noisy_scans(arena: Arena, n: int) -> np.ndarray:
    """Scans from random poses, with noise of 1 cm."""
    rng = np.random.default_rng(1)
    positions = places(arena, n)
    ranges = arena.ranges(positions, rng.uniform(-np.pi, np.pi, len(positions)), BEAMS, np.inf)
    return np.maximum(ranges + rng.normal(0.0, 0.01, ranges.shape), 0.0)


@pytest.mark.parametrize(
    "arena", [Arena.regular(50, 1.0), Arena.rooms(12)], ids=["convex", "rooms"]
)
def test_walls_near(benchmark, arena):
    benchmark(arena.walls_near, places(arena, N), REACH_M)


def test_walls_in_scan(benchmark):
    benchmark(walls_in_scan, noisy_scans(named_arena("square"), 1)[0], REACH_M)
