import torch

from neuroslam.cells import LAHNGridCells, VelocityOscillators
from neuroslam.config import GridCellConfig
from neuroslam.evaluation.gridness import grid_stats

axis = torch.arange(0.0, 1.5, 0.025, dtype=torch.float64)
at = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1)
for spacing in (0.3, 0.5):
    config = GridCellConfig(spacings_m=(spacing,), orientations_deg=(0.0,), development_steps=800)
    cells, oscillators = LAHNGridCells(config), VelocityOscillators(config)
    with torch.no_grad():
        rates = cells.settled(oscillators.phases_at(at))
    print(spacing, grid_stats(rates[..., 0, 3].numpy(), bin_m=0.025).spacing_m)
