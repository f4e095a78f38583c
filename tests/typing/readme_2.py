import matplotlib.pyplot as plt

from neuroslam import record
from neuroslam.evaluation.ratemap import Bins, rate_map

log = record("arena:square?minutes=10&speed=0.2")  # boundary, grid and place cells
bins = Bins.around(log.position_m, 0.08)
figure, rows = plt.subplots(3, 6, figsize=(12, 6), layout="constrained")
for axes, name in zip(rows, log.names, strict=True):
    cells = log[name].var(axis=0).argsort()[::-1][:6]  # that vary most
    maps = rate_map(log.position_m, log[name][:, cells], bins)
    for ax, k, one in zip(axes, cells, maps, strict=True):
        ax.imshow(one, origin="lower", extent=bins.extent_m).axes.set_title(f"{name} {k} (m)")
figure.savefig("rate_maps.png")
