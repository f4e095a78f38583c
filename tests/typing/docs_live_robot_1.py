import time

import numpy as np

from neuroslam.runs.live import Event, LiveRobot


def heard(event: Event) -> None:
    print(event.kind, "at experience", event.experience)


with LiveRobot(path="map.safetensors", on_event=heard) as robot:  # saved on exit, also on Ctrl-C
    for _ in range(3):
        picture = np.zeros((120, 160, 3), np.uint8)  # your camera
        speed_m_s, turn_rad_s = 0.5, 0.0  # your wheels; None: measured from the pictures
        here = robot.step(picture, time.time(), (speed_m_s, turn_rad_s), order="bgr")
        print(here.pose, here.confidence)
