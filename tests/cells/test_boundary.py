import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells.boundary import (
    ATTENUATION,
    GROWTH,
    INHIBITION,
    BoundaryCells,
    boundary_activity,
    boundary_tuning,
    boundary_zone,
    check_walls,
)
from neuroslam.config import BoundaryCellConfig
from neuroslam.errors import BadFrame

REACH_M, RATE = 0.3, 0.8
CONFIG = BoundaryCellConfig()
distances = st.floats(0.0, 2.0)
bearings = st.floats(-math.pi, math.pi)
shares = st.floats(0.0, 1.0)


def tensor(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def tuned(distance_m, bearing_rad, config=CONFIG):
    n, m = config.n_bearings, config.n_distances
    return boundary_tuning(
        tensor(*distance_m),
        tensor(*bearing_rad),
        torch.arange(1, m + 1, dtype=torch.float64) * config.reach_m / (m + 1),
        torch.arange(n, dtype=torch.float64) * 2 * math.pi / n,
        tensor(config.sigma_m)[0],
        tensor(config.beta_m)[0],
        tensor(config.sigma_bearing_rad)[0],
    )


def held(activity, distance_m, seconds, steps):
    for _ in range(steps):
        activity = boundary_activity(activity, tensor(distance_m), REACH_M, RATE, seconds / steps)
    return activity


@given(distance_m=distances, reach_m=st.floats(0.01, 1.0))
@settings(max_examples=100, deadline=None)
def test_every_distance_is_in_the_zone_of_eq_1(distance_m, reach_m):
    if distance_m > reach_m:
        expected = INHIBITION
    elif distance_m > reach_m / 2:
        expected = ATTENUATION
    else:
        expected = GROWTH
    assert boundary_zone(tensor(distance_m), reach_m).item() == expected


def test_zones_end_where_eq_1_says_and_no_wall_is_out_of_reach():
    zones = boundary_zone(tensor(0.0, 0.15, 0.1500001, 0.3, 0.3000001, math.inf), 0.3)
    assert zones.tolist() == [GROWTH, GROWTH, ATTENUATION, ATTENUATION, INHIBITION, INHIBITION]


@given(
    activity=shares, distance_m=distances, rate=st.floats(0.01, 50.0), dt_s=st.floats(0.0, 100.0)
)
@settings(max_examples=100, deadline=None)
def test_activity_grows_near_fades_farther_ends_beyond_and_stays_a_share(
    activity, distance_m, rate, dt_s
):
    after = boundary_activity(tensor(activity), tensor(distance_m), REACH_M, rate, dt_s).item()
    assert 0.0 <= after <= 1.0
    zone = boundary_zone(tensor(distance_m), REACH_M).item()
    if zone == INHIBITION:
        assert after == 0.0
    elif zone == GROWTH:
        assert after >= activity
    else:
        assert after <= activity


@given(activity=shares, distance_m=distances, seconds=st.floats(0.0, 3.0), n=st.integers(2, 40))
@settings(max_examples=60, deadline=None)
def test_activity_after_a_time_does_not_depend_on_the_steps_in_it(activity, distance_m, seconds, n):
    one, many = (held(tensor(activity), distance_m, seconds, steps) for steps in (1, n))
    torch.testing.assert_close(many, one, rtol=0, atol=1e-6)


def test_at_the_wall_activity_grows_at_the_full_rate_and_at_the_reach_it_rests():
    assert held(tensor(0.1), 0.0, 0.5, 1).item() == pytest.approx(0.1 + RATE * 0.5)
    assert held(tensor(0.7), REACH_M, 100.0, 1).item() == pytest.approx(0.7)


def test_the_printed_recursion_has_no_bound_and_ours_has():
    activity = held(tensor(0.0), 0.01, 3600.0, 720)
    assert activity.item() == 1.0
    assert held(activity, 0.2, 3600.0, 720).item() == 0.0


@given(near=st.integers(0, 6), k=st.integers(0, 23))
@settings(max_examples=60, deadline=None)
def test_a_cell_responds_most_and_with_one_to_the_wall_it_prefers(near, k):
    rates = tuned([CONFIG.reach_m * (near + 1) / 8], [2 * math.pi * k / 24])
    assert rates[k, near].item() == pytest.approx(1.0)
    assert rates.argmax().item() == 7 * k + near


@given(distance_m=distances, bearing=bearings, turn=st.integers(-50, 50))
@settings(max_examples=60, deadline=None)
def test_a_wall_turned_by_some_cells_turns_the_population(distance_m, bearing, turn):
    angle = turn * 2 * math.pi / CONFIG.n_bearings
    torch.testing.assert_close(
        tuned([distance_m], [bearing + angle]),
        tuned([distance_m], [bearing]).roll(turn, 0),
        rtol=0,
        atol=1e-9,
    )


@given(walls=st.lists(st.tuples(distances, bearings), max_size=5))
@settings(max_examples=60, deadline=None)
def test_the_walls_of_a_corner_add_in_any_order(walls):
    together = tuned([w[0] for w in walls], [w[1] for w in walls])
    apart = sum((tuned([r], [a]) for r, a in walls), torch.zeros_like(together))
    torch.testing.assert_close(together, apart)
    torch.testing.assert_close(
        together, tuned([w[0] for w in walls[::-1]], [w[1] for w in walls[::-1]])
    )


def test_cells_of_far_walls_are_tuned_more_widely_as_hartley_has_it():
    config = BoundaryCellConfig(n_bearings=3, n_distances=2)
    for cell, preferred in enumerate((0.1, 0.2)):
        sigma = config.sigma_m * (preferred / config.beta_m + 1.0)
        rate = tuned([preferred + sigma], [0.0], config)[0, cell].item()
        assert rate == pytest.approx(math.exp(-0.5))


def test_no_wall_and_a_wall_at_infinity_say_the_same():
    cells, others = BoundaryCells(CONFIG), BoundaryCells(CONFIG)
    none, far = torch.empty(0), torch.tensor([math.inf, math.inf])
    assert cells(none, none, 0.1).count_nonzero() == 0
    assert others(far, torch.zeros(2), 0.1).count_nonzero() == 0
    wall, bearing = torch.tensor([0.1]), torch.tensor([1.0])
    padded, angles = torch.tensor([0.1, math.inf]), torch.tensor([1.0, 0.0])
    torch.testing.assert_close(cells(wall, bearing, 0.5), others(padded, angles, 0.5))


@pytest.mark.parametrize("batch", [None, 3])
@pytest.mark.parametrize("name", ["sigma_m", "beta_m", "sigma_rad"])
def test_a_gradient_reaches_every_width_and_is_the_difference_quotient(batch, name):
    cells = BoundaryCells(CONFIG, batch).double()
    lead = () if batch is None else (batch,)
    wall = torch.full((*lead, 2), 0.12, dtype=torch.float64)
    angle = tensor(0.3, 2.0).expand(*lead, 2)

    def response():
        cells.rest()
        return cells(wall, angle, 1.0).square().sum()

    response().backward()
    width = getattr(cells, name)
    slope, step = width.grad.item(), 1e-6
    with torch.no_grad():
        width += step
        above = response()
        width -= 2 * step
        below = response()
    assert slope != 0.0
    assert slope == pytest.approx(((above - below) / (2 * step)).item(), rel=1e-5)


def test_gradients_stay_finite_where_there_is_no_wall():
    cells = BoundaryCells(CONFIG)
    cells(torch.tensor([0.1, math.inf]), torch.tensor([0.5, 0.0]), 1.0).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in cells.parameters())


def test_animals_of_a_batch_are_as_if_alone():
    together = BoundaryCells(CONFIG, batch=3)
    alone = [BoundaryCells(CONFIG) for _ in range(3)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        wall = 0.5 * torch.rand(3, 2, generator=generator)
        angle = 6.0 * torch.rand(3, 2, generator=generator)
        rates = together(wall, angle, 0.1)
        assert rates.shape == (3, 24, 7)
        for row, cells in enumerate(alone):
            torch.testing.assert_close(rates[row], cells(wall[row], angle[row], 0.1))
            torch.testing.assert_close(together.activity[row], cells.activity)


def test_activity_decays_to_rest_away_from_a_wall():
    cells, rested = BoundaryCells(CONFIG), BoundaryCells(CONFIG)
    for one in (cells, rested):
        one(torch.tensor([0.05]), torch.tensor([0.0]), 1.0)
    cells(torch.tensor([0.31]), torch.tensor([0.0]), 0.1)
    rested.rest()
    torch.testing.assert_close(cells.activity, rested.activity)
    torch.testing.assert_close(cells.rates, rested.rates)


@pytest.mark.parametrize(
    ("wall", "bearing", "complaint"),
    [
        ([-0.1], [0.0], r"walls: distance -0.1 m; expected 0 or more, inf for none"),
        ([0.1, math.nan], [0.0, 0.0], r"walls: distance nan m; expected 0 or more, inf for none"),
        ([-math.inf], [0.0], r"walls: distance -inf m; expected 0 or more"),
        ([0.1], [math.nan], r"walls: bearing nan rad; expected a finite number"),
        ([0.1, 0.2], [0.0, math.inf], r"walls: bearing inf rad; expected a finite number"),
        (
            [0.1, 0.2],
            [0.0],
            r"walls: distances have shape \(2,\), bearings \(1,\); expected the same",
        ),
    ],
)
def test_walls_that_cannot_be_are_refused_in_one_line_and_change_nothing(wall, bearing, complaint):
    cells = BoundaryCells(CONFIG)
    cells(torch.tensor([0.1]), torch.tensor([0.0]), 0.7)
    before = {name: value.clone() for name, value in cells.state_dict().items()}
    with pytest.raises(BadFrame, match=f"^{complaint}") as caught:
        cells(torch.tensor(wall), torch.tensor(bearing), 0.1)
    assert "\n" not in str(caught.value)
    after = cells.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


@given(walls=st.lists(st.tuples(st.floats(0.0, math.inf), bearings), max_size=4))
@settings(max_examples=40, deadline=None)
def test_walls_that_can_be_pass(walls):
    check_walls(tensor(*(w[0] for w in walls)), tensor(*(w[1] for w in walls)))
