"""Attention: which landmarks in view are used, and the vectors that represent them."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.spiking.space import SSPSpace

NOTHING = -1
"""Attended landmark where none is in view."""
SEVERAL = -2
"""Attended landmark where all in view are seen as one."""


class Sight(NamedTuple):
    """Attended landmarks over some steps.

    Attributes:
        key: Pointers of what is attended to, summed, ``(steps, batch, n_features)``; 0 where
            nothing is.
        vector: Where it is from the animal, as Fourier coefficients, complex,
            ``(steps, batch, n_frequencies)``; 0 where nothing is.
        attended: Number of the landmark, ``NOTHING`` or ``SEVERAL``, ``(steps, batch)``.
        held_s: For how long it has been attended to, ``(steps, batch)``.
        damping: Factors of its coefficients by the noise of the sensor, ``(steps, batch,
            n_frequencies)``; ``(steps, batch, 1)`` where sightings are exact.
    """

    key: Tensor
    vector: Tensor
    attended: Tensor
    held_s: Tensor
    damping: Tensor


def attend(in_view: Tensor, distance_m: Tensor, time_s: Tensor, turn_s: float, how: str) -> Tensor:
    """Choose one landmark of those in view.

    Args:
        in_view: Booleans, ``(steps, batch, landmarks)``.
        distance_m: The same shape.
        time_s: Since the start, ``(steps,)``.
        turn_s: How long each is attended to, if they take turns.
        how: ``"nearest"`` or ``"turns"``.

    Returns:
        Its number, or ``NOTHING``; ``(steps, batch)``.

    Example:
        >>> seen = torch.tensor([[[True, False, True]]]).expand(4, 1, 3)
        >>> attend(seen, torch.ones(4, 1, 3), torch.arange(4.0), 1.0, "turns")[:, 0].tolist()
        [0, 2, 0, 2]
    """
    count = in_view.sum(-1)
    if how == "nearest":
        chosen = torch.where(in_view, distance_m, torch.inf).argmin(-1)
    else:
        turn = (time_s / turn_s).floor().long().unsqueeze(-1) % count.clamp_min(1)
        rank = in_view.cumsum(-1) - 1
        chosen = (in_view & (rank == turn.unsqueeze(-1))).to(torch.uint8).argmax(-1)
    return torch.where(count > 0, chosen, NOTHING)


def held(attended: Tensor, before: Tensor, held_s: Tensor, time_step_s: float) -> Tensor:
    """Return for how long the same landmark has been attended to, at each step.

    Args:
        attended: ``(steps, batch)``.
        before: In the step before the first, ``(batch,)``.
        held_s: For how long then, ``(batch,)``.
        time_step_s: Length of a step.

    Example:
        >>> a = torch.tensor([[3], [3], [5], [5]])
        >>> held(a, torch.tensor([3]), torch.tensor([1.0]), 0.5)[:, 0].tolist()
        [1.5, 2.0, 0.0, 0.5]
    """
    steps = torch.arange(len(attended), device=attended.device).unsqueeze(-1)
    changed = attended != torch.cat([before.unsqueeze(0), attended[:-1]])
    since = torch.where(changed, steps, -1).cummax(0).values
    whole = held_s + (steps + 1) * time_step_s
    return torch.where(since >= 0, (steps - since) * time_step_s, whole)


def region_vectors(space: SSPSpace, low_m: Tensor, high_m: Tensor, weight: Tensor) -> Tensor:
    """Return unit vectors of regions made of boxes, as Fourier coefficients.

    Args:
        space: Of the positions.
        low_m: Lower corners, ``(..., boxes, dimension)``.
        high_m: Upper corners; a point has both alike.
        weight: Share of each box, ``(..., boxes)``; 0 for one that is not there.

    Returns:
        Complex, ``(..., n_frequencies)``, of mean square 1.
    """
    parts = space.region_fourier(low_m, high_m) * weight.unsqueeze(-1)
    z = parts.sum(-2)
    size = torch.view_as_real(z).square().sum(-1).mean(-1, keepdim=True).sqrt()
    return z / size.clamp_min(1e-6)
