from pathlib import Path

import numpy as np

from neuroslam import NavigationBrain
from neuroslam.shared_map import Journal, LiveRobot


def drive(folder: Path, brain: NavigationBrain, picture: np.ndarray) -> None:
    """Offer what is new, take the places of other robots, and ask where a picture was taken."""
    with Journal(folder, brain.config) as journal:
        robot = LiveRobot(journal, brain, "ada")
        robot.offer()
        if robot.take():
            print(robot.pose, robot.recognise(picture), robot.localiser())
