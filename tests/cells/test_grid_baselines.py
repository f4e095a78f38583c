"""The two published grid-cell models that ours are compared with."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import functional_call

from neuroslam.cells.convolve import circular_convolve, fourier_convolve
from neuroslam.cells.interference import OscillatoryInterference, interference, lattice_waves
from neuroslam.cells.sheet import (
    GridSheet,
    SheetParameters,
    calibrated_gains,
    pattern_shift,
    pattern_waves,
    sheet_step,
    sheet_weights,
)
from neuroslam.errors import ConfigError, MapError
from neuroslam.evaluation.gridness import grid_stats, gridness
from neuroslam.evaluation.ratemap import Bins, rate_map

THETA_S = 0.125  # one cycle of 8 Hz: theta is back at the phase it had
WAYS = [(3, "product"), (3, "sum"), (6, "product"), (6, "sum")]
MODELS = [
    lambda batch=None: OscillatoryInterference([0.3, 0.5], n_cells=8, batch=batch),
    lambda batch=None: GridSheet(0.4, n_cells=16, batch=batch),
]
IDS = ["interference", "sheet"]


def at(distance, angle):
    return torch.tensor([distance * math.cos(angle), distance * math.sin(angle)])


def wander(n, seed=0, speed_m_s=0.3):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.0, 0.3, n))
    return torch.from_numpy(speed_m_s * np.column_stack([np.cos(heading), np.sin(heading)]))


def transported(sheet, velocity, seconds, dt_s=0.05):
    """Distance in metres by which the pattern is carried, x and y of the arena if unturned."""
    total = torch.zeros(2, dtype=torch.float64)
    for _ in range(round(seconds / dt_s)):
        before = sheet.sheet
        sheet(velocity, dt_s)
        total = total + sheet.spacing_m * pattern_shift(before, sheet.sheet)
    return total


@pytest.mark.parametrize(("directions", "combine"), WAYS)
@pytest.mark.parametrize("theta_hz", [8.0, None])
def test_interference_repeats_at_its_spacing_along_three_axes(directions, combine, theta_hz):
    cells = OscillatoryInterference(
        [0.47], directions=directions, combine=combine, theta_hz=theta_hz, orientations_rad=[0.2]
    )
    cells(torch.tensor([0.8, -0.5]), THETA_S)
    here = cells.rates
    for axis in range(6):
        angle = 0.2 + axis * math.pi / 3
        there = cells(at(0.47 / THETA_S, angle), THETA_S)
        torch.testing.assert_close(there, here, atol=1e-6, rtol=0)
    between = cells(at(0.47 / 2 / THETA_S, 0.2), THETA_S)
    assert (between - here).abs().max() > 0.05


@pytest.mark.parametrize(("directions", "combine"), WAYS)
def test_every_cell_has_the_same_field_elsewhere_and_is_silent_far_from_it(directions, combine):
    n = 24
    side = torch.arange(n) / n
    places = side[:, None, None] * at(1.0, 0.2) + side[:, None] * at(1.0, 0.2 + math.pi / 3)
    cells = OscillatoryInterference(
        [1.0],
        directions=directions,
        combine=combine,
        theta_hz=None,
        orientations_rad=[0.2],
        batch=n * n,
    )
    rates = cells(places.reshape(-1, 2) / THETA_S, THETA_S)
    peaks = rates.amax(0)
    in_field = (rates > 0.5 * peaks).double().mean(0)
    assert rates.min() >= 0.0
    assert peaks.max() / peaks.min() < 1.1
    assert in_field.min() > 0.02
    assert in_field.max() < 0.3


@given(
    path=st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=6),
)
@settings(max_examples=30, deadline=None)
def test_there_and_back_returns_the_rates_of_interference(path):
    cells = OscillatoryInterference([0.35, 0.6], n_cells=6)
    start = cells.rates
    way = torch.tensor(path, dtype=torch.float64)
    for velocity in torch.cat([way, -way.flip(0)]):
        cells(velocity, THETA_S)
    torch.testing.assert_close(cells.rates, start, atol=1e-9, rtol=0)


def test_oscillator_phases_advance_by_the_distance_along_their_direction():
    cells = OscillatoryInterference([0.5], orientations_rad=[0.0])
    for _ in range(8):
        cells(torch.tensor([0.0, 0.1]), 0.05)  # 4 cm along the second wave vector
    wave_number = 4 * math.pi / (math.sqrt(3) * 0.5)
    torch.testing.assert_close(cells.phase_rad[0, 1].item(), 0.04 * wave_number)
    torch.testing.assert_close(cells.phase_rad[0, 0].item(), 0.02 * wave_number)
    assert cells.theta_rad.item() == pytest.approx((0.4 * 8 % 1) * 2 * math.pi)


def test_the_mean_rate_is_that_of_a_theta_cycle():
    slow = OscillatoryInterference([0.5])
    mean = OscillatoryInterference([0.5], theta_hz=None)
    here = torch.tensor([1.0, 0.4])
    slow(here, THETA_S)
    mean(here, THETA_S)
    still = torch.zeros(2)
    cycle = torch.stack([slow(still, THETA_S / 100) for _ in range(100)]).mean(0)
    torch.testing.assert_close(cycle, mean.rates, atol=2e-3, rtol=0)


@pytest.mark.parametrize("combine", ["product", "sum"])
def test_gradients_reach_spacing_and_velocity(combine):
    cells = OscillatoryInterference([0.3, 0.5], combine=combine, theta_hz=None)
    spacings = torch.tensor([0.3, 0.5], dtype=torch.float64, requires_grad=True)
    velocity = torch.tensor([0.4, 0.3], dtype=torch.float64, requires_grad=True)

    def mean_square(spacings, velocity):
        cells.reset()
        rates = functional_call(cells, {"spacings_m": spacings}, (velocity, 0.3))
        return (rates**2).sum()

    assert torch.autograd.gradcheck(mean_square, (spacings, velocity))
    mean_square(spacings, velocity).backward()
    assert (spacings.grad.abs() > 1e-3).all()


def test_three_waves_and_their_opposites_close():
    waves = lattice_waves(torch.tensor(0.3, dtype=torch.float64), 6)
    torch.testing.assert_close(waves.sum(0), torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(waves[:3], -waves[3:])
    torch.testing.assert_close(waves[0] + waves[2], waves[1])


def test_interference_is_strongest_in_phase_and_never_negative():
    phases = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 6.28
    for combine in ("product", "sum"):
        rates = interference(phases, torch.zeros(500), combine, 0.0)
        assert rates.min() >= 0.0
        assert rates.max() <= 1.0


@pytest.fixture(scope="module")
def sheet():
    return GridSheet(0.4)


def test_noise_settles_into_hexagons(sheet):
    for seed in range(3):
        sheet.reset(torch.Generator().manual_seed(seed))
        waves = pattern_waves(sheet.sheet).abs()
        assert waves.min() > 0.7
        assert waves.max() - waves.min() < 0.01


def test_the_sheets_convolution_is_the_pose_cells_moved_by_the_shift():
    """A layer's weights are two separable Gaussians, wrapped; here moved by one whole cell."""
    p = SheetParameters(n_y=24, n_x=28, shift=2.0 / 28)
    steepness = 2 * math.log(p.surround) * p.surround / (p.surround - 1)
    beta = 4 * math.pi**2 / 3 / steepness

    def gaussian(width):
        factors = [torch.ones(1, dtype=torch.float64)]
        for n, size in ((p.n_y, math.sqrt(3)), (p.n_x, 2.0)):
            r = (torch.arange(4 * n + 1, dtype=torch.float64) - 2 * n) * size / n
            factors.append(torch.exp(-width * r**2))
        return tuple(factors)

    generator = torch.Generator().manual_seed(0)
    activity = torch.rand(1, p.n_y, p.n_x, generator=generator, dtype=torch.float64)
    missing = circular_convolve(activity, gaussian(p.surround * beta), "window")
    arrived = missing - circular_convolve(activity, gaussian(beta), "window")
    cell_area = 2.0 * math.sqrt(3) / (p.n_x * p.n_y)
    wanted = 0.25 * p.strength * 13**2 * beta / 3 * cell_area * arrived[0]
    for layer, (move, axis) in enumerate([(1, -1), (-1, -1)]):
        found = fourier_convolve(activity, sheet_weights(p)[[layer]])
        torch.testing.assert_close(found, wanted.roll(move, axis), rtol=1e-9, atol=1e-9)


def test_gains_are_equal_along_x_and_y():
    x, y = calibrated_gains(SheetParameters())
    assert x == pytest.approx(y, rel=0.01)


def test_the_pattern_moves_as_far_as_the_animal_at_every_speed_and_in_every_direction():
    speeds = torch.tensor([0.05, 0.1, 0.3, 0.5, 1.0])
    headings = torch.tensor([0.0, 0.5, 1.0, 2.0]) * math.pi / 2
    velocity = torch.stack(
        [torch.outer(headings.cos(), speeds), torch.outer(headings.sin(), speeds)], dim=-1
    ).reshape(-1, 2)
    sheet = GridSheet(0.4, batch=len(velocity))
    transported(sheet, velocity, 0.5)
    found = transported(sheet, velocity, 1.0)
    miss = (found - velocity).norm(dim=-1) / velocity.norm(dim=-1)
    assert miss.max() < 0.05
    assert miss[velocity.norm(dim=-1) > 0.2].max() < 0.02


def test_the_pattern_stays_where_it_is_while_the_animal_does(sheet):
    sheet.reset()
    transported(sheet, torch.zeros(2), 1.0)
    assert transported(sheet, torch.zeros(2), 20.0).norm() < 0.002
    settled = sheet.sheet
    sheet(torch.zeros(2), 0.05)
    torch.testing.assert_close(sheet.sheet, settled, atol=1e-4, rtol=0)


def test_a_sheet_is_back_where_it_was_after_one_spacing_along_its_axis():
    sheet = GridSheet(0.4, orientation_rad=0.3)
    sheet(torch.zeros(2), 1.0)
    start = sheet.sheet
    for _ in range(20):
        sheet(at(0.4, 0.3), 0.05)
    for _ in range(4):
        sheet(torch.zeros(2), 0.05)
    moved = 0.4 * pattern_shift(start, sheet.sheet)  # modulo a period
    assert moved.norm() < 0.01


def test_activity_of_a_sheet_is_bounded_and_it_lags_above_its_top_speed():
    sheet = GridSheet(0.3)
    start = sheet.sheet.sum().item()
    assert 2.0 < sheet.fastest_m_s < 5.0
    for speed in (0.5, sheet.fastest_m_s, 100.0):
        for velocity in wander(20, speed_m_s=speed):
            rates = sheet(velocity, 0.05)
            assert rates.min() >= 0.0
            assert rates.max() < 1.0
            assert sheet.sheet.sum().item() == pytest.approx(start, rel=0.1)
        assert pattern_waves(sheet.sheet).abs().min() > 0.5


def test_steps_of_any_length_carry_the_pattern_as_far():
    ends = []
    for dt_s in (0.01, 0.02, 0.1):
        sheet = GridSheet(0.4)
        start = sheet.sheet
        for _ in range(round(0.4 / dt_s)):
            sheet(torch.tensor([0.2, 0.1]), dt_s)
        ends.append(0.4 * pattern_shift(start, sheet.sheet))
    torch.testing.assert_close(ends[0], ends[1], atol=5e-4, rtol=0)
    torch.testing.assert_close(ends[0], ends[2], atol=5e-4, rtol=0)


def test_gradients_flow_through_a_sheets_step():
    p = SheetParameters(n_y=24, n_x=28)
    generator = torch.Generator().manual_seed(0)
    rates = torch.rand(4, 24, 28, generator=generator, dtype=torch.float64) * 0.01
    rates.requires_grad_()
    drive = torch.tensor([0.1, -0.05], dtype=torch.float64, requires_grad=True)

    def step(rates, drive):
        return sheet_step(rates, drive, sheet_weights(p), 0.2)

    assert torch.autograd.gradcheck(step, (rates, drive), fast_mode=True)


@pytest.mark.parametrize("make", MODELS, ids=IDS)
def test_a_batch_is_its_animals_one_by_one(make):
    walks = torch.stack([wander(12, seed) for seed in range(3)], dim=1)
    together = make(3)
    alone = [make() for _ in range(3)]
    for velocities in walks:
        rates = together(velocities, 0.05)
        singles = torch.stack([m(v, 0.05) for m, v in zip(alone, velocities, strict=True)])
        torch.testing.assert_close(rates, singles, atol=1e-5, rtol=0)


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("make", MODELS, ids=IDS)
def test_a_state_dict_restores_every_bit(make, batch):
    cells, copy = make(batch), make(batch)
    walk = wander(10) if batch is None else torch.stack([wander(10), wander(10, 1)], dim=1)
    for velocity in walk:
        cells(velocity, 0.05)
    copy.load_state_dict(cells.state_dict())
    assert torch.equal(copy.rates, cells.rates)
    for velocity in walk:
        assert torch.equal(cells(velocity, 0.05), copy(velocity, 0.05))
    for each in (cells, copy):
        each.reset()
    assert torch.equal(copy.rates, cells.rates)
    assert torch.equal(copy.rates, make(batch).rates)


@pytest.mark.parametrize("make", MODELS, ids=IDS)
def test_a_step_replaces_the_state_and_a_change_of_type_keeps_it(make):
    cells = make()
    before = cells.rates
    kept = before.clone()
    cells(torch.tensor([0.3, 0.1]), 0.05)
    assert torch.equal(before, kept)
    rates = cells.rates
    double = cells.double()
    torch.testing.assert_close(double.rates, rates.double())
    assert double(torch.tensor([0.3, 0.1]), 0.05).dtype == torch.float64


def test_cells_differ_by_their_generator_alone():
    for make in (
        lambda seed: OscillatoryInterference(generator=torch.Generator().manual_seed(seed)),
        lambda seed: GridSheet(generator=torch.Generator().manual_seed(seed)),
    ):
        first, again, other = make(1).rates, make(1).rates, make(2).rates
        assert torch.equal(first, again)
        assert not torch.equal(first, other)


@pytest.mark.parametrize("make", MODELS, ids=IDS)
def test_steps_that_cannot_be_made_are_named_and_leave_the_state(make):
    cells, batch = make(), make(2)
    before = cells.rates
    with pytest.raises(MapError, match=r"has shape \(3,\), expected \(2,\): x and y"):
        cells(torch.zeros(3), 0.05)
    with pytest.raises(MapError, match=r"expected \(2, 2\): x and y, a row for each animal"):
        batch(torch.zeros(2), 0.05)
    with pytest.raises(MapError, match=r"velocity_m_s is \[nan, 0.0\]; expected finite"):
        cells(torch.tensor([math.nan, 0.0]), 0.05)
    with pytest.raises(MapError, match=r"dt_s is -1.0; expected"):
        cells(torch.zeros(2), -1.0)
    assert torch.equal(cells.rates, before)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: OscillatoryInterference([0.3, -1.0]), r"spacings_m is \[0.3, -1.0\]; expected"),
        (lambda: OscillatoryInterference(directions=4), "directions is 4; expected 3 or 6"),
        (lambda: OscillatoryInterference(combine="max"), "'max'; expected product or sum"),
        (lambda: OscillatoryInterference(orientations_rad=[0.0]), "expected 4 of them"),
        (lambda: OscillatoryInterference(threshold=1.0), "threshold is 1.0; expected"),
        (lambda: GridSheet(0.0), "GridSheet: spacing_m is 0.0; expected a positive number"),
        (lambda: GridSheet(n_cells=0), "n_cells is 0; expected 1 to 2688"),
        (lambda: SheetParameters(n_x=8), r"n_x is 8; expected a number in \[24, inf\]"),
        (lambda: SheetParameters(substep=0.5), r"substep is 0.5; expected"),
        (
            lambda: GridSheet(parameters=SheetParameters(strength=1.0, shift=0.2)),
            "no hexagons grew.*raise strength or lower shift",
        ),
    ],
)
def test_wrong_values_are_named(make, said):
    with pytest.raises(ConfigError, match=said):
        make()


def test_both_are_grids_on_the_walk_of_a_rat(shared):
    with np.load(shared / "data" / "rodent" / "hafting2005_circle2m.npz") as file:
        times, track = file["t"], file["pos"]
    clock = np.arange(times[0], times[0] + 300.0, 0.1)
    track = np.column_stack([np.interp(clock, times, axis) for axis in track.T])
    velocities = torch.from_numpy(np.diff(track, axis=0) / 0.1)
    oscillators = OscillatoryInterference([0.5], 6, orientations_rad=[0.1], theta_hz=None)
    sheet = GridSheet(0.5, 6, orientation_rad=0.1)
    with torch.inference_mode():
        for cells in (oscillators, sheet):
            rates = np.stack([cells(velocity, 0.1).numpy() for velocity in velocities])
            maps = rate_map(track[1:], rates, Bins.around(track))
            assert gridness(maps).min() > 0.9  # five minutes leave gaps
            stats = grid_stats(maps[0], bin_m=0.025)
            assert stats.spacing_m == pytest.approx(0.5, rel=0.04)
            assert stats.orientation_rad == pytest.approx(0.1, abs=0.05)
