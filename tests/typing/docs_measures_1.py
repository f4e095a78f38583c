import numpy as np

from neuroslam.evaluation.decoding import decode_position
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import Bins, RateMaps, spatial_information
from neuroslam.evaluation.selectivity import border_score, sparsity

rng = np.random.default_rng(0)
positions = rng.uniform(0.0, 1.0, (6000, 2))  # five minutes at 20 Hz, metres
centres = rng.uniform(0.0, 1.0, (30, 2))
distance = np.linalg.norm(positions[:, None] - centres, axis=2)
rates = 20.0 * np.exp(-((distance / 0.15) ** 2))  # Hz

bins = Bins.around(positions, bin_m=0.05)
maps = RateMaps(bins, n_cells=30)
maps.add(positions, rates)
smooth = maps.maps(sigma_bins=1.0)
print(spatial_information(smooth, maps.counts), sparsity(smooth, maps.counts))
print(gridness(smooth), border_score(smooth, bins.bin_m).score)

counts = rng.poisson(rates / 20.0)
decoded = decode_position(counts, smooth, bins, dt_s=0.05)
print(np.median(np.linalg.norm(decoded.position_m - positions, axis=1)))
