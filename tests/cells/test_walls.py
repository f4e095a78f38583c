import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells import wall_table
from neuroslam.cells.boundary import check_motion
from neuroslam.cells.boundary_vectors import Wall, squared_mismatch, wall_innovation, wrap
from neuroslam.cells.wall_table import OWN
from neuroslam.cells.walls import WallMemory
from neuroslam.config import WallMemoryConfig
from neuroslam.errors import BadFrame
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import NO_NOISE, SenseNoise, sense

ALIKE = {"speed_scale": 0.0, "heading_slow_deg": 0.0, "period_s": 0.0}
"""Errors of motion that are alike in all directions."""

angles = st.floats(-math.pi, math.pi)
places = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
RATE_HZ = 10.0


def tensor(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def remembered(anchor, bearing, distance):
    known = [*anchor, bearing, distance, 1e-4]
    return Wall(*tensor(known + [0.0] * (len(Wall._fields) - len(known))))


def senses_in(arena, minutes, noise=NO_NOISE, seeds=(0,), walk_seed=0):
    arena = named_arena(arena) if isinstance(arena, str) else arena
    return sense(roam(arena, minutes, np.random.default_rng(walk_seed), RATE_HZ), noise, seeds)


class Path:
    """Positions, corrections and the memory after a walk, one row for each animal."""

    def __init__(self, senses, config=None, compass=True, headings=None, watch=None):
        heading = senses.heading_rad if headings is None else headings
        n = len(heading)
        self.memory = WallMemory(config or WallMemoryConfig(), batch=n)
        position, dt_s = torch.zeros(n, 2, dtype=torch.float64), senses.dt_s.tolist()
        speed, heading, wall_m, bearing = (
            torch.from_numpy(a)
            for a in (senses.speed_m_s, heading, senses.wall_m, senses.wall_bearing_rad)
        )
        positions, corrections = [], []
        for k, dt in enumerate(dt_s):
            position = position + self.memory.move(speed[:, k], heading[:, k], dt)
            correction = self.memory.update_from_walls(
                position, wall_m[:, k], bearing[:, k] + heading[:, k, None], compass=compass
            )
            position = position + correction
            positions.append(position)
            corrections.append(correction)
            if watch is not None:
                watch(k, self.memory)
        self.positions = torch.stack(positions, 1).numpy()
        self.corrections = torch.stack(corrections, 1).numpy()
        truth = senses.position_m - senses.position_m[0]
        self.rmse_m = np.sqrt(np.mean(np.sum((self.positions - truth) ** 2, -1)))
        length = senses.speed_m_s * senses.dt_s
        heading = heading.numpy()
        steps = np.stack([length * np.cos(heading), length * np.sin(heading)], -1)
        self.alone_m = np.sqrt(np.mean(np.sum((steps.cumsum(1) - truth) ** 2, -1)))


def assert_is_a_covariance(memory):
    p = memory.covariance
    torch.testing.assert_close(p, p.mT, rtol=0, atol=1e-12)
    assert torch.linalg.eigvalsh((p + p.mT) / 2).min() >= -1e-12
    assert (memory.position_variance_m2.diagonal(dim1=1, dim2=2) >= 0.0).all()


# Geometry


@given(first=places, then=places, bearing=angles, away=st.floats(2.0, 4.0))
@settings(max_examples=100, deadline=None)
def test_a_straight_wall_agrees_with_the_memory_of_it_from_anywhere(first, then, bearing, away):
    normal = tensor([math.cos(bearing), math.sin(bearing)])
    distance = [away - (tensor(at) @ normal).item() for at in (first, then)]
    off, seen, lever = wall_innovation(
        tensor(then), tensor(distance[1]), tensor(bearing), remembered(first, bearing, distance[0])
    )
    assert abs(off.item()) < 1e-12
    torch.testing.assert_close(seen, normal, rtol=0, atol=1e-12)
    across = tensor([-math.sin(bearing), math.cos(bearing)])
    assert abs(lever.item()) == pytest.approx(
        abs(((tensor(first) - tensor(then)) @ across).item()), abs=1e-12
    )


@given(
    angle=angles, apart=st.floats(-1.0, 1.0), r=st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9))
)
@settings(max_examples=100, deadline=None)
def test_a_round_wall_agrees_with_the_memory_of_it_from_within_and_from_around(angle, apart, r):
    for radius, sign in ((1.0, 1.0), (0.05, -1.0)):  # within an arena; around a pillar
        at = [
            tensor([q * math.cos(b), q * math.sin(b)])
            for q, b in zip(r, (angle, angle + apart), strict=True)
        ]
        distance = [sign * (radius - q) for q in r]
        turn = 0.0 if sign > 0 else math.pi
        off, _, _ = wall_innovation(
            at[1],
            tensor(distance[1]),
            tensor(angle + apart + turn),
            remembered(at[0].tolist(), angle + turn, distance[0]),
        )
        assert abs(off.item()) < 1e-12


@given(first=places, then=places, bearing=angles, more=st.floats(-0.1, 0.1), turn=angles)
@settings(max_examples=60, deadline=None)
def test_a_wall_correction_does_not_depend_on_the_origin_of_the_world(
    first, then, bearing, more, turn
):
    c, s = math.cos(turn), math.sin(turn)
    turned = tensor([[c, -s], [s, c]])
    shift = tensor([3.0, -7.0])
    off, normal, lever = wall_innovation(
        tensor(then), tensor(0.2), tensor(bearing + more), remembered(first, bearing, 0.15)
    )
    moved = remembered((turned @ tensor(first) + shift).tolist(), bearing + turn, 0.15)
    again = wall_innovation(
        turned @ tensor(then) + shift, tensor(0.2), tensor(bearing + more + turn), moved
    )
    for ours, theirs in zip((off, turned @ normal, lever), again, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-11)


@given(angle=st.floats(-50.0, 50.0))
@settings(max_examples=60, deadline=None)
def test_wrapped_angles_are_the_same_angles_within_half_a_turn(angle):
    wrapped = wrap(tensor(angle)).item()
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


def test_a_wall_is_the_same_within_the_spread_and_another_beyond():
    scale = tensor([0.25, math.radians(12.0)])
    wall = torch.stack(remembered((0.0, 0.0), math.pi, 0.1))
    for off_m, off_deg, same in (
        (0.0, 0.0, True),
        (0.24, 0.0, True),
        (0.26, 0.0, False),
        (0.0, 11.9, True),
        (0.0, -11.9, True),
        (0.0, 12.1, False),
        (0.2, 10.0, False),
    ):
        bearing = tensor(-math.pi + math.radians(off_deg))
        assert (squared_mismatch(wall, tensor([0.0, off_m]), bearing, scale) < 1.0).item() == same


# One wall


def memory_of_one_wall(bearing, way, **config):
    """An animal that saw a wall 0.2 m off, and then went the way, as it believes."""
    memory = WallMemory(WallMemoryConfig(**{**ALIKE, **config}))
    at = torch.zeros(2, dtype=torch.float64)
    memory.update_from_walls(at, tensor([0.2]), tensor([bearing]))
    length, course = way
    at = at + memory.move(tensor(length), tensor(course), 1.0)
    return memory, at


@given(
    bearing=angles,
    way=st.tuples(st.floats(0.05, 0.2), angles),
    wrong=st.floats(-0.02, 0.02),
)
@settings(max_examples=60, deadline=None)
def test_a_wall_corrects_across_it_and_never_along(bearing, way, wrong):
    memory, at = memory_of_one_wall(bearing, way)
    normal = tensor([math.cos(bearing), math.sin(bearing)])
    along = tensor([-math.sin(bearing), math.cos(bearing)])
    spread = memory.covariance.clone()
    distance = 0.2 - at @ normal + wrong
    correction = memory.update_from_walls(at, distance.clamp_min(0.0)[None], tensor([bearing]))
    wrong = distance.clamp_min(0.0) - (0.2 - at @ normal)
    assert abs((correction @ along).item()) < 1e-12
    share = -(correction @ normal).item()
    assert 0.0 <= share / wrong <= 1.0 if abs(wrong) > 1e-9 else abs(share) < 1e-9
    own = memory.position_variance_m2[0]
    assert (along @ own @ along).item() > 0.0
    assert (normal @ own @ normal) < (along @ own @ along)
    assert spread.shape[-1] == memory.covariance.shape[-1]


def test_a_wall_far_beyond_all_errors_is_another_and_corrects_nothing():
    memory, at = memory_of_one_wall(0.0, (0.05, math.pi / 2))
    assert memory.update_from_walls(at, tensor([0.9]), tensor([0.0])).tolist() == [0.0, 0.0]


def test_walls_sensed_too_soon_or_none_correct_nothing():
    memory, at = memory_of_one_wall(0.0, (0.1, 0.0), period_s=5.0)
    assert not memory.is_due
    assert memory.update_from_walls(at, tensor([0.1]), tensor([0.0])).tolist() == [0.0, 0.0]
    memory.move(tensor(0.0), tensor(0.0), 4.0)
    assert memory.is_due
    assert memory.update_from_walls(at, tensor([math.inf]), tensor([0.0])).tolist() == [0.0, 0.0]
    assert memory.update_from_walls(at, torch.empty(0), torch.empty(0)).tolist() == [0.0, 0.0]


def test_without_learning_no_wall_is_remembered():
    memory = WallMemory(WallMemoryConfig(), batch=2)
    memory.move(torch.zeros(2), torch.zeros(2), 1.0)
    at, wall = torch.zeros(2, 2), torch.tensor([[0.1], [0.1]])
    memory.update_from_walls(at, wall, torch.zeros(2, 1), learns=torch.tensor([True, False]))
    assert memory.n_walls.tolist() == [1, 0]
    assert [len(wall.x_m) for wall in memory.remembered()] == [1, 0]


def test_a_wall_is_remembered_as_it_was_seen():
    memory = WallMemory(WallMemoryConfig(period_s=0.0))
    memory.update_from_walls(tensor([0.3, -0.4]), tensor([0.12]), tensor([2.0]))
    (wall,) = memory.remembered()
    seen = [value.item() for value in wall]
    assert seen[:4] == pytest.approx([0.3, -0.4, 2.0, 0.12])
    assert seen[4] == pytest.approx(memory.config.sigma_m**2, rel=0.01)


def test_learnt_errors_are_taken_off_the_motion():
    memory = WallMemory(WallMemoryConfig())
    memory.errors = tensor([[0.1, 0.2]])
    step = memory.move(tensor(2.0), tensor(0.5), 0.25)
    expected = [0.45 * math.cos(0.3), 0.45 * math.sin(0.3)]
    torch.testing.assert_close(step, tensor(expected))


@given(seen=places, sigma=st.floats(0.01, 1.0))
@settings(max_examples=30, deadline=None)
def test_a_given_position_corrects_by_the_ratio_of_variances(seen, sigma):
    memory, twin = (WallMemory(WallMemoryConfig(**ALIKE)) for _ in range(2))
    at = memory.move(tensor(1.0), tensor(0.3), 1.0)
    twin.observe_position(at, at, 1e6 * twin.move(tensor(1.0), tensor(0.3), 1.0).norm().item())
    spread = twin.position_variance_m2[0, 0, 0].item()
    assert spread > 1e-5
    step = memory.observe_position(at, tensor(seen), sigma)
    share = spread / (spread + sigma**2)
    torch.testing.assert_close(step, share * (tensor(seen) - at), rtol=1e-6, atol=1e-12)
    expected = share * sigma**2 * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(memory.position_variance_m2[0], expected, rtol=1e-6, atol=1e-12)


@given(way=st.tuples(st.floats(0.05, 1.0), angles), n=st.integers(2, 40))
@settings(max_examples=30, deadline=None)
def test_the_belief_spreads_alike_at_any_rate_of_samples(way, n):
    spreads = []
    for steps in (1, n):
        memory = WallMemory(WallMemoryConfig())
        at = torch.zeros(2, dtype=torch.float64)
        for _ in range(steps):
            at = at + memory.move(*tensor(way), 1.0 / steps)
        memory.observe_position(at, at, 1e6)
        spreads.append(memory.position_variance_m2)
    torch.testing.assert_close(spreads[1], spreads[0], rtol=1e-6, atol=1e-12)


def test_missing_known_walls_contradict_the_position_and_present_ones_support_it():
    memory, wall = WallMemory(WallMemoryConfig()), tensor([0.05])
    at, east, nothing = torch.zeros(2, dtype=torch.float64), tensor([0.0]), tensor([math.inf])
    assert [bool(e) for e in memory.evidence(at[None], nothing[None], east[None], 0.18)] == [
        False,
        False,
    ]
    for _ in range(600):
        memory.move(tensor(0.0), tensor(0.0), 0.2)
        memory.update_from_walls(at, wall, east)
    against, supports = memory.evidence(at[None], wall[None], east[None], 0.18)
    assert (against.item(), supports.item()) == (False, True)
    against, supports = memory.evidence(at[None], nothing[None], east[None], 0.18)
    assert (against.item(), supports.item()) == (True, False)


@pytest.mark.parametrize("batch", [None, 1])
def test_the_absence_of_a_wall_counts_by_how_often_it_was_sensed_at_first(batch):
    """A wall that was read once from a noisy scan, and never again, contradicts nothing."""
    memory = WallMemory(WallMemoryConfig(period_s=0.0), batch)
    at, east, north = torch.zeros(2, dtype=torch.float64), tensor([0.0]), tensor([math.pi / 2])

    def against(there):
        felt = tensor([[0.05 if there else math.inf]])
        return memory.evidence(at[None], felt, east[None], 0.18)[0].item()

    def sense(bearing):
        memory.move(*(tensor(0.0).expand(() if batch is None else batch) for _ in range(2)), 0.1)
        one = at, tensor([0.05]), bearing
        memory.update_from_walls(*(one if batch is None else (part[None] for part in one)))

    sense(north)  # the outlier
    for _ in range(4):
        sense(east)
        assert against(there=True) == 0.0
    assert memory.walls[0, :2, 6:].tolist() == [[4.0, 0.0], [4.0, 4.0]]
    memory.since.time_s += 61.0
    wrong, right = against(there=True), against(there=False)
    assert 0.0 < wrong < 0.05  # the outlier alone is missing
    assert wrong < right < 1.0
    assert memory.walls[0, :2, 6:].tolist() == [[4.0, 0.0], [4.0, 4.0]]  # learnt at first only


def test_walls_saved_without_counts_are_read_with_none():
    memory = WallMemory(WallMemoryConfig())
    memory.update_from_walls(torch.zeros(2), tensor([0.2]), tensor([0.0]))
    state = memory.state_dict()
    again = WallMemory(WallMemoryConfig())
    again.load_state_dict(state | {"walls": state["walls"][..., :6].clone()})
    assert torch.equal(again.walls[..., :6], state["walls"][..., :6])
    assert again.walls.shape == state["walls"].shape
    assert not again.walls[..., 6:].any()


def test_forgetting_the_position_keeps_walls_and_learnt_errors():
    path = Path(senses_in("triangle", 1.0, SenseNoise()))
    memory = path.memory
    walls, errors = memory.walls.clone(), memory.errors.clone()
    memory.forget_position(0.5)
    torch.testing.assert_close(
        memory.position_variance_m2[0], 0.25 * torch.eye(2, dtype=torch.float64)
    )
    assert memory.covariance[:, :2, 2:].count_nonzero() == 0
    assert memory.covariance[:, 2:, :2].count_nonzero() == 0
    assert torch.equal(memory.walls, walls)
    assert torch.equal(memory.errors, errors)
    assert_is_a_covariance(memory)


# Walks


@pytest.mark.parametrize(
    "arena",
    ["triangle", "nonagon", "circle1m", "circle2m", "pillar", "two_rooms"],
)
def test_error_free_motion_and_walls_cause_no_correction(arena):
    path = Path(senses_in(arena, 2.0))
    assert path.memory.n_walls.item() > 5
    assert np.abs(path.corrections).max() < 1e-6
    assert path.rmse_m < 1e-6
    assert path.memory.errors.abs().max() < 1e-6


@pytest.mark.parametrize("arena", ["triangle", "circle2m", "pillar"])
def test_walls_keep_the_error_below_that_of_self_motion_and_the_belief_sound(arena):
    def watch(k, memory):
        if k % 300 == 0:
            assert_is_a_covariance(memory)

    path = Path(senses_in(arena, 5.0, SenseNoise(), seeds=range(3)), watch=watch)
    assert_is_a_covariance(path.memory)
    assert path.rmse_m < 0.75 * path.alone_m


def test_all_noise_off_but_that_of_the_walls_does_little_harm():
    noise = SenseNoise().scaled(0.0)
    path = Path(senses_in("triangle", 4.0, noise, seeds=range(2)))
    assert path.alone_m < 1e-9
    assert path.rmse_m < 0.03


@pytest.mark.parametrize(("noise", "bound_m"), [(NO_NOISE, 1e-6), (SenseNoise(), 0.08)])
def test_with_room_for_few_walls_they_are_swapped_out_and_in(monkeypatch, noise, bound_m):
    monkeypatch.setattr(wall_table, "ACTIVE", 10)
    seen = set()

    def watch(k, memory):
        active = memory.active[memory.active >= 0]
        assert len(active) <= 10
        assert len(active) == len(active.unique())
        seen.update(active.tolist())
        if k % 300 == 0:
            assert_is_a_covariance(memory)

    path = Path(senses_in("triangle", 5.0, noise, walk_seed=3), watch=watch)
    memory = path.memory
    n = memory.n_walls.item()
    assert n > 2 * 10
    assert seen == set(range(n))
    assert memory.active.shape[1] == 10
    assert memory.covariance.shape[-1] == OWN + 10
    (wall,) = memory.remembered()
    assert len(wall.x_m) == n
    assert (wall.variance_m2 > 0.0).all()
    assert wall.variance_m2.max() < 0.1
    assert path.rmse_m < bound_m


def test_more_walls_than_active_ones_still_keep_the_position():
    boxes = [
        [(x, y), (x + 0.3, y), (x + 0.3, y + 0.3), (x, y + 0.3)]
        for x in np.arange(5) * 0.8
        for y in np.arange(5) * 0.8
    ]
    arena = Arena([(-0.5, -0.5), (4.0, -0.5), (4.0, 4.0), (-0.5, 4.0)], holes=boxes, name="boxes")
    walk = roam(arena, 8.0, np.random.default_rng(2), RATE_HZ, speed_m_s=0.25)
    path = Path(sense(walk, SenseNoise(), [0]))
    assert path.memory.n_walls.item() > wall_table.ACTIVE
    assert (path.memory.active >= 0).sum() == wall_table.ACTIVE
    assert path.rmse_m < 0.8 * path.alone_m
    assert_is_a_covariance(path.memory)


@pytest.mark.parametrize("turn", [0.7, -2.9, math.pi])
def test_rotating_the_world_rotates_the_estimates(turn):
    senses = senses_in("triangle", 2.0, SenseNoise(), seeds=(0, 5))
    as_it_is = Path(senses)
    turned = Path(senses, headings=wrap(torch.from_numpy(senses.heading_rad + turn)).numpy())
    c, s = math.cos(turn), math.sin(turn)
    back = turned.positions @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(back, as_it_is.positions, rtol=0, atol=1e-9)
    assert turned.memory.n_walls.tolist() == as_it_is.memory.n_walls.tolist()
    torch.testing.assert_close(turned.memory.errors, as_it_is.memory.errors, rtol=0, atol=1e-9)


def test_shifting_the_world_keeps_the_corrections():
    senses = senses_in("circle1m", 1.5, SenseNoise())
    here, there = (WallMemory(WallMemoryConfig()) for _ in range(2))
    shift, at = tensor([40.0, -9.0]), torch.zeros(2, dtype=torch.float64)
    speed, heading, wall_m, bearing = (torch.from_numpy(a[0]) for a in senses[2:6])
    for k, dt_s in enumerate(senses.dt_s.tolist()):
        at = at + here.move(speed[k], heading[k], dt_s)
        there.move(speed[k], heading[k], dt_s)
        look = wall_m[k], bearing[k] + heading[k]
        correction = here.update_from_walls(at, *look)
        torch.testing.assert_close(
            there.update_from_walls(at + shift, *look), correction, rtol=0, atol=1e-9
        )
        at = at + correction
    assert here.n_walls.item() > 5


@pytest.mark.parametrize(("arena", "factor"), [("triangle", 1.05), ("circle2m", 0.95)])
def test_a_speedometer_that_is_five_percent_off_is_found_out(arena, factor):
    senses = senses_in(arena, 6.0, walk_seed=2)
    senses = senses._replace(speed_m_s=factor * senses.speed_m_s)
    path = Path(senses, WallMemoryConfig(speed_scale=0.05))
    learnt = path.memory.errors[0, 0].item()
    assert learnt == pytest.approx(1.0 - 1.0 / factor, abs=0.01)
    assert path.memory.covariance[0, 2, 2].sqrt() < 0.02
    assert path.rmse_m < 0.5 * path.alone_m


def test_without_a_compass_walls_tell_the_heading():
    senses = senses_in("triangle", 6.0, SenseNoise(heading_white_deg=0.0, heading_slow_deg=0.0))
    drift = np.cumsum(np.random.default_rng(0).normal(0.0, 0.004, senses.heading_rad.shape), 1)
    assert np.abs(drift).max() > math.radians(10.0)
    path = Path(senses, compass=False, headings=senses.heading_rad + drift)
    assert path.rmse_m < 0.5 * path.alone_m
    assert path.memory.errors[0, 1].item() == pytest.approx(drift[0, -1], abs=math.radians(8.0))
    assert_is_a_covariance(path.memory)


def test_animals_that_see_walls_at_the_same_times_are_as_if_alone():
    senses = senses_in("triangle", 2.0, SenseNoise(), seeds=(1, 2, 3))
    together = Path(senses)
    for row in range(3):
        own = {
            name: getattr(senses, name)[row : row + 1]
            for name in ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad")
        }
        alone = Path(senses._replace(**own))
        np.testing.assert_allclose(together.positions[row], alone.positions[0], atol=1e-9)
        assert together.memory.n_walls[row] == alone.memory.n_walls[0]


@pytest.mark.parametrize(
    ("speed", "heading"), [(math.nan, 0.0), (math.inf, 0.0), (0.1, math.nan), (0.1, -math.inf)]
)
def test_motion_that_cannot_be_is_refused_in_one_line(speed, heading):
    with pytest.raises(BadFrame) as caught:
        check_motion(torch.tensor(speed), torch.tensor(heading))
    assert str(caught.value) == (
        f"motion: speed {speed:.6} m/s, heading {heading:.6} rad; expected finite numbers"
    )


def test_of_a_batch_the_animal_that_cannot_be_is_named():
    with pytest.raises(BadFrame, match=r"speed 0\.2 m/s, heading nan rad"):
        check_motion(torch.tensor([0.1, 0.2]), torch.tensor([0.0, math.nan]))
