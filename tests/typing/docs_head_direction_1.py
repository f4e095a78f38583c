from neuroslam.cells import HeadDirectionCells, SpeedCells
from neuroslam.types import Motion, ViewMatch

heads, speeds = HeadDirectionCells(), SpeedCells()
motion = Motion(v_m_s=0.5, w_rad_s=0.8, dt_s=0.05)
heading = heads(
    motion, ViewMatch(0, -1.0, 0.0, True), compass_rad=0.3
)  # view and compass are optional
speed = speeds(motion)
heads.rates, heads.heading_rad, speeds.rates, speeds.speed_m_s
