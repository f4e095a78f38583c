import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import (
    FAR_M,
    NEIGHBOURS,
    CompetitiveHebbianPlaceCells,
    bump_of,
    excited,
    hebbian_step,
    place_response,
)
from neuroslam.config import GridCellConfig, PlaceCellConfig
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam

CONFIG = PlaceCellConfig()
FIRST_WINDOW = 32
seeds = st.integers(0, 10_000)


def strides(arena, minutes, seed=0, at_least_m=0.017, rate_hz=2.0):
    """A walk of which every step is long enough for the cells to compete anew."""
    walk = roam(named_arena(arena), minutes, np.random.default_rng(seed), rate_hz)
    kept = [walk.positions[0]]
    for position in walk.positions[1:]:
        if math.dist(position, kept[-1]) > at_least_m:
            kept.append(position)
    return torch.from_numpy(np.array(kept) - kept[0])


@pytest.fixture(scope="module")
def patterns():
    """Rates of the default grid cells at positions."""
    grid, oscillators = LAHNGridCells(GridCellConfig()), VelocityOscillators(GridCellConfig())

    @torch.no_grad()
    def rates(positions_m):
        grid.rates = torch.zeros_like(grid.rates)
        found = []
        for position in positions_m:
            found.append(grid(oscillators.place_at(position.clone())).flatten().clone())
        return torch.stack(found)

    return rates


def new_cells(config=CONFIG, batch=None):
    return CompetitiveHebbianPlaceCells(config, n_grid=96, batch=batch)


class AllCells:
    """The same network to the letter: every cell is asked, one after the other, in float64."""

    def __init__(self, config):
        self.config = config
        self.weights, self.centres, self.visits, self.time_s = [], [], [], []
        self.links, self.winner = set(), -1

    def step(self, grid, position, dt_s):
        c, grid = self.config, grid.double().numpy()
        grid = grid / np.linalg.norm(grid)
        away = np.array([math.dist(centre, position) for centre in self.centres])
        recruited = not len(away) or away.min() >= c.threshold_m
        if recruited:
            winner = len(self.centres)
            self.weights.append(grid)
            self.centres.append(tuple(position))
            self.visits.append(0)
            self.time_s.append(0.0)
        else:
            alike = np.maximum(np.stack(self.weights) @ grid, 0.0) ** c.power
            winner = int((alike * np.exp(-0.5 * (away / c.continuity_m) ** 2)).argmax())
        moved = (1 - c.hebbian_rate) * self.weights[winner] + c.hebbian_rate * grid
        self.weights[winner] = moved / np.linalg.norm(moved)
        if winner != self.winner:
            self.visits[winner] += 1
            if self.winner >= 0:
                self.links.add((min(winner, self.winner), max(winner, self.winner)))
        self.time_s[winner] += dt_s
        self.winner = winner
        return winner, recruited


@pytest.mark.parametrize(("arena", "minutes"), [("triangle", 16), ("pillar", 22)])
def test_every_winner_newcomer_visit_link_and_weight_is_that_of_a_network_without_shortcuts(
    patterns, arena, minutes
):
    walk = strides(arena, minutes, seed=3)
    grid = patterns(walk)
    cells, plain = new_cells(), AllCells(CONFIG)
    assert cells.capacity == 64
    for rates, position in zip(grid, walk, strict=True):
        response = cells(rates, position, 0.5)
        winner, recruited = plain.step(rates, position.tolist(), 0.5)
        assert (response.winner.item(), response.recruited.item()) == (winner, recruited)
    n = len(plain.centres)
    assert n == cells.n_cells.item()
    assert n > 2 * 64, "the tables grew more than once"
    np.testing.assert_allclose(cells.centres_m[0, :n], plain.centres)
    assert (cells.centres_m[0, n:] == FAR_M).all()
    np.testing.assert_array_equal(cells.visits[0, :n], plain.visits)
    cells.state_dict()  # what was learnt in the window is in the table then
    np.testing.assert_allclose(cells.weights[0, :n], np.stack(plain.weights), atol=1e-5)
    _, links = cells.graph()
    assert {tuple(link) for link in links.tolist()} <= plain.links
    if (cells.neighbours[0, :n] >= 0).sum(1).max() < NEIGHBOURS:
        assert {tuple(link) for link in links.tolist()} == plain.links
    time_s = cells.time_s[0, :n].clone()
    time_s[cells.winner] += cells.now.stay_s
    np.testing.assert_allclose(time_s, plain.time_s, atol=1e-9)


def test_after_a_long_walk_there_are_more_cells_than_the_window_and_all_is_sound(patterns):
    walk = strides("circle1m", 20, seed=1)
    cells, winners = new_cells(), []
    for rates, position in zip(patterns(walk), walk, strict=True):
        winners.append(cells(rates, position, 0.5).winner.item())
    cells.state_dict()
    n = cells.n_cells.item()
    centres, links = cells.graph()
    assert n > 2 * FIRST_WINDOW
    apart = torch.pdist(centres)
    assert apart.min() >= CONFIG.threshold_m - 1e-12
    to_nearest = torch.cdist(walk, centres).min(1).values
    assert to_nearest.max() < CONFIG.threshold_m
    torch.testing.assert_close(cells.weights[0, :n].norm(dim=1), torch.ones(n))
    changes = [pair for pair in itertools.pairwise(winners) if pair[0] != pair[1]]
    assert {tuple(link) for link in links.tolist()} <= {(min(p), max(p)) for p in changes}
    assert cells.visits.sum().item() == len(changes) + 1
    assert cells.time_s.sum().item() + cells.now.stay_s == pytest.approx(0.5 * len(walk))
    graph = cells.neighbours[0, :n]
    for start, row in enumerate(graph.tolist()):
        others = [end for end in row if end >= 0]
        assert len(others) == len(set(others))
        assert start not in others


def test_the_winner_lies_where_the_animal_is(patterns):
    walk = strides("square", 20, seed=4)
    cells = new_cells()
    far = []
    for rates, position in zip(patterns(walk), walk, strict=True):
        winner = cells(rates, position, 0.5).winner
        far.append((cells.centre_of(winner) - position).norm().item())
    assert np.median(far) < CONFIG.threshold_m
    assert max(far) < 3 * CONFIG.threshold_m


def test_responses_of_all_cells_peak_at_the_winner_and_at_one_where_it_was_recruited(patterns):
    walk = strides("triangle", 5, seed=5)
    cells = new_cells(PlaceCellConfig(hebbian_rate=0.0))
    grid = patterns(walk)
    for rates, position in zip(grid, walk, strict=True):
        response = cells(rates, position, 0.5)
        every = cells.responses(rates, position)
        assert every.shape == (cells.n_cells.item(),)
        assert every.argmax() == response.winner
        assert 0.0 <= every.min() <= every.max() <= 1.0 + 1e-4
        if response.recruited:
            assert every.max().item() == pytest.approx(1.0, abs=1e-4)
    alone = cells.responses(grid[-1])
    assert (alone >= every - 1e-6).all()  # continuity only takes away


def test_without_learning_cells_only_respond(patterns):
    walk = strides("triangle", 6, seed=6)
    grid = patterns(walk)
    cells = new_cells()
    for rates, position in zip(grid[:150], walk[:150], strict=True):
        cells(rates, position, 0.5)
    state = cells.state_dict()
    kept = {k: state[k].clone() for k in ("n_cells", "weights", "centres_m", "visits")}
    kept["neighbours"] = state["neighbours"].clone()
    no, winners = torch.tensor([False]), set()
    for rates, position in zip(grid[150:], walk[150:], strict=True):
        response = cells(rates, position, 0.5, learns=no)
        assert not response.recruited
        winners.add(response.winner.item())
    assert len(winners) > 5
    after = cells.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in kept.items())


def test_without_cells_and_learning_there_is_no_winner(patterns):
    cells = new_cells()
    walk = strides("triangle", 1)[:5]
    for rates, position in zip(patterns(walk), walk, strict=True):
        response = cells(rates, position, 0.5, learns=torch.tensor([False]))
        assert response.winner.item() == -1
    assert cells.n_cells.item() == 0
    assert cells.time_s.sum() == 0.0
    assert cells(patterns(walk)[0], walk[0] + 1.0, 0.5).winner.item() == 0


def test_an_animal_at_rest_keeps_its_winner_and_recruits_no_cell(patterns):
    walk = strides("triangle", 3, seed=8)
    cells = new_cells()
    for rates, position in zip(patterns(walk), walk, strict=True):
        last = cells(rates, position, 0.5)
    weights = cells.state_dict()["weights"].clone()
    for k in range(50):
        angle = torch.tensor([math.cos(k), math.sin(k)], dtype=torch.float64)
        response = cells(torch.rand(96), walk[-1] + 0.004 * angle, 0.5)
        assert response.winner == last.winner
        assert not response.changed
    assert torch.equal(cells.state_dict()["weights"], weights)
    assert cells.time_s.sum().item() + cells.now.stay_s == pytest.approx(0.5 * (len(walk) + 50))


def test_animals_of_a_batch_that_do_the_same_have_the_same_cells(patterns):
    walk = strides("triangle", 6, seed=9)
    together, alone = new_cells(batch=3), new_cells()
    for rates, position in zip(patterns(walk), walk, strict=True):
        many = together(rates.expand(3, -1), position.expand(3, 2), 0.5)
        one = alone(rates, position, 0.5)
        assert many.winner.tolist() == [one.winner.item()] * 3
        assert many.recruited.tolist() == [one.recruited.item()] * 3
        assert many.changed.tolist() == [one.changed.item()] * 3
    several, single = together.state_dict(), alone.state_dict()
    for name in ("weights", "centres_m", "visits", "time_s", "neighbours"):
        for row in range(3):
            torch.testing.assert_close(several[name][row], single[name][0])


def test_animals_of_a_batch_on_different_paths_are_as_if_alone(patterns):
    walks = [strides("triangle", 6, seed=seed) for seed in (10, 11)]
    n = min(map(len, walks))
    grids = [patterns(walk) for walk in walks]
    together, alone = new_cells(batch=2), [new_cells() for _ in walks]
    for k in range(n):
        many = together(torch.stack([g[k] for g in grids]), torch.stack([w[k] for w in walks]), 0.5)
        for row, one in enumerate(alone):
            said = one(grids[row][k], walks[row][k], 0.5)
            assert many.winner[row] == said.winner
            assert many.recruited[row] == said.recruited
    assert together.n_cells.tolist() == [one.n_cells.item() for one in alone]
    for row, one in enumerate(alone):
        for mine, its in zip(together.graph(row), one.graph(), strict=True):
            torch.testing.assert_close(mine, its)


@pytest.mark.parametrize("cut", [20, 200])
def test_saved_and_loaded_cells_continue_bit_for_bit(patterns, cut):
    walk = strides("triangle", 6, seed=12)
    grid = patterns(walk)
    whole, first, second = new_cells(), new_cells(), new_cells()
    for k in range(len(walk)):
        whole(grid[k], walk[k], 0.5)
        if k == cut:
            second.load_state_dict({n: v.clone() for n, v in first.state_dict().items()})
        (first if k < cut else second)(grid[k], walk[k], 0.5)
    ours, theirs = whole.state_dict(), second.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_reading_the_state_dict_does_not_change_the_path(patterns):
    walk = strides("triangle", 3, seed=13)
    quiet, watched = new_cells(), new_cells()
    for rates, position in zip(patterns(walk), walk, strict=True):
        quiet(rates, position, 0.5)
        watched(rates, position, 0.5)
        watched.state_dict()
        watched.responses(rates, position)
        watched.graph()
    ours, theirs = quiet.state_dict(), watched.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@given(seed=seeds, rate=st.floats(0.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_a_hebbian_step_keeps_unit_length_and_comes_nearer(seed, rate):
    generator = torch.Generator().manual_seed(seed)
    w, g = torch.nn.functional.normalize(
        torch.rand(2, 12, generator=generator, dtype=torch.float64), dim=-1
    )
    moved = hebbian_step(w, g, rate)
    assert moved.norm().item() == pytest.approx(1.0)
    assert (moved @ g).item() >= (w @ g).item() - 1e-12
    torch.testing.assert_close(hebbian_step(w, g, 0.0), w)
    torch.testing.assert_close(hebbian_step(w, g, 1.0), g)


@given(seed=seeds, power=st.floats(0.5, 80.0), sigma=st.floats(0.05, 1.0))
@settings(max_examples=40, deadline=None)
def test_a_response_falls_with_distance_and_mismatch(seed, power, sigma):
    generator = torch.Generator().manual_seed(seed)
    weights = torch.nn.functional.normalize(
        torch.randn(20, 8, generator=generator, dtype=torch.float64), dim=-1
    )
    near = torch.zeros(20, dtype=torch.float64)
    here = place_response(weights, near, weights[3], power, sigma)
    assert 0.0 <= here.min() <= here.max() <= 1.0 + 1e-9
    assert here.argmax() == 3
    farther = place_response(weights, near + sigma**2, weights[3], power, sigma)
    torch.testing.assert_close(farther, here * math.exp(-0.5))
    assert place_response(-weights[3:4], near[:1], weights[3], power, sigma).item() == 0.0


@given(seed=seeds, gain=st.floats(0.0, 5.0), inhibition=st.floats(0.0, 0.99))
@settings(max_examples=40, deadline=None)
def test_a_bump_has_sum_one_and_a_narrow_kernel_keeps_the_winner(seed, gain, inhibition):
    generator = torch.Generator().manual_seed(seed)
    response = torch.rand(12, generator=generator, dtype=torch.float64)
    centres = torch.rand(12, 2, generator=generator, dtype=torch.float64)
    narrow = excited(response, centres, gain, 1e-6)
    torch.testing.assert_close(narrow, (1.0 + gain) * response)
    bump = bump_of(excited(response, centres, gain, 0.2), inhibition)
    assert bump.min() >= 0.0
    assert bump.sum().item() == pytest.approx(1.0)
    alone = bump_of(narrow, 1.0 - 1e-12)
    assert alone.argmax() == response.argmax()
    assert alone.max().item() == pytest.approx(1.0)


def test_excitation_does_not_depend_on_the_order_or_the_place_of_the_cells():
    generator = torch.Generator().manual_seed(1)
    response = torch.rand(9, generator=generator, dtype=torch.float64)
    centres = torch.rand(9, 2, generator=generator, dtype=torch.float64)
    order = torch.randperm(9, generator=generator)
    once = excited(response, centres, 0.5, 0.1)
    torch.testing.assert_close(excited(response[order], centres[order], 0.5, 0.1), once[order])
    torch.testing.assert_close(excited(response, centres + 3.0, 0.5, 0.1), once)
    assert (once >= response).all()


def test_gradients_reach_the_responses_and_the_centres_through_the_kernel():
    response = torch.rand(5, dtype=torch.float64, requires_grad=True)
    centres = torch.rand(5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda p, x: bump_of(excited(p, x, 0.5, 0.3), 0.1), (response, centres)
    )


def test_the_bump_says_more_exactly_than_the_winner_where_the_animal_is(patterns):
    walk = strides("pentagon", 20, seed=4)
    grid, far, n_cells = patterns(walk), {}, set()
    for gain in (0.0, 0.5):
        cells = new_cells(PlaceCellConfig(power=10.0, excitation=gain))
        found = []
        for k, (rates, position) in enumerate(zip(grid, walk, strict=True)):
            winner = cells.centre_of(cells(rates, position, 0.5).winner)
            if k > len(walk) // 2:
                bump, centre = cells.bump(rates, position)
                assert bump.shape == (cells.n_cells.item(),)
                found.append([(x - position).norm().item() for x in (winner, centre)])
        far[gain] = np.mean(found, axis=0)
        n_cells.add(cells.n_cells.item())
    assert len(n_cells) == 1, "cells are recruited by distance, whatever the kernel"
    assert far[0.5][1] < 0.8 * far[0.5][0]
    assert far[0.5][1] < 0.95 * far[0.0][1]
