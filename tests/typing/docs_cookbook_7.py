import torch

from neuroslam.cells import LAHNGridCells, VelocityOscillators
from neuroslam.config import GridCellConfig

position = torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
config = GridCellConfig(spacings_m=(0.5,), orientations_deg=(0.0,), development_steps=800)
cells, guess = LAHNGridCells(config), VelocityOscillators(config)
wanted = cells.settled(guess.phases_at(position)).detach()  # by a spacing of 0.5 m
guess.spacing_m.data.fill_(0.54)
optimiser = torch.optim.Adam([guess.spacing_m], lr=0.004)
for _ in range(60):
    optimiser.zero_grad()
    (cells.settled(guess.phases_at(position)) - wanted).square().mean().backward()
    optimiser.step()
