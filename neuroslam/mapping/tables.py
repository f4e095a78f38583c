"""What a map keeps of its experiences, of the links between them, and of where they come from."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

NUMBER_BITS = 23
"""An experience's number in its session takes so many; a session's id the 40 above them."""

LINK_COLUMNS = {
    "source": ((), torch.int64),
    "target": ((), torch.int64),
    "distance_m": ((), torch.float64),
    "heading_rad": ((), torch.float64),
    "facing_rad": ((), torch.float64),
    "duration_s": ((), torch.float64),
}

EXPERIENCE_COLUMNS = {
    "pose": ((3,), torch.float64),  # x_m, y_m, theta_rad
    "cell": ((3,), torch.float64),  # pose-cell estimate when it was made: x, y, theta
    "template": ((), torch.int64),
    "first_frame": ((), torch.int64),
    "session": ((), torch.int64),  # in which it was made, and how many that had made before
    "number": ((), torch.int64),
}

ALIAS_COLUMNS = {
    "session": ((), torch.int64),
    "number": ((), torch.int64),
    "first_frame": ((), torch.int64),
    "experience": ((), torch.int64),  # what it is part of now
    "turn_rad": ((), torch.float64),  # its heading, minus that of what it is part of
}


class Links(NamedTuple):
    """What the robot measured between experiences; arrays of one length, relative to ``source``.

    Attributes:
        source: Experience that was left.
        target: Experience that was reached.
        distance_m: How far the target lies from the source.
        heading_rad: In which direction, relative to the source's heading.
        facing_rad: Heading on arrival, relative to the source's heading.
        duration_s: How long the way took.
    """

    source: np.ndarray
    target: np.ndarray
    distance_m: np.ndarray
    heading_rad: np.ndarray
    facing_rad: np.ndarray
    duration_s: np.ndarray


class Origins(NamedTuple):
    """Where experiences come from; one row for each that any session ever made.

    Attributes:
        session: Session that made it.
        number: How many that session had made before.
        first_frame: Frame that made it.
        experience: What it is now: its id, or that of the experience it was made part of.
        turn_rad: Heading it was made with, minus the heading of what it is now.
    """

    session: np.ndarray
    number: np.ndarray
    first_frame: np.ndarray
    experience: np.ndarray
    turn_rad: np.ndarray


def origin_key(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """One number for each session and number of an experience in it, ``int64``.

    Example:
        >>> origin_key({"session": np.array([1]), "number": np.array([2])}).tolist()
        [8388610]
    """
    return (rows["session"] << NUMBER_BITS) | rows["number"]


def closes_loop(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Tell which links join places that were both known: not the way on which one was found.

    Example:
        >>> closes_loop(np.array([0, 1, 2]), np.array([1, 2, 0])).tolist()
        [False, False, True]
    """
    first = np.zeros(len(target), dtype=bool)
    first[np.unique(target, return_index=True)[1]] = True
    return ~(first & (target > source))
