"""Merging two maps of n places each, and recognising a view in several stored maps at once."""

import numpy as np
import pytest
import torch

from benchmarks.bench_relaxation import laps
from benchmarks.timing import Row, cpu_ms, written
from neuroslam.brain import NavigationBrain
from neuroslam.brain.recognition import StoredViews
from neuroslam.config import BrainConfig
from neuroslam.state.match import Match, Pairs
from neuroslam.state.sessions import Session
from neuroslam.view.search import block_means

SIZES = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
TARGET = 10_000  # places of each map, which merge in half a second


def mapped(n: int, seed: int) -> NavigationBrain:
    """A brain of ``n`` places, ten laps with one loop link in ten."""
    brain, rng = NavigationBrain(BrainConfig()), np.random.default_rng(seed)
    poses, (source, target, distance, heading, facing) = laps(n, n // 10)
    pixels = rng.integers(0, 256, (n, 600), dtype=np.uint8)
    g = brain.view.geometry
    columns = pixels.reshape(n, g.width, g.height)[:, g.core[0] : g.core[1]]
    brain.view.templates.replace(
        pixels=torch.from_numpy(pixels), blocks=torch.from_numpy(block_means(columns, g))
    )
    cells = torch.from_numpy(rng.uniform(0.0, 21.0, (n, 3)))
    x, y, theta = cells.unbind(1)
    brain.pose_cells.bindings.replace(x=x, y=y, theta=theta, decay=torch.zeros(n))
    numbers = torch.arange(n)
    brain.map.experiences.replace(
        pose=torch.from_numpy(poses),
        cell=cells,
        template=numbers,
        first_frame=numbers,
        session=torch.full((n,), seed),
        number=numbers,
    )
    columns = dict(zip(brain.map.links_table.columns, (source, target, distance, heading, facing,
                                                       distance), strict=True))  # fmt: skip
    brain.map.links_table.replace(**{k: torch.from_numpy(v) for k, v in columns.items()})
    brain.map.state.current = n - 1
    brain.sessions.sessions.append(Session(seed))
    return brain


def meeting(n: int) -> Match:
    """Five places in a row: the last of one map are the first of the other."""
    places = np.arange(5)
    pairs = Pairs(n - 5 + places, places, np.zeros(5), np.zeros(5))
    return Match(4, n - 1, others=pairs.pick(slice(-1)))


def rows() -> list[Row]:
    found = []
    for n in SIZES:
        one, other, match = mapped(n, 1), mapped(n, 2), meeting(n)
        merged, report = one.merge(other, match)
        assert merged is not None, report.reason
        ms = cpu_ms(lambda one=one, other=other, match=match: one.merge(other, match), 1, 5)
        target = "<= 500 ms" if n == TARGET else "linear"
        found.append(Row("merge of two maps", f"{n} places each", ms, target))
    rng = np.random.default_rng(3)
    brains = [mapped(2_500, seed) for seed in range(8)]
    views, maps = [one.view for one in brains], [one.map for one in brains]
    view = rng.integers(0, 256, (10, 60)) / 255.0
    for k in (1, 2, 4, 8):
        joined = StoredViews(views[:k], maps[:k])
        once = cpu_ms(lambda joined=joined: joined.search(view), 20)
        each = cpu_ms(lambda k=k: [one.search(view, 0.05) for one in views[:k]], 20)
        size = f"{k} stored maps of 2500 places"
        found.append(Row("a view among stored maps", size, once, "", f"one by one {written(each)}"))
    return found


@pytest.mark.parametrize("n", SIZES[:4])
def test_merge(benchmark, n):
    torch.set_num_threads(1)
    one, other, match = mapped(n, 1), mapped(n, 2), meeting(n)
    benchmark(one.merge, other, match)
