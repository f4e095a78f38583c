import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells import grid
from neuroslam.cells.convolve import convolve_axes, gaussian_kernel
from neuroslam.cells.grid import (
    LAHNGridCells,
    LAHNWeights,
    lahn_drive,
    lahn_learn,
    lateral_kernel,
    sheet_of,
)
from neuroslam.cells.oscillators import (
    VelocityOscillators,
    decode_phases,
    restore_amplitude,
    turn_phases,
    wave_vectors,
)
from neuroslam.config import GridCellConfig
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import Bins, rate_map

CONFIG = GridCellConfig()
UNDEVELOPED = GridCellConfig(development_steps=0)
steps = st.tuples(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15))
walks = st.lists(steps, min_size=1, max_size=60)
seeds = st.integers(0, 10_000)


def tensor(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def moved(oscillators, walk):
    for step in walk:
        oscillators.shift(tensor(step))
    return oscillators


def phases_at(positions_m, config):
    n = len(positions_m)
    return VelocityOscillators(config, n).place_at(positions_m).detach()


def rate_maps(cells, config, side_m=2.4, n=72):
    """Rates of all cells on a grid of positions, each held till they settled."""
    middle = (torch.arange(n, dtype=torch.float64) + 0.5) * (side_m / n)
    at = torch.stack([middle.repeat(n), middle.repeat_interleave(n)], dim=-1)
    phases = phases_at(at, config)
    quiet = GridCellConfig(**{**config.model_dump(), "development_steps": 0})
    copy = LAHNGridCells(quiet, batch=n * n)
    kept = {name: v for name, v in cells.state_dict().items() if name != "rates"}
    copy.load_state_dict(kept, strict=False)
    with torch.no_grad():
        for _ in range(3):
            rates = copy(phases)
    return rates.permute(1, 2, 0).reshape(*rates.shape[1:], n, n).double().numpy()


def medians(cells, config):
    return np.median(gridness(rate_maps(cells, config)), axis=-1)


@pytest.fixture(scope="module")
def grown():
    return LAHNGridCells(CONFIG)


# Oscillators


@given(walk=walks)
@settings(max_examples=40, deadline=None)
def test_there_and_back_returns_the_phases(walk):
    oscillators = moved(VelocityOscillators(CONFIG), walk)
    moved(oscillators, [(-x, -y) for x, y in reversed(walk)])
    fresh = VelocityOscillators(CONFIG)
    torch.testing.assert_close(oscillators.phases, fresh.phases, rtol=0, atol=1e-11)
    torch.testing.assert_close(oscillators.position_m, fresh.position_m, rtol=0, atol=1e-12)


@given(walk=walks, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_a_closed_loop_closes_in_whatever_order_its_steps_are_taken(walk, seed):
    closed = [*walk, tuple(-np.sum(walk, axis=0))]
    order = np.random.default_rng(seed).permutation(len(closed))
    oscillators = moved(VelocityOscillators(CONFIG), [closed[i] for i in order])
    fresh = VelocityOscillators(CONFIG)
    torch.testing.assert_close(oscillators.phases, fresh.phases, rtol=0, atol=1e-11)


@given(walk=walks)
@settings(max_examples=40, deadline=None)
def test_the_phases_tell_the_position_of_any_walk_exactly(walk):
    oscillators = VelocityOscillators(CONFIG)
    where = torch.zeros(2, dtype=torch.float64)
    for step in walk:
        where = where + tensor(step)
        oscillators.shift(tensor(step))
    torch.testing.assert_close(oscillators.decode(), where, rtol=0, atol=1e-11)
    waves = oscillators.waves.detach()
    solver = torch.linalg.pinv(waves.flatten(0, 1))
    near = where + tensor([0.05, -0.05])  # a rough guess is enough, as long as no phase wraps
    torch.testing.assert_close(
        decode_phases(waves, solver, oscillators.phases, near), where, rtol=0, atol=1e-11
    )


@given(walk=walks)
@settings(max_examples=40, deadline=None)
def test_all_modules_agree_on_where_they_are(walk):
    oscillators = moved(VelocityOscillators(CONFIG), walk)
    waves = oscillators.waves.detach()
    where = oscillators.position_m
    for module in range(len(CONFIG.spacings_m)):
        one = waves[module : module + 1]
        solver = torch.linalg.pinv(one.flatten(0, 1))
        alone = decode_phases(one, solver, oscillators.phases[module : module + 1], where)
        torch.testing.assert_close(alone, where, rtol=0, atol=1e-11)


@given(walk=walks)
@settings(max_examples=20, deadline=None)
def test_walking_to_a_place_and_being_put_there_are_the_same(walk):
    walked = moved(VelocityOscillators(CONFIG), walk)
    put = VelocityOscillators(CONFIG)
    put.place_at(walked.position_m)
    torch.testing.assert_close(put.phases, walked.phases, rtol=0, atol=1e-11)


def test_the_amplitude_is_one_after_a_hundred_thousand_steps():
    oscillators = VelocityOscillators(CONFIG)
    waves, phases = oscillators.waves.detach(), oscillators.phases
    way = tensor([0.0, 0.0])
    with torch.inference_mode():
        for k in range(100_000):
            step = tensor([0.004 * math.cos(0.01 * k), 0.003])
            way = way + step
            phases = turn_phases(waves, step, phases)
    assert (phases.norm(dim=-1) - 1.0).abs().max() < 1e-9
    expected = VelocityOscillators(CONFIG)
    expected.place_at(way.clone())
    torch.testing.assert_close(phases, expected.phases, rtol=0, atol=1e-7)


@given(off=st.floats(-0.01, 0.01), turn=st.floats(-4.0, 4.0))
@settings(max_examples=40, deadline=None)
def test_a_wrong_amplitude_is_drawn_to_one_and_the_phase_stays(off, turn):
    phase = tensor([math.cos(turn), math.sin(turn)])
    drawn = restore_amplitude((1.0 + off) * phase)
    assert abs(drawn.norm().item() - 1.0) <= 2.0 * off * off + 1e-12
    torch.testing.assert_close(drawn / drawn.norm(), phase, rtol=0, atol=1e-12)


@given(velocity=steps, n=st.integers(2, 50))
@settings(max_examples=30, deadline=None)
def test_two_step_sizes_lead_to_the_same_phases(velocity, n):
    coarse, fine = VelocityOscillators(CONFIG), VelocityOscillators(CONFIG)
    coarse(tensor(velocity), 1.0)
    for _ in range(n):
        fine(tensor(velocity), 1.0 / n)
    torch.testing.assert_close(fine.phases, coarse.phases, rtol=0, atol=1e-11)


@given(velocity=steps)
@settings(max_examples=30, deadline=None)
def test_a_phase_turns_at_the_rate_k_times_v(velocity):
    oscillators, dt_s = VelocityOscillators(CONFIG), 0.01
    before = oscillators.phases.clone()
    after = oscillators(tensor(velocity), dt_s).detach()
    turned = torch.view_as_complex(after) * torch.view_as_complex(before).conj()
    expected = oscillators.waves.detach() @ tensor(velocity)
    torch.testing.assert_close(turned.angle() / dt_s, expected, rtol=0, atol=1e-10)


def test_waves_of_a_module_are_as_long_as_its_spacing_says_and_evenly_spread():
    waves = wave_vectors(tensor([0.5, 1.0]), tensor([0.0, 0.3]), 6)
    lengths = waves.norm(dim=-1)
    torch.testing.assert_close(
        lengths, (4 * math.pi / (math.sqrt(3) * tensor([0.5, 1.0])))[:, None].expand(2, 6)
    )
    assert waves.sum(1).abs().max() < 1e-12
    angle = torch.atan2(waves[..., 1], waves[..., 0])
    apart = (angle.diff(dim=1) - math.pi / 3).remainder(2 * math.pi)
    assert torch.minimum(apart, 2 * math.pi - apart).max() < 1e-12
    torch.testing.assert_close(angle[:, 0], tensor([0.0, 0.3]))


def test_animals_of_a_batch_move_as_if_alone():
    together = VelocityOscillators(CONFIG, 3)
    alone = [VelocityOscillators(CONFIG) for _ in range(3)]
    generator = torch.Generator().manual_seed(1)
    for _ in range(30):
        velocity = torch.randn(3, 2, generator=generator)
        together(velocity, 0.05)
        for row, one in enumerate(alone):
            one(velocity[row], 0.05)
    decoded = together.decode()
    for row, one in enumerate(alone):
        torch.testing.assert_close(together.phases[row], one.phases, rtol=0, atol=1e-11)
        torch.testing.assert_close(decoded[row], one.decode(), rtol=0, atol=1e-11)


def test_a_gradient_reaches_the_spacings_and_is_the_difference_quotient():
    oscillators, step = VelocityOscillators(CONFIG), tensor([0.1, 0.07])
    oscillators.shift(step)[..., 1].square().sum().backward()
    slopes, tiny = oscillators.spacing_m.grad.clone(), 1e-7

    def response(spacing):
        waves = wave_vectors(spacing, oscillators.orientation_rad, 6)
        start = torch.stack([torch.ones(4, 6), torch.zeros(4, 6)], -1).double()
        return turn_phases(waves, step, start)[..., 1].square().sum().item()

    for module in range(4):
        nudge = torch.zeros(4, dtype=torch.float64)
        nudge[module] = tiny
        spacing = oscillators.spacing_m.detach()
        quotient = (response(spacing + nudge) - response(spacing - nudge)) / (2 * tiny)
        assert slopes[module].item() == pytest.approx(quotient, rel=1e-5)


def test_a_changed_spacing_is_heeded_with_and_without_gradients():
    oscillators = VelocityOscillators(CONFIG)
    with torch.no_grad():
        oscillators.shift(tensor([0.1, 0.0]))
        oscillators.spacing_m *= 2.0
        oscillators.place_at(tensor([0.1, 0.2]))
    expected = turn_phases(
        wave_vectors(2.0 * tensor(CONFIG.spacings_m), oscillators.orientation_rad, 6),
        tensor([0.1, 0.2]),
        VelocityOscillators(CONFIG).phases,
    )
    torch.testing.assert_close(oscillators.phases, expected)


# The lateral anti-Hebbian network


def test_after_development_weights_are_unit_rows_and_inhibition_without_self(grown):
    q, w = grown.feedforward.detach(), grown.lateral.detach()
    assert q.shape == (4, 24, 12)
    torch.testing.assert_close(q.norm(dim=-1), torch.ones(4, 24), rtol=0, atol=1e-5)
    assert (w <= 0.0).all()
    assert (w < 0.0).any()
    assert w.diagonal(dim1=1, dim2=2).count_nonzero() == 0


def test_every_module_of_the_default_network_is_hexagonal(grown):
    assert (medians(grown, CONFIG) > 1.2).all()


def test_it_is_the_sixty_degrees_that_make_hexagons_not_the_learning(grown):
    six = medians(grown, CONFIG)
    for directions in (12, 36):
        config = GridCellConfig(directions=directions)
        other = medians(LAHNGridCells(config), config)
        assert (other < six - 0.25).all()
    twelve = GridCellConfig(directions=12)
    assert (medians(LAHNGridCells(twelve), twelve) < 0.5).all()


def test_cells_are_silent_at_the_share_of_places_that_the_config_says(grown):
    fires = (rate_maps(grown, CONFIG) > 0.0).mean((-1, -2))
    assert np.abs(fires - (1.0 - CONFIG.silent_fraction)).max() < 0.1


def grown_anew(config):
    """Cells that develop now, though others of this config did before."""
    grid._developed.clear()
    return LAHNGridCells(config)


def test_the_same_seed_grows_the_same_network_and_another_one_another():
    configs = [GridCellConfig(development_steps=50, seed=seed) for seed in (0, 0, 1)]
    first, again, other = (grown_anew(config) for config in configs)
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in first.state_dict().items())
    assert not torch.equal(first.feedforward, other.feedforward)
    torch.manual_seed(17)  # the generator of the process has no say
    assert torch.equal(grown_anew(configs[0]).feedforward, first.feedforward)


def test_two_networks_developed_alike_are_equal_and_independent():
    config = GridCellConfig(development_steps=50)
    first = grown_anew(config)
    before = {name: value.clone() for name, value in first.state_dict().items()}
    second = LAHNGridCells(config)
    second.develop(5)
    assert not torch.equal(second.feedforward, before["feedforward"])
    for cells in (first, LAHNGridCells(config)):
        assert all(torch.equal(v, before[name]) for name, v in cells.state_dict().items())
    assert LAHNGridCells(config, batch=2).rates.shape == (2, *first.rates.shape)


def test_development_in_two_parts_is_development_in_one():
    whole = LAHNGridCells(GridCellConfig(development_steps=40))
    parts = LAHNGridCells(GridCellConfig(development_steps=25))
    later = LAHNGridCells(GridCellConfig(development_steps=0))
    later.load_state_dict(parts.state_dict())
    later.develop(15)
    assert all(torch.equal(v, later.state_dict()[k]) for k, v in whole.state_dict().items())


def test_a_gradient_reaches_both_kinds_of_weights():
    cells, oscillators = LAHNGridCells(CONFIG), VelocityOscillators(CONFIG)
    cells(oscillators.shift(tensor([0.1, 0.05])).detach())
    assert cells.rates.count_nonzero() > 0
    cells(oscillators.shift(tensor([0.02, 0.0])).detach()).sum().backward()
    for weights in (cells.feedforward, cells.lateral):
        assert weights.grad.isfinite().all()
        assert weights.grad.count_nonzero() > 0


def test_a_gradient_goes_through_the_network_to_the_spacings():
    cells, oscillators = LAHNGridCells(CONFIG), VelocityOscillators(CONFIG)
    cells(oscillators.shift(tensor([0.1, 0.05]))).square().sum().backward()
    assert (oscillators.spacing_m.grad != 0.0).all()


@given(seed=seeds)
@settings(max_examples=25, deadline=None)
def test_the_drive_is_eq_12(seed):
    generator = torch.Generator().manual_seed(seed)
    x, r = (torch.randn(5, 2, n, generator=generator) for n in (4, 3))
    q, w = torch.randn(2, 3, 4, generator=generator), torch.randn(2, 3, 3, generator=generator)
    expected = torch.einsum("mij,smj->smi", q, x) + torch.einsum("mik,smk->smi", w, r)
    torch.testing.assert_close(lahn_drive(x, r, q, w), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(lahn_drive(x[0], r[0], q, w), expected[0], rtol=1e-4, atol=1e-5)


def test_a_step_of_learning_is_the_one_computed_by_hand():
    config = GridCellConfig(
        hebbian_rate=0.5, lateral_rate=0.1, threshold_rate=0.2, sparseness=0.1, silent_fraction=0.6
    )
    weights = LAHNWeights(
        tensor([[[1.0, 0.0], [0.0, 1.0]]]),
        tensor([[[0.0, -0.2], [-0.2, 0.0]]]),
        tensor([[0.5, 0.0]]),
        tensor([[2.0, 0.0]]),
    )
    x, drive = tensor([[[0.6, 0.8]]]), tensor([[[1.5, 2.0]]])
    learnt = lahn_learn(x, drive, weights, config)
    # s = [xi - theta]_+^2 = (1, 4); Qx = (0.6, 0.8)
    # row 0: q + 0.5 * 1 * (x - 0.6 q) = (1, 0.4);  row 1: q + 0.5 * 4 * (x - 0.8 q) = (1.2, 1.0)
    rows = tensor([[1.0, 0.4], [1.2, 1.0]])
    torch.testing.assert_close(learnt.feedforward[0], rows / rows.norm(dim=1, keepdim=True))
    # W - 0.1 (s s' - 0.01) off the diagonal: -0.2 - 0.1 (4 - 0.01) = -0.599
    torch.testing.assert_close(learnt.lateral[0], tensor([[0.0, -0.599], [-0.599, 0.0]]))
    # theta + 0.2 (s - 0.1); the bias by 0.2 (fires - 0.4), and only the second cell fires
    torch.testing.assert_close(learnt.threshold, tensor([[0.68, 0.78]]))
    torch.testing.assert_close(learnt.bias, tensor([[1.92, 0.12]]))


@given(seed=seeds, scale=st.floats(0.0, 3.0))
@settings(max_examples=25, deadline=None)
def test_any_step_of_learning_leaves_unit_rows_and_inhibition(seed, scale):
    generator = torch.Generator().manual_seed(seed)
    cells = LAHNGridCells(UNDEVELOPED)
    x = scale * torch.randn(4, 4, 12, generator=generator)
    cells.learn(x)
    q, w = cells.feedforward.detach(), cells.lateral.detach()
    torch.testing.assert_close(q.norm(dim=-1), torch.ones(4, 24), rtol=0, atol=1e-5)
    assert (w <= 0.0).all()
    assert w.diagonal(dim1=1, dim2=2).count_nonzero() == 0


def test_rates_follow_from_the_phases_and_the_rates_before(grown):
    cells = LAHNGridCells(UNDEVELOPED)
    cells.load_state_dict(grown.state_dict())
    oscillators = VelocityOscillators(CONFIG)
    q, w, _, bias = cells.weights
    before = cells.rates
    for _ in range(3):
        phases = oscillators.shift(tensor([0.03, 0.02])).detach()
        rates = cells(phases).detach()
        x = phases.flatten(-2).float()
        drive = (q @ x[..., None] + w @ before[..., None])[..., 0]
        torch.testing.assert_close(rates, (drive - bias).clamp_min(0.0).detach())
        before = rates
    assert rates.shape == (4, 24)
    torch.testing.assert_close(cells.rates, rates)


def test_animals_of_a_batch_have_the_rates_that_each_has_alone(grown):
    together = LAHNGridCells(UNDEVELOPED, batch=3)
    learnt = {k: v for k, v in grown.state_dict().items() if k != "rates"}
    together.load_state_dict(learnt, strict=False)
    alone = [LAHNGridCells(UNDEVELOPED) for _ in range(3)]
    for one in alone:
        one.load_state_dict(learnt, strict=False)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for _ in range(10):
            phases = phases_at(torch.rand(3, 2, generator=generator).double(), CONFIG)
            rates = together(phases)
            for row, one in enumerate(alone):
                torch.testing.assert_close(rates[row], one(phases[row]), rtol=1e-5, atol=1e-6)


def test_learning_goes_on_while_moving_only_where_the_config_says_so():
    for online in (False, True):
        cells = LAHNGridCells(GridCellConfig(development_steps=30, learns_online=online))
        before = cells.feedforward.detach().clone()
        with torch.no_grad():
            cells(VelocityOscillators(CONFIG).shift(tensor([0.1, 0.2])))
        assert torch.equal(before, cells.feedforward) != online


def test_learning_online_on_a_walk_keeps_the_hexagons(grown):
    config = GridCellConfig(learns_online=True, development_steps=0)
    cells, oscillators = LAHNGridCells(config), VelocityOscillators(config)
    cells.load_state_dict(grown.state_dict())
    rng = np.random.default_rng(5)
    heading = np.cumsum(rng.normal(0.0, 0.3, 6000))
    position = np.zeros(2)
    with torch.inference_mode():
        for angle in heading:
            step = 0.01 * np.array([math.cos(angle), math.sin(angle)])
            step = np.where(np.abs(position + step) > 1.0, -step, step)
            position = position + step
            cells(oscillators.shift(torch.from_numpy(step)))
    assert not torch.equal(cells.feedforward, grown.feedforward)
    assert (medians(cells, CONFIG) > 1.2).all()


def explored(config, steps):
    """Rates of a network along a walk in a square of 1.2 m, and the positions."""
    cells, oscillators = LAHNGridCells(config), VelocityOscillators(config)
    rng, at = np.random.default_rng(11), np.zeros(2)
    positions, rates, angle = np.empty((steps, 2)), [], 0.0
    with torch.inference_mode():
        for k in range(steps):
            angle += rng.normal(0.0, 0.3)
            step = 0.03 * np.array([math.cos(angle), math.sin(angle)])
            if (np.abs(at + step) > 0.6).any():
                angle += math.pi / 2
                step = np.zeros(2)
            at = positions[k] = at + step
            oscillators.shift(torch.from_numpy(step))
            rates.append(cells.rates_compiled(oscillators.phases.numpy()).flatten().copy())
    return positions, np.array(rates)


def test_random_weights_learn_grids_while_the_animal_explores_unless_they_learn_too_fast():
    def score(**settings):
        config = GridCellConfig(development_steps=0, spacings_m=(0.35, 0.46), **settings)
        positions, rates = explored(config, 4000)
        maps = rate_map(positions, rates, Bins.around(np.array([[-0.6, -0.6], [0.6, 0.6]])))
        return np.median(gridness(maps))

    slow = score(learns_online=True)
    assert slow > 1.0
    assert slow > score() + 0.15  # what their random mixtures of six waves score
    assert slow > score(learns_online=True, online_share=1.0) + 0.15  # its fields wander


@given(n_cells=st.integers(1, 30), seed=seeds)
@settings(max_examples=40, deadline=None)
def test_the_lateral_kernel_is_a_convolution_on_the_sheet_that_excites_as_much_as_it_inhibits(
    n_cells, seed
):
    config = GridCellConfig(n_cells=n_cells, excitation=1.5, inhibition=0.5)
    rates = torch.rand(n_cells, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    sheet, odd = sheet_of(n_cells), [n - 1 + n % 2 for n in sheet_of(n_cells)]
    near, far = (
        convolve_axes(rates.reshape(sheet), [gaussian_kernel(size, std) for size in sizes])
        for sizes, std in (([min(5, n) for n in odd], 1.0), (odd, 2.0))
    )
    kernel = lateral_kernel(config)
    torch.testing.assert_close(kernel @ rates, (1.5 * near - 0.5 * far).flatten())
    torch.testing.assert_close(kernel.sum(1), torch.ones(n_cells, dtype=torch.float64))


@pytest.mark.parametrize("lateral", ["kernel", "both"])
def test_with_a_kernel_neighbours_on_the_sheet_fire_alike_and_fields_stay_hexagonal(lateral, grown):
    config = GridCellConfig(lateral=lateral)
    cells = LAHNGridCells(config)
    assert (medians(cells, config) > medians(grown, CONFIG) - 0.02).all()
    rows, columns = sheet_of(config.n_cells)
    apart = np.zeros((rows, columns, rows, columns), int)
    for axis, n in ((0, rows), (1, columns)):
        away = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        apart += np.expand_dims(np.minimum(away, n - away), (1, 3) if axis == 0 else (0, 2))
    apart = apart.reshape(config.n_cells, -1)
    positions = 4.0 * torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)).double()
    phases = phases_at(positions, CONFIG)
    alike = {}
    for name, network in (("kernel", cells), ("learned", grown)):
        with torch.no_grad():
            drive = phases.flatten(-2).float().unsqueeze(-2) @ network.feedforward.mT
            rates = (drive.squeeze(-2) - network.bias).clamp_min(0.0).numpy()
        maps = [np.corrcoef(rates[:, m].T) for m in range(len(config.spacings_m))]
        alike[name] = min(m[apart == 1].mean() - m[apart >= 3].mean() for m in maps)
    assert alike["kernel"] > 0.4
    assert alike["learned"] < 0.2
