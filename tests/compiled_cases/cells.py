"""Navigation cells, head-direction and speed cells, worlds."""

import numpy as np
import torch

from neuroslam.cells.boundary import BoundaryCells
from neuroslam.cells.boundary_sheet import BoundarySheet
from neuroslam.cells.clone_steps import (
    SPREAD,
    TURN_SPREAD,
    advance_belief_of_arrays,
    advance_belief_step,
)
from neuroslam.cells.familiarity import Familiarity
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.head_direction import (
    HeadDirectionConfig,
    bump_at,
    decode_heading,
    decode_step,
    inject,
    inject_step,
    make_ring,
    ring_step,
    turn_step,
)
from neuroslam.cells.interference import OscillatoryInterference
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells, place_response
from neuroslam.cells.sheet import SheetParameters, _waves, relax_step, sheet_step, sheet_weights
from neuroslam.cells.speed import SpeedCells
from neuroslam.cells.walls import WallMemory
from neuroslam.config import (
    BoundaryCellConfig,
    GridCellConfig,
    PlaceCellConfig,
    WallMemoryConfig,
)
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.types import Motion
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from tests.compiled_cases import case, with_and_without


def twins(make):
    """Make two equal modules; the second is to take compiled steps."""
    return make(), make()


def states(first, second):
    """Pair the states of two modules; the place cells' window is in no order."""
    one, other = (module.state_dict() for module in (first, second))
    assert one.keys() == other.keys()
    return [
        tuple(s[name].sort().values if name == "window" else s[name].clone() for s in (one, other))
        for name in one
    ]


def walls_around(rng, most=5):
    n = int(rng.integers(0, most))
    distance = np.where(rng.random(n) < 0.8, rng.uniform(0.0, 0.4, n), np.inf)
    return np.sort(distance), rng.uniform(-7.0, 7.0, n)


def tensors(*arrays):
    return [torch.as_tensor(array, dtype=torch.float64) for array in arrays]


@case("cells.boundary.respond_step")
@torch.inference_mode()
def boundary_cells(rng):
    ours, theirs = twins(lambda: BoundaryCells(BoundaryCellConfig()))
    pairs = []
    for _ in range(4):
        heading, dt_s, (wall_m, relative) = rng.uniform(-3, 3), rng.uniform(0, 1), walls_around(rng)
        ours.respond(*tensors(wall_m, relative + heading), dt_s)
        _, bearing = theirs.respond_compiled(0.1, heading, wall_m, relative, dt_s)
        pairs += [*states(ours, theirs), (relative + heading, bearing)]
    return pairs


@case("cells.boundary_sheet.respond_step", "cells.boundary_sheet.read_step")
@torch.inference_mode()
def boundary_sheet(rng):
    sheet = BoundarySheet(BoundaryCellConfig(sheet_bearings=int(rng.integers(36, 80))))
    wall_m, bearing = tensors(*walls_around(rng))
    batch, rates = sheet(wall_m[None], bearing[None]), sheet(wall_m, bearing)
    return [
        (batch[0], rates),
        *((p[0], q) for p, q in zip(sheet.read(batch), sheet.read(rates), strict=True)),
    ]


@case("cells.oscillators.shift_step", "cells.oscillators.decode_step")
@torch.inference_mode()
def oscillators(rng):
    ours, theirs = twins(lambda: VelocityOscillators(GridCellConfig()))
    pairs = []
    for _ in range(4):
        move = rng.normal(0.0, 0.05, 2)
        ours.shift(torch.from_numpy(move))
        theirs.shift_compiled(*move.tolist())
        pairs += states(ours, theirs)
        ours.decode()
        theirs.decode_compiled()
        pairs += states(ours, theirs)
    return pairs


@case("cells.grid.rates_step", "cells.grid.learn_step")
@torch.inference_mode()
def grid_cells(rng):
    n_cells = int(rng.integers(1, 26))
    config = GridCellConfig(
        n_cells=n_cells, development_steps=5, learns_online=rng.random() < 0.5,
        online_share=float(rng.choice([0.01, 1.0])),
        lateral=rng.choice(["learned", "kernel", "both"]),
    )  # fmt: skip
    ours, theirs = twins(lambda: LAHNGridCells(config))
    pairs = []
    for _ in range(3):
        angle = rng.uniform(0, 7, (4, 6))
        phases = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        pairs.append((ours(torch.from_numpy(phases)).numpy(), theirs.rates_compiled(phases).copy()))
        pairs += states(ours, theirs)
    return pairs


@case("cells.place.compete_step")
@torch.inference_mode()
def place_cells(rng):
    config = PlaceCellConfig(excitation=float(rng.choice([0.0, 0.7])), excitation_m=0.08)
    ours, theirs = twins(lambda: CompetitiveHebbianPlaceCells(config, n_grid=26))
    at, waves, pairs = np.zeros(2), rng.normal(0.0, 3.0, (26, 2)), []
    for _ in range(90 if rng.random() < 0.2 else 25):  # 90: more cells than the first table has
        at = at + rng.normal(0.0, 0.12, 2)
        learns = None if rng.random() < 0.9 else bool(rng.random() < 0.5)
        rates = np.maximum(np.cos(waves @ at), 0.0).astype(np.float32).reshape(2, 13)
        told = None if learns is None else torch.tensor([learns])
        grid = torch.from_numpy(rates).flatten()
        here = ours(grid, torch.from_numpy(at), 0.1, learns=told)
        winner, recruited = theirs.compete_compiled(rates, at, 0.1, learns)
        pairs += [(here.winner.numpy(), np.array(winner)), (here.recruited, np.array(recruited))]
    return pairs + states(ours, theirs)


@case("cells.place.responses_step", "cells.place.record_step")
@torch.inference_mode()
def place_cell_responses(rng):
    config = PlaceCellConfig()
    cells = CompetitiveHebbianPlaceCells(config, n_grid=26)
    waves = rng.normal(0.0, 3.0, (26, 2))
    for _ in range(12):
        at = rng.uniform(-0.6, 0.6, 2)
        grid = torch.from_numpy(np.maximum(np.cos(waves @ at), 0.0).astype(np.float32))
        cells(grid, torch.from_numpy(at), 0.1)
    n = int(cells.n_cells)
    away = (cells.centres_m[:, :n] - torch.from_numpy(at)).square().sum(-1)
    unit = torch.nn.functional.normalize(grid.double(), dim=0)
    compiled = cells.responses(grid, torch.from_numpy(at))  # first: it completes the weights
    weights = cells.weights[:, :n].double()
    said = place_response(weights, away, unit, config.power, config.continuity_m)[0]
    felt, tables = rng.random((3, 2)).astype(np.float32), [np.zeros((2, m), np.float32) for m in
                                                           (6, 26, n + 3)]  # fmt: skip
    wrote = cells.record_compiled(1, felt, grid.numpy().reshape(2, 13), at, *tables)
    narrow = cells.record_compiled(1, felt, grid.numpy(), at, *tables[:2], tables[2][:, : n - 1])
    expected = [felt.flatten(), grid.numpy(), np.append(compiled.numpy(), np.zeros(3, np.float32))]
    return [
        (said.float().numpy(), compiled.numpy()),
        (np.array([n, -1]), np.array([wrote, narrow])),
        *zip(expected, (table[1] for table in tables), strict=True),
        *((np.zeros_like(table[0]), table[0]) for table in tables),
    ]


@case("cells.walls.move_step", "cells.walls.predict_step", "cells.walls.correct_step",
      "cells.walls.evidence_step")  # fmt: skip
@torch.inference_mode()
def wall_memory(rng):
    ours, theirs = twins(lambda: WallMemory(WallMemoryConfig(period_s=0.0)))
    at, pairs, compass = np.zeros(2), [], bool(rng.random() < 0.5)
    for k in range(20):
        speed, heading, dt_s = rng.uniform(0, 0.5), rng.uniform(-3, 3), rng.uniform(0.0, 8.0)
        step = ours.move(*tensors(speed, heading), dt_s).numpy()
        pairs.append((step, np.array(theirs.move_compiled(speed, heading, dt_s))))
        # Two walls at right angles that are where they were, but for noise, and others.
        at = 0.9 * (at + step)
        wall_m = np.abs(np.append(0.3 - at + rng.normal(0.0, 0.01, 2), rng.uniform(0, 0.3)))
        bearing = np.array([0.0, np.pi / 2, rng.uniform(-3, 3)]) + rng.normal(0.0, 0.02, 3)
        learns = bool(rng.random() < 0.8)
        off = ours.update_from_walls(
            *tensors(at, wall_m, bearing), compass=compass, learns=torch.tensor([learns])
        )
        end = at.copy()
        theirs.update_compiled(end, wall_m, bearing, compass=compass, learns=learns)
        pairs.append((at + off.numpy(), end))
        if k % 10 == 9:
            felt = bearing - ours.errors[:, 1].numpy()
            evidence = ours.evidence(*tensors(at[None], wall_m[None], felt[None]), 0.2)
            *again, error = theirs.evidence_compiled(at, wall_m, bearing, 0.2)
            pairs += zip((e.item() for e in evidence), again, strict=True)
            pairs.append((ours.errors[0, 1].item(), error))
            pairs += states(ours, theirs)
    return pairs


@case("cells.familiarity.compare_step")
@torch.inference_mode()
def familiarity(rng):
    ours, theirs = twins(lambda: Familiarity(BoundaryCellConfig(), 4.0))
    pairs = []
    walls = [walls_around(rng) for _ in range(3)]
    for _ in range(20):
        place = int(rng.integers(-1, 3))
        wall_m, bearing = walls[place] if rng.random() < 0.8 else walls_around(rng)
        against, supports = (rng.random(2) < 0.1).tolist()
        evidence = torch.tensor([against]), torch.tensor([supports])
        told = tensors(wall_m[None], bearing[None] - 0.25)
        ours(torch.tensor([place]), *told, evidence, 0.5)
        theirs.compare_compiled(place, wall_m, bearing, 0.25, (against, supports), 0.5)
        pairs += states(ours, theirs)
    return pairs


@case("cells.interference.interference_step")
@torch.inference_mode()
def interference(rng):
    def make():
        theta_hz = None if seed % 2 else 8.0
        combine = ("product", "sum")[seed // 2 % 2]
        return OscillatoryInterference(theta_hz=theta_hz, combine=combine, batch=batch)

    seed, batch, pairs = int(rng.integers(0, 4)), 1, []
    ours = make()
    batch = None
    theirs = make()
    for _ in range(3):
        velocity, dt_s = torch.from_numpy(rng.normal(0.0, 0.3, 2)), rng.uniform(0.0, 0.5)
        pairs.append((ours(velocity[None], dt_s)[0], theirs(velocity, dt_s)))
        pairs += [(ours.phase_rad[0], theirs.phase_rad), (ours.theta_rad[0], theirs.theta_rad)]
    return pairs


@case("cells.sheet.relax_step")
@torch.inference_mode()
def grid_sheet(rng):
    shape = {"n_y": int(rng.integers(24, 30)), "n_x": int(rng.integers(24, 30))}
    p = SheetParameters(**shape, surround=rng.uniform(1.01, 2.0))
    rates = torch.from_numpy(rng.uniform(0.0, 0.2, (4, p.n_y, p.n_x)))
    drive = torch.from_numpy(rng.normal(0.0, 0.1, 2))
    stepped = rates.float().numpy()
    pushed = (1.0 + torch.stack([drive, -drive], dim=-1).flatten()).float().numpy()
    relax_step(stepped, pushed, 0.2, 3, *_waves(p))
    for _ in range(3):
        rates = sheet_step(rates, drive, sheet_weights(p), 0.2)
    return [(rates.float(), stepped)]


@case("cells.head_direction.turn_step", "cells.head_direction.inject_step",
      "cells.head_direction.decode_step")  # fmt: skip
@torch.inference_mode()
def head_direction(rng):
    config = HeadDirectionConfig(n=int(rng.integers(24, 130)), exponent=rng.choice([2.0, 1.5]))
    ring, at = make_ring(config), rng.uniform(-4, 4)
    order, _, kernels, bump, windows = (part.numpy() for part in ring[:5])
    ours, theirs, pairs = bump_at(ring, at), bump_at(ring, at).numpy(), []
    for _ in range(3):
        turn, cue, share = rng.normal(0.0, 0.5), rng.uniform(-4, 4), rng.random()
        ours = ring_step(ours, turn, share, ring)
        theirs = turn_step(theirs, turn, share, order, kernels, config.gain, config.exponent)
        pairs += [(ours, theirs), (decode_heading(ours, ring), decode_step(theirs, windows))]
        ours = inject(ours, cue, share / 2, ring)
        theirs = inject_step(theirs, cue, share / 2, order, bump)
        pairs.append((ours, theirs))
    return pairs


@case("cells.clone_steps.advance_belief_step")
def belief_of_clones(rng):
    n = int(rng.integers(5, 60))
    links = [np.arange(n - 1), np.arange(1, n)]
    extra = rng.integers(0, n, (2, int(rng.integers(0, 20))))
    source, target = (np.concatenate(pair) for pair in zip(links, extra, strict=True))
    belief = rng.random(n) * (rng.random(n) < 0.5)
    since = np.column_stack([rng.uniform(0.0, 1.0, n), rng.normal(0.0, 0.3, n)])
    length, facing = rng.uniform(0.05, 1.0, len(source)), rng.normal(0.0, 0.5, len(source))
    moved = float(rng.uniform(0.0, 0.5)), float(rng.normal(0.0, 0.2))
    rows = belief, since, source, target, length, facing, moved, 0.5
    steps = advance_belief_step(*rows, SPREAD, TURN_SPREAD)
    return [*zip(advance_belief_of_arrays(*rows), steps, strict=True)]


@case("worlds.arena.cast_step")
def scans(rng):
    arena = named_arena(rng.choice(["triangle", "pillar", "two_rooms", "circle1m"]))
    low, high = np.reshape(arena.bounds, (2, 2)).T
    points = rng.uniform(low, high, (8, 2))
    points, headings, beams = points[arena.contains(points)], rng.uniform(-9, 9, 8), 60
    headings = headings[: len(points)]
    angle = (headings[:, None] + 2 * np.pi * np.arange(beams) / beams).ravel()
    expected = arena._cast(points, np.column_stack([np.cos(angle), np.sin(angle)]))
    got = arena.ranges(points, headings, beams, np.inf)
    return [(expected.reshape(got.shape), got)]


@case("sensors.scan.find_walls")
def walls_of_scans(rng):
    arena = named_arena(rng.choice(["triangle", "pillar", "two_rooms", "circle1m"]))
    low, high = np.reshape(arena.bounds, (2, 2)).T
    points = rng.uniform(low, high, (12, 2))
    points, reach_m = points[arena.contains(points)], rng.choice([0.5, 5.0])
    scans = arena.ranges(points, np.zeros(len(points)), int(rng.integers(36, 200)), reach_m)
    scans = np.maximum(scans + rng.normal(0.0, 0.01, scans.shape), 0.0)
    return with_and_without(lambda: [walls_in_scan(scan, 0.3) for scan in scans])


@case("worlds.rodent.walk_steps")
def walks(rng):
    arena, seed = named_arena(rng.choice(["triangle", "pillar", "circle1m"])), rng.integers(1000)
    return with_and_without(lambda: [roam(arena, 0.3, np.random.default_rng(seed)).positions])


@case("cells.speed.rates_step")
@torch.inference_mode()
def speed_cells(rng):
    ours, theirs = SpeedCells(batch=1), SpeedCells()
    pairs = []
    for dt_s in (0.0, *rng.uniform(0.0, 0.2, 4)):
        speed = rng.uniform(-1.0, 3.0)
        ours.advance(Motion(*tensors([speed], [0.0]), dt_s))
        theirs.advance(Motion(speed, 0.0, dt_s))
        pairs += [(ours.rates_hz[0], theirs.rates_hz.clone())]
        pairs += [(ours.smoothed_m_s[0], theirs.smoothed_m_s.clone())]
    return pairs
