"""Frequencies of a space: waves of grid modules, waves along axes, or waves of any direction."""

import math

import torch
from torch import Tensor

GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


def simplex(dimension: int) -> Tensor:
    """Return unit vectors to the corners of a regular simplex; they sum to zero.

    Returns:
        ``(dimension + 1, dimension)``; on a line, where both would be one wave, only ``(1, 1)``.

    Example:
        >>> [round(abs(x), 6) for x in simplex(3).sum(0).tolist()]
        [0.0, 0.0, 0.0]
    """
    m = dimension
    if m == 1:
        return torch.ones(1, 1, dtype=torch.float64)
    ones = torch.ones(1, m, dtype=torch.float64)
    most = math.sqrt(1.0 + 1.0 / m) * torch.eye(m, dtype=torch.float64)
    return torch.cat([most - m**-1.5 * (math.sqrt(m + 1.0) + 1.0) * ones, ones / math.sqrt(m)])


def scales(n: int, low: float, high: float, spacing: str, draw: torch.Generator) -> Tensor:
    """Return spatial frequencies from low to high, ``(n,)``.

    Args:
        n: How many; one alone is the highest.
        low: In rad a length scale.
        high: The same.
        spacing: ``"linear"``, ``"log"`` or ``"random"``.
        draw: Of random ones.
    """
    if n == 1:
        return torch.tensor([high], dtype=torch.float64)
    if spacing == "random":
        share = torch.rand(n, generator=draw, dtype=torch.float64)
        return (low + (high - low) * share).sort().values
    if spacing == "log":
        return torch.logspace(math.log10(low), math.log10(high), n, dtype=torch.float64)
    return torch.linspace(low, high, n, dtype=torch.float64)


def rotations(dimension: int, n: int, period_rad: float, draw: torch.Generator) -> Tensor:
    """Return rotations that spread waves over all directions, ``(n, dimension, dimension)``.

    In the plane they are evenly over the period after which the waves come back; in more
    dimensions they are random.

    Args:
        dimension: Of the space.
        n: How many; a line has one.
        period_rad: Of the wave vectors, in the plane.
        draw: Of random ones.
    """
    if dimension == 1:
        return torch.ones(1, 1, 1, dtype=torch.float64)
    if dimension == 2:
        angle = torch.arange(n, dtype=torch.float64) * period_rad / n
        c, s = angle.cos(), angle.sin()
        return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    normal = torch.randn(n, dimension, dimension, generator=draw, dtype=torch.float64)
    q, r = torch.linalg.qr(normal)
    q = q * r.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)  # uniform over all rotations
    q[..., 0] *= torch.linalg.det(q).sign().unsqueeze(-1)
    return q


def lattice(corners: Tensor, scale: Tensor, rotation: Tensor) -> Tensor:
    """Return each corner turned and scaled, in the order rotation, scale, corner, ``(k, m)``."""
    turned = torch.einsum("rij,vj->rvi", rotation, corners)
    return torch.einsum("s,rvi->rsvi", scale, turned).reshape(-1, corners.shape[1])


def hexagonal(
    dimension: int,
    n_rotations: int,
    n_scales: int,
    scale_range: tuple[float, float],
    spacing: str,
    draw: torch.Generator,
) -> Tensor:
    """Return the waves of grid modules, ``(k, dimension)``: their phases close, in each module.

    Waves 60 degrees apart are those of one module up to their sign, so an even number of
    orientations is spread over 60 degrees; an odd one over 120, where none repeats (the reference
    spreads both over 120, and then half of the waves of an even number are there twice).
    """
    period = 2.0 * math.pi / 3.0 if n_rotations % 2 else math.pi / 3.0
    return lattice(
        simplex(dimension),
        scales(n_scales, *scale_range, spacing, draw),
        rotations(dimension, n_rotations, period, draw),
    )


def rectangular(
    dimension: int,
    n_rotations: int,
    n_scales: int,
    scale_range: tuple[float, float],
    spacing: str,
    draw: torch.Generator,
) -> Tensor:
    """Return waves along turned axes, ``(k, dimension)``."""
    return lattice(
        torch.eye(dimension, dtype=torch.float64),
        scales(n_scales, *scale_range, spacing, draw),
        rotations(dimension, n_rotations, math.pi / 2.0, draw),
    )


def uniform_in_ball(dimension: int, n: int, radius: float, draw: torch.Generator) -> Tensor:
    """Return wave vectors uniform in a ball, ``(n, dimension)``."""
    way = torch.randn(n, dimension, generator=draw, dtype=torch.float64)
    share = torch.rand(n, 1, generator=draw, dtype=torch.float64) ** (1.0 / dimension)
    return radius * share * way / way.norm(dim=-1, keepdim=True)
