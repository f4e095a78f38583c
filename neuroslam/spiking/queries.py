"""Queries to a semantic map: positions of landmarks, contents of areas, displacements."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.errors import SpaceError
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.spiking.space import SSPSpace

_LEAST_STRENGTH = 0.4  # of the remainder, above which one more position is sought
_MOST_PLACES = 50
_REFINEMENTS = 12
_BOX_POINTS = 64
_AREA_POINTS = 4096
_AREA_RIDGE = 1e-2  # larger: edges of an area are less sharp, and less is answered beside it
_TWO = 1.4  # strength above which a position may be two


class Places(NamedTuple):
    """Positions that a vector contains.

    Attributes:
        position_m: ``(n, dimension)``, the clearest first.
        strength: How much of each there is; 1 for a whole one, ``(n,)``.
    """

    position_m: Tensor
    strength: Tensor


def places_in(space: SSPSpace, z: Tensor, least: float = _LEAST_STRENGTH) -> Places:
    r"""Find the positions whose SSPs sum to a vector.

    One place after the other is taken out of it; all are moved together, so that neighbours do not
    pull each other,

    .. math:: \min_{x_i} \Bigl\lVert z - \sum_i c_i e^{i a \cdot x_i} \Bigr\rVert^2

    Args:
        space: Of the positions.
        z: Fourier coefficients, complex, ``(n_frequencies,)``.
        least: Strength from which on something is a place.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> at = torch.tensor([[0.5, 0.2], [-0.3, 0.6]])
        >>> found = places_in(space, space.encode_fourier(at).sum(0))
        >>> sorted([round(x, 2), round(y, 2)] for x, y in found.position_m.tolist())
        [[-0.3, 0.6], [0.5, 0.2]]
    """
    decoder = PositionDecoder(space)
    found = z.real.new_zeros(0, space.dimension)
    strength = z.real.new_zeros(0)
    rest = z
    for _ in range(_MOST_PLACES):
        best = decoder(rest.unsqueeze(0))
        if float(best.similarity) < least:
            break
        found, strength = _together(space, z, torch.cat([found, best.position_m]))
        rest = z - strength.to(z.dtype) @ space.encode_fourier(found)
    found, strength = _split(space, z, found, strength)
    keep = strength >= least
    found, strength = found[keep], strength[keep]
    order = strength.argsort(descending=True)
    return Places(found[order], strength[order])


def _split(space: SSPSpace, z: Tensor, at: Tensor, strength: Tensor) -> tuple[Tensor, Tensor]:
    """Split a position that represents two, nearer to each other than a wavelength.

    Both are tried on opposite sides of it, in several directions; the pair stays whose sum is
    nearer to the vector, if none of the two is weak.
    """
    apart = 0.3 / space.wave_vectors.detach().abs().amax(0)
    for _ in range(len(at)):
        double = int(strength.argmax()) if len(strength) else -1
        if double < 0 or strength[double] < _TWO:
            return at, strength
        others = torch.cat([at[:double], at[double + 1 :]])
        best: tuple[float, Tensor, Tensor] | None = None
        for direction in _directions(at.shape[1]).to(at):
            pair = at[double] + apart * torch.stack([direction, -direction])
            moved, share = _together(space, z, torch.cat([others, pair]))
            left = float((z - share.to(z.dtype) @ space.encode_fourier(moved)).abs().square().sum())
            if best is None or left < best[0]:
                best = left, moved, share
        if best is None or best[2][-2:].min() < _LEAST_STRENGTH:
            return at, strength
        at, strength = best[1], best[2]
    return at, strength


def _directions(dimension: int) -> Tensor:
    """Return half of the directions to the neighbours of a cell, ``(n, dimension)``."""
    all_ = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * dimension)
    all_ = all_.reshape(-1, dimension)
    return all_[: len(all_) // 2]


def _together(space: SSPSpace, z: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Refine positions and strengths by Gauss-Newton, so that they sum to a vector."""
    waves = space.wave_vectors.detach()
    low, high = space.bounds_m.T.to(at)
    target = torch.cat([z.real, z.imag])
    for _ in range(_REFINEMENTS):
        phi = space.encode_fourier(at).detach()
        basis = torch.cat([phi.real, phi.imag], dim=-1)
        strength = torch.linalg.lstsq(basis.T, target.unsqueeze(-1)).solution.squeeze(-1)
        slope = 1j * waves.T * phi.unsqueeze(-2) * strength[:, None, None]
        slope = torch.cat([slope.real, slope.imag], dim=-1).flatten(0, 1)
        both = torch.cat([basis, slope])
        gram = both @ both.T
        gram = gram + 1e-3 * gram.diagonal().mean() * torch.eye(len(both), dtype=gram.dtype)
        step = torch.linalg.solve(gram, both @ (target - strength @ basis))
        at = at + step[len(at) :].reshape(at.shape)
        at = torch.minimum(torch.maximum(at, low), high)
    return at, strength


def recall(slam: SSPSLAM, key: Tensor, animal: int = 0) -> Tensor:
    """Return what a pointer recalls, as Fourier coefficients, complex, ``(n_frequencies,)``.

    Args:
        slam: With its map.
        key: Of a landmark, or of several together, ``(n_key,)``; its length does not matter
            where it is of one. Sums of pointers recall sums of places.
        animal: Of a batch.
    """
    n_key = slam.pointers.shape[1]
    if key.shape != (n_key,):
        raise SpaceError(
            f"recall: a pointer of shape {tuple(key.shape)}, the map has {n_key} "
            "features; make it with the map's vocabulary"
        )
    return slam.space.to_fourier(slam.map.read(key.unsqueeze(0))[animal, 0])


def where(slam: SSPSLAM, key: Tensor, animal: int = 0) -> Places:
    """Return where the landmarks are whose pointers a key holds; see :func:`recall`."""
    return places_in(slam.space, recall(slam, key, animal))


def what(
    slam: SSPSLAM, low_m: Sequence[float], high_m: Sequence[float], animal: int = 0
) -> dict[str, float]:
    r"""Return the share of each landmark in a box; about 1 inside, 0.5 on its edge, 0 outside.

    The key of the map from places to pointers is that of :func:`area_key`. A landmark in the box is
    recalled as strongly as the memory answers alike to this key and to the landmark's own place; an
    answer is measured by the mean of that over the box.

    Args:
        slam: Whose map of places learns (``places`` in its config).
        low_m: Lower corner.
        high_m: Upper corner.
        animal: Of a batch.

    Raises:
        SpaceError: If it has no such map, or the box is not one.
    """
    if slam.places is None:
        raise SpaceError("what: this map does not learn what is at places; set places = true")
    box = torch.tensor([list(low_m), list(high_m)]).to(slam.pointers)
    if box.shape != (2, slam.space.dimension) or not bool((box[0] <= box[1]).all()):
        raise SpaceError(
            f"what: a box from {list(low_m)} to {list(high_m)}, expected a lower and an upper "
            f"corner of {slam.space.dimension} numbers each"
        )
    key = area_key(slam.space, box[0], box[1]).unsqueeze(0)
    share = torch.quasirandom.SobolEngine(len(box[0])).draw(_BOX_POINTS).to(box)
    inside = slam.space.encode(box[0] + (box[1] - box[0]) * share).detach()
    with torch.no_grad():
        whole, each = (slam.places.respond(k)[animal] for k in (key, inside))
        alike = (each @ whole[0] / each.square().sum(-1).clamp_min(1e-12)).mean()
    said = slam.places.read(key)[animal, 0]
    amounts = slam.pointers @ said / slam.pointers.square().sum(-1) / alike.clamp_min(1e-6)
    return dict(zip(slam.names, amounts.tolist(), strict=True))


@torch.no_grad()
def area_key(space: SSPSpace, low_m: Tensor, high_m: Tensor) -> Tensor:
    r"""Return the vector that is like the places in a box, and unlike those beside it.

    The mean of the places, :math:`R = \text{mean}_{x \in D}\,\phi(x)`, is alike to its
    surroundings as far as the similarity of places is wide. The key is the function of the space
    that comes nearest to 1 in the box and 0 outside of it, over the bounds :math:`B`:

    .. math:: k \propto (C + \lambda\,\bar c\, I)^{-1} R, \qquad
              C = \text{mean}_{x \in B}\,\phi(x)\,\phi(x)^\top

    with :math:`\bar c` the mean of the diagonal of :math:`C`.

    Args:
        space: Of the places.
        low_m: Lower corner, ``(dimension,)``.
        high_m: Upper corner.

    Returns:
        Of length 1, ``(n_features,)``.

    Example:
        >>> space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)
        >>> key = area_key(space, torch.tensor([-0.4, -0.4]), torch.tensor([0.4, 0.4]))
        >>> beside = torch.tensor([[0.3, 0.0], [0.5, 0.0]])
        >>> inside, outside = (space.encode(beside).detach() @ key).tolist()
        >>> inside > 5.0 * abs(outside)
        True
    """
    low, high = space.bounds_m.T.to(low_m)
    at = low + (high - low) * torch.quasirandom.SobolEngine(len(low)).draw(_AREA_POINTS).to(low)
    phi = space.encode(at).double()
    covariance = phi.T @ phi / len(phi)
    ridge = _AREA_RIDGE * covariance.diagonal().mean() * torch.eye(len(covariance)).to(phi)
    region = space.from_fourier(space.region_fourier(low_m, high_m)).double()
    key = torch.linalg.solve(covariance + ridge, region)
    return (key / key.norm()).to(low_m)


def vectors_to(slam: SSPSLAM, z: Tensor, animal: int = 0) -> Tensor:
    r"""Return the vectors to all landmarks, as Fourier coefficients, complex.

    .. math:: \hat\phi(x_i - x) = \hat\phi(x)^{-1} \circledast \hat\phi(x_i)

    Args:
        slam: With its map.
        z: Where the animal is, complex, ``(..., n_frequencies)``.
        animal: Of a batch.

    Returns:
        ``(..., landmarks, n_frequencies)``.
    """
    known = slam.space.to_fourier(slam.map.read(slam.pointers)[animal])
    return z.unsqueeze(-2).conj() * known


def whole_map(slam: SSPSLAM, animal: int = 0) -> Tensor:
    r"""Return all landmarks in one vector, :math:`\sum_i \phi(x_i) \circledast B_i`.

    Returns:
        ``(n_features,)``; unbind a pointer from it and it is where that landmark is.

    Raises:
        SpaceError: If pointers are of another length than places, so that they cannot be bound.
    """
    if slam.pointers.shape[1] != slam.space.n_features:
        raise SpaceError(
            f"whole_map: pointers of {slam.pointers.shape[1]} features; to be bound with places "
            f"they need as many features as the space, {slam.space.n_features}"
        )
    places = torch.fft.rfft(slam.map.read(slam.pointers)[animal])
    pointers = torch.fft.rfft(slam.pointers)
    return torch.fft.irfft((places * pointers).sum(0), n=slam.space.n_features)


def landmarks_in(
    slam: SSPSLAM, low_m: Sequence[float], high_m: Sequence[float], animal: int = 0
) -> dict[str, tuple[float, ...]]:
    """Return the landmarks whose recalled positions are in a box, with these positions.

    Sharper at the edges than :func:`what`, and as many recalls as there are landmarks.
    """
    z = slam.space.to_fourier(slam.map.read(slam.pointers)[animal])
    known = z.abs().square().mean(-1).sqrt() > _LEAST_STRENGTH
    at = PositionDecoder(slam.space)(z).position_m
    low, high = torch.tensor([list(low_m), list(high_m)]).to(at)
    inside = known & ((at >= low) & (at <= high)).all(-1)
    return {name: tuple(at[k].tolist()) for k, name in enumerate(slam.names) if inside[k]}
