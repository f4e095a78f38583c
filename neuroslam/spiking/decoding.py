"""Decoding of positions from vectors: search and refinement, a network, a probability."""

from itertools import pairwise
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.errors import SpaceError
from neuroslam.spiking.space import SSPSpace
from neuroslam.spiking.vector_steps import (
    CANDIDATES,
    LEAST_CURVATURE,
    REFINEMENTS,
    SpaceTables,
    fourier_tables,
)
from neuroslam.threads import in_own_types

_STEP_RAD = 1.25  # phase of the shortest wave between two points of the coarse search
_MOST_POINTS = 20_000


class Decoded(NamedTuple):
    """A decoded position, and the similarity of its vector.

    Attributes:
        position_m: ``(..., dimension)``.
        similarity: Mean of the waves' agreement, 1 for a clean vector, ``(...)``.
    """

    position_m: Tensor
    similarity: Tensor


def agreement(space: SSPSpace, z: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return what is in phase with positions and what is a quarter ahead, for each wave."""
    angle = x @ space.wave_vectors.T
    c, s = angle.cos(), angle.sin()
    return z.real * c + z.imag * s, z.imag * c - z.real * s


class PositionDecoder:
    r"""Finds the position whose vector is most similar to a given one.

    .. math:: \hat x = \arg\max_x s(x), \qquad
              s(x) = \frac1K \sum_k \mathrm{Re}\bigl(z_k e^{-i a_k \cdot x}\bigr)

    A coarse search at the resolution of the shortest wave, then Newton's method from the best few.
    It is the estimate of the paper (argmax of :math:`\phi(x) \cdot \hat\phi`) without a grid's
    error, 0.0077 for 100 points a side.

    Args:
        space: Of the positions; those outside its bounds are not considered.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> at = torch.tensor([[0.123, -0.456]])
        >>> found = PositionDecoder(space)(space.encode_fourier(at))
        >>> [round(x, 4) for x in found.position_m[0].tolist()], round(found.similarity.item(), 4)
        ([0.123, -0.456], 1.0)
    """

    def __init__(self, space: SSPSpace) -> None:
        self.space = space
        self._waves: Tensor | None = None
        self._tables: tuple[Tensor, Tensor, tuple[object, ...], SpaceTables] | None = None

    @in_own_types
    def __call__(self, z: Tensor) -> Decoded:
        """Decode Fourier coefficients, complex, ``(..., n_frequencies)``.

        Raises:
            SpaceError: If they are not as many as the space has.
        """
        if z.shape[-1:] != (self.space.n_frequencies,):
            raise SpaceError(
                f"PositionDecoder: {tuple(z.shape)[-1:]} coefficients, this space has "
                f"{self.space.n_frequencies}"
            )
        lead, z = z.shape[:-1], z.detach().reshape(-1, z.shape[-1])
        grid, cosines, sines = self._grid()
        coarse = z.real @ cosines + z.imag @ sines
        best = coarse.topk(min(CANDIDATES, len(grid)), dim=-1).indices
        each = z.unsqueeze(1)
        at = grid[best]
        for _ in range(REFINEMENTS):
            at = self.track(each, at)
        similarity = self.similarity(each, at)
        first = similarity.argmax(-1, keepdim=True)
        at = at.gather(1, first.unsqueeze(-1).expand(-1, -1, at.shape[-1])).squeeze(1)
        return Decoded(at.reshape(*lead, -1), similarity.gather(1, first).squeeze(1).reshape(lead))

    @in_own_types
    def similarity(self, z: Tensor, x: Tensor) -> Tensor:
        """Return s(x) of positions, ``(..., dimension)``, for coefficients ``(..., K)``."""
        return agreement(self.space, z, x)[0].mean(-1)

    @in_own_types
    def track(self, z: Tensor, start_m: Tensor) -> Tensor:
        r"""Go from positions to the maxima next to them, by one step of Newton's method.

        .. math:: x \leftarrow x + \Bigl(\sum_k r_k\, a_k a_k^\top\Bigr)^{-1} \sum_k q_k\, a_k

        :math:`r` and :math:`q` are the parts in phase and ahead; where a wave disagrees, its
        curvature counts as a little, so that each step goes up. Gradients pass to ``z`` and the
        space, as those of a maximum do.

        Args:
            z: Complex, ``(..., n_frequencies)``.
            start_m: ``(..., dimension)``.
        """
        waves = self.space.wave_vectors
        m = waves.shape[1]
        start = start_m.detach()
        here, ahead = agreement(self.space, z, start)
        outer = (waves.unsqueeze(-1) * waves.unsqueeze(-2)).flatten(-2)
        curvature = here.clamp_min(LEAST_CURVATURE) @ outer
        curvature = curvature.detach().unflatten(-1, (m, m))
        up = (ahead @ waves).unsqueeze(-1)
        step = torch.linalg.solve_ex(curvature, up).result.squeeze(-1)
        longest = 1.0 / waves.detach().abs().amax(0)
        low, high = self.space.bounds_m.T
        position = start + torch.clamp(step, -longest, longest)
        return torch.clamp(position, low, high)

    def tables(self) -> SpaceTables:
        """Return what compiled steps take of the space, on the CPU; renewed with it."""
        own = self.space._parameters
        frequencies, scale = cast(Tensor, own["frequencies"]), cast(Tensor, own["length_scale_m"])
        versions = _version(frequencies), _version(scale)
        known = self._tables
        if (
            known is None
            or known[0] is not frequencies
            or known[1] is not scale
            or known[2] != versions
        ):
            points, cosines, sines = self._grid()
            waves, modules = cast(Tensor, self._waves), self.space.grid_modules
            longest = 1.0 / waves.abs().amax(0)
            tables = SpaceTables(
                waves.numpy(),
                self.space.bounds_m.contiguous().numpy(),
                longest.numpy(),
                np.zeros((0, 0), dtype=np.int64) if modules is None else modules.numpy(),
                points.contiguous().numpy(),
                cosines.contiguous().numpy(),
                sines.contiguous().numpy(),
                *fourier_tables(self.space.n_features, waves.numpy().dtype),
            )
            known = self._tables = frequencies, scale, versions, tables
        return known[3]

    def _grid(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the points of the coarse search and the waves at them; renewed with the space."""
        waves = self.space.wave_vectors.detach()
        known = self._waves
        if (
            known is None
            or known.device != waves.device
            or known.dtype != waves.dtype
            or not torch.equal(known, waves)
        ):
            low, high = self.space.bounds_m.T
            each = ((high - low) * waves.abs().amax(0) / _STEP_RAD).ceil() + 1
            each = (each * min(1.0, (_MOST_POINTS / float(each.prod())) ** (1 / len(each)))).long()
            axes = [
                torch.linspace(float(a), float(b), max(2, int(n)), device=waves.device)
                for a, b, n in zip(low, high, each, strict=True)
            ]
            points = torch.cartesian_prod(*axes).reshape(-1, len(axes)).to(waves)
            angle = points @ waves.T
            self._points, self._waves = (points, angle.cos().T, angle.sin().T), waves.clone()
        return self._points


def _version(tensor: Tensor) -> tuple[int, int]:
    """Return where a tensor's numbers are, and how often they were changed in place."""
    return tensor.data_ptr(), 0 if tensor.is_inference() else tensor._version


class LearnedDecoder(nn.Module):
    """A small network that decodes positions from vectors; trained on the space.

    Args:
        space: Of the positions.
        hidden: Units of each of two layers.
        steps: Of training.
        noise: Standard deviation of what is added to each vector in training, over its length.
        seed: Of the weights and of the positions.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> decoder = LearnedDecoder(space, steps=200)
        >>> decoder(space.encode(torch.zeros(3, 2))).shape
        torch.Size([3, 2])
    """

    low_m: Tensor
    high_m: Tensor

    def __init__(
        self,
        space: SSPSpace,
        hidden: int = 128,
        steps: int = 2000,
        noise: float = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        draw = torch.Generator().manual_seed(seed)
        sizes = (space.n_features, hidden, hidden, space.dimension)
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            layer = nn.Linear(n_in, n_out)
            with torch.no_grad():
                layer.weight.normal_(0.0, (2.0 / n_in) ** 0.5, generator=draw)
                layer.bias.zero_()
            layers += [layer, nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])
        low, high = space.bounds_m.detach().T
        self.register_buffer("low_m", low)
        self.register_buffer("high_m", high)
        self._train(space, steps, noise, draw)

    def _train(self, space: SSPSpace, steps: int, noise: float, draw: torch.Generator) -> None:
        adam = torch.optim.Adam(self.parameters(), lr=3e-3)
        fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
        with torch.inference_mode(False), torch.enable_grad():
            for _ in range(steps):
                share = torch.rand(256, space.dimension, generator=draw)
                x = self.low_m + (self.high_m - self.low_m) * share
                phi = space.encode(x).detach()
                scatter = noise / space.n_features**0.5 * torch.randn(phi.shape, generator=draw)
                adam.zero_grad()
                (self(phi + scatter) - x).square().mean().backward()
                adam.step()
                fall.step()
        self.requires_grad_(False)

    def forward(self, phi: Tensor) -> Tensor:
        """Return positions, ``(..., n_features)`` to ``(..., dimension)``."""
        return torch.clamp(self.layers(phi), self.low_m, self.high_m)


def probability(similarity: Tensor, cell_m: float) -> tuple[Tensor, Tensor]:
    r"""Turn similarities at evenly spaced points into a probability density.

    .. math:: \hat f(x) = (\phi(x) \cdot \hat\phi - \xi)_+, \qquad \int \hat f(x)\,dx = 1

    (SSP-SLAM, Eq. 7). The bias :math:`\xi` is exact: it follows from the sorted similarities.

    Args:
        similarity: ``(..., points)``.
        cell_m: Volume that belongs to a point, in m to the power of the dimension.

    Returns:
        The density, the same shape, and :math:`\xi`, ``(...)``.

    Example:
        >>> density, bias = probability(torch.tensor([0.9, 0.5, -0.2]), cell_m=2.0)
        >>> round(float(density.sum() * 2.0), 6), round(float(bias), 2)
        (1.0, 0.45)
    """
    ordered = similarity.sort(dim=-1, descending=True).values
    n = torch.arange(1, ordered.shape[-1] + 1, device=ordered.device)
    biases = (ordered.cumsum(-1) - 1.0 / cell_m) / n
    count = (ordered > biases).sum(-1, keepdim=True)
    bias = biases.gather(-1, count - 1)
    return (similarity - bias).clamp_min(0.0), bias.squeeze(-1)
