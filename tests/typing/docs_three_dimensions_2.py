from neuroslam import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.sensors import open_source

cells = ["pose_3d", "semantic", "head_direction"]
brain = NavigationBrain(build_config(merge_values(read_preset("neuroslam_3d"), {"cells": cells})))
for frame in open_source("world:garage?markers=12&landmark_reach=6&noise=0.05").frames(stop=40):
    brain(frame)
print(brain.pose_3d.z_m, brain.semantic.counts(), brain.head_direction.heading_rad)
