from pathlib import Path

import torch

from neuroslam.figures.density import Spread, plot_densities
from neuroslam.figures.style import save
from neuroslam.spiking import DensityEstimator, SSPSpace
from neuroslam.spiking.density import encode_samples, rectified_density
from neuroslam.spiking.gaussian import fit_gaussian

draw = torch.Generator().manual_seed(0)
turned = torch.tensor([[0.20, 0.0], [0.10, 0.08]])
long = torch.tensor([0.25, 0.2]) + torch.randn(600, 2, generator=draw) @ turned.T
round_ = torch.tensor([-0.5, -0.4]) + 0.08 * torch.randn(300, 2, generator=draw)
samples = torch.cat([long, round_])

space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)  # pointers of 151 numbers
estimator = DensityEstimator(space)
estimator(samples)
density = estimator.density()
print(density.integral, density.mean_m, density.covariance_m2, density.entropy)
print(density.expectation(lambda x: (x[:, 1] < 0.0).float()))  # probability of y < 0

each = [fit_gaussian(space, encode_samples(space, part)) for part in (long, round_)]
spreads = [Spread(one.mean_m.numpy(), one.covariance_m2.numpy()) for one in each]
panels = {
    "Rectified similarity": rectified_density(space, estimator.z),
    "Maximum entropy": density,
}
title = "Density of 900 samples in a pointer of 151 numbers"
save(plot_densities(panels, samples.numpy(), spreads, title), Path("density.png"))
