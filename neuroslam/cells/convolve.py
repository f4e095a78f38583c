r"""Circular convolution on a torus with separable kernels, and the packet it is computed on.

Activity of an attractor network is compact: some hundred cells of a hundred thousand. A
:class:`Packet` keeps the smallest window that holds them, so a step costs the same on any torus.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from neuroslam.errors import MapError

Kernels = tuple[Tensor, Tensor, Tensor]
"""One odd 1-D kernel for each axis, in the order theta, y, x."""


Cell = tuple[int, int, int]
"""A cell of the torus, or an extent in cells: theta, y, x."""


class Packet(NamedTuple):
    """Activity inside a window of the torus; every cell outside is silent.

    Attributes:
        values: Shape ``(..., a, b, c)``, a window in theta, y, x; it may have batch dimensions.
        origin: Torus coordinates of the window's first cell, in ``[0, n)`` on each axis; in a
            batch those of each brain's window, ``(brains, 3)``.
        shape: Size of the torus ``(n_theta, n_y, n_x)``.
    """

    values: Tensor
    origin: Cell | Tensor
    shape: tuple[int, int, int]


def gaussian_kernel(size: int, std_cells: float, dtype: torch.dtype = torch.float64) -> Tensor:
    r"""Return the 1-D factor of a normalised Gaussian kernel, sum 1.

    .. math:: w(r) = e^{-r^2 / 2\sigma^2} / \textstyle\sum_r e^{-r^2 / 2\sigma^2}

    The 3-D kernel is the product of three such factors (multisession RatSLAM, Eq. 1).

    Example:
        >>> [round(w, 3) for w in gaussian_kernel(3, std_cells=1.0).tolist()]
        [0.274, 0.452, 0.274]
    """
    r = torch.arange(size, dtype=torch.float64) - size // 2
    weights = torch.exp(-(r**2) / (2.0 * std_cells**2))
    return (weights / weights.sum()).to(dtype)


class GaussianDifference(NamedTuple):
    """Separable difference of Gaussians: excitation minus inhibition.

    Attributes:
        excite: One odd 1-D kernel for each axis.
        inhibit: The same of the inhibition.
    """

    excite: tuple[Tensor, ...]
    inhibit: tuple[Tensor, ...]


def gaussian_difference(
    excite: Sequence[tuple[int, float]],
    inhibit: Sequence[tuple[int, float]],
    dtype: torch.dtype = torch.float64,
) -> GaussianDifference:
    r"""Make the kernels of a difference of Gaussians, each Gaussian with sum 1.

    .. math:: w = \textstyle\prod_a G_{\sigma^E_a} - \prod_a G_{\sigma^I_a}

    Args:
        excite: Size in cells and standard deviation in cells for each axis.
        inhibit: The same of the inhibition.
        dtype: Of the kernels.

    Example:
        >>> kernels = gaussian_difference([(3, 1.0), (5, 1.0)], [(5, 2.0), (5, 2.0)])
        >>> [len(k) for k in kernels.excite], [len(k) for k in kernels.inhibit]
        ([3, 5], [5, 5])
    """
    return GaussianDifference(
        tuple(gaussian_kernel(size, std, dtype) for size, std in excite),
        tuple(gaussian_kernel(size, std, dtype) for size, std in inhibit),
    )


def convolve_axes(
    activity: Tensor, kernels: Sequence[Tensor], circular: Sequence[bool] | bool = True
) -> Tensor:
    r"""Convolve the last axes with a separable kernel; an axis is a ring or has ends.

    .. math:: h_{i_1 \dots i_k} = \sum_{r_1 \dots r_k} w^1_{r_1} \cdots w^k_{r_k}
              \, a_{i_1 - r_1 \dots i_k - r_k}

    Beyond the ends of an axis that is no ring there is no activity. Differentiable in both.

    Args:
        activity: ``(..., n_1, ..., n_k)``, with any batch dimensions.
        kernels: Odd 1-D kernel for each of the last :math:`k` axes, no longer than a ring.
        circular: Whether each of these axes is a ring; one value for all.

    Returns:
        Same shape.

    Example:
        >>> one = torch.zeros(4, 4, dtype=torch.float64); one[0, 0] = 1.0
        >>> side = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        >>> convolve_axes(one, (side, side), (True, False)).sum().item()  # lost at the end
        0.0
    """
    rings = (circular,) * len(kernels) if isinstance(circular, bool) else tuple(circular)
    out = activity
    first = activity.dim() - len(kernels)
    for axis, (kernel, ring) in enumerate(zip(kernels, rings, strict=True), start=first):
        reach = kernel.shape[0] // 2
        last = out.movedim(axis, -1)
        lines = last.reshape(-1, 1, last.shape[-1])
        pads = F.pad(lines, (reach, reach), mode="circular" if ring else "constant")
        lines = F.conv1d(pads, kernel.flip(0)[None, None])  # conv1d correlates
        out = lines.reshape(last.shape).movedim(-1, axis)
    return out


def excite_and_inhibit(
    activity: Tensor,
    kernels: GaussianDifference,
    gains: tuple[float, float],
    circular: Sequence[bool] | bool = True,
) -> Tensor:
    r"""Let neighbours excite each other and a surround inhibit, once, and rectify.

    .. math:: r = [a + g_E \, G_E * a - g_I \, G_I * a]_+

    Args:
        activity: :math:`a`, ``(..., n_1, ..., n_k)``.
        kernels: :math:`G_E, G_I`.
        gains: :math:`g_E, g_I`; where one is 0 its convolution is left out.
        circular: As in :func:`convolve_axes`.

    Returns:
        Same shape, non-negative.

    Example:
        >>> kernels = gaussian_difference([(3, 1.0)], [(5, 2.0)])
        >>> excite_and_inhibit(torch.eye(6, dtype=torch.float64), kernels, (0.0, 0.0)).sum().item()
        6.0
    """
    out = activity
    for kernel, gain in zip(kernels, (gains[0], -gains[1]), strict=True):
        if gain:
            out = out + gain * convolve_axes(activity, kernel, circular)
    return out.clamp_min(0.0)


def circulant(kernel: Tensor, n_in: int, n: int, reach: int | None = None) -> Tensor:
    r"""Return the matrix that convolves ``n_in`` neighbouring cells of a ring of ``n``.

    Row :math:`i` is the cell :math:`i - r` places after the window's first. Rows that would pass
    once round the ring fall onto their cell.

    Args:
        kernel: Odd number of weights, at most ``n``.
        n_in: Cells in the window.
        n: Cells in the ring.
        reach: :math:`r`, how far beyond the window cells are looked at; half the kernel's width,
            which is all that the window reaches, if not given.

    Returns:
        Shape ``(min(n_in + 2 r, n), n_in)``.

    Example:
        >>> circulant(torch.tensor([1.0, 2.0, 3.0]), n_in=1, n=9).flatten().tolist()
        [1.0, 2.0, 3.0]
    """
    size = kernel.shape[0]
    reach = size // 2 if reach is None else reach
    n_out = min(n_in + 2 * reach, n)
    columns = torch.arange(n_in, device=kernel.device).repeat_interleave(size)
    taps = torch.arange(size, device=kernel.device) - size // 2 + reach
    rows = (columns + taps.repeat(n_in)) % n
    held = rows < n_out
    empty = kernel.new_zeros(n_out, n_in)
    return empty.index_put((rows[held], columns[held]), kernel.repeat(n_in)[held], accumulate=True)


def multiply_axes(values: Tensor, along: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Apply a matrix to each of the last three axes: shapes ``(a', a)``, ``(b', b)``, ``(c', c)``.

    Example:
        >>> twice = 2.0 * torch.eye(2)
        >>> multiply_axes(torch.ones(2, 2, 2), (twice, twice, twice)).unique().item()
        8.0
    """
    a, b, _ = values.shape[-3:]
    in_theta, in_y, in_x = along
    batch = values.shape[:-3]
    rows = values.flatten(-3, -2) @ in_x.transpose(-1, -2)
    planes = in_y @ rows.unflatten(-2, (a, b))
    out = in_theta @ planes.flatten(-2, -1)
    return out.reshape(*batch, in_theta.shape[-2], in_y.shape[-2], in_x.shape[-2])


def circular_convolve(
    activity: Tensor,
    kernels: Kernels,
    method: Literal["auto", "window", "separable", "dense"] = "auto",
) -> Tensor:
    r"""Convolve activity on the torus with a separable kernel.

    .. math:: (W * P)_{k,j,i} = \sum_{c,b,a} w^\theta_c w^y_b w^x_a \,
              P_{k-c \bmod n_\theta,\; j-b \bmod n_y,\; i-a \bmod n_x}

    Three implementations, equal up to rounding, all of them differentiable:
    ``window`` multiplies the active window with circulant matrices (fast on a CPU, one brain),
    ``separable`` runs ``conv1d`` along each axis (batches), ``dense`` is ``conv3d`` with the full
    kernel, the definition.

    Args:
        activity: Shape ``(..., n_theta, n_y, n_x)``.
        kernels: Odd 1-D kernels for theta, y and x.
        method: ``auto`` takes ``window`` for one brain on the CPU, else ``separable``.

    Returns:
        Same shape.

    Example:
        >>> spread = (gaussian_kernel(3, 1.0),) * 3
        >>> one = torch.zeros(8, 8, 8, dtype=torch.float64); one[0, 0, 0] = 1.0
        >>> round(circular_convolve(one, spread).sum().item(), 9)
        1.0
    """
    if method == "auto":
        single = activity.dim() == 3 and activity.device.type == "cpu"
        method = "window" if single else "separable"
    if method == "window":
        packet = to_packet(activity)
        theta, y, x = (
            circulant(kernel, n_in, n)
            for kernel, n_in, n in zip(kernels, packet.values.shape[-3:], packet.shape, strict=True)
        )
        a, b, c = (kernel.shape[0] // 2 for kernel in kernels)
        values = multiply_axes(packet.values, (theta, y, x))
        return to_dense(Packet(values, widened_origin(packet, (a, b, c)), packet.shape))
    batch = activity.shape[:-3]
    flat = activity.reshape(-1, 1, *activity.shape[-3:])
    if method == "dense":
        t, y, x = (kernel.flip(0) for kernel in kernels)  # conv3d correlates
        weight = t[:, None, None] * y[:, None] * x
        pad = [kernel.shape[0] // 2 for kernel in reversed(kernels) for _ in range(2)]
        out = F.conv3d(F.pad(flat, pad, mode="circular"), weight[None, None])
        return out.reshape(activity.shape)
    out = convolve_axes(flat[:, 0], kernels)
    return out.reshape(*batch, *activity.shape[-3:])


def widened_origin(packet: Packet, reach: Cell) -> Cell:
    """Return the first cell of one brain's window that is wider by ``reach`` on both sides."""
    n_theta, n_y, n_x = packet.shape
    theta, y, x = cast(Cell, packet.origin)
    return (theta - reach[0]) % n_theta, (y - reach[1]) % n_y, (x - reach[2]) % n_x


def to_packet(activity: Tensor) -> Packet:
    """Take the smallest window that holds all activity; with batch dimensions, the whole torus.

    Args:
        activity: Shape ``(..., n_theta, n_y, n_x)``.

    Raises:
        MapError: If no cell is active.
    """
    n_theta, n_y, n_x = activity.shape[-3:]
    packet = Packet(activity, (0, 0, 0), (n_theta, n_y, n_x))
    return packet if activity.dim() > 3 else trim(packet)


def to_dense(packet: Packet) -> Tensor:
    """Put the window back onto the torus; shape ``(..., n_theta, n_y, n_x)``."""
    values = packet.values
    pads: list[int] = []
    for width, n in zip(values.shape[-3:], packet.shape, strict=True):
        pads = [0, n - width, *pads]
    return torch.roll(F.pad(values, pads), cast(Cell, packet.origin), dims=(-3, -2, -1))


def trim(packet: Packet) -> Packet:
    """Cut silent planes from the window's sides; where it is the whole ring, at the longest gap.

    Raises:
        MapError: If no cell is active.
    """
    layers = packet.values.detach().flatten(1)  # two axes at a time: five times faster
    plane = layers.amax(0).unflatten(0, packet.values.shape[1:])
    masks = (layers.amax(1), plane.amax(1), plane.amax(0))
    cut, rolls, origin = [], [0, 0, 0], list(cast(Cell, packet.origin))
    for axis, (mask, n) in enumerate(zip(masks, packet.shape, strict=True)):
        active = [i for i, peak in enumerate(mask.tolist()) if peak != 0.0]
        if not active:
            raise MapError(
                "pose cells: no activity is left; global inhibition is above every cell's "
                "activity, lower global_inhibition or raise inject_energy"
            )
        first, last = active[0], active[-1]
        if len(mask) == n and last - first + 1 == n:
            gaps = [b - a for a, b in pairwise(active)]
            widest = max(gaps, default=1)
            if widest > 1:
                start = active[gaps.index(widest) + 1]
                rolls[axis] = -start
                first, last = 0, n - widest
                origin[axis] = (origin[axis] + start) % n
        cut.append(slice(first, last + 1))
        origin[axis] = (origin[axis] + first) % n
    kept = packet.values
    if any(rolls):
        kept = torch.roll(kept, rolls, dims=(0, 1, 2))
    theta, y, x = origin
    return Packet(kept[cut[0], cut[1], cut[2]], (theta, y, x), packet.shape)


def widen(packet: Packet, cell: tuple[int, int, int], width: int = 2) -> Packet:
    """Grow the window by silent cells until it holds ``width`` cells from ``cell`` on."""
    pads: list[int] = []
    origin: list[int] = []
    sizes = packet.values.shape[-3:]
    for o, size, c, n in zip(cast(Cell, packet.origin), sizes, cell, packet.shape, strict=True):
        ahead = (c - o) % n  # of the window's first cell
        after = max(0, ahead + width - size) if size < n else 0
        before = n - ahead if after else 0
        if before and before <= after:
            after = max(0, width - before - size)
        else:
            before = 0
        after = min(after, n - size - before)
        pads = [before, after, *pads]
        origin.append((o - before) % n)
    if not any(pads):
        return packet
    theta, y, x = origin
    return Packet(F.pad(packet.values, pads), (theta, y, x), packet.shape)


def fourier_convolve(activity: Tensor, transfer: Tensor) -> Tensor:
    r"""Convolve populations on a torus, each with its own kernel, and add up what arrives.

    .. math:: h = \mathcal F^{-1} \sum_d \hat w_d \, \mathcal F r_d

    The way for kernels as wide as the torus, or shifted by fractions of a cell; those of
    :func:`circular_convolve` are narrow and centred on a cell.

    Args:
        activity: :math:`r_d`, shape ``(..., populations, n_y, n_x)``.
        transfer: :math:`\hat w_d`, ``torch.fft.rfft2`` of the kernels, shape
            ``(populations, n_y, n_x // 2 + 1)``.

    Returns:
        Shape ``(..., n_y, n_x)``.

    Example:
        >>> one = torch.zeros(1, 4, 4, dtype=torch.float64); one[0, 3, 0] = 1.0
        >>> down = torch.zeros(1, 4, 4, dtype=torch.float64); down[0, 1, 0] = 2.0
        >>> fourier_convolve(one, torch.fft.rfft2(down))[0, 0].item()
        2.0
    """
    arrived = (torch.fft.rfft2(activity) * transfer).sum(-3)
    return torch.fft.irfft2(arrived, s=activity.shape[-2:])


def ring_convolve(activity: Tensor, kernels: Tensor) -> Tensor:
    r"""Convolve activity on a ring with kernels as wide as the ring.

    By ``conv1d`` with circular padding; where each ring of a batch has kernels of its own, by the
    Fourier transform, which is the same and many times faster there.

    .. math:: h_{m,i} = \sum_j w_{m,\,(i - j) \bmod n} \, r_j

    Args:
        activity: :math:`r`, shape ``(..., n)``.
        kernels: :math:`w`, shape ``(m, n)`` for all, or ``(..., m, n)`` for each its own;
            entry 0 is the weight of a cell to itself.

    Returns:
        Shape ``(..., m, n)``.

    Example:
        >>> one = torch.tensor([0.0, 0.0, 0.0, 1.0])
        >>> ring_convolve(one, torch.tensor([[0.0, 2.0, 3.0, 0.0]]))[0].tolist()
        [2.0, 3.0, 0.0, 0.0]
    """
    m, n = kernels.shape[-2:]
    if kernels.dim() > 2:
        spectrum = torch.fft.rfft(activity)[..., None, :] * torch.fft.rfft(kernels)
        return torch.fft.irfft(spectrum, n=n)
    around = torch.cat([activity[..., 1:], activity], -1).reshape(-1, 1, 2 * n - 1)
    out = torch.conv1d(around, kernels.flip(-1)[:, None])  # conv1d correlates
    return out.reshape(*activity.shape[:-1], m, n)
