import math

import numpy as np
import pytest
import torch

from neuroslam.cells.boundary_sheet import (
    BoundarySheet,
    foot_of_beams,
    unwarp,
    warp,
    warped_tuning,
)
from neuroslam.cells.convolve import (
    circular_convolve,
    convolve_axes,
    excite_and_inhibit,
    gaussian_difference,
    gaussian_kernel,
)
from neuroslam.cells.navigation import NavigationCells
from neuroslam.config import BoundaryCellConfig, BrainConfig
from neuroslam.geometry import TWO_PI
from neuroslam.worlds.arena import named_arena

CONFIG = BoundaryCellConfig()
SHEET = BoundarySheet(CONFIG)
AXES = SHEET.bearings_rad, SHEET.warped_m


def tensor(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def random_walls(n, walls, seed=0):
    generator = torch.Generator().manual_seed(seed)
    distance = CONFIG.reach_m * torch.rand(n, walls, generator=generator, dtype=torch.float64)
    return distance, TWO_PI * torch.rand(n, walls, generator=generator, dtype=torch.float64)


def apart(a, b):
    return (a - b + math.pi).remainder(TWO_PI) - math.pi


def test_the_warped_axis_makes_every_distance_tuning_equally_wide():
    d = torch.linspace(0.0, 0.3, 31, dtype=torch.float64)
    assert torch.allclose(unwarp(warp(d, 0.15), 0.15), d, atol=1e-12)
    slope = torch.autograd.functional.jacobian(lambda x: warp(x, 0.15), d).diagonal()
    assert torch.allclose(slope * (d / 0.15 + 1.0), torch.ones_like(d))


def test_one_wall_is_read_within_2_mm_and_half_a_degree():
    distance, bearing = random_walls(300, 1)
    read_m, read_rad, width_m = SHEET.read(SHEET(distance, bearing))
    assert read_m.shape == distance.shape
    assert (read_m - distance).abs().max() < 0.002
    assert apart(read_rad, bearing).abs().max() < math.radians(0.5)
    assert (width_m > 0).all()


def test_walls_closer_than_the_kernel_merge_and_farther_stay_two():
    for degrees, n in ((10.0, 1), (40.0, 2)):  # the kernel is 8.6 degrees wide
        d = tensor(0.15, 0.15)
        found, _, _ = SHEET.read(SHEET(d, tensor(1.0, 1.0 + math.radians(degrees))))
        assert found.isfinite().sum() == n
    for second_m, n in ((0.12, 1), (0.28, 2)):
        found, _, _ = SHEET.read(SHEET(tensor(0.1, second_m), tensor(1.0, 1.0)))
        assert found.isfinite().sum() == n


@pytest.mark.parametrize("radius_m", [0.5, 100.0])
def test_a_wall_in_noisy_scans_is_read_once_and_without_bias_curved_or_straight(radius_m):
    """Beams of 3 cm noise and 10 % outliers; the cells alone read the curved wall 9 mm too near."""
    rng, angle = np.random.default_rng(5), TWO_PI * np.arange(180) / 180
    off, distance_m = [], 0.25
    for _ in range(100):
        ahead = (radius_m - distance_m) * np.cos(angle)
        ranges = -ahead + np.sqrt(ahead**2 + 2.0 * radius_m * distance_m - distance_m**2)
        ranges = np.maximum(ranges + 0.03 * rng.standard_normal(180), 0.0)
        wrong = rng.random(180) < 0.1
        ranges[wrong] = rng.uniform(0.0, 5.0, int(wrong.sum()))
        walls = SHEET.walls_in_scan(ranges)
        off += [row for row in walls - [distance_m, 0.0] if row[0] < 0.05]
    off_m, off_rad = np.array(off).T
    off_rad = (off_rad + math.pi) % TWO_PI - math.pi
    assert 90 <= len(off) <= 102
    assert abs(off_m.mean()) < 0.005
    assert off_m.std() < 0.01
    assert abs(off_rad.mean()) < math.radians(1.0)
    # The nearer the middle of a circle, the less its nearest point is defined.
    assert off_rad.std() < math.radians(6.0) / (1.0 - distance_m / radius_m)


def test_beams_of_another_wall_are_no_foot_of_one():
    """A maximum 40 degrees beside the foot of the perpendicular."""
    angle = TWO_PI * np.arange(180) / 180
    ranges = np.where(np.cos(angle) > 0.1, 0.2 / np.maximum(np.cos(angle), 0.1), math.inf)
    assert foot_of_beams(ranges, 0.2, 0.1, 0.05) == pytest.approx((0.2, 0.0), abs=1e-6)
    assert foot_of_beams(ranges, 0.2, math.radians(40.0), 0.05) is None
    few = np.where(np.arange(180) < 3, ranges, math.inf)
    assert foot_of_beams(few, 0.2, 0.1, 0.05) == (0.2, 0.1)  # too few to tell


def test_turning_the_animal_rolls_the_sheet():
    distance, bearing = random_walls(4, 2)
    turned = SHEET(distance, bearing + 5 * TWO_PI / CONFIG.sheet_bearings)
    assert torch.allclose(turned, SHEET(distance, bearing).roll(5, dims=-2), atol=1e-9)


def test_without_interaction_the_convolution_is_the_tuning_formula():
    alone = BoundarySheet(BoundaryCellConfig(sheet_excitation=0.0, sheet_inhibition=0.0))
    distance, bearing = random_walls(200, 1)
    direct = warped_tuning(distance, bearing, AXES, CONFIG)
    assert torch.allclose(alone.interact_by_convolution(alone.tuned(distance, bearing)), direct,
                          rtol=0, atol=1e-6)  # fmt: skip
    assert torch.allclose(alone(distance, bearing), direct, rtol=0, atol=1e-12)


def test_matrices_and_convolutions_are_equal():
    u = SHEET.tuned(*random_walls(5, 3))
    assert torch.allclose(SHEET.interact(u), SHEET.interact_by_convolution(u), atol=1e-12)


def test_a_batch_equals_its_animals_one_by_one():
    distance, bearing = random_walls(20, 2)
    distance[3:7, 1] = math.inf
    together = SHEET.read(SHEET(distance, bearing))
    for i in range(20):
        alone = SHEET.read(SHEET(distance[i], bearing[i]))
        for whole, one in zip(together, alone, strict=True):
            n = len(one)
            assert torch.allclose(whole[i, :n], one, atol=1e-12)


def test_gradients_flow_through_input_and_kernels():
    distance = tensor(0.1).requires_grad_()
    SHEET(distance, tensor(0.3)).square().sum().backward()
    assert distance.grad.abs().item() > 0
    kernels = [
        k.clone().requires_grad_() for k in (gaussian_kernel(3, 1.0), gaussian_kernel(5, 1.0))
    ]
    convolve_axes(torch.rand(2, 7, 9, dtype=torch.float64), kernels, (True, False))[
        0, 0, 0
    ].backward()
    assert all(k.grad.abs().sum() > 0 for k in kernels)


def test_convolve_axes_is_the_definition_on_rings_and_on_lines():
    values = torch.rand(3, 6, 7, 8, dtype=torch.float64)
    kernels = tuple(torch.rand(n, dtype=torch.float64) for n in (3, 5, 3))
    dense = circular_convolve(values, kernels, "dense")
    assert torch.allclose(convolve_axes(values, kernels), dense, atol=1e-12)
    line = torch.arange(1.0, 5.0, dtype=torch.float64)
    open_ = convolve_axes(line, (tensor(1.0, 2.0, 4.0),), False)
    assert open_.tolist() == np.convolve(line, [1.0, 2.0, 4.0], "same").tolist()


def test_excitation_and_inhibition_are_equal_where_activity_is_flat():
    kernels = gaussian_difference([(3, 1.0)] * 2, [(7, 2.0)] * 2)
    flat = torch.full((9, 9), 0.5, dtype=torch.float64)
    assert torch.allclose(excite_and_inhibit(flat, kernels, (0.7, 0.7)), flat)


def test_noisy_beams_are_read_as_the_walls_that_are_there():
    arena, rng = named_arena("square"), np.random.default_rng(0)
    at = rng.uniform(-0.6, 0.6, (40, 2))
    at[:, 0] = rng.uniform(0.75, 0.92, 40)  # beside one wall, in no corner
    ranges = arena.ranges(at, np.zeros(40), 180, 5.0) + 0.03 * rng.standard_normal((40, 180))
    wrong = rng.random(ranges.shape) < 0.1
    ranges[wrong] = rng.uniform(0.0, 5.0, int(wrong.sum()))
    read = [SHEET.walls_in_scan(np.maximum(r, 0.0))[:1] for r in ranges]
    error = np.array([walls[0, 0] for walls in read]) - (1.0 - at[:, 0])
    assert np.sqrt(np.mean(error**2)) < 0.01  # single beams: 0.03 m


def test_near_a_wall_noisy_beams_make_one_wall_of_its_bearing():
    """Slanting beams tell the bearing: those within 40 degrees alone make two walls of one."""
    rng, n = np.random.default_rng(3), 60
    away = rng.uniform(0.03, 0.12, n)
    for name in ("square", "circle2m"):
        at = np.column_stack([1.0 - away, np.zeros(n)])
        ranges = named_arena(name).ranges(at, np.zeros(n), 180, 5.0)
        ranges += 0.03 * rng.standard_normal(ranges.shape)
        wrong = rng.random(ranges.shape) < 0.1
        ranges[wrong] = rng.uniform(0.0, 5.0, int(wrong.sum()))
        read = [SHEET.walls_in_scan(np.maximum(r, 0.0)) for r in ranges]
        assert sum(len(walls) == 1 for walls in read) >= 0.95 * n, name
        one = np.array([walls[0] for walls in read])
        assert np.std(one[:, 0] - away) < 0.008, name
        assert np.std(np.remainder(one[:, 1] + np.pi, TWO_PI)) < math.radians(6.0), name


@pytest.mark.parametrize("batch", [None, 2])
def test_silent_boundary_cells_change_the_position(batch):
    def drive(share):
        config = BrainConfig.model_validate(
            {
                "wall_memory": {"senses": "boundary_cells"},
                "boundary_cells": {"sheet_inhibition": share},
            }
        )
        cells = NavigationCells(config, batch)
        one = (lambda x: x) if batch is None else (lambda x: x.expand(batch, *x.shape))
        for i in range(60):
            wall = tensor(0.2 if i < 30 else 0.18)
            felt = one(tensor(0.1)[0]), one(tensor(0.0)[0]), 0.05, one(wall), one(tensor(0.4))
            here = cells(*felt)
        return here.position_m

    assert not torch.equal(drive(0.8), drive(30.0))  # inhibition that silences every cell
