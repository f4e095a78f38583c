import math

from neuroslam import NavigationBrain
from neuroslam.config import build_config, read_preset
from neuroslam.types import Frame, Velocity

brain = NavigationBrain(build_config(read_preset("neuroslam_3d")))
speed, pitch = 2.0, math.radians(8)
velocity = Velocity(speed * math.cos(pitch), 0.0)
for i in range(30):
    brain(Frame(i, 0.1 * i, None, velocity, v_z_m_s=speed * math.sin(pitch)))
print(brain.pose_3d.estimate_3d, brain.pose_3d.z_m)
