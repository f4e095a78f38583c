"""SSP-SLAM: neurons beside the same network in Nengo, vectors, and questions to a map."""

import time
from collections.abc import Callable

import numpy as np
import pytest
import torch

from benchmarks.timing import Row, written
from neuroslam.config.semantic import (
    NeuronConfig,
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
)
from neuroslam.experiments.ssp_simulation import slam_in, views
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.space import SSPSpace
from neuroslam.worlds.landmark_paths import band_limited_path
from neuroslam.worlds.landmarks import random_world

BATCH = 8
REFERENCE = SSPSLAMConfig(
    integrator=PathIntegratorConfig(neurons=500),
    map=SemanticMapConfig(neurons=550, relay=True),
    vector_neurons=550,
    binding_neurons=50,
)
"""As many neurons everywhere as the reference's run of 27 400 had."""


class Integrators:
    def __init__(self, batch: int, neurons: int = 500) -> None:
        config = PathIntegratorConfig(neurons=neurons)
        self.walk = PathIntegrator(SSPSpace.hexagonal(), config, NeuronConfig(), 1e-3, batch=batch)
        self.walk.start(torch.zeros(batch, 2))
        self.velocity = 0.1 * torch.randn(batch, 2, generator=torch.Generator().manual_seed(0))

    def steps(self, n: int) -> None:
        self.walk.run(self.velocity.expand(n, -1, -1))


class Animals:
    def __init__(self, config: SSPSLAMConfig, batch: int) -> None:
        dt = config.time_step_s
        paths = [band_limited_path(60.0, 0.08, seed=k, time_step_s=dt) for k in range(batch)]
        worlds = [random_world(10, seed=k) for k in range(batch)]
        self.at = np.stack([path.position_m for path in paths], axis=1)
        self.velocity = torch.from_numpy(np.stack([p.velocity_m_s for p in paths], axis=1))
        self.slam = slam_in(config, worlds[0], batch)
        self.slam.start(torch.from_numpy(self.at[0]))
        self.view = views(worlds, self.at)
        self.now = 0

    def steps(self, n: int) -> None:
        part = slice(self.now, self.now + n)
        view = self.view
        cut = view._replace(
            **{f: getattr(view, f)[part] for f in view._fields if f != "box_landmark"}
        )
        self.slam.run(self.velocity[part], cut)
        self.now = (self.now + n) % (len(self.at) - n)


def milliseconds(
    pairs: dict[str, Callable[[int], object]], steps: int = 200, rounds: int = 7
) -> dict[str, float]:
    """Median CPU ms of a step, all in turn in each round: what is noisy is so for all."""
    times: dict[str, list[float]] = {name: [] for name in pairs}
    for run in pairs.values():
        run(steps)
    for _ in range(rounds):
        for name, run in pairs.items():
            began = time.process_time()
            run(steps)
            times[name].append((time.process_time() - began) / steps * 1e3)
    return {name: float(np.median(each)) for name, each in times.items()}


def rows() -> list[Row]:
    from benchmarks import nengo_ssp

    found = []
    with nengo_ssp.simulator(nengo_ssp.path_integrator, 500) as reference:
        one, eight = Integrators(1), Integrators(BATCH)
        ms = milliseconds(
            {
                "nengo": lambda n: reference.run_steps(n, progress_bar=False),
                "1": one.steps,
                "8": eight.steps,
            }
        )
    for batch, name in ((1, "1"), (BATCH, "8")):
        times = 10 if batch == 1 else 20
        found.append(_row("path integrator, 13 500 neurons", batch, ms["nengo"], ms[name], times))
    with nengo_ssp.simulator(nengo_ssp.whole, 500, 550, 50) as reference:
        one, eight = Animals(REFERENCE, 1), Animals(REFERENCE, BATCH)
        ms = milliseconds(
            {
                "nengo": lambda n: reference.run_steps(n, progress_bar=False),
                "1": one.steps,
                "8": eight.steps,
            }
        )
    for batch, name in ((1, "1"), (BATCH, "8")):
        times = 15 if batch == 1 else 25
        found.append(_row("SSP-SLAM, 27 050 neurons", batch, ms["nengo"], ms[name], times))
    algebraic = SSPSLAMConfig(tier="algebraic", time_step_s=0.01)
    for batch in (1, BATCH, 64):
        ms = milliseconds({"": Animals(algebraic, batch).steps})[""]
        speed = batch * algebraic.time_step_s / ms * 1e3
        found.append(
            Row(
                "SSP-SLAM in vectors, a step and animal",
                f"{batch} animals, 100 Hz",
                ms / batch,
                ">= 300 simulated s/s" if batch == 1 else "",
                more=f"{speed:.0f} simulated s/s",
            )
        )
    return found


def _row(what: str, batch: int, reference: float, ours: float, times: int) -> Row:
    each = ours / batch
    return Row(
        what, f"a step and animal of {batch}", each, f"{times} times Nengo",
        f"Nengo {written(reference)}", f"{reference / each:.1f} times",
    )  # fmt: skip


@pytest.mark.parametrize("batch", [1, BATCH])
def test_path_integrator(benchmark, batch):
    torch.set_num_threads(1)
    benchmark(Integrators(batch).steps, 50)


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_slam(benchmark, tier):
    torch.set_num_threads(1)
    config = REFERENCE if tier == "spiking" else SSPSLAMConfig(tier=tier, time_step_s=0.01)
    benchmark(Animals(config, BATCH).steps, 50)
