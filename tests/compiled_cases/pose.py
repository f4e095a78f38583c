"""Pose cells."""

import torch

from neuroslam.cells import PoseCellNetwork
from neuroslam.config import PoseCellConfig
from neuroslam.types import Motion, ViewMatch
from tests.compiled_cases import case, with_and_without


@case("cells.attractor.advance", "cells.attractor.decode_window", "cells.attractor.inject_window")
def _a_few_frames_of_pose_cells(draw):
    n_theta, n_xy = draw.integers(7, 14, 2)
    precision = draw.choice(["float32", "float64"])
    config = PoseCellConfig(
        n_theta=n_theta, n_xy=n_xy, cell_size_m=1.0, precision=precision, inject_after=0,
        excite_size=draw.choice([3, 7]), inhibit_size=draw.choice([3, 5]),
        decode_radius=draw.integers(1, 8), exact_gain=bool(draw.integers(2)),
    )  # fmt: skip
    activity = torch.from_numpy(draw.random((n_theta, n_xy, n_xy)) ** draw.integers(9, 60))
    torus = torch.tensor([n_xy, n_xy, n_theta])
    start, v, w = draw.random(3), *draw.normal(0.0, 2.0, 2)

    def drive():
        cells = PoseCellNetwork(config)
        cells.activity = activity / activity.sum()
        cells.bindings.append(**dict(zip(("x", "y", "theta"), 7 * start, strict=True)), decay=0.1)
        frames = [cells.activity]
        for view in (ViewMatch(0, 0.0, 0.3, False), ViewMatch(-1, -1.0, 0.0, False)):
            cells(Motion(v, w, 0.4), view)
            turns = torch.tensor(cells.estimate, dtype=torch.float64) / torus
            frames += [cells.activity, turns.to(cells.activity)]
        return [frame.numpy() for frame in frames]

    return with_and_without(drive)
