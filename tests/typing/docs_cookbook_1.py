from neuroslam import record
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.figures.recorded import plot_population, plot_raster

log = record("arena:circle1m?minutes=1&noise=0&speed=0.3")  # activity of all cells
for name in log.names:  # rate maps, autocorrelograms, tuning to heading and speed
    plot_population(log, name).savefig(f"{name}.png")
plot_raster(log).savefig("raster.png")
bins = Bins.around(log.position_m, 0.1)
maps = {name: rate_map(log.position_m, log[name], bins) for name in log.names}  # as arrays
