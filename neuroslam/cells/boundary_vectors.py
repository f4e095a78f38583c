"""Boundary vectors: bearing and distance of a wall from the position where it was sensed."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.geometry import TWO_PI


class Wall(NamedTuple):
    """Remembered walls, one tensor for each column.

    Attributes:
        x_m: Position at which the wall was first sensed (the anchor).
        y_m: The same along y.
        bearing_rad: Bearing of the wall from the anchor, in the world.
        distance_m: Distance of the wall from the anchor.
        variance_m2: Variance of that distance.
        made_s: Time at which it was first sensed, since the session began.
        due: Comparisons in its first minute at which it should have been sensed.
        met: Those at which it was.
    """

    x_m: Tensor
    y_m: Tensor
    bearing_rad: Tensor
    distance_m: Tensor
    variance_m2: Tensor
    made_s: Tensor
    due: Tensor
    met: Tensor


def wrap(angle: Tensor) -> Tensor:
    """Wrap angles to [-pi, pi)."""
    return (angle + math.pi).remainder(TWO_PI) - math.pi


def wall_innovation(
    position_m: Tensor, distance_m: Tensor, bearing_rad: Tensor, wall: Wall
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return the innovation of a sensed wall against the memory of it.

    .. math:: \nu = R - R_m - (x_m - x) \cdot \mathbf n, \qquad
              \mathbf n = \frac{(\cos\gamma, \sin\gamma)}{\cos((\alpha - \alpha_m)/2)}, \quad
              \gamma = \frac{\alpha + \alpha_m}{2}

    The chord between two feet of perpendiculars is normal to the mean bearing: exactly for a
    straight wall and for a circle, to second order for any other. (With the present
    bearing in place of the mean, a curved wall seems too far, which biases the position.)

    Args:
        position_m: :math:`x`, ``(..., 2)``.
        distance_m: :math:`R`, ``(...)``.
        bearing_rad: :math:`\alpha` in the world, ``(...)``.
        wall: :math:`x_m, \alpha_m, R_m`.

    Returns:
        :math:`\nu` in metres; :math:`\mathbf n`, ``(..., 2)``; the lever in metres, the distance
        along the wall between the two positions, which multiplies an error of bearing.
    """
    half = wrap(bearing_rad - wall.bearing_rad) / 2
    middle = wall.bearing_rad + half
    normal = torch.stack([middle.cos(), middle.sin()], dim=-1) / half.cos().unsqueeze(-1)
    dx, dy = wall.x_m - position_m[..., 0], wall.y_m - position_m[..., 1]
    nx, ny = normal.unbind(-1)
    return distance_m - wall.distance_m - dx * nx - dy * ny, normal, dy * nx - dx * ny


def squared_mismatch(
    walls: Tensor, position_m: Tensor, bearing_rad: Tensor, scale: Tensor
) -> Tensor:
    r"""Return the squared mismatch of remembered walls with a sensed one; below 1 it is the same.

    .. math:: \frac{|x_m - x|^2}{s^2} + \frac{(\alpha_m - \alpha)^2}{a^2}

    Args:
        walls: Rows as in :class:`Wall`, ``(..., 8)``.
        position_m: :math:`x`, ``(..., 2)``.
        bearing_rad: :math:`\alpha`, ``(...)``.
        scale: :math:`s` in metres, :math:`a` in radians.
    """
    away = (walls[..., :2] - position_m).square().sum(-1) / scale[0].square()
    return away + (wrap(walls[..., 2] - bearing_rad) / scale[1]).square()
