"""Probability densities of positions as semantic pointers: means of encoded samples."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.errors import MapError, SpaceError
from neuroslam.spiking.algebra import bind, unbind
from neuroslam.spiking.decoding import probability
from neuroslam.spiking.gaussian import Gaussian, fit_gaussian
from neuroslam.spiking.space import SSPSpace
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State, merge_by_rules, summed
from neuroslam.state.renumbering import Renumbering

_POINTS = {1: 1001, 2: 81}  # a side of a grid, by the dimension
_POINTS_IN_MORE = 25
_MOST_POINTS = 200_000
_NEWTON_STEPS = 60
_CONVERGED = 1e-10  # decrease of the objective that a further step would bring


class Density(NamedTuple):
    """A probability density at evenly spaced points of the bounds of a space.

    Attributes:
        points_m: ``(n, dimension)``; the last axis changes fastest.
        density: Per metre to the power of the dimension, ``(n,)``.
        cell: Volume that belongs to a point, in metres to the power of the dimension.
        shape: Points along each axis.
    """

    points_m: Tensor
    density: Tensor
    cell: float
    shape: tuple[int, ...]

    @property
    def integral(self) -> float:
        """Integral over the bounds: 1."""
        return float(self.density.sum()) * self.cell

    @property
    def mean_m(self) -> Tensor:
        """Expectation of the position, ``(dimension,)``."""
        return self.expectation(lambda x: x)

    @property
    def covariance_m2(self) -> Tensor:
        """Covariance of the position, ``(dimension, dimension)``."""
        mean = self.mean_m
        return self.expectation(lambda x: (x - mean).unsqueeze(-1) * (x - mean).unsqueeze(-2))

    @property
    def entropy(self) -> float:
        r"""Differential entropy :math:`-\int f \ln f\,dx`, nats; log m for each dimension."""
        return -float(torch.special.xlogy(self.density, self.density).sum()) * self.cell

    def expectation(self, function: Callable[[Tensor], Tensor]) -> Tensor:
        r"""Return :math:`\int g(x)\,f(x)\,dx`.

        Args:
            function: :math:`g`, of points ``(n, dimension)``; returns ``(n, ...)``.

        Returns:
            ``(...)``.
        """
        values = function(self.points_m)
        return torch.einsum("n,n...->...", self.density.to(values), values) * self.cell


def encode_samples(space: SSPSpace, samples_m: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""Return the mean of the pointers of samples.

    .. math:: M_n = \frac1n \sum_i \phi(x_i)

    (SSP-SLAM, section 2.1.3). Its coefficients are the empirical characteristic function of the
    samples at the waves of the space.

    Args:
        space: Of the positions.
        samples_m: ``(n, dimension)``.
        weights: Of the samples, not negative, ``(n,)``; ``None``: all alike.

    Returns:
        Fourier coefficients, complex, ``(n_frequencies,)``.

    Raises:
        SpaceError: If there is no sample, or a weight is negative.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> z = encode_samples(space, torch.tensor([[0.2, 0.1], [0.2, 0.1]]))
        >>> bool(torch.allclose(z, space.encode_fourier(torch.tensor([0.2, 0.1]))))
        True
    """
    share = _shares(samples_m, weights)
    return (space.encode_fourier(samples_m) * share.to(space.frequencies).unsqueeze(-1)).sum(-2)


def _shares(samples: Tensor, weights: Tensor | None) -> Tensor:
    """Check samples and weights; return the share of each sample."""
    if samples.ndim != 2 or not len(samples) or not bool(torch.isfinite(samples).all()):
        raise SpaceError(
            f"samples of shape {tuple(samples.shape)}; expected at least one row of finite numbers"
        )
    weights = torch.ones(len(samples)) if weights is None else weights
    if weights.shape != (len(samples),) or not bool((weights >= 0).all()) or not weights.sum() > 0:
        raise SpaceError(
            f"weights of shape {tuple(weights.shape)} for {len(samples)} samples; expected one for "
            "each, none negative and not all zero"
        )
    return weights / weights.sum()


def grid_of(space: SSPSpace, points: int | None = None) -> tuple[Tensor, float, tuple[int, ...]]:
    """Return evenly spaced points in the bounds of a space, as those of a :class:`Density`.

    Each point is the centre of a cell; the cells fill the bounds.

    Args:
        space: Of the positions.
        points: Points along each axis; ``None``: 1001 on a line, 81 in a plane, 25 in a volume.

    Returns:
        Points ``(n, dimension)``, volume of a cell, and points along each axis.

    Raises:
        SpaceError: If that makes more than 200 000 points.
    """
    m = space.dimension
    points = _POINTS.get(m, _POINTS_IN_MORE) if points is None else points
    if points < 2 or points**m > _MOST_POINTS:
        raise SpaceError(
            f"a grid of {points} points along each of {m} axes; expected at least 2, and at most "
            f"{_MOST_POINTS} in all"
        )
    low, high = space.bounds_m.detach().T
    share = (torch.arange(points).to(low) + 0.5) / points
    axes = [a + (b - a) * share for a, b in zip(low, high, strict=True)]
    cell = float(((high - low) / points).prod())
    return torch.cartesian_prod(*axes).reshape(-1, m), cell, (points,) * m


def kernel_volume(space: SSPSpace) -> float:
    r"""Return the volume of the main lobe of the similarity, as of a normal distribution.

    .. math:: \kappa = \sqrt{(2\pi)^m / \det \Lambda}, \qquad
              \Lambda = -\nabla^2 k(0) = \frac2d \sum_j a_j a_j^\top

    Divided by it, the similarity :math:`k` is a kernel of unit mass in its main lobe.

    Returns:
        In metres to the power of the dimension.

    Example:
        >>> space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)
        >>> round(kernel_volume(space), 3)
        0.104
    """
    waves = space.wave_vectors.detach().double()
    curvature = 2.0 / space.n_features * waves.T @ waves
    return float(((2.0 * math.pi) ** space.dimension / torch.linalg.det(curvature)).sqrt())


@torch.no_grad()
def rectified_density(space: SSPSpace, z: Tensor, points: int | None = None) -> Density:
    r"""Return the density that rectified similarities give, as a population of neurons reads it.

    .. math:: \hat f(x) = \Bigl(\frac{\phi(x) \cdot M_n}{\kappa} - \xi\Bigr)_+, \qquad
              \int \hat f(x)\,dx = 1

    (SSP-SLAM, Eqs. 6 and 7; Glad et al., 2003), with the kernel's volume :math:`\kappa` of
    :func:`kernel_volume`, so that it does not depend on the unit of length. It is a kernel density
    estimate: wider than the samples by the width of the similarity, and of its side lobes what
    :math:`\xi` leaves. :func:`maximum_entropy_density` is nearer to the samples.

    Args:
        space: Of the positions.
        z: Fourier coefficients of the pointer, complex, ``(n_frequencies,)``.
        points: As for :func:`grid_of`.

    Example:
        >>> space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)
        >>> f = rectified_density(space, space.encode_fourier(torch.tensor([0.3, -0.2])))
        >>> round(f.integral, 4), f.points_m[f.density.argmax()].round(decimals=1).tolist()
        (1.0, [0.30000001192092896, -0.20000000298023224])
    """
    _check_pointer(space, z)
    at, cell, shape = grid_of(space, points)
    alike = space.similarity(space.from_fourier(z), at).double()
    density, _ = probability(alike / kernel_volume(space), cell)
    return Density(at, density.to(at), cell, shape)


@torch.no_grad()
def maximum_entropy_density(
    space: SSPSpace, z: Tensor, points: int | None = None, noise: float = 1e-4
) -> Density:
    r"""Return the density of largest entropy whose own pointer is the given one.

    .. math:: \hat f(x) \propto e^{\lambda \cdot \phi(x)}, \qquad
              \lambda = \arg\min_\lambda\; \ln \int e^{\lambda \cdot \phi(x)}dx
              - \lambda \cdot M_n + \tfrac{\varepsilon}{2} |\lambda|^2

    (Jaynes, 1957, with the Fourier coefficients as what is known of the density). Neurons that
    respond exponentially in place of :func:`rectified_density`'s rectified ones, and a pointer
    :math:`\lambda` in place of :math:`M_n`, in which the width of the similarity is undone.
    Newton's method on the convex dual.

    Args:
        space: Of the positions.
        z: Fourier coefficients of the pointer, complex, ``(n_frequencies,)``.
        points: As for :func:`grid_of`.
        noise: :math:`\varepsilon`, variance of a coefficient that is noise; of a pointer that was
            unbound from others about their number.

    Raises:
        SpaceError: If the noise is not positive, or the pointer does not fit.

    Example:
        >>> space = SSPSpace.hexagonal()
        >>> cloud = 0.1 * torch.randn(2000, 2, generator=torch.Generator().manual_seed(0))
        >>> f = maximum_entropy_density(space, encode_samples(space, cloud))
        >>> f.covariance_m2.diagonal().sqrt().round(decimals=2).tolist()
        [0.10000000149011612, 0.10000000149011612]
    """
    _check_pointer(space, z)
    if not noise > 0:
        raise SpaceError(f"maximum_entropy_density: noise {noise}; expected a positive variance")
    at, cell, shape = grid_of(space, points)
    angle = (at @ space.wave_vectors.detach().T).double()
    waves = torch.cat([angle.cos(), angle.sin()], dim=-1)
    known = torch.cat([z.real, z.imag]).double()
    dual = torch.zeros_like(known)
    ridge = noise * torch.eye(len(dual), dtype=dual.dtype, device=dual.device)

    def objective(x: Tensor) -> float:
        return float(torch.logsumexp(waves @ x, 0) - x @ known + 0.5 * noise * x @ x)

    value = objective(dual)
    for _ in range(_NEWTON_STEPS):
        share = torch.softmax(waves @ dual, 0)
        mean = share @ waves
        slope = mean - known + noise * dual
        curvature = (waves.T * share) @ waves - torch.outer(mean, mean) + ridge
        step = -torch.linalg.solve(curvature, slope)
        gain, length = -float(slope @ step), 1.0
        if gain < _CONVERGED:
            break
        while (new := objective(dual + length * step)) > value - 1e-4 * length * gain:
            length /= 2.0
            if length < 1e-6:
                break
        if length < 1e-6:
            break
        dual, value = dual + length * step, new
    density = torch.softmax(waves @ dual, 0) / cell
    return Density(at, density.to(at), cell, shape)


def _check_pointer(space: SSPSpace, z: Tensor) -> None:
    if z.shape != (space.n_frequencies,) or not z.is_complex():
        raise SpaceError(
            f"a pointer of shape {tuple(z.shape)}; expected {space.n_frequencies} complex Fourier "
            "coefficients: use the space's encode_fourier, or to_fourier of a vector"
        )


# --- joint densities: a landmark and its position, two positions ---------------------------------


def encode_joint(
    space: SSPSpace, pointers: Tensor, samples_m: Tensor, weights: Tensor | None = None
) -> Tensor:
    r"""Return the pointer of a joint density of labels and positions.

    .. math:: J_n = \frac1n \sum_i B_i \circledast \phi(x_i)

    (SSP-SLAM, section 2.1.3: binding makes a density of several variables; Furlong and Eliasmith,
    2022). Two positions need no label: encode them as one in a space of twice the dimension, see
    :func:`given_coordinates`.

    Args:
        space: Of the positions.
        pointers: :math:`B_i` of each sample, unitary, ``(n, n_features)``.
        samples_m: :math:`x_i`, ``(n, dimension)``.
        weights: Of the samples; ``None``: all alike.

    Returns:
        ``(n_features,)``.
    """
    share = _shares(samples_m, weights)
    if pointers.shape != (len(samples_m), space.n_features):
        raise SpaceError(
            f"encode_joint: pointers of shape {tuple(pointers.shape)}, expected "
            f"({len(samples_m)}, {space.n_features}): one of the space's features for each sample"
        )
    each = bind(pointers.to(space.frequencies), space.encode(samples_m))
    return (each * share.to(each).unsqueeze(-1)).sum(0)


def given_label(space: SSPSpace, joint: Tensor, pointer: Tensor, share: float = 1.0) -> Tensor:
    r"""Condition a joint density on a label, by unbinding it.

    .. math:: E[\phi(x) \mid B] \approx J \circledast B^{-1} / P(B)

    What is bound to other labels is left as noise, of variance
    :math:`\sum_{C \ne B} P(C)^2 / (d\,P(B)^2)` in the similarity.

    Args:
        space: Of the positions.
        joint: From :func:`encode_joint`, ``(n_features,)``.
        pointer: :math:`B`, ``(n_features,)``.
        share: :math:`P(B)`; 1: the result is of strength :math:`P(B)`, which ``fit_gaussian`` finds
            if the density has one mode.

    Returns:
        Fourier coefficients, complex, ``(n_frequencies,)``.

    Raises:
        SpaceError: If the share is not in (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise SpaceError(f"given_label: share {share}; expected a probability above 0, up to 1")
    return space.to_fourier(unbind(joint, pointer.to(joint))) / share


def given_position(space: SSPSpace, joint: Tensor, position_m: Tensor, pointers: Tensor) -> Tensor:
    r"""Condition a joint density on a position, by unbinding it: the probability of each label.

    .. math:: P(B \mid x) \propto \bigl(B \cdot (J \circledast \phi(x)^{-1}) - \xi\bigr)_+

    with :math:`\xi = 2 |J| / \sqrt d`, twice the standard deviation that bound pointers which are
    elsewhere leave.

    Args:
        space: Of the positions.
        joint: From :func:`encode_joint`, ``(n_features,)``.
        position_m: :math:`x`, ``(dimension,)``.
        pointers: Of all labels, unitary, ``(labels, n_features)``.

    Returns:
        ``(labels,)``, of sum 1; all 0 where the joint density is too small to tell.
    """
    free = unbind(joint, space.encode(position_m))
    bias = 2.0 * float(joint.norm()) / space.n_features**0.5
    alike = (pointers.to(free) @ free - bias).clamp_min(0.0)
    return alike / alike.sum().clamp_min(torch.finfo(alike.dtype).tiny)


def given_coordinates(
    space: SSPSpace, z: Tensor, known: dict[int, float]
) -> tuple[SSPSpace, Tensor]:
    r"""Condition a density on some of its coordinates, by unbinding them.

    .. math:: z'_k = z_k\, e^{-i\, b_k \cdot y}

    with the parts :math:`b_k` of the wave vectors along the known coordinates :math:`y`: samples
    with other values interfere and vanish. The result is not of strength 1, but that of the
    density at :math:`y`, as wide as the similarity.

    Args:
        space: Of all coordinates.
        z: Fourier coefficients, complex, ``(n_frequencies,)``.
        known: Axis -> value in metres.

    Returns:
        The space of the other coordinates and the Fourier coefficients in it.

    Raises:
        SpaceError: If all or none are known, or there is no such axis.
    """
    _check_pointer(space, z)
    m = space.dimension
    free = [axis for axis in range(m) if axis not in known]
    if not free or len(free) == m or any(not 0 <= axis < m for axis in known):
        raise SpaceError(
            f"given_coordinates: axes {sorted(known)} are known of a space of {m}; expected at "
            "least one of them known, and one not"
        )
    y = torch.zeros(m).to(space.frequencies)
    for axis, value in known.items():
        y[axis] = value
    rest = SSPSpace(
        space.frequencies.detach()[:, free],
        space.length_scale_m.detach()[free].tolist(),
        space.bounds_m[free],
    )
    return rest, z * space.encode_fourier(y).conj()


# --- a module that learns a density --------------------------------------------------------------


class DensityEstimator(Mergeable):
    """Learns the density of samples as one pointer; see :func:`encode_samples`.

    State: ``total``, the sum of the samples' Fourier coefficients, ``(n_frequencies, 2)``, and
    ``count``, the sum of their weights. Sums and counts merge exactly: the density of two sessions
    is that of their samples together.

    Args:
        space: Of the positions.

    Example:
        >>> estimator = DensityEstimator(SSPSpace.hexagonal())
        >>> estimator(torch.tensor([[0.5, 0.0], [-0.5, 0.0]]))
        >>> f = estimator.density()
        >>> round(f.integral, 4), float(f.mean_m.abs().max()) < 0.01
        (1.0, True)
    """

    total: Tensor
    count: Tensor

    def __init__(self, space: SSPSpace) -> None:
        super().__init__()
        self.space = space
        self.register_buffer("total", torch.zeros(space.n_frequencies, 2, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def forward(self, samples_m: Tensor, weights: Tensor | None = None) -> None:
        """Learn samples.

        Args:
            samples_m: ``(n, dimension)``.
            weights: Of the samples, not negative, ``(n,)``; ``None``: 1 each.

        Raises:
            SpaceError: If there is no sample, one is not a number, or a weight is negative.
        """
        added = float(len(samples_m)) if weights is None else float(weights.sum())
        mean = encode_samples(self.space, samples_m, weights).to(torch.complex128)
        self.total = self.total + added * torch.view_as_real(mean)
        self.count = self.count + added

    @property
    def z(self) -> Tensor:
        """Fourier coefficients of the mean pointer, complex, ``(n_frequencies,)``.

        Raises:
            SpaceError: If it has no samples yet.
        """
        if not float(self.count) > 0:
            raise SpaceError("DensityEstimator: it has no samples yet; call it with some")
        mean = torch.view_as_complex(self.total / self.count)
        single = self.space.frequencies.dtype == torch.float32
        return mean.to(torch.complex64) if single else mean

    def density(self, points: int | None = None) -> Density:
        """Return the density; see :func:`maximum_entropy_density`.

        The noise of a coefficient is that of a mean of as many samples.

        Args:
            points: As for :func:`grid_of`.
        """
        noise = max(1e-4, 0.5 / float(self.count))
        return maximum_entropy_density(self.space, self.z, points, noise)

    def gaussian(self) -> Gaussian:
        """Return the nearest normal distribution; see :func:`~.gaussian.fit_gaussian`."""
        return fit_gaussian(self.space, self.z)

    def renumber(self, change: Renumbering) -> None:
        """Do nothing: samples have no ids of the map."""

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Add the samples of two sessions, those of the partial one in the loaded frame.

        A shift is bound to them. A turn cannot be: it moves the waves of a space onto others.

        Raises:
            MapError: If the partial map is turned by the merge.
        """
        dx, dy = join.onto.x_m - join.pivot.x_m, join.onto.y_m - join.pivot.y_m
        still = dx == dy == 0.0
        if abs(join.rotation_rad) > 1e-9 or not (still or self.space.dimension == 2):
            raise MapError(
                f"merge: a density of {self.space.dimension} dimensions is turned by "
                f"{join.rotation_rad:.3f} rad or moved by {dx:.2f}, {dy:.2f} m; a pointer can be "
                "moved in a plane but not turned: keep both sessions in the frame of a compass"
            )
        moved = partial
        if not still:
            shift = self.space.encode_fourier(torch.tensor([dx, dy])).detach().to(torch.complex128)
            total = torch.view_as_complex(partial["total"].contiguous()) * shift
            moved = partial | {"total": torch.view_as_real(total)}
        return merge_by_rules({"total": summed, "count": summed, "space": _kept}, loaded, moved,
                              join)  # fmt: skip


def _kept(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    return loaded
