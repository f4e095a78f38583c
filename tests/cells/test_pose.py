"""Pose cells: convolution on the torus, attractor dynamics, path integration, views."""

import csv
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells import PoseCellNetwork, circular_convolve, gaussian_kernel
from neuroslam.cells.attractor import decode, inject, path_integrate
from neuroslam.cells.convolve import Packet, to_dense, to_packet, trim, widen
from neuroslam.cells.side_by_side import decode_all, move_all, to_packets, to_tori
from neuroslam.config import PoseCellConfig
from neuroslam.errors import ConfigError, MapError
from neuroslam.geometry import TWO_PI
from neuroslam.types import Motion, PoseEstimate, ViewMatch

BOTH = [(torch.float32, 1e-6), (torch.float64, 1e-12)]
STILL = Motion(0.0, 0.0, 1.0)


def kernels(dtype):
    return (
        gaussian_kernel(7, 1.0, dtype),
        gaussian_kernel(5, 2.0, dtype),
        gaussian_kernel(3, 0.7, dtype),
    )


def packet_at(shape, at, dtype=torch.float64):
    empty = Packet(torch.zeros(1, 1, 1, dtype=dtype), (0, 0, 0), shape)
    return trim(inject(empty, at, 1.0))


def ring_distance(a, b, n):
    return abs((a - b + n / 2) % n - n / 2)


@pytest.mark.parametrize(("dtype", "tolerance"), BOTH)
@pytest.mark.parametrize("spread", [0.02, 0.5, 1.0])
def test_three_convolutions_are_equal(dtype, tolerance, spread):
    generator = torch.Generator().manual_seed(3)
    activity = torch.rand(11, 9, 8, generator=generator, dtype=dtype)
    activity *= torch.rand(11, 9, 8, generator=generator) < spread
    activity[10, 0, 7] = 1.0  # near the seams
    dense = circular_convolve(activity, kernels(dtype), "dense")
    for method in ("window", "separable", "auto"):
        found = circular_convolve(activity, kernels(dtype), method)
        assert (found - dense).abs().max() <= tolerance


def test_convolution_of_a_batch_is_that_of_each():
    batch = torch.rand(2, 3, 8, 9, 10, dtype=torch.float64)
    together = circular_convolve(batch, kernels(torch.float64))
    alone = circular_convolve(batch[1, 2], kernels(torch.float64), "dense")
    torch.testing.assert_close(together[1, 2], alone)


@pytest.mark.parametrize("method", ["window", "separable", "dense"])
def test_gradients_flow_through_every_convolution(method):
    activity = torch.rand(7, 8, 7, dtype=torch.float64, requires_grad=True)
    ks = tuple(k.requires_grad_() for k in kernels(torch.float64))

    def total(a, *weights):
        return (circular_convolve(a, weights, method) ** 2).sum()

    assert torch.autograd.gradcheck(total, (activity, *ks), fast_mode=True)


@pytest.mark.parametrize("cells_per_frame", [1.0, 7.0, 21.0, -3.0, 0.5, 1.5])
def test_a_lap_of_the_torus_returns_to_the_start(cells_per_frame):
    start = packet_at((36, 21, 21), PoseEstimate(3.0, 5.0, 0.0))
    packet = start
    for _ in range(round(21 / abs(cells_per_frame))):
        packet = path_integrate(packet, cells_per_frame, 0.0)
    found = decode(packet, 10)
    assert ring_distance(found.x, 3.0, 21) < 1e-9
    assert ring_distance(found.y, 5.0, 21) < 1e-9
    if cells_per_frame == round(cells_per_frame):
        torch.testing.assert_close(to_dense(packet), to_dense(start))


@given(
    distance=st.floats(-30, 30),
    turn=st.floats(-40, 40),
    x=st.floats(0, 20.99),
    theta=st.floats(0, 35.99),
)
@settings(max_examples=60, deadline=None)
def test_path_integration_keeps_mass_and_sign(distance, turn, x, theta):
    packet = packet_at((36, 21, 21), PoseEstimate(x, 3.0, theta))
    moved = path_integrate(packet, distance, turn)
    assert moved.values.sum().item() == pytest.approx(1.0, abs=1e-12)
    assert moved.values.min() >= 0.0


@given(steps=st.lists(st.tuples(st.integers(-25, 25), st.integers(-5, 5)), max_size=5))
@settings(max_examples=30, deadline=None)
def test_whole_cells_forth_and_back_change_nothing(steps):
    packet = start = packet_at((36, 21, 21), PoseEstimate(4.25, 17.5, 9.0))
    for distance, quarters in steps:
        packet = path_integrate(packet, distance, 9 * quarters)
    for distance, quarters in reversed(steps):  # turn back first: layers move along their heading
        packet = path_integrate(path_integrate(packet, 0.0, -9 * quarters), -distance, 0.0)
    torch.testing.assert_close(to_dense(packet), to_dense(start))


def test_each_layer_moves_along_its_own_heading():
    for layer in (0, 5, 9, 20, 33):
        packet = packet_at((36, 21, 21), PoseEstimate(10.0, 10.0, float(layer)))
        found = decode(path_integrate(packet, 3.0, 0.0), 3)
        angle = TWO_PI * layer / 36
        # Bilinear weights decode to within a hundredth of a cell between lattice points.
        assert found.x == pytest.approx(10.0 + 3.0 * math.cos(angle), abs=0.03)
        assert found.y == pytest.approx(10.0 + 3.0 * math.sin(angle), abs=0.03)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("speed", [0.05, 0.1, 0.3, 0.5, 0.9, -0.4])
def test_the_packet_follows_odometry_with_gain_one(speed, precision):
    cells = PoseCellNetwork(PoseCellConfig(cell_size_m=1.0, precision=precision))
    cells.activity = to_dense(packet_at(cells.shape, PoseEstimate(10.0, 10.0, 4.5)))
    for _ in range(20):
        before = cells.estimate
        cells.integrate(STILL)
    travelled = [0.0, 0.0]
    for _ in range(200):
        before, now = cells.estimate, cells.integrate(Motion(speed, 0.0, 1.0))
        for axis in (0, 1):
            travelled[axis] += (now[axis] - before[axis] + 10.5) % 21 - 10.5
    assert math.hypot(*travelled) == pytest.approx(200 * abs(speed), rel=2e-3)
    heading = math.atan2(travelled[1], travelled[0]) + (math.pi if speed < 0 else 0.0)
    assert ring_distance(heading, TWO_PI * 4.5 / 36, TWO_PI) < 0.01


@pytest.mark.parametrize("turn", [0.05, 0.5, -1.2])
def test_the_packet_turns_with_gain_one(turn):
    cells = PoseCellNetwork(PoseCellConfig())
    turned = 0.0
    for step in range(220):
        before, now = cells.estimate, cells.integrate(Motion(0.0, turn * TWO_PI / 36, 1.0))
        if step >= 20:
            turned += (now.theta - before.theta + 18) % 36 - 18
    assert turned == pytest.approx(200 * turn, rel=2e-3)


def test_standing_still_keeps_the_estimate():
    cells = PoseCellNetwork(PoseCellConfig())
    cells.activity = to_dense(packet_at(cells.shape, PoseEstimate(4.3, 12.6, 30.4)))
    for _ in range(300):
        found = cells.integrate(STILL)
    for value, wanted in zip(found, (4.3, 12.6, 30.4), strict=True):
        assert value == pytest.approx(wanted, abs=0.05)


def test_activity_stays_a_belief():
    cells = PoseCellNetwork(PoseCellConfig(precision="float64"))
    generator = np.random.default_rng(0)
    for _ in range(100):
        cells.integrate(Motion(*generator.normal(size=2), 0.1))
        activity = cells.activity
        assert activity.shape == (36, 21, 21)
        assert activity.min() >= 0
        assert activity.sum().item() == pytest.approx(1.0, abs=1e-12)


def test_activity_spread_over_the_whole_torus_is_settled_as_the_definition_says():
    cells = PoseCellNetwork(PoseCellConfig(precision="float64", exact_gain=False))
    spread = torch.rand(cells.shape, dtype=torch.float64) ** 20
    cells.activity = spread / spread.sum()
    excited = circular_convolve(cells.activity, cells.kernels[0], "dense")
    inhibited = excited - circular_convolve(excited, cells.kernels[1], "dense")
    wanted = (inhibited - cells.config.global_inhibition).clamp_min(0.0)
    cells.integrate(STILL)
    torch.testing.assert_close(cells.activity, wanted / wanted.sum())


def test_inhibition_that_silences_every_cell_is_named():
    cells = PoseCellNetwork(PoseCellConfig(global_inhibition=0.9))
    with pytest.raises(MapError, match=r"silenced every cell; global_inhibition 0\.9"):
        cells.integrate(STILL)


@pytest.mark.parametrize("shape", [(36, 21, 21), (7, 9, 80)])
def test_packets_survive_the_seams(shape):
    for at in ((0, 0, 0), (shape[0] - 1, shape[1] - 1, shape[2] - 1)):
        dense = torch.zeros(shape)
        for offset in (0, 1):
            dense[tuple((a + offset) % n for a, n in zip(at, shape, strict=True))] = 1.0
        packet = to_packet(dense)
        assert packet.values.shape == (2, 2, 2)
        torch.testing.assert_close(to_dense(packet), dense)


@given(
    origin=st.tuples(*[st.integers(0, 8)] * 3),
    size=st.tuples(*[st.integers(1, 9)] * 3),
    cell=st.tuples(*[st.integers(0, 8)] * 3),
)
@settings(max_examples=200, deadline=None)
def test_a_widened_window_holds_the_cells_and_loses_none(origin, size, cell):
    packet = Packet(torch.ones(size), origin, (9, 9, 9))
    wide = widen(packet, cell)
    torch.testing.assert_close(to_dense(wide), to_dense(packet))
    for o, width, c in zip(wide.origin, wide.values.shape, cell, strict=True):
        assert width <= 9
        assert (c - o) % 9 < width
        assert (c + 1 - o) % 9 < width


@given(x=st.floats(0, 20.999), y=st.floats(0, 20.999), theta=st.floats(0, 35.999))
@settings(max_examples=60, deadline=None)
def test_injection_is_found_where_it_was_made(x, y, theta):
    packet = packet_at((36, 21, 21), PoseEstimate(x, y, theta))
    assert packet.values.sum().item() == pytest.approx(1.0)
    found = decode(packet, 3)
    for value, wanted, n in zip(found, (x, y, theta), (21, 21, 36), strict=True):
        assert ring_distance(value, wanted, n) < 0.01


def test_one_brain_and_a_batch_agree():
    config = PoseCellConfig(precision="float64", cell_size_m=1.0)
    batch = PoseCellNetwork(config, batch=3)
    singles = [PoseCellNetwork(config) for _ in range(3)]
    generator = torch.Generator().manual_seed(1)
    for _ in range(40):
        v = torch.rand(3, generator=generator, dtype=torch.float64) - 0.3
        w = torch.rand(3, generator=generator, dtype=torch.float64) * 0.4 - 0.2
        together = batch.integrate(Motion(v, w, 1.0))
        alone = [
            s.integrate(Motion(a.item(), b.item(), 1.0))
            for s, a, b in zip(singles, v, w, strict=True)
        ]
        torch.testing.assert_close(together, torch.tensor(alone, dtype=torch.float64))
    torch.testing.assert_close(batch.activity[2], singles[2].activity)
    torch.testing.assert_close(
        decode_all(batch.packet, 3)[1], torch.tensor(singles[1].estimate, dtype=torch.float64)
    )


def test_gradients_reach_the_motion_through_a_step():
    start = to_packets(PoseCellNetwork(PoseCellConfig(precision="float64")).activity[None])
    distance = torch.tensor([0.4], dtype=torch.float64, requires_grad=True)
    turn, aside = torch.tensor([0.2], dtype=torch.float64), torch.zeros(1, 2)
    moved = to_tori(move_all(start, distance, turn, aside))
    (moved * torch.arange(21, dtype=torch.float64)).sum().backward()
    assert distance.grad.item() == pytest.approx(-1.0, abs=0.02)  # the start heads along -x


def known_view(cells, template=0):
    return ViewMatch(template, 0.01, 0.0, False)


def test_a_recognised_view_brings_the_packet_back():
    cells = PoseCellNetwork(PoseCellConfig(cell_size_m=1.0, inject_after=0))
    for template in range(3):
        cells(Motion(0.5, 0.0, 1.0), ViewMatch(template, -1.0, 0.0, True))
    learnt = [cells.bindings[c][1].item() for c in ("x", "y", "theta")]
    for _ in range(12):
        cells(Motion(0.5, 0.05, 1.0), ViewMatch(-1, -1.0, 0.0, False))
    far = ring_distance(cells.estimate.x, learnt[0], 21)
    for step in range(30):
        cells(STILL, known_view(cells, 1 + step % 2))
    near = ring_distance(cells.estimate.x, learnt[0], 21)
    assert far > 4.0
    assert near < 1.0


def test_the_newest_views_inject_nothing():
    cells = PoseCellNetwork(PoseCellConfig(inject_after=10))
    quiet = PoseCellNetwork(PoseCellConfig(inject_after=10))
    for template in range(10):
        cells(Motion(1.0, 0.0, 0.1), ViewMatch(template, -1.0, 0.0, True))
        quiet(Motion(1.0, 0.0, 0.1), ViewMatch(template, -1.0, 0.0, True))
    cells(STILL, known_view(cells))
    quiet(STILL, ViewMatch(-1, -1.0, 0.0, False))
    assert torch.equal(cells.activity, quiet.activity)


def test_a_view_matched_in_a_row_injects_less_and_recovers():
    cells = PoseCellNetwork(PoseCellConfig(inject_after=0, active_decay=1.0, restore=0.05))
    cells(STILL, ViewMatch(0, -1.0, 0.0, True))
    cells(STILL, ViewMatch(1, -1.0, 0.0, True))
    for _ in range(5):
        cells(STILL, known_view(cells))
    assert cells.bindings["decay"][0].item() == pytest.approx(1 + 4 * 1.0 - 5 * 0.05, abs=0.06)
    for _ in range(200):
        cells(STILL, ViewMatch(-1, -1.0, 0.0, False))
    assert cells.bindings["decay"][0].item() == 1.0


@pytest.mark.parametrize("n", [21, 11])
def test_unit_sequence_of_the_reference(shared, n):
    """Every step of the C++ core's own sequence; its x is our y, for its theta 0 moves along +y."""
    folder = shared / "refs" / "ratslam" / "unit"
    with (folder / f"pc_{n}x{n}x36_steps.csv").open() as file:
        rows = list(csv.DictReader(file))
    snapshots = np.fromfile(folder / f"pc_{n}x{n}x36_cells.f64").reshape(6, 36, n, n)
    cells = PoseCellNetwork(
        PoseCellConfig(
            n_xy=n,
            cell_size_m=1.0,
            inject_energy=0.15,
            precision="float64",
            inject_while_few=True,
            inject_at_cell=True,
            exact_gain=False,
        )
    )
    apart, n_views = [], 0
    for step, row in enumerate(rows):
        template = int(row["vt"])
        view = ViewMatch(template, 0.0, float(row["vt_rad"]), template == n_views)
        n_views = max(n_views, template + 1)
        found = cells(Motion(float(row["vtrans"]), float(row["vrot"]), 1.0), view)
        wanted = (float(row["y"]), float(row["x"]), float(row["th"]))
        apart.append(
            max(ring_distance(*pair) for pair in zip(found, wanted, (n, n, 36), strict=True))
        )
        if n == 21 and step % 20 == 19:
            theirs = snapshots[step // 20].swapaxes(1, 2)
            assert np.abs(cells.activity.numpy() - theirs).max() < 1e-12
    apart = np.array(apart)
    if n == 21:
        assert apart.max() < 1e-9
    else:  # from the step at which the packet crosses the reference's seam the two go apart
        assert apart[:24].max() < 1e-9
        assert (apart < 0.5).mean() >= 0.95


def test_shapes_that_do_not_fit_are_named():
    cells = PoseCellNetwork(PoseCellConfig())
    with pytest.raises(MapError, match=r"shape \(3, 3, 3\), expected \(36, 21, 21\)"):
        cells.activity = torch.zeros(3, 3, 3)
    with pytest.raises(MapError, match="view 5 is not bound, there are 0"):
        cells.update_from_view(known_view(cells, 5))
    with pytest.raises(ValueError, match="expected an odd number"):
        PoseCellConfig(excite_size=6)
    assert issubclass(ConfigError, ValueError)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no accelerator on this machine")
def test_the_same_on_an_accelerator():
    config = PoseCellConfig(precision="float64")
    here, there = PoseCellNetwork(config, batch=4), PoseCellNetwork(config, batch=4).to("cuda")
    for _ in range(10):
        v = torch.linspace(0.0, 1.0, 4, dtype=torch.float64)
        here.integrate(Motion(v, 0.1 * v, 0.1))
        there.integrate(Motion(v.cuda(), 0.1 * v.cuda(), 0.1))
    torch.testing.assert_close(there.activity.cpu(), here.activity)


def test_a_robot_that_stands_still_for_an_hour_stays_where_it_is():
    cells = PoseCellNetwork(PoseCellConfig(inject_after=0))
    for template in range(2):
        cells(Motion(0.2, 0.0, 1.0), ViewMatch(template, -1.0, 0.0, True))
    before = cells.estimate
    for _ in range(3000):
        cells(STILL, known_view(cells, 1))
    assert ring_distance(cells.estimate.x, before.x, 21) < 1.5


@pytest.mark.parametrize("batch", [None, 2])
def test_state_goes_through_a_state_dict_and_a_change_of_type(batch):
    cells = PoseCellNetwork(PoseCellConfig(), batch=batch)
    for _ in range(5):
        cells.integrate(
            Motion(torch.full((2,), 0.3) if batch else 0.3, torch.zeros(2) if batch else 0.1, 1.0)
        )
    copy = PoseCellNetwork(PoseCellConfig(), batch=batch)
    copy.load_state_dict(cells.state_dict())
    assert torch.equal(copy.activity, cells.activity)
    double = PoseCellNetwork(PoseCellConfig(), batch=batch)
    double.load_state_dict(cells.state_dict())
    double = double.to(torch.float64)
    assert double.activity.dtype == torch.float64
    torch.testing.assert_close(double.activity.float(), cells.activity)
    for each in (cells, copy):
        each.integrate(
            Motion(torch.full((2,), 0.3) if batch else 0.3, torch.zeros(2) if batch else 0.1, 1.0)
        )
    assert torch.equal(copy.activity, cells.activity)


@given(seed=st.integers(0, 1000), cells=st.integers(1, 5), brains=st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_windows_of_a_batch_hold_all_activity_and_are_no_larger_than_alone(seed, cells, brains):
    generator = torch.Generator().manual_seed(seed)
    tori = torch.zeros(brains, 9, 7, 8)
    for torus in tori:
        where = torch.randint(torus.numel(), (cells,), generator=generator)
        torus.view(-1)[where] = torch.rand(cells, generator=generator) + 0.1
    packets = to_packets(tori)
    assert torch.equal(to_tori(packets), tori)
    alone = torch.tensor([to_packet(torus).values.shape for torus in tori])
    assert (torch.tensor(packets.values.shape[1:]) <= alone.amax(0)).all()


@given(seed=st.integers(0, 1000), speed=st.floats(-3.0, 3.0), turn=st.floats(-2.0, 2.0))
@settings(max_examples=60, deadline=None)
def test_each_brain_of_a_batch_moves_as_it_would_alone(seed, speed, turn):
    generator = torch.Generator().manual_seed(seed)
    shape, aside = (12, 9, 9), torch.rand(2, 2, generator=generator).double() - 0.5
    at = [torch.rand(3, generator=generator).double() * 9 for _ in range(2)]
    packets = [packet_at(shape, PoseEstimate(*where.tolist())) for where in at]
    tori = torch.stack([to_dense(packet) for packet in packets])
    distances, turns = torch.tensor([speed, -speed / 2]), torch.tensor([turn, turn / 3])
    moved = move_all(to_packets(tori), distances.double(), turns.double(), aside)
    for k, packet in enumerate(packets):
        alone = path_integrate(
            packet, distances[k].item(), turns[k].item(), tuple(aside[k].tolist())
        )
        torch.testing.assert_close(to_tori(moved)[k], to_dense(alone), rtol=0, atol=1e-6)


def test_a_silent_brain_in_a_batch_is_refused():
    tori = torch.zeros(2, 3, 3, 3)
    tori[0, 1, 1, 1] = 1.0
    with pytest.raises(MapError, match="no activity in a brain of the batch"):
        to_packets(tori)


def test_a_nudge_moves_every_brain_of_a_batch_as_it_moves_one():
    one, batch = PoseCellNetwork(PoseCellConfig()), PoseCellNetwork(PoseCellConfig(), batch=2)
    for cells in (one, batch):
        cells.nudge(0.4, -1.2, 2.5)
    torch.testing.assert_close(batch.activity, one.activity.expand(2, -1, -1, -1))


@pytest.mark.parametrize("speed", [400.0, 3e3, 1e6])
def test_a_motion_many_times_round_the_torus_moves_as_the_definition_says(speed, monkeypatch):
    ours, defined = (PoseCellNetwork(PoseCellConfig()) for _ in range(2))
    for k in range(4):
        motion = Motion(speed * (1.0 - 1.7 * (k % 2)), 0.4, 0.05)
        ours.integrate(motion)
        with monkeypatch.context() as patch:
            patch.setattr("neuroslam.cells.torus.runs_compiled", lambda *_: False)
            defined.integrate(motion)
    found, expected = to_dense(ours.packet), to_dense(defined.packet)
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-4)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0.0)
