import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from neuroslam.cells.speed import (
    SpeedCellConfig,
    SpeedCells,
    acceleration,
    decode_speed,
    draw_tuning,
    fit_readout,
    speed_rates,
    speed_score,
)
from neuroslam.config import BrainConfig
from neuroslam.state.join import Join
from neuroslam.state.population import Correction
from neuroslam.types import Motion

CONFIG = SpeedCellConfig()
DT = 0.05


def tuning(config=CONFIG):
    return draw_tuning(config, torch.Generator().manual_seed(config.seed))


def run(cells, speeds, dt=DT):
    told, rates = [], []
    for speed in speeds:
        told.append(cells(Motion(speed, 0.0, dt)))
        rates.append(cells.rates)
    return np.array(told), np.array(rates)


def wander(seconds, dt, seed=0):
    """Speeds that change within some 0.4 s, as those of rats do, mean 0.6 m/s."""
    rough = np.random.default_rng(seed).normal(size=round(seconds / dt))
    smooth = gaussian_filter1d(rough, 0.4 / dt)
    return (0.6 + 0.2 * smooth / smooth.std()).clip(0.0)


def test_rates_rise_linearly_with_speed_and_then_no_more():
    speeds = torch.linspace(0.0, 2.0 * CONFIG.max_speed_m_s, 41, dtype=torch.float64)
    rates = speed_rates(speeds, torch.zeros_like(speeds), tuning(), CONFIG.max_speed_m_s)
    rise = rates.diff(dim=0)
    assert (rise[:20] > 0).all()
    assert (rise[:20] - rise[0]).abs().max() < 1e-12
    assert (rise[20:] == 0).all()


def test_rates_at_rest_and_at_the_top_are_within_their_bands():
    still, top = torch.tensor([0.0, CONFIG.max_speed_m_s], dtype=torch.float64)
    at_rest = speed_rates(still, still, tuning(), CONFIG.max_speed_m_s)
    at_top = speed_rates(top, still, tuning(), CONFIG.max_speed_m_s)
    for rates, (low, high) in ((at_rest, CONFIG.rest_hz), (at_top, CONFIG.top_hz)):
        assert low <= rates.min()
        assert rates.max() <= high
        assert rates.std() > 0.2 * (high - low)


@given(speed=st.floats(0.0, 2.0))
@settings(max_examples=50, deadline=None)
def test_the_readout_tells_the_speed_exactly(speed):
    rates = speed_rates(torch.tensor(speed, dtype=torch.float64), torch.tensor(0.0), tuning(), 2.0)
    assert decode_speed(rates, fit_readout(tuning(), 2.0)).item() == pytest.approx(speed, abs=1e-10)


def test_no_other_exact_readout_is_less_sensitive_to_noise():
    t = tuning()
    w = fit_readout(t, 2.0)
    assert (w @ t.rest_hz).item() == pytest.approx(0.0, abs=1e-10)
    assert (w @ t.slope_hz_s_m).item() == pytest.approx(1.0, abs=1e-10)
    # The smallest such vector lies in the plane of the two.
    plane = torch.stack([t.rest_hz, t.slope_hz_s_m], 1)
    assert (w - plane @ torch.linalg.lstsq(plane, w).solution).abs().max() < 1e-10


def test_a_steady_speed_is_told_whichever_way_the_animal_heads_or_backs():
    for motion in (Motion(0.7, 0.0, DT), Motion(0.7, 5.0, DT), Motion(-0.7, -1.0, DT)):
        cells = SpeedCells()
        for _ in range(40):
            cells.advance(motion)
        assert cells.speed_m_s == pytest.approx(0.7, abs=1e-9)


@given(rise=st.floats(-1.0, 1.0), dt=st.sampled_from([0.005, 0.02, 0.05, 0.1]))
@settings(max_examples=30, deadline=None)
def test_acceleration_of_a_steady_rise_is_the_rise_at_any_time_step(rise, dt):
    smoothed = torch.tensor(5.0, dtype=torch.float64)
    for k in range(1, round(1.0 / dt) + 1):
        speed = torch.tensor(5.0 + rise * k * dt, dtype=torch.float64)
        change, smoothed = acceleration(smoothed, speed, 0.05, dt)
    assert change.item() == pytest.approx(rise, abs=1e-6)


def test_while_the_animal_speeds_up_each_cell_runs_ahead_by_its_own_time():
    cells = SpeedCells()
    run(cells, 0.2 * DT * np.arange(1, 81))  # up to 0.8 m/s
    ahead = (cells.rates_hz - cells.rest_hz) / cells.slope_hz_s_m - 0.8
    torch.testing.assert_close(ahead / 0.2, cells.lead_s, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dt", [0.05, 0.01])
def test_the_population_anticipates_speed_by_50_to_80_ms(dt):
    """Prospective bias of 50 to 80 ms (Kropff et al. 2015)."""
    speeds = wander(200.0, dt)
    told, _ = run(SpeedCells(), speeds, dt)
    time = np.arange(len(speeds)) * dt
    at = np.arange(1.0, time[-1] - 1.0, 0.01)
    lags = np.arange(-0.1, 0.2, 0.005)
    fits = [
        np.corrcoef(CubicSpline(time, told)(at), CubicSpline(time, speeds)(at + lag))[0, 1]
        for lag in lags
    ]
    assert 0.049 < lags[int(np.argmax(fits))] < 0.081


def test_every_cell_is_a_speed_cell_and_noise_makes_it_a_worse_one():
    speeds = wander(200.0, DT)
    scores = []
    for noise_hz in (0.0, 5.0, 20.0):
        _, rates = run(SpeedCells(SpeedCellConfig(noise_hz=noise_hz)), speeds)
        scores.append(speed_score(rates, speeds))
    assert scores[0].min() > 0.98
    assert scores[0].mean() > scores[1].mean() > scores[2].mean() > 0.0


def test_the_noise_of_the_speed_told_is_that_of_the_readout():
    config = SpeedCellConfig(noise_hz=1.0, rest_hz=(10.0, 14.0))  # no rate is cut at 0
    cells = SpeedCells(config)
    told, _ = run(cells, np.full(4000, 1.0))
    analytic = config.noise_hz * cells.readout.norm().item()
    assert told[100:].std() == pytest.approx(analytic, rel=0.04)
    assert told[100:].mean() == pytest.approx(1.0, abs=4 * analytic / math.sqrt(3900))


def test_cells_are_determined_by_the_seed():
    one, same, other = (SpeedCells(SpeedCellConfig(noise_hz=2.0, seed=seed)) for seed in (3, 3, 4))
    speeds = wander(2.0, DT)
    assert np.array_equal(run(one, speeds)[1], run(same, speeds)[1])
    assert not np.array_equal(one.rest_hz, other.rest_hz)


def test_cells_that_are_saved_and_loaded_go_on_bit_for_bit():
    config = SpeedCellConfig(noise_hz=2.0)
    cells, copy = SpeedCells(config), SpeedCells(config.model_copy(update={"seed": 9}))
    run(cells, wander(2.0, DT))
    copy.load_state_dict({name: value.clone() for name, value in cells.state_dict().items()})
    speeds = wander(2.0, DT, seed=1)
    for one, other in zip(run(cells, speeds), run(copy, speeds), strict=True):
        assert np.array_equal(one, other)


def test_a_batch_is_its_animals_one_by_one():
    speeds = np.stack([wander(3.0, DT, seed) for seed in range(3)])
    together = SpeedCells(batch=3)
    for column in speeds.T:
        together.advance(Motion(torch.from_numpy(column), 0.0, DT))
    for row, rates, told in zip(speeds, together.rates, together.speed_m_s, strict=True):
        one = SpeedCells()
        run(one, row)
        assert np.allclose(one.rates, rates, rtol=0, atol=1e-12)
        assert told.item() == pytest.approx(one.speed_m_s, abs=1e-12)


def test_no_rate_is_negative_however_hard_the_animal_brakes():
    cells = SpeedCells(SpeedCellConfig(noise_hz=30.0))
    _, rates = run(cells, [1.9, 0.0, 1.9, 0.0] * 20)
    assert rates.min() >= 0.0


def test_a_first_frame_of_no_duration_is_no_acceleration():
    cells = SpeedCells()
    cells.advance(Motion(1.0, 0.0, 0.0))
    assert cells.speed_m_s == pytest.approx(1.0, abs=1e-9)


def test_gradients_flow_from_the_speed_told_to_the_speed():
    speed = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    rates = speed_rates(speed, torch.zeros_like(speed), tuning(), 2.0)
    decode_speed(rates, fit_readout(tuning(), 2.0)).backward()
    assert speed.grad.item() == pytest.approx(1.0)


def test_the_session_that_goes_on_keeps_its_cells():
    loaded, partial = (SpeedCells(SpeedCellConfig(seed=seed)).state_dict() for seed in (0, 1))
    merged = SpeedCells().merged(loaded, partial, Join.nothing())
    assert all(torch.equal(merged[name], value) for name, value in partial.items())


def test_corrections_of_others_mean_nothing_to_them():
    cells = SpeedCells()
    before = cells.state_dict()
    cells.follow(Correction(dx_m=1.0, turn_rad=1.0))
    assert all(torch.equal(before[name], value) for name, value in cells.state_dict().items())


def test_faults_of_a_state_are_told():
    state = {name: tensor.numpy() for name, tensor in SpeedCells().state_dict().items()}
    assert list(SpeedCells.faults(state, BrainConfig(), 0, 0)) == []
    wrong = state | {"rates_hz": -state["rates_hz"]}
    assert list(SpeedCells.faults(wrong, BrainConfig(), 0, 0)) == ["speed.rates_hz: negative"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"rest_hz": (5.0, 2.0)}, "expected 0 <= first <= second"),
        ({"rest_hz": (1.0, 20.0)}, "every rate to rise with speed"),
        ({"n": 1}, "greater than or equal to 2"),
    ],
)
def test_a_config_that_makes_no_speed_cells_is_refused(wrong, said):
    with pytest.raises(ValidationError, match=said):
        SpeedCellConfig(**wrong)
