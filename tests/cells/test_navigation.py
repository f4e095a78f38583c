import math
from copy import deepcopy
from functools import lru_cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells.familiarity import Familiarity, felt_walls
from neuroslam.cells.navigation import NavigationCells
from neuroslam.config import BoundaryCellConfig, BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.types import Motion, Pose, ViewMatch
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import SenseNoise, sense

CONFIG = BrainConfig()
RATE_HZ = 10.0


def tensor(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


@lru_cache(maxsize=8)
def walk_in(arena, minutes, seed=0):
    return roam(named_arena(arena), minutes, np.random.default_rng([seed, 1]), RATE_HZ)


def live(cells, senses, start=0, stop=None):
    """Live through senses, one row for each animal; what the cells said, row by step."""
    arrays = (senses.speed_m_s, senses.heading_rad, senses.wall_m, senses.wall_bearing_rad)
    if cells.batch is None:
        arrays = [a[0] for a in arrays]
    speed, heading, wall_m, bearing = (torch.from_numpy(np.ascontiguousarray(a)) for a in arrays)
    lead = () if cells.batch is None else (slice(None),)
    said = []
    for k in range(start, len(senses.dt_s) if stop is None else stop):
        at = (*lead, k)
        here = cells(speed[at], heading[at], float(senses.dt_s[k]), wall_m[at], bearing[at])
        said.append([value.clone() for value in here])
    return [torch.stack(column, len(lead)) for column in zip(*said, strict=True)]


def rows_of(*several):
    """Senses of animals on different walks, side by side."""
    columns = ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad")
    joined = {name: np.concatenate([getattr(s, name) for s in several]) for name in columns}
    return several[0]._replace(**joined)


def one_of(senses, row):
    columns = ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad")
    return senses._replace(**{name: getattr(senses, name)[row : row + 1] for name in columns})


def rmse(positions, senses):
    truth = senses.position_m - senses.position_m[0]
    return float(np.sqrt(np.mean(np.sum((positions.numpy() - truth) ** 2, -1))))


def copied(cells):
    return {name: value.clone() for name, value in cells.state_dict().items()}


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if not torch.equal(ours[name], theirs[name])] == []


# A life


@pytest.mark.parametrize("arena", ["triangle", "pillar"])
def test_without_errors_the_position_is_exact_and_never_lost(arena):
    senses = sense(walk_in(arena, 1.5))
    cells = NavigationCells(CONFIG)
    positions, corrections, places, recruited, lost = live(cells, senses)
    truth = torch.from_numpy(senses.position_m - senses.position_m[0])
    torch.testing.assert_close(positions, truth, rtol=0, atol=1e-6)
    assert corrections.abs().max() < 1e-6
    assert not lost.any()
    assert recruited.sum() == cells.place.n_cells
    torch.testing.assert_close(cells.oscillators.decode(), positions[-1], rtol=0, atol=1e-9)
    centres, _ = cells.place.graph()
    away = (centres[places] - positions).norm(dim=-1)
    assert away.median() < 0.06
    assert away.max() < 0.15


def test_with_noise_the_walls_keep_it_nearer_than_self_motion_alone():
    senses = sense(walk_in("triangle", 3.0), SenseNoise(), range(2))
    with_walls = live(NavigationCells(CONFIG, batch=2), senses)[0]
    way, heading = senses.speed_m_s * senses.dt_s, senses.heading_rad
    alone = np.stack([way * np.cos(heading), way * np.sin(heading)], -1).cumsum(1)
    alone = torch.from_numpy(alone)
    assert rmse(with_walls, senses) < 0.75 * rmse(alone, senses)
    off = BrainConfig(wall_memory={"corrects": False})
    positions, corrections, *_ = live(NavigationCells(off, batch=2), senses, stop=200)
    assert corrections.count_nonzero() == 0
    torch.testing.assert_close(positions, alone[:, :200], rtol=0, atol=1e-9)


def test_two_runs_of_the_same_session_are_equal():
    senses = sense(walk_in("circle1m", 0.5), SenseNoise(), [3])
    first, again = NavigationCells(CONFIG), NavigationCells(CONFIG)
    torch.manual_seed(0)
    said = live(first, senses)
    torch.manual_seed(1)
    for ours, theirs in zip(said, live(again, senses), strict=True):
        assert torch.equal(ours, theirs)
    assert_same(first.state_dict(), again.state_dict())


@pytest.mark.parametrize("batch", [None, 3])
@pytest.mark.parametrize("cut", [1, 153])
def test_saved_and_loaded_cells_continue_bit_for_bit(batch, cut):
    senses = sense(walk_in("triangle", 0.5), SenseNoise(), range(batch or 1))
    whole, first, second = (NavigationCells(CONFIG, batch) for _ in range(3))
    said = live(whole, senses)
    live(first, senses, stop=cut)
    second.load_state_dict(copied(first))
    assert_same(first.state_dict(), second.state_dict())
    for ours, theirs in zip(said, live(second, senses, start=cut), strict=True):
        assert torch.equal(ours[cut:] if batch is None else ours[:, cut:], theirs)
    assert_same(whole.state_dict(), second.state_dict())


def test_animals_of_a_batch_with_the_same_input_are_equal():
    senses = sense(walk_in("triangle", 0.5), SenseNoise(), [4])
    together = live(NavigationCells(CONFIG, batch=3), rows_of(senses, senses, senses))
    alone = live(NavigationCells(CONFIG), senses)
    for many, one in zip(together, alone, strict=True):
        for row in range(3):
            torch.testing.assert_close(many[row], one, rtol=0, atol=1e-9)


def test_animals_of_a_batch_that_see_walls_at_the_same_times_are_as_if_alone():
    senses = sense(walk_in("triangle", 0.4), SenseNoise(), range(3))
    cells = NavigationCells(CONFIG, batch=3)
    together = live(cells, senses)
    for row in range(3):
        single = NavigationCells(CONFIG)
        alone = live(single, one_of(senses, row))
        torch.testing.assert_close(together[0][row], alone[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(together[1][row], alone[1], rtol=0, atol=1e-9)
        assert cells.walls.n_walls[row] == single.walls.n_walls[0]
        # Who competes when depends a little on the others, see CompetitiveHebbianPlaceCells.
        assert abs(int(cells.place.n_cells[row] - single.place.n_cells[0])) <= 4


def test_animals_of_a_batch_on_different_paths_stay_close_to_each_alone():
    senses = rows_of(
        *(sense(walk_in("triangle", 0.4, seed), SenseNoise(), [seed]) for seed in range(3))
    )
    together = live(NavigationCells(CONFIG, batch=3), senses)[0]
    for row in range(3):
        alone = live(NavigationCells(CONFIG), one_of(senses, row))[0]
        assert (together[row] - alone).norm(dim=-1).max() < 0.05


# Mistakes


@lru_cache
def lived(batch):
    """Cells that have lived for a while; to be copied, as to make them takes a second."""
    cells = NavigationCells(CONFIG, batch)
    live(cells, sense(walk_in("triangle", 0.3), SenseNoise(), range(batch or 1)))
    return cells


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({0: math.nan}, "motion: speed nan m/s"),
        ({0: math.inf}, "motion: speed inf m/s"),
        ({1: math.nan}, "heading nan rad; expected finite numbers"),
        ({2: -0.1}, "walls: distance -0.1 m; expected 0 or more, inf for none"),
        ({2: math.nan}, "walls: distance nan m"),
        ({3: math.nan}, "walls: bearing nan rad; expected a finite number"),
        ({3: math.inf}, "walls: bearing inf rad"),
    ],
)
def test_input_that_cannot_be_is_refused_and_changes_nothing(batch, change, complaint):
    cells = deepcopy(lived(batch))
    before = copied(cells)
    given_ = [tensor(0.1), tensor(0.2), tensor([0.1, 0.2]), tensor([0.0, 1.0])]
    if batch:
        given_ = [value.expand(batch, *value.shape).clone() for value in given_]
    for at, number in change.items():
        given_[at].view(-1)[-1] = number
    speed, heading, wall_m, bearing = given_
    with pytest.raises(BadFrame, match=complaint) as caught:
        cells(speed, heading, 0.1, wall_m, bearing)
    assert "\n" not in str(caught.value)
    assert_same(before, cells.state_dict())


def test_a_frame_that_cannot_be_is_refused_and_changes_nothing():
    cells = NavigationCells(CONFIG)
    cells.advance(Motion(0.1, 0.2, 0.1), None, np.array([[0.2, 0.1]]))
    before = copied(cells)
    for motion, compass, walls in (
        (Motion(math.nan, 0.0, 0.1), 0.0, None),
        (Motion(0.1, math.nan, 0.1), None, None),
        (Motion(0.1, 0.0, 0.1), math.nan, None),
        (Motion(0.1, 0.0, 0.1), 0.0, np.array([[0.2, 0.0], [-1.0, 0.0]])),
        (Motion(0.1, 0.0, 0.1), 0.0, np.array([[math.nan, 0.0], [0.1, 0.0]])),
        (Motion(0.1, 0.0, 0.1), None, np.array([[0.1, math.nan]])),
    ):
        with pytest.raises(BadFrame):
            cells.advance(motion, compass, walls)
        assert_same(before, cells.state_dict())


# Frames


def test_frames_equal_steps_and_walls_may_come_in_any_order():
    senses = sense(walk_in("triangle", 0.6), SenseNoise(), [2])
    steps, frames = NavigationCells(CONFIG), NavigationCells(CONFIG)
    expected = live(steps, senses)[0]
    for k, dt_s in enumerate(senses.dt_s.tolist()):
        walls = np.column_stack([senses.wall_m[0, k], senses.wall_bearing_rad[0, k]])
        walls = np.flipud(walls[np.isfinite(walls[:, 0])]).copy()
        motion = Motion(float(senses.speed_m_s[0, k]), 0.0, dt_s)
        frames.advance(motion, float(senses.heading_rad[0, k]), walls if len(walls) else None)
        x, y, theta = frames.pose
        assert (x, y) == pytest.approx(expected[k].tolist(), abs=1e-4)
        heading = senses.heading_rad[0, k] - frames.heading_error_rad
        assert math.cos(theta - heading) == pytest.approx(1.0)


def test_without_a_compass_turns_are_added_to_the_heading_of_the_start():
    cells = NavigationCells(CONFIG)
    start = math.radians(CONFIG.map.initial_heading_deg)
    for _ in range(8):
        cells.advance(Motion(0.1, math.pi / 4, 0.5), None, None)
    theta = cells.pose.theta_rad
    assert math.cos(theta - start - math.pi) == pytest.approx(1.0)


def view(number, is_new=False, turned=0.0):
    return ViewMatch(number, 0.0, turned, is_new)


def walked(cells, metres, heading=0.0):
    for _ in range(round(metres / 0.05)):
        cells.advance(Motion(0.1, 0.0, 0.5), heading, None)


@torch.inference_mode()
def test_a_near_view_corrects_a_little_and_a_single_far_view_corrects_nothing():
    cells = NavigationCells(CONFIG)
    cells.update_from_view(view(0, is_new=True))
    walked(cells, 0.5)
    cells.update_from_view(view(1, is_new=True))
    before = cells.pose
    assert not cells.update_from_view(view(0))
    assert 0.0 <= cells.pose.x_m < before.x_m
    assert not cells.vetoes(view(0))
    walked(cells, 3.0)
    before = cells.pose
    assert cells.vetoes(view(0))
    assert not cells.update_from_view(view(0))
    assert cells.pose == before


@torch.inference_mode()
def test_agreeing_views_relocalise_the_animal_where_they_were_learnt():
    cells = NavigationCells(CONFIG)
    for number in range(8):
        cells.update_from_view(view(number, is_new=True))
        walked(cells, 0.2)
    walked(cells, 4.0)
    went = [cells.update_from_view(view(k)) for k in range(CONFIG.sessions.confirm)]
    assert went == [False] * (CONFIG.sessions.confirm - 1) + [True]
    assert cells.pose.x_m == pytest.approx(0.2 * (CONFIG.sessions.confirm - 1), abs=0.2)
    torch.testing.assert_close(
        cells.oscillators.decode(), tensor([cells.pose.x_m, cells.pose.y_m]), rtol=0, atol=1e-9
    )


def test_relocalising_clears_doubt_and_keeps_what_was_learnt():
    cells = NavigationCells(CONFIG)
    live(cells, sense(walk_in("triangle", 1.0), SenseNoise()))
    n_cells, n_walls = cells.place.n_cells.clone(), cells.walls.n_walls.clone()
    cells.relocalise(Pose(0.3, -0.2, 1.0), 0.1)
    assert cells.oscillators.position_m.tolist() == [0.3, -0.2]
    assert cells.pose.theta_rad == pytest.approx(1.0)
    assert not cells.familiarity.lost.any()
    assert torch.equal(cells.place.n_cells, n_cells)
    assert torch.equal(cells.walls.n_walls, n_walls)
    variance = cells.walls.position_variance_m2[0]
    torch.testing.assert_close(variance, 0.01 * torch.eye(2, dtype=torch.float64))


# Being carried away


def carried(arena, n, before_min=4.0, after_min=1.0, far_m=0.5):
    """Senses of animals that are set down elsewhere, each after its own walk; and when."""
    cut, after = round(60 * before_min * RATE_HZ), round(60 * after_min * RATE_HZ)
    several = []
    for seed in range(100):
        walk = walk_in.__wrapped__(arena, before_min + 2 * after_min + 0.5, seed)
        away = np.hypot(*(walk.positions - walk.positions[cut - 1]).T)
        (far,) = np.nonzero(away[cut : len(away) - after] > far_m)
        if not len(far):
            continue
        kept = np.r_[0:cut, cut + far[0] : cut + far[0] + after]
        senses = sense(walk, SenseNoise(), [seed])
        cut_out = {
            name: getattr(senses, name)[:, kept]
            for name in ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad")
        }
        dt_s = np.full(len(kept), 1.0 / RATE_HZ)
        several.append(senses._replace(**cut_out, dt_s=dt_s))
        if len(several) == n:
            break
    return rows_of(*several), cut


def test_most_kidnapped_animals_notice_and_lost_ones_learn_nothing():
    several, (cut, _) = zip(*(carried(arena, 6) for arena in ("triangle", "circle1m")), strict=True)
    senses, n = rows_of(*several), 12
    cells = NavigationCells(CONFIG, batch=n)
    lost = live(cells, senses, stop=cut)[4]
    assert not lost.any(), "a false alarm"
    noticed = torch.full((n,), math.inf)
    was_lost = cells.familiarity.lost.clone()
    for k in range(cut, senses.dt_s.size):
        known = cells.place.n_cells.clone(), cells.walls.n_walls.clone()
        visits, felt = cells.place.visits.sum(1), cells.familiarity.felt_s.sum((1, 2, 3))
        *_, recruited, now_lost = live(cells, senses, start=k, stop=k + 1)
        assert not (recruited[:, 0] & was_lost).any()
        for before, then in zip(known, (cells.place.n_cells, cells.walls.n_walls), strict=True):
            assert torch.equal(before[was_lost], then[was_lost])
        still = was_lost & now_lost[:, 0]
        assert torch.equal(visits[still], cells.place.visits.sum(1)[still])
        assert torch.equal(felt[still], cells.familiarity.felt_s.sum((1, 2, 3))[still])
        was_lost = now_lost[:, 0].clone()
        seconds = torch.tensor((k + 1 - cut) / RATE_HZ)
        noticed = torch.minimum(noticed, torch.where(was_lost, seconds, math.inf))
    assert (noticed <= 60.0).float().mean() >= 0.7


@pytest.mark.parametrize("batch", [None, 1])
def test_a_scanner_slower_than_the_odometry_does_not_make_the_animal_lost(batch):
    minutes = 3.0 if batch is None else 2.0  # walls are known for long after one
    walk = roam(named_arena("circle1m"), minutes, np.random.default_rng(8), 20.0)
    senses = sense(walk, SenseNoise(), [2], k=2)

    def lost_s(looks):
        cells = NavigationCells(CONFIG, batch)
        for k, dt_s in enumerate(senses.dt_s.tolist()):
            sensed = k % 3 == 0 or k < 1300  # in their first minute walls are always sensed
            at = (0, k) if batch is None else (slice(None), k)
            far = np.full_like(senses.wall_m[at], np.inf)
            row = [senses.speed_m_s[at], senses.heading_rad[at]]
            row += [senses.wall_m[at] if sensed else far, senses.wall_bearing_rad[at]]
            speed, heading, wall, bearing = map(torch.as_tensor, row)
            cells(speed, heading, dt_s, wall, bearing, sensed=sensed or looks)
        return cells.now.lost_s

    assert lost_s(looks=False) == 0.0
    assert lost_s(looks=True) > 0.0  # to look and to find none is evidence


def test_a_frame_without_walls_is_no_look_and_an_empty_list_of_them_is_one():
    cells, motion = NavigationCells(CONFIG), Motion(0.1, 0.0, 0.4)
    for walls, since_s in ((None, 0.4), (None, 0.5), (np.empty((0, 2)), 0.0), (None, 0.4)):
        cells.advance(motion, 0.0, walls)
        assert cells.now.since_s == pytest.approx(since_s)


def test_no_animal_is_reported_lost_in_ten_minutes_of_walking():
    arenas = ("triangle", "circle1m", "circle2m", "square", "pillar")
    senses = rows_of(
        *(sense(walk_in(name, 10.0, 7), SenseNoise(), [k]) for k, name in enumerate(arenas))
    )
    lost = live(NavigationCells(CONFIG, batch=len(arenas)), senses)[4]
    assert not lost.any()


# Familiarity

FELT = BoundaryCellConfig()


@given(
    walls=st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(-9.0, 9.0)), min_size=1, max_size=5),
    turn=st.integers(-30, 30),
)
@settings(max_examples=50, deadline=None)
def test_walls_are_felt_by_bearing_whatever_their_order_and_turn_with_the_world(walls, turn):
    distance, bearing = (tensor([[wall[i] for wall in walls]]) for i in (0, 1))
    felt = felt_walls(distance, bearing, 0.3, 24)
    again = felt_walls(distance.flip(1), bearing.flip(1), 0.3, 24)
    assert torch.equal(felt.any, again.any)
    assert torch.equal(felt.near, again.near)
    assert (felt.near <= felt.any).all()
    assert felt.any.sum() <= (distance < 0.3).sum()
    middles = (bearing * (24 / math.tau)).round() * (math.tau / 24)
    turned = felt_walls(distance, middles + turn * math.tau / 24, 0.3, 24)
    assert torch.equal(turned.any, felt_walls(distance, middles, 0.3, 24).any.roll(turn, 1))


def feel(familiarity, winner, wall, bearing, seconds):
    evidence = torch.tensor([False]), torch.tensor([False])
    lost = None
    for _ in range(round(seconds / 0.5)):
        lost = familiarity(
            torch.tensor([winner]), tensor([[wall]]), tensor([[bearing]]), evidence, 0.5
        )
    return lost.item()


def test_a_wall_where_none_ever_was_is_doubted_and_one_that_is_missing_too():
    for known, now in ((math.inf, 0.05), (0.05, math.inf)):
        familiarity = Familiarity(FELT, lost_after_s=2.0)
        assert not feel(familiarity, 0, known, 1.0, 10.0)
        assert familiarity.doubt_s.item() == 0.0
        assert not feel(familiarity, 0, now, 1.0, 2.0)
        assert feel(familiarity, 0, now, 1.0, 0.5)


def test_a_place_that_is_new_is_not_doubted_and_nor_is_a_wall_as_ever():
    familiarity = Familiarity(FELT, lost_after_s=2.0)
    assert not feel(familiarity, 0, 0.05, 1.0, 60.0)
    assert not feel(familiarity, 700, 0.05, -2.0, 60.0)
    assert not feel(familiarity, -1, 0.05, 2.0, 60.0)
    assert familiarity.doubt_s.item() == 0.0
    assert familiarity.n_activated().item() == 2
    assert familiarity.time_s[0, [0, 700]].tolist() == [60.0, 60.0]


def test_relocalising_resets_familiarity_doubt():
    familiarity = Familiarity(FELT, lost_after_s=2.0)
    feel(familiarity, 0, math.inf, 0.0, 10.0)
    assert feel(familiarity, 0, 0.05, 0.0, 5.0)
    familiarity.reset_doubt()
    assert familiarity.doubt_s.item() == 0.0
    assert not familiarity.lost.item()
