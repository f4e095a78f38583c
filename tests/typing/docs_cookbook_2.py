import numpy as np

from neuroslam import BrainConfig, NavigationBrain, open_source

t = np.arange(0.0, 30.0, 0.05)  # yours: times in s, positions in m, corners of the box
x, y = 0.5 + 0.3 * np.cos(0.4 * t), 0.5 + 0.3 * np.sin(0.6 * t)
box = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
np.savez("track.npz", t=t, pos=np.column_stack([x, y]), vertices=np.array(box))
brain, rates = NavigationBrain(BrainConfig(cells=("place", "head_direction"))), []
for frame in open_source("arena:track.npz?noise=0"):
    brain(frame)
    rates.append(np.hstack([p.rates for p in brain.populations.values() if p.rates is not None]))
activity = np.array(rates)  # time by cells: boundary, grid and head-direction cells
print(activity.shape)
