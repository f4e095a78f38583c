"""Spatial semantic pointers: positions as vectors, whose binding adds the positions."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from neuroslam.config.semantic import SSPSpaceConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking import frequencies as waves
from neuroslam.threads import in_own_types


class SSPSpace(nn.Module):
    r"""Encodes positions as spatial semantic pointers.

    .. math:: \phi(x) = F^{-1}\{e^{iA x / \ell}\}, \qquad
              \phi(x) \circledast \phi(y) = \phi(x + y)

    (SSP-SLAM, Eqs. 3 and 4). A vector has ``n_features`` :math:`= 2K + 1` numbers, or as Fourier
    coefficients :math:`z_1 \ldots z_K`, complex; the constant one is 1 and the rest conjugate.
    Parameters: ``frequencies`` and ``length_scale_m``; gradients reach them if asked to.

    Args:
        frequencies: Rows of :math:`A`, rad a length scale, ``(K, dimension)``.
        length_scale_m: :math:`\ell`, one or one for each dimension.
        bounds_m: Where positions are, ``(dimension, 2)``; ``None``: in [-1, 1].
        grid_modules: Numbers of frequencies whose phases sum to zero, ``(modules, n)``;
            ``None``: there are none.

    Raises:
        SpaceError: If these do not fit each other.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> x, y = torch.tensor([0.3, 0.1]), torch.tensor([-0.1, 0.4])
        >>> from neuroslam.spiking.algebra import bind
        >>> moved = bind(space.encode(x), space.encode(y))
        >>> bool(torch.allclose(moved, space.encode(x + y), atol=1e-6))
        True
    """

    bounds_m: Tensor

    def __init__(
        self,
        frequencies: Tensor,
        length_scale_m: float | Sequence[float] = 0.2,
        bounds_m: Tensor | None = None,
        grid_modules: Tensor | None = None,
    ) -> None:
        super().__init__()
        if frequencies.ndim != 2 or not bool(torch.isfinite(frequencies).all()):
            raise SpaceError(
                f"SSPSpace: frequencies of shape {tuple(frequencies.shape)}, expected finite "
                "numbers (n_frequencies, dimension)"
            )
        m = frequencies.shape[1]
        kind = torch.get_default_dtype()
        scale = torch.as_tensor(length_scale_m, dtype=kind).expand(m).clone()
        bounds = torch.tensor([[-1.0, 1.0]] * m) if bounds_m is None else torch.as_tensor(bounds_m)
        if bounds.shape != (m, 2) or not bool((bounds[:, 0] < bounds[:, 1]).all()):
            raise SpaceError(
                f"SSPSpace: bounds {bounds.tolist()}, expected a lower and an upper one for each "
                f"of {m} dimensions"
            )
        if not bool((scale > 0).all()):
            raise SpaceError(f"SSPSpace: length scale {scale.tolist()} m, must be positive")
        self.frequencies = nn.Parameter(frequencies.to(kind).clone(), requires_grad=False)
        self.length_scale_m = nn.Parameter(scale, requires_grad=False)
        self.register_buffer("bounds_m", bounds.to(kind))
        self.grid_modules = grid_modules

    @classmethod
    def hexagonal(
        cls,
        dimension: int = 2,
        n_rotations: int = 3,
        n_scales: int = 3,
        length_scale_m: float | Sequence[float] = 0.2,
        bounds_m: Tensor | None = None,
        scale_range: tuple[float, float] = (1.0, math.pi),
        scale_spacing: str = "linear",
        seed: int = 0,
    ) -> "SSPSpace":
        """Make a space of grid modules: waves of simplices of several scales and orientations.

        Args:
            dimension: Of the positions.
            n_rotations: Orientations of modules; a line has one.
            n_scales: Scales of modules, for each orientation.
            length_scale_m: As for the class.
            bounds_m: As for the class.
            scale_range: Lowest and highest frequency, rad a length scale.
            scale_spacing: ``"linear"``, ``"log"`` or ``"random"`` in between.
            seed: Of random scales, and of rotations in three and more dimensions.
        """
        draw = torch.Generator().manual_seed(seed)
        rows = waves.hexagonal(dimension, n_rotations, n_scales, scale_range, scale_spacing, draw)
        modules = torch.arange(len(rows)).reshape(-1, dimension + 1) if dimension > 1 else None
        return cls(rows, length_scale_m, bounds_m, modules)

    @classmethod
    def rectangular(
        cls,
        dimension: int = 2,
        n_rotations: int = 3,
        n_scales: int = 4,
        length_scale_m: float | Sequence[float] = 0.2,
        bounds_m: Tensor | None = None,
        scale_range: tuple[float, float] = (1.0, math.pi),
        scale_spacing: str = "linear",
        seed: int = 0,
    ) -> "SSPSpace":
        """Make a space of waves along axes, turned; arguments as those of :meth:`hexagonal`."""
        draw = torch.Generator().manual_seed(seed)
        rows = waves.rectangular(dimension, n_rotations, n_scales, scale_range, scale_spacing, draw)
        return cls(rows, length_scale_m, bounds_m)

    @classmethod
    def random(
        cls,
        dimension: int = 2,
        n_frequencies: int = 27,
        length_scale_m: float | Sequence[float] = 0.2,
        bounds_m: Tensor | None = None,
        scale_max: float = math.pi,
        seed: int = 0,
    ) -> "SSPSpace":
        """Make a space of waves uniform in a ball of ``scale_max`` rad a length scale."""
        draw = torch.Generator().manual_seed(seed)
        rows = waves.uniform_in_ball(dimension, n_frequencies, scale_max, draw)
        return cls(rows, length_scale_m, bounds_m)

    @classmethod
    def from_config(cls, config: SSPSpaceConfig) -> "SSPSpace":
        """Make the space that a config describes."""
        c, m = config, config.dimension
        reach = c.reach_m if isinstance(c.reach_m, tuple) else (c.reach_m,)
        reach = reach * m if len(reach) == 1 else reach
        bounds = torch.tensor([[-r, r] for r in reach])
        if c.kind == "random":
            return cls.random(m, c.n_random, c.length_scale_m, bounds, c.scale_max, c.seed)
        make = cls.hexagonal if c.kind == "hexagonal" else cls.rectangular
        return make(
            m,
            c.n_rotations,
            c.n_scales,
            c.length_scale_m,
            bounds,
            (c.scale_min, c.scale_max),
            c.scale_spacing,
            c.seed,
        )

    @property
    def dimension(self) -> int:
        """Of the positions."""
        return self.frequencies.shape[1]

    @property
    def n_frequencies(self) -> int:
        """Of complex numbers in a vector."""
        return self.frequencies.shape[0]

    @property
    def n_features(self) -> int:
        """Of real numbers in a vector."""
        return 2 * self.n_frequencies + 1

    @property
    def wave_vectors(self) -> Tensor:
        """Of the waves, rad/m, ``(n_frequencies, dimension)``."""
        return self.frequencies / self.length_scale_m

    @in_own_types
    def encode_fourier(self, x: Tensor) -> Tensor:
        """Return Fourier coefficients, complex: ``(..., dimension)`` to ``(..., K)``."""
        angle = self._checked(x) @ self.wave_vectors.T
        return torch.polar(torch.ones_like(angle), angle)

    def encode(self, x: Tensor) -> Tensor:
        """Return the vectors of positions: ``(..., dimension)`` to ``(..., n_features)``."""
        return self.from_fourier(self.encode_fourier(x))

    def from_fourier(self, z: Tensor) -> Tensor:
        """Turn Fourier coefficients, ``(..., K)``, into vectors, ``(..., n_features)``."""
        whole = torch.cat([torch.ones_like(z[..., :1]), z], dim=-1)
        return torch.fft.irfft(whole, n=self.n_features)

    def to_fourier(self, phi: Tensor) -> Tensor:
        """Turn vectors into Fourier coefficients, without the constant one."""
        if phi.shape[-1] != self.n_features:
            raise SpaceError(
                f"SSPSpace: vectors of {phi.shape[-1]} features, this space has {self.n_features}"
            )
        return torch.fft.rfft(phi)[..., 1:]

    @in_own_types
    def gradient(self, x: Tensor) -> Tensor:
        r"""Return :math:`\partial\phi/\partial x = F^{-1}\{i A/\ell \odot F\{\phi\}\}` (Eq. 16).

        Args:
            x: ``(..., dimension)``.

        Returns:
            ``(..., n_features, dimension)``.
        """
        slope = 1j * self.wave_vectors * self.encode_fourier(x).unsqueeze(-1)
        whole = torch.cat([torch.zeros_like(slope[..., :1, :]), slope], dim=-2)
        return torch.fft.irfft(whole, n=self.n_features, dim=-2)

    @in_own_types
    def region_fourier(self, low_m: Tensor, high_m: Tensor) -> Tensor:
        r"""Return the mean of a box's points, as Fourier coefficients.

        .. math:: \frac{1}{|D|} \int_D e^{i a \cdot x}\,dx =
                  e^{i a \cdot c} \prod_q \frac{\sin(a_q w_q / 2)}{a_q w_q / 2}

        with the box's centre :math:`c` and widths :math:`w`; a point is a box without any.

        Args:
            low_m: Lower corners, ``(..., dimension)``.
            high_m: Upper corners.
        """
        half = (self._checked(high_m) - self._checked(low_m)) / 2
        spread = torch.sinc(half.unsqueeze(-2) * self.wave_vectors / math.pi).prod(-1)
        return self.encode_fourier(low_m.to(half) + half) * spread

    def region(self, low_m: Tensor, high_m: Tensor) -> Tensor:
        r"""Return the vector of a box, of length 1: that of :math:`\int_D \phi(x)\,dx`."""
        phi = self.from_fourier(self.region_fourier(low_m, high_m))
        return phi / phi.norm(dim=-1, keepdim=True)

    @in_own_types
    def kernel(self, offset_m: Tensor) -> Tensor:
        r"""Return the similarity of two positions by their displacement.

        .. math:: k(\delta) = \phi(x) \cdot \phi(x + \delta) =
                  \frac1d \sum_j \cos(A_j \cdot \delta / \ell)
        """
        waves_there = (self._checked(offset_m) @ self.wave_vectors.T).cos().sum(-1)
        return (1.0 + 2.0 * waves_there) / self.n_features

    @in_own_types
    def similarity(self, phi: Tensor, x: Tensor) -> Tensor:
        """Return how alike vectors and positions are: ``(..., n_features)``, ``(n, dimension)``.

        Returns:
            ``(..., n)``.
        """
        return phi @ self.encode(x).T

    def _checked(self, x: Tensor) -> Tensor:
        """Take positions in this space's numbers."""
        if x.shape[-1:] != (self.dimension,):
            raise SpaceError(
                f"SSPSpace: positions of shape {tuple(x.shape)}, expected (..., {self.dimension})"
            )
        return x.to(self.frequencies.dtype)
