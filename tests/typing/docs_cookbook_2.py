import numpy as np

from neuroslam import BrainConfig, record

t = np.arange(0.0, 30.0, 0.05)  # yours: times in s, positions in cm
px, py = 50 + 30 * np.cos(0.4 * t), 50 + 30 * np.sin(0.6 * t)
np.savetxt("rat.csv", np.column_stack([t, px, py]), header="t,px,py", comments="", delimiter=",")
cells = BrainConfig(cells=("place", "head_direction"))
log = record("track:rat.csv?x=px&y=py&units=cm", cells)
for name in log.names:
    print(name, log[name].shape)  # samples by cells
