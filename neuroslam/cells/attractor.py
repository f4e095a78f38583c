r"""Pure functions: the dynamics of pose cells and other attractors on a torus."""

import math
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.convolve import Cell, Kernels, Packet, circulant, trim, widen, widened_origin
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, rotate_points
from neuroslam.types import PoseEstimate

Headings = list[list[float]]


class Couplings(NamedTuple):
    """Matrices of one window size that excite, and excite then inhibit, along theta, y and x.

    Attributes:
        theta: ``[E, -I E]`` side by side, shape ``(a', 2 a)``: the difference in one product.
        y: ``E`` and ``I E`` stacked, shape ``(2, 1, b', b)``.
        x: ``E`` and ``I E`` stacked and transposed, shape ``(2, c, c')``.
    """

    theta: Tensor
    y: Tensor
    x: Tensor


def couplings(
    excite: Kernels, inhibit: Kernels, sizes: tuple[int, int, int], shape: tuple[int, int, int]
) -> Couplings:
    """Prepare the products of :func:`settle` for a window of ``sizes`` on a torus of ``shape``."""
    pairs = []
    for up, down, size, n in zip(excite, inhibit, sizes, shape, strict=True):
        # E then I is one kernel, E * I: full convolution of the two. Cells beyond the reach of E
        # are only inhibited, hence silent: they need no rows.
        both = torch.nn.functional.conv1d(
            up[None, None], down.flip(0)[None, None], padding=down.shape[0] - 1
        )[0, 0]
        reach = up.shape[0] // 2
        pairs.append(torch.stack([circulant(up, size, n, reach), circulant(both, size, n, reach)]))
    theta, y, x = pairs
    return Couplings(
        torch.cat([theta[0], -theta[1]], dim=1).contiguous(),
        y[:, None].contiguous(),
        x.transpose(-1, -2).contiguous(),
    )


def settle(
    packet: Packet, coupled: Couplings, reach: tuple[int, int, int], global_inhibition: float
) -> Packet:
    r"""Excite, inhibit, inhibit globally, normalise.

    .. math::
        P \leftarrow W_e * P, \quad P \leftarrow P - W_i * P, \quad
        P \leftarrow \frac{[P - \varphi]_+}{\sum [P - \varphi]_+}

    (multisession RatSLAM, Eqs. 1 and 3; :math:`*` is the circular convolution.)

    Args:
        packet: :math:`P`, values ``(a, b, c)``, or of a batch ``(brains, a, b, c)``.
        coupled: Kernels as matrices for windows of this size, from :func:`couplings`.
        reach: Half width of the excitation kernel, for theta, y and x.
        global_inhibition: :math:`\varphi`, activity removed from every cell.

    Returns:
        Non-negative activity of sum 1 (for each brain of a batch, whose windows are not trimmed).

    Raises:
        MapError: If inhibition silenced every cell.
    """
    values = packet.values
    a, b, _ = values.shape[-3:]
    batch = values.shape[:-3]
    rows = values.flatten(-3, -2).unsqueeze(-3) @ coupled.x  # (..., 2, a b, c')
    planes = coupled.y @ rows.unflatten(-2, (a, b))  # (..., 2, a, b', c')
    field = coupled.theta @ planes.flatten(-4, -3).flatten(-2, -1)  # (..., a', b' c')
    field = (field - global_inhibition).clamp_min(0.0)
    total = field.sum((-2, -1), keepdim=True)
    if total.min().item() <= 0.0:
        raise MapError(
            "pose cells: inhibition silenced every cell; global_inhibition "
            f"{global_inhibition:g} is above all activity; lower it"
        )
    field = (field / total).reshape(
        *batch, coupled.theta.shape[0], coupled.y.shape[-2], coupled.x.shape[-1]
    )
    if batch:
        n = torch.tensor(packet.shape, device=values.device)
        first = cast(Tensor, packet.origin)
        origin = (first - torch.tensor(reach, device=values.device)) % n
        return Packet(field, origin, packet.shape)
    return trim(Packet(field, widened_origin(packet, reach), packet.shape))


def shift_matrix(shift: Tensor, first: int, n_out: int, n_in: int, n: int) -> Tensor:
    r"""Return matrices that move activity along a ring by any distance, interpolating linearly.

    .. math:: S_{ij} = [\,1 - |i + f - j - d|_n\,]_+

    where :math:`|\cdot|_n` is the distance on a ring of :math:`n` cells. Columns sum to 1, and
    activity moves by exactly :math:`d` on average: the gain is 1.

    Args:
        shift: :math:`d` in cells, shape ``(...)``.
        first: :math:`f`, offset of the first row from the first column.
        n_out: Rows.
        n_in: Columns.
        n: Cells in the ring.

    Returns:
        Shape ``(..., n_out, n_in)``.

    Example:
        >>> shift_matrix(torch.tensor(0.25), first=0, n_out=2, n_in=1, n=8).flatten().tolist()
        [0.75, 0.25]
    """
    apart = _offsets(first, n_out, n_in, shift.dtype, shift.device) - shift[..., None, None]
    if n_out == n:  # only then can two cells be nearer across the wrap-around
        apart = apart - n * torch.round(apart / n)
    return (1.0 - apart.abs()).clamp_min(0.0)


@lru_cache(maxsize=256)
@torch.inference_mode(mode=False)
def _offsets(first: int, n_out: int, n_in: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    rows = torch.arange(first, first + n_out, dtype=dtype, device=device)
    return rows[:, None] - torch.arange(n_in, dtype=dtype, device=device)


@lru_cache(maxsize=16)
@torch.inference_mode(mode=False)
def _headings(n_theta: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Headings]:
    """Cosine and sine of every layer's heading, twice round, as a tensor and as numbers."""
    angles = [TWO_PI * k / n_theta for k in range(2 * n_theta)]
    both = [[math.cos(a) for a in angles], [math.sin(a) for a in angles]]
    return torch.tensor(both, dtype=dtype, device=device), both


def path_integrate(
    packet: Packet,
    distance_cells: float,
    turn_cells: float,
    aside_cells: tuple[float, float] = (0.0, 0.0),
) -> Packet:
    r"""Move every layer along its heading, then all layers along theta: activity follows odometry.

    Layer :math:`k` moves by :math:`d` along :math:`\theta_k = 2\pi k / n_\theta` (bilinear), then
    activity moves along theta (linear). Any distance, also backward; activity wraps around.

    Args:
        packet: Activity of one brain, values ``(a, b, c)``.
        distance_cells: :math:`d = v\,dt / \text{cell size}`.
        turn_cells: :math:`\omega\,dt\,n_\theta / 2\pi`.
        aside_cells: Displacement of all layers along x and y.

    Returns:
        Activity of the same sum.
    """
    values = packet.values
    sizes, (n_theta, n_y, n_x) = values.shape, packet.shape
    layers = slice(packet.origin[0], packet.origin[0] + sizes[0])
    table, numbers = _headings(n_theta, values.dtype, values.device)
    shifts = distance_cells * table[:, layers]
    if any(aside_cells):
        shifts = shifts + values.new_tensor(aside_cells)[:, None]
    windows = []
    for axis, n, row, aside in zip((2, 1), (n_x, n_y), numbers, aside_cells, strict=True):
        ends = [distance_cells * end + aside for end in (min(row[layers]), max(row[layers]))]
        windows.append(_window(sizes[axis], n, min(ends), max(ends)))
    (first_x, n_out_x), (first_y, n_out_y) = windows
    first_theta, n_out_theta = _window(sizes[0], n_theta, turn_cells, turn_cells)
    along_x = shift_matrix(shifts[0], first_x, n_out_x, sizes[2], n_x)
    along_y = shift_matrix(shifts[1], first_y, n_out_y, sizes[1], n_y)
    moved = along_y @ values @ along_x.transpose(-1, -2)
    turn = values.new_tensor(turn_cells)
    along_theta = shift_matrix(turn, first_theta, n_out_theta, sizes[0], n_theta)
    turned = (along_theta @ moved.flatten(-2, -1)).unflatten(-1, (n_out_y, n_out_x))
    o_theta, o_y, o_x = cast(Cell, packet.origin)
    origin = ((o_theta + first_theta) % n_theta, (o_y + first_y) % n_y, (o_x + first_x) % n_x)
    return Packet(turned, origin, packet.shape)


def moved_cells(
    cells: np.ndarray,
    pivot: np.ndarray,
    shift: np.ndarray,
    torus: tuple[int, int, int],
    paths: np.ndarray | None = None,
) -> np.ndarray:
    r"""Move pose-cell states on the torus so that the pivot coincides with another state.

    .. math:: P' = P + \Delta \pmod n, \qquad \Delta = P_u - P_z

    (Multisession RatSLAM, Eqs. 10 and 11; Eq. 10 is misprinted there.) If the two
    sessions started with different headings, displacements differ in direction too; with ``paths``
    they are rotated,

    .. math:: P' = P_u + R(\Delta_\theta)\,(P - P_z)_\text{unwrapped} \pmod n

    so that a robot that comes there in the other session has its activity there. The displacement
    from :math:`P_z` to :math:`P` is unwrapped to the value nearest to ``paths``.

    Args:
        cells: x, y, theta in cells, ``(n, 3)``.
        pivot: :math:`P_z`, ``(3,)``.
        shift: :math:`\Delta` in cells, ``(3,)``; any fraction.
        torus: ``(n_x, n_y, n_theta)``.
        paths: Displacements from the pivot on the map, in cells, ``(n, 2)``; ``None``: shift only.

    Example:
        >>> moved_cells(np.array([[20.5, 3.0, 1.0]]), None, np.array([1, 0, -2]), (21, 21, 36))
        array([[ 0.5,  3. , 35. ]])
    """
    n = np.array(torus, dtype=np.float64)
    moved = cells + shift
    if paths is not None:
        apart = cells[:, :2] - pivot[:2]
        apart = apart + n[:2] * np.round((paths - apart) / n[:2])
        turned = rotate_points(apart, TWO_PI * shift[2] / n[2])
        moved[:, :2] = pivot[:2] + shift[:2] + turned
    moved = moved % n
    return np.where(moved >= n, 0.0, moved)  # a tiny negative rounds up to n


def _window(size: int, n: int, low: float, high: float) -> tuple[int, int]:
    first = math.floor(low)
    return first, min(size + math.ceil(high) - first, n)


def inject(packet: Packet, at: PoseEstimate, energy: float) -> Packet:
    r"""Add activity at a point between cells, shared by its eight neighbours (trilinear).

    .. math:: \Delta P_{k,j,i} = \delta \, [1-|k-\theta|]_+ [1-|j-y|]_+ [1-|i-x|]_+

    (multisession RatSLAM, Eq. 5.) Activity is renormalised by the next :func:`settle`.
    """
    where = (at.theta, at.y, at.x)
    corner = tuple(math.floor(c) for c in where)
    theta, y, x = (c % n for c, n in zip(corner, packet.shape, strict=True))
    packet = widen(packet, (theta, y, x))
    added = packet.values.new_tensor(energy)
    for axis, (c, low) in enumerate(zip(where, corner, strict=True)):
        weights = [0.0] * packet.values.shape[axis]
        ahead = (low - packet.origin[axis]) % packet.shape[axis]
        weights[ahead] = 1.0 - (c - low)
        weights[(ahead + 1) % packet.shape[axis]] = c - low
        added = added[..., None] * packet.values.new_tensor(weights)
    return packet._replace(values=packet.values + added)


def decode(packet: Packet, radius: int) -> PoseEstimate:
    r"""Decode the dominant packet: the most active cell, then the population vector around it.

    .. math:: \hat x = \frac{n_x}{2\pi} \operatorname{atan2}
              \Big(\sum_i p_i \sin\tfrac{2\pi i}{n_x}, \sum_i p_i \cos\tfrac{2\pi i}{n_x}\Big)

    over the cells within ``radius`` of the peak on every axis; likewise y and theta.

    Args:
        packet: Activity of one brain, values ``(a, b, c)``.
        radius: Cells to each side of the peak.

    Returns:
        Position in cells, each in ``[0, n)``.
    """
    values = packet.values.numpy(force=True)
    a, b, c = values.shape
    peak = int(values.argmax())
    peaks = (peak // (b * c), peak // c % b, peak % c)
    whole = [size == n for size, n in zip((a, b, c), packet.shape, strict=True)]
    if any(whole):  # roll the peak to the middle, so that its neighbourhood does not wrap
        rolls = [
            size // 2 - p if w else 0 for size, p, w in zip((a, b, c), peaks, whole, strict=True)
        ]
        values = np.roll(values, rolls, axis=(0, 1, 2))
        peaks = tuple(p + r for p, r in zip(peaks, rolls, strict=True))
    else:
        rolls = (0, 0, 0)
    lows = [max(0, p - radius) for p in peaks]
    near = values[
        lows[0] : peaks[0] + radius + 1,
        lows[1] : peaks[1] + radius + 1,
        lows[2] : peaks[2] + radius + 1,
    ]
    over_x = near.sum(2)
    marginals = (over_x.sum(1), over_x.sum(0), near.sum((0, 1)))
    found = []
    for marginal, low, p, roll, origin, n in zip(
        marginals, lows, peaks, rolls, packet.origin, packet.shape, strict=True
    ):
        # Relative to the peak: same angle, and no rounding of a whole turn.
        unit = TWO_PI / n
        weights = marginal.tolist()
        s = sum(w * math.sin(unit * (low + i - p)) for i, w in enumerate(weights))
        co = sum(w * math.cos(unit * (low + i - p)) for i, w in enumerate(weights))
        found.append((origin + p - roll + math.atan2(s, co) / unit) % n)
    return PoseEstimate(found[2], found[1], found[0])
