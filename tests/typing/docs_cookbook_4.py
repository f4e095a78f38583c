import numpy as np
import torch

from neuroslam.cells import LAHNGridCells, VelocityOscillators
from neuroslam.config import GridCellConfig
from neuroslam.evaluation.decoding import decode_position
from neuroslam.evaluation.ratemap import Bins, rate_map

position = np.random.default_rng(0).uniform(0.0, 1.0, (6000, 2))
phases = VelocityOscillators(GridCellConfig()).phases_at(torch.from_numpy(position))
rates = 10.0 * LAHNGridCells(GridCellConfig()).settled(phases).detach().flatten(1).numpy()
counts, bins = np.random.default_rng(1).poisson(0.25 * rates), Bins(0.0, 0.0, 20, 20, 0.05)
maps = rate_map(position[:4000], counts[:4000] / 0.25, bins, sigma_bins=0.5)
decoded = decode_position(counts[4000:], maps, bins, dt_s=0.25)
print(np.median(np.linalg.norm(decoded.position_m - position[4000:], axis=1)), "m, held out")
