"""TensorBoard gets rates, rasters, the gate and what the map recalls."""

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.tensorboard import SummaryWriter

from neuroslam.config.semantic import PathIntegratorConfig, SSPSLAMConfig
from neuroslam.experiments.ssp_simulation import slam_in, views
from neuroslam.runs.panels import SemanticPanels
from neuroslam.worlds.landmarks import make_world, point


def test_panels_are_written(tmp_path):
    world = make_world([point("A", (0.1, 0.0)), point("B", (-0.3, 0.15))])
    config = SSPSLAMConfig(
        integrator=PathIntegratorConfig(neurons=50), binding="exact", vector_neurons=60
    )
    slam = slam_in(config, world)
    slam.start(torch.zeros(1, 2))
    with SummaryWriter(tmp_path) as writer:
        panels = SemanticPanels(slam, writer, world, every=20)
        slam.run(torch.zeros(200, 1, 2), views([world], np.zeros((200, 1, 2))), panels)
    events = EventAccumulator(str(tmp_path), {"images": 0, "scalars": 0, "histograms": 0})
    events.Reload()
    tags = events.Tags()
    assert {"ssp/gate", "ssp/recall", "ssp/agreement", "ssp_rate_hz/integrator"} <= set(
        tags["scalars"]
    )
    assert set(tags["images"]) == {"ssp/spikes", "ssp/map"}
    assert "ssp_rates_hz/map.memory" in tags["histograms"]
    rate = [event.value for event in events.Scalars("ssp_rate_hz/integrator")]
    assert 30 < rate[-1] < 300
