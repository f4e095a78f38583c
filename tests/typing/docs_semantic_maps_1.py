import torch

from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.experiments.ssp_simulation import simulate, slam_in
from neuroslam.spiking import merge_semantic_maps, queries, save_semantic_map
from neuroslam.worlds.landmark_paths import band_limited_path
from neuroslam.worlds.landmarks import random_world

world = random_world(10, seed=1, attributes=True)
slam = slam_in(SSPSLAMConfig(tier="algebraic", time_step_s=0.01), world)
life = simulate(slam, [world], [band_limited_path(60.0, 0.08, seed=3, time_step_s=0.01)])
places = queries.where(slam, slam.pointers[0])  # where is the first landmark?
save_semantic_map(slam, "map.safetensors")  # complete: continues bit for bit
