"""Normal distributions as semantic pointers: expectation over noise, and the fit of one."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.errors import SpaceError
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.space import SSPSpace

_ITERATIONS = 30
_LEAST_MODULUS = 1e-3  # of a coefficient whose logarithm is taken


class Gaussian(NamedTuple):
    """A normal distribution over positions.

    Attributes:
        mean_m: ``(..., dimension)``.
        covariance_m2: ``(..., dimension, dimension)``; symmetric, no eigenvalue below 0.
        strength: Amplitude of its pointer; 1 for a whole distribution, ``(...)``.
    """

    mean_m: Tensor
    covariance_m2: Tensor
    strength: Tensor


def gaussian_damping(space: SSPSpace, covariance_m2: Tensor) -> Tensor:
    r"""Return the factors by which noise of a position damps the Fourier coefficients.

    .. math:: E[e^{i a_k \cdot \epsilon}] = e^{-a_k^\top \Sigma\, a_k / 2}, \qquad
              \epsilon \sim \mathcal N(0, \Sigma)

    the characteristic function of the normal distribution at the wave vectors :math:`a_k`.

    Args:
        space: Of the positions.
        covariance_m2: :math:`\Sigma`, ``(..., dimension, dimension)``.

    Returns:
        Between 0 and 1, ``(..., n_frequencies)``.

    Raises:
        SpaceError: If covariances do not have the dimension of the space.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> gaussian_damping(space, torch.zeros(2, 2)).unique().tolist()
        [1.0]
    """
    m = space.dimension
    if covariance_m2.shape[-2:] != (m, m):
        raise SpaceError(
            f"gaussian_damping: covariances of shape {tuple(covariance_m2.shape)}, expected "
            f"(..., {m}, {m}), one row and column for each dimension of the space"
        )
    waves = space.wave_vectors
    return (-0.5 * ((waves @ covariance_m2.to(waves)) * waves).sum(-1)).exp()


def encode_gaussian(space: SSPSpace, mean_m: Tensor, covariance_m2: Tensor) -> Tensor:
    r"""Return the pointer of a normal distribution: the expectation of the pointers of its points.

    .. math:: F\{E[\phi(x)]\}_k = e^{i a_k \cdot \mu - a_k^\top \Sigma\, a_k / 2}

    Args:
        space: Of the positions.
        mean_m: :math:`\mu`, ``(..., dimension)``.
        covariance_m2: :math:`\Sigma`, ``(..., dimension, dimension)``.

    Returns:
        Fourier coefficients, complex, ``(..., n_frequencies)``.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> z = encode_gaussian(space, torch.tensor([0.3, -0.2]), 0.04 * torch.eye(2))
        >>> found = fit_gaussian(space, z)
        >>> found.covariance_m2.diagonal().round(decimals=4).tolist()
        [0.03999999910593033, 0.03999999910593033]
    """
    return space.encode_fourier(mean_m) * gaussian_damping(space, covariance_m2)


def sighting_covariance(
    vector_m: Tensor, distance_sigma_m: float, bearing_sigma_rad: float
) -> Tensor:
    r"""Return the covariance of a measured vector, from those of its distance and bearing.

    .. math:: \Sigma = \sigma_r^2\, u u^\top + (r\, \sigma_\beta)^2\,(I - u u^\top), \qquad
              u = v / r

    the first-order covariance of polar coordinates; in more than two dimensions the bearing is
    equally uncertain in all directions across. A vector of length 0 has none.

    Args:
        vector_m: :math:`v`, from the sensor to the landmark, ``(..., dimension)``.
        distance_sigma_m: :math:`\sigma_r`, standard deviation of the distance :math:`r`.
        bearing_sigma_rad: :math:`\sigma_\beta`, standard deviation of the bearing.

    Returns:
        ``(..., dimension, dimension)``.

    Example:
        >>> sighting_covariance(torch.tensor([2.0, 0.0]), 0.1, 0.2).round(decimals=2).tolist()
        [[0.009999999776482582, 0.0], [0.0, 0.1599999964237213]]
    """
    r = vector_m.norm(dim=-1, keepdim=True)
    u = vector_m / r.clamp_min(torch.finfo(r.dtype).tiny)
    along = u.unsqueeze(-1) * u.unsqueeze(-2)
    across = torch.eye(vector_m.shape[-1]).to(along) - along
    r = r.unsqueeze(-1)
    return distance_sigma_m**2 * along + (bearing_sigma_rad * r).square() * across


@torch.no_grad()
def fit_gaussian(space: SSPSpace, z: Tensor, free_strength: bool = False) -> Gaussian:
    r"""Return the normal distribution whose pointer is nearest to a given one.

    .. math:: \min_{s, \mu, \Sigma} \sum_k
              \bigl| z_k - s\, e^{i a_k \cdot \mu - a_k^\top \Sigma\, a_k / 2} \bigr|^2

    by the method of Levenberg and Marquardt, from the position decoded and a linear fit of
    :math:`\ln |z_k|`. Of a density with several modes it is that of one of them, not the moments
    of the whole.

    Args:
        space: Of the positions.
        z: Fourier coefficients, complex, ``(..., n_frequencies)``.
        free_strength: Fit the strength :math:`s` too, for pointers that a memory has not learnt
            fully; else it is 1.
    """
    lead, m = z.shape[:-1], space.dimension
    waves = space.wave_vectors.detach().double()
    flat = z.detach().reshape(-1, z.shape[-1])
    mean = PositionDecoder(space)(flat).position_m.double()
    flat = flat.to(torch.complex128)
    i, j = torch.triu_indices(m, m, device=waves.device)
    products = waves[:, i] * waves[:, j] * torch.where(i == j, 1.0, 2.0)
    power = flat.abs().clamp_min(_LEAST_MODULUS)
    design = -0.5 * products
    if free_strength:
        design = torch.cat([design, torch.ones_like(design[:, :1])], dim=-1)
    weighted = power.unsqueeze(-1) * design
    gram = weighted.mT @ weighted
    gram = gram + 1e-9 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * _eye(gram)
    start = torch.linalg.solve(gram, weighted.mT @ (power * power.log()).unsqueeze(-1)).squeeze(-1)
    given = torch.cat([mean, start], dim=-1)

    def model(p: Tensor) -> Tensor:
        exponent = p[:, m:] @ design.T
        return torch.polar(exponent.clamp_max(3.0).exp(), p[:, :m] @ waves.T)

    slope = torch.cat([1j * waves, design.to(flat)], dim=-1)
    error = (model(given) - flat).abs().square().sum(-1)
    damped = torch.full_like(error, 1e-3)
    for _ in range(_ITERATIONS):
        now = model(given)
        jacobian = torch.view_as_real(now.unsqueeze(-1) * slope).movedim(-1, 1).flatten(1, 2)
        residual = torch.view_as_real(flat - now).movedim(-1, 1).flatten(1, 2).unsqueeze(-1)
        normal = jacobian.mT @ jacobian
        size = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12)
        normal = normal + damped[:, None, None] * torch.diag_embed(size)
        step = torch.linalg.solve(normal, jacobian.mT @ residual).squeeze(-1)
        new_error = (model(given + step) - flat).abs().square().sum(-1)
        better = new_error < error
        given = torch.where(better.unsqueeze(-1), given + step, given)
        error = torch.where(better, new_error, error)
        damped = torch.where(better, damped / 3.0, damped * 5.0).clamp(1e-9, 1e9)
    covariance = given.new_zeros(len(given), m, m)
    covariance[:, i, j] = covariance[:, j, i] = given[:, m : m + len(i)]
    values, vectors = torch.linalg.eigh(covariance)
    covariance = vectors @ torch.diag_embed(values.clamp_min(0.0)) @ vectors.mT
    strength = given[:, -1].exp() if free_strength else torch.ones_like(error)
    kind = z.real.dtype
    return Gaussian(
        given[:, :m].to(kind).reshape(*lead, m),
        covariance.to(kind).reshape(*lead, m, m),
        strength.to(kind).reshape(lead),
    )


def _eye(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
