import numpy as np

from neuroslam import record
from neuroslam.evaluation.ratemap import Bins, rate_map

logs = [  # two boxes of one shape; the animal enters each elsewhere
    record(f"arena:circle1m?minutes=2&noise=0&speed=0.2&seed={seed}") for seed in (1, 2)
]
bins = Bins(-0.5, -0.5, 10, 10, 0.1)
for name in ("boundary", "grid"):
    maps = [rate_map(log.position_m, log[name], bins) for log in logs]
    both = np.isfinite(maps[0][0]) & np.isfinite(maps[1][0])
    print(name, "cells", np.corrcoef([one[:, both].ravel() for one in maps])[0, 1])
