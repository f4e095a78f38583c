"""Tables of a map: its experiences, the links between them, and their origins."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

NUMBER_BITS = 23
"""Bits of an experience's number in its session; the id of the session has the 40 above."""

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
    "session": ((), torch.int64),  # that made it, and its number there
    "number": ((), torch.int64),
}

ALIAS_COLUMNS = {
    "session": ((), torch.int64),
    "number": ((), torch.int64),
    "first_frame": ((), torch.int64),
    "experience": ((), torch.int64),  # that it is part of now
    "turn_rad": ((), torch.float64),  # its heading minus that of the experience it is part of
}


class Links(NamedTuple):
    """Displacements measured between experiences, relative to ``source``; arrays of one length.

    Attributes:
        source: Experience at which the link begins.
        target: Experience at which it ends.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target, relative to the source's heading.
        duration_s: Time that the robot took from source to target.
    """

    source: np.ndarray
    target: np.ndarray
    distance_m: np.ndarray
    heading_rad: np.ndarray
    facing_rad: np.ndarray
    duration_s: np.ndarray


class Origins(NamedTuple):
    """Origins of experiences; one row for each that any session ever made.

    Attributes:
        session: Session that made it.
        number: Number of experiences that this session had made before.
        first_frame: Frame that made it.
        experience: Its id now, or that of the experience that it is part of.
        turn_rad: Its heading when it was made, minus the heading of ``experience``.
        ahead_m: Its position in the frame of ``experience``; 0 for one that was merged.
        left_m: And to the left.
    """

    session: np.ndarray
    number: np.ndarray
    first_frame: np.ndarray
    experience: np.ndarray
    turn_rad: np.ndarray
    ahead_m: np.ndarray
    left_m: np.ndarray


def origin_key(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return one ``int64`` key for each pair of session and number.

    Example:
        >>> origin_key({"session": np.array([1]), "number": np.array([2])}).tolist()
        [8388610]
    """
    key: np.ndarray = (rows["session"] << NUMBER_BITS) | rows["number"]
    return key


def closes_loop(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return which links close a loop: not the first link to an experience from an earlier one.

    Example:
        >>> closes_loop(np.array([0, 1, 2]), np.array([1, 2, 0])).tolist()
        [False, False, True]
    """
    first = np.zeros(len(target), dtype=bool)
    first[np.unique(target, return_index=True)[1]] = True
    return ~(first & (target > source))
