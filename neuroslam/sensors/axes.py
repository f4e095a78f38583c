"""Axes of poses in three dimensions, and their projection onto the ground plane."""

import re
from typing import NamedTuple

import numpy as np

from neuroslam.errors import SourceError

_NAMED = {"robot": "x,y", "camera": "z,-x"}
_SYNTAX = re.compile(r"\s*([+-]?)([xyz])\s*,\s*([+-]?)([xyz])\s*")

_FLAT = 0.1
"""Extent in y relative to that in z below which y counts as the vertical."""


class Axes(NamedTuple):
    """The axes of a file that span the ground plane.

    Attributes:
        name: As the user writes them.
        ahead: Number and sign of the axis that becomes x, and along which the body looks.
        left: Number and sign of the axis that becomes y.
    """

    name: str
    ahead: tuple[int, float]
    left: tuple[int, float]


def parse_axes(text: str) -> Axes:
    """Read the axes of the ground plane: ``robot`` (x, y), ``camera`` (z, -x), or a pair of axes.

    Raises:
        SourceError: If the text is something else, or both axes are the same.

    Example:
        >>> parse_axes("camera")
        Axes(name='camera', ahead=(2, 1.0), left=(0, -1.0))
        >>> parse_axes("-z,-x").ahead
        (2, -1.0)
    """
    match = _SYNTAX.fullmatch(_NAMED.get(text, text))
    if match is None or match[2] == match[4]:
        raise SourceError(
            f"axes {text!r}: expected robot (x ahead, y left), camera (z ahead, x right), or the "
            "axes that point ahead and left, such as z,-x"
        )
    (ahead, forward), (left, side) = (
        ("xyz".index(match[n + 1]), -1.0 if match[n] == "-" else 1.0) for n in (1, 3)
    )
    return Axes(text, (ahead, forward), (left, side))


ROBOT = parse_axes("robot")


def rotate(quaternions: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate a vector by quaternions x, y, z, w, ``(n, 4)``, of any length; NaN for length 0."""
    with np.errstate(invalid="ignore"):
        q = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    axis, w = q[:, :3], q[:, 3:]
    across = np.cross(axis, vector)
    return np.asarray(vector + 2.0 * (w * across + np.cross(axis, across)))


def on_ground(
    positions: np.ndarray, quaternions: np.ndarray | None, axes: Axes = ROBOT
) -> np.ndarray:
    """Project poses onto the ground plane: position, and heading of the axis that points ahead.

    Args:
        positions: ``(n, 3)`` in metres.
        quaternions: x, y, z, w of the body in the world, ``(n, 4)``; ``None`` if unknown.
        axes: Axes that span the ground plane, of the world and of the body alike.

    Returns:
        x, y in metres and heading in radians, ``(n, 3)``; NaN where unknown.

    Example:
        >>> turned = np.array([[0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)]])  # about y, which is down
        >>> on_ground(np.array([[-1.0, 0.0, 2.0]]), turned, parse_axes("camera")).round(3).tolist()
        [[2.0, 1.0, 1.571]]
    """
    (ahead, forward), (left, side) = axes.ahead, axes.left
    poses = np.full((len(positions), 3), np.nan)
    poses[:, 0], poses[:, 1] = forward * positions[:, ahead], side * positions[:, left]
    if quaternions is not None:
        nose = np.zeros(3)
        nose[ahead] = forward
        looks = rotate(quaternions, nose)
        poses[:, 2] = np.arctan2(side * looks[:, left], forward * looks[:, ahead])
    return poses


def axes_note(what: str, positions: np.ndarray, option: str = "--axes camera") -> str | None:
    """Return a note if positions move along z and not along y, as in the axes of a camera.

    Args:
        what: Name of the file, for the note.
        positions: ``(n, 3)`` in metres.
        option: What to do about it, for the note.

    Example:
        >>> drive = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 2.0], [-1.0, 0.01, 4.0]])
        >>> axes_note("truth.tum", drive)  # doctest: +ELLIPSIS
        'truth.tum: moves along z (4 m) and not along y (0.01 m), so its ground plane ...'
        >>> axes_note("truth.tum", drive[:, [2, 0, 1]]) is None
        True
    """
    known = positions[np.isfinite(positions).all(axis=1)]
    if len(known) < 2:
        return None
    x, y, z = np.ptp(known, axis=0).tolist()
    if z <= 0.0 or y >= _FLAT * z or z < 0.2 * x:
        return None
    return (
        f"{what}: moves along z ({z:.3g} m) and not along y ({y:.3g} m), so its ground plane is "
        f"not x-y but that of a camera, as ORB-SLAM and KITTI write it; use {option}"
    )
