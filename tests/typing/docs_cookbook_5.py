import numpy as np

from neuroslam import BrainConfig, NavigationBrain
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.worlds.senses import open_arena

maps = []
for box in (1, 2):  # two boxes of one shape; the animal enters each elsewhere
    brain, rates = NavigationBrain(BrainConfig(cells=("place",))), []
    rat = open_arena(f"circle1m?minutes=2&noise=0&speed=0.2&seed={box}")
    for frame in rat:
        brain(frame)
        rates.append(brain.populations["place"].rates)
    maps.append(rate_map(rat.walk.positions, np.array(rates), Bins(-0.5, -0.5, 10, 10, 0.1)))
both = np.isfinite(maps[0][0]) & np.isfinite(maps[1][0])
for name, cells in (("boundary cells", slice(0, 168)), ("grid cells", slice(168, None))):
    print(name, np.corrcoef(*(m[cells][:, both].ravel() for m in maps))[0, 1])
