import numpy as np

from neuroslam import BrainConfig, NavigationBrain
from neuroslam.config import WallMemoryConfig
from neuroslam.worlds.senses import open_arena

for corrects in (True, False):  # False: walls are felt, but no longer reach the grid cells
    memory, way = WallMemoryConfig(corrects=corrects), []
    brain = NavigationBrain(BrainConfig(cells=("place",), wall_memory=memory))
    rat = open_arena("circle1m?minutes=2&speed=0.2&noise=3&seed=1")
    for frame in rat:
        way.append(brain(frame).cells[:2])
    error = np.linalg.norm(way - (rat.walk.positions - rat.walk.positions[0]), axis=1)
    print("intact" if corrects else "lesioned", error[-600:].mean(), "m in the last 30 s")
