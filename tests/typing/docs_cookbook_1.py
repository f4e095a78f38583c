import numpy as np

from neuroslam import BrainConfig, NavigationBrain
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.figures.cells import Firing, plot_firing_maps
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.senses import open_arena

brain, box = NavigationBrain(BrainConfig(cells=("place",))), named_arena("circle1m")
rat, rates = open_arena("circle1m?minutes=1&noise=0&speed=0.3"), []
for frame in rat:
    brain(frame)
    rates.append(brain.populations["place"].rates)
bins = Bins.around(rat.walk.positions, 0.1)
maps = rate_map(rat.walk.positions, np.array(rates), bins)
panels = [Firing(f"Cell {k}", "", maps[k], bins, box) for k in (0, 168, 192, 216)]
plot_firing_maps([panels], "A boundary and three grid cells", "rate").savefig("maps.png")
