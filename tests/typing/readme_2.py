import matplotlib.pyplot as plt

from neuroslam import record
from neuroslam.evaluation.ratemap import Bins, rate_map

log = record("arena:square?minutes=10&speed=0.2")  # boundary, grid and place cells
bins = Bins.around(log.position_m, 0.08)
figure, rows = plt.subplots(3, 6, figsize=(12, 6), layout="constrained")
for axes, name in zip(rows, log.names, strict=True):
    cells = log[name].var(axis=0).argsort()[::-1][:6]  # that vary most
    for ax, k, one in zip(axes, cells, rate_map(log.position_m, log[name][:, cells], bins), strict=True):
        ax.imshow(one, origin="lower", extent=bins.extent_m)
        ax.set(title=f"{name} {k}", xlabel="x (m)", ylabel="y (m)")
figure.savefig("rate_maps.png")
