r"""Pure functions: the dynamics of pose cells and other attractors on a torus."""

import math
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.convolve import Cell, Kernels, Packet, circulant, trim, widen, widened_origin
from neuroslam.compiled import compiled
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI
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
        raise silenced(global_inhibition)
    field = (field / total).reshape(
        *batch, coupled.theta.shape[0], coupled.y.shape[-2], coupled.x.shape[-1]
    )
    if batch:
        n = torch.tensor(packet.shape, device=values.device)
        first = cast(Tensor, packet.origin)
        origin = (first - torch.tensor(reach, device=values.device)) % n
        return Packet(field, origin, packet.shape)
    return trim(Packet(field, widened_origin(packet, reach), packet.shape))


def silenced(global_inhibition: float) -> MapError:
    """Make the error of activity that inhibition has silenced."""
    return MapError(
        "pose cells: inhibition silenced every cell; global_inhibition "
        f"{global_inhibition:g} is above all activity; lower it"
    )


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


def heading_table(n_theta: int) -> np.ndarray:
    """Return cosine and sine of every layer's heading, ``(2, n_theta)``."""
    return np.array([row[:n_theta] for row in _headings(n_theta, torch.float64, _CPU)[1]])


_CPU = torch.device("cpu")


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


@compiled
def advance(
    values: np.ndarray,
    sizes: Cell,
    origin: Cell,
    torus: Cell,
    excite: np.ndarray,
    inhibit: np.ndarray,
    global_inhibition: float,
    distance_cells: float,
    turn_cells: float,
    aside_cells: tuple[float, float],
    headings: np.ndarray,
    radius: int,
    single: bool,
) -> tuple[np.ndarray, Cell, Cell, tuple[float, float, float]]:
    """Advance one brain by a frame: :func:`settle`, :func:`path_integrate`, :func:`decode`.

    Windows of compiled steps are flat, ``float64``.

    Args:
        values: Activity of the window.
        sizes: Its cells along theta, y and x.
        origin: Its first cell on the torus.
        torus: Cells of the torus along theta, y and x.
        excite: 1-D factors for theta, y and x, ``(3, size)``.
        inhibit: The same of the inhibition.
        global_inhibition: Activity removed from every cell.
        distance_cells: Displacement of each layer along its heading.
        turn_cells: Displacement of all layers along theta.
        aside_cells: Displacement of all layers along x and y.
        headings: Cosine and sine of every layer's heading, ``(2, n_theta)``.
        radius: Cells on each side of the peak that are decoded.
        single: Whether activity is rounded to single precision.

    Returns:
        The window, its sizes and origin, and the estimate: x, y, theta. The window is empty if
        every cell is silent.
    """
    reach = excite.shape[1] // 2
    field, wide = _convolve(values, sizes, torus, excite, reach)
    inhibited, _ = _convolve(field, wide, torus, inhibit, 0 * reach)  # 0 alone compiles again
    sums = np.zeros(8)  # a single sum waits for each addition
    for i in range(field.size):
        field[i] = max(field[i] - inhibited[i] - global_inhibition, 0.0)
    for i in range(field.size):
        sums[i % 8] += field[i]
    total = sums.sum()
    if not total > 0.0:
        return field[:0], wide, origin, (0.0, 0.0, 0.0)
    for i in range(field.size):
        field[i] /= total
    first = (
        (origin[0] - reach) % torus[0],
        (origin[1] - reach) % torus[1],
        (origin[2] - reach) % torus[2],
    )
    field, wide, first = _trim(field, wide, first, torus)
    moved, wide, first = _move(
        field, wide, first, torus, distance_cells, turn_cells, aside_cells, headings
    )
    if single:
        for i in range(moved.size):
            moved[i] = np.float32(moved[i])
    return moved, wide, first, decode_window(moved, wide, first, torus, radius)


@compiled
def _convolve(
    values: np.ndarray, sizes: Cell, torus: Cell, kernels: np.ndarray, lead: int
) -> tuple[np.ndarray, Cell]:
    """Convolve a window that widens by ``lead`` cells on each side."""
    a, b, c = sizes
    one = min(a, 1)  # a literal 1 would be compiled for on its own
    a_out, b_out, c_out = (
        min(a + 2 * lead, torus[0]),
        min(b + 2 * lead, torus[1]),
        min(c + 2 * lead, torus[2]),
    )
    field = _along_x(values, a * b, c, torus[2], kernels[2], lead)
    field = _along(field, a, b, c_out, torus[1], kernels[1], lead)
    field = _along(field, one, a, b_out * c_out, torus[0], kernels[0], lead)
    return field, (a_out, b_out, c_out)


@compiled
def _along(
    source: np.ndarray, rows: int, size: int, inner: int, n: int, kernel: np.ndarray, lead: int
) -> np.ndarray:
    """Convolve rows of cells, each row a stretch of a ring of ``n``, each cell ``inner`` numbers.

    The whole stretch is added at once, shifted by each weight's place.
    """
    size_out = min(size + 2 * lead, n)
    out = np.zeros(rows * size_out * inner)
    for row in range(rows):
        for m in range(kernel.size):
            for turns in range(-n, n + 1, n):  # what leaves the ring at one end enters at the other
                shift = m - kernel.size // 2 + lead + turns
                low, high = max(0, -shift), min(size, size_out - shift)
                if low < high:
                    weight = kernel[m]
                    arriving = source[(row * size + low) * inner :]
                    reached = out[(row * size_out + low + shift) * inner :]
                    for k in range((high - low) * inner):
                        reached[k] += weight * arriving[k]
    return out


@compiled
def _along_x(
    source: np.ndarray, rows: int, size: int, n: int, kernel: np.ndarray, lead: int
) -> np.ndarray:
    """Do the same where a cell is one number: all rows at once, as the rows are short.

    Each row stands between margins, which hold what the ring has there.
    """
    reach = kernel.size // 2
    size_out = min(size + 2 * lead, n)
    width = size_out + 2 * reach
    padded, sums, out = np.zeros(rows * width), np.zeros(rows * width), np.empty(rows * size_out)
    for t in range(width):
        cell = (t - lead - reach) % n
        if cell < size:
            for row in range(rows):
                padded[row * width + t] = source[row * size + cell]
    span = sums.size - 2 * reach
    for m in range(kernel.size):
        weight, shifted = kernel[m], padded[2 * reach - m :]
        for k in range(span):
            sums[k] += weight * shifted[k]
    for row in range(rows):
        for k in range(size_out):
            out[row * size_out + k] = sums[row * width + k]
    return out


@compiled
def _span(active: np.ndarray, n: int) -> tuple[int, int]:
    """Return the first active cell and how many to keep; a whole ring opens at its longest gap."""
    first = last = widest = start = -1
    for i in range(active.size):
        if active[i] > 0.0:
            if first < 0:
                first = i
            elif i - last > widest:
                widest, start = i - last, i
            last = i
    if last - first + 1 == n and widest > 1:
        return start, n - widest + 1
    return first, last - first + 1


@compiled
def _trim(
    values: np.ndarray, sizes: Cell, origin: Cell, torus: Cell
) -> tuple[np.ndarray, Cell, Cell]:
    """Cut silent planes from the sides of a window."""
    a, b, c = sizes
    planes, rows, columns = np.zeros(a), np.zeros(b), np.zeros(c)
    for i in range(a):
        for j in range(b):
            most, at = 0.0, (i * b + j) * c
            for k in range(c):
                value = values[at + k]
                columns[k] = max(columns[k], value)
                most = max(most, value)
            planes[i], rows[j] = max(planes[i], most), max(rows[j], most)
    i0, a_out = _span(planes, torus[0])
    j0, b_out = _span(rows, torus[1])
    k0, c_out = _span(columns, torus[2])
    kept, to = np.empty(a_out * b_out * c_out), 0
    for i in range(a_out):
        for j in range(b_out):
            at = ((i0 + i) % a * b + (j0 + j) % b) * c
            for k in range(k0, k0 + c_out):
                kept[to] = values[at + (k if k < c else k - c)]
                to += 1
    first = ((origin[0] + i0) % torus[0], (origin[1] + j0) % torus[1], (origin[2] + k0) % torus[2])
    return kept, (a_out, b_out, c_out), first


@compiled
def _move(
    values: np.ndarray,
    sizes: Cell,
    origin: Cell,
    torus: Cell,
    distance_cells: float,
    turn_cells: float,
    aside_cells: tuple[float, float],
    headings: np.ndarray,
) -> tuple[np.ndarray, Cell, Cell]:
    """Move the activity of a window."""
    a, b, c = sizes
    along_x, along_y = np.empty(a), np.empty(a)
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in range(a):
        layer = (origin[0] + i) % torus[0]
        x = distance_cells * headings[0, layer] + aside_cells[0]
        y = distance_cells * headings[1, layer] + aside_cells[1]
        along_x[i], along_y[i] = x, y
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    first_x, first_y, first_theta = math.floor(low_x), math.floor(low_y), math.floor(turn_cells)
    a_out = min(a + math.ceil(turn_cells) - first_theta, torus[0])
    b_out = min(b + math.ceil(high_y) - first_y, torus[1])
    c_out = min(c + math.ceil(high_x) - first_x, torus[2])
    ahead_theta = turn_cells - first_theta
    layer_size = b_out * c_out
    out, plane = np.zeros(a_out * layer_size), np.empty(layer_size)
    for i in range(a):
        whole_x, whole_y = math.floor(along_x[i]), math.floor(along_y[i])
        ahead_x, ahead_y = along_x[i] - whole_x, along_y[i] - whole_y
        shift_x, shift_y = whole_x - first_x, whole_y - first_y
        plane[:] = 0.0
        for j in range(b):
            for up in range(2):  # a weight is 0 where the cell lies beyond the window
                weight_y = ahead_y if up else 1.0 - ahead_y
                if weight_y == 0.0:
                    continue
                row = (j + shift_y + up) % torus[1] * c_out
                for k in range(c):
                    value = weight_y * values[(i * b + j) * c + k]
                    to = k + shift_x
                    plane[row + (to if to < c_out else to % torus[2])] += (1.0 - ahead_x) * value
                    if ahead_x > 0.0:
                        to += 1
                        plane[row + (to if to < c_out else to % torus[2])] += ahead_x * value
        for up in range(2):
            weight = ahead_theta if up else 1.0 - ahead_theta
            if weight > 0.0:
                sink = out[(i + up) % torus[0] * layer_size :]
                for k in range(layer_size):
                    sink[k] += weight * plane[k]
    first = (
        (origin[0] + first_theta) % torus[0],
        (origin[1] + first_y) % torus[1],
        (origin[2] + first_x) % torus[2],
    )
    return out, (a_out, b_out, c_out), first


@compiled
def decode_window(
    values: np.ndarray, sizes: Cell, origin: Cell, torus: Cell, radius: int
) -> tuple[float, float, float]:
    """Decode x, y and theta of the dominant packet: :func:`decode`; arguments of :func:`advance`.

    Where a window is the whole ring its cells are taken around the peak; else it has two ends.
    """
    b, c = sizes[1], sizes[2]
    peak = 0
    for i in range(values.size):
        if values[i] > values[peak]:
            peak = i
    peaks = (peak // (b * c), peak // c % b, peak % c)
    width = 2 * radius + 1
    cells, sums = np.full((3, width), -1), np.zeros((3, width))
    for axis in range(3):
        size, n = sizes[axis], torus[axis]
        for i in range(width):
            at = peaks[axis] + i - radius
            if size < n and 0 <= at < size:
                cells[axis, i] = at
            elif size == n and -(n // 2) <= i - radius < n - n // 2:
                cells[axis, i] = at % n
    for i in range(width):
        for j in range(width):
            at = (cells[0, i] * b + cells[1, j]) * c
            if cells[0, i] < 0 or cells[1, j] < 0:
                continue
            for k in range(width):
                if cells[2, k] >= 0:
                    value = values[at + cells[2, k]]
                    sums[0, i] += value
                    sums[1, j] += value
                    sums[2, k] += value
    found = np.empty(3)
    for axis in range(3):
        unit = TWO_PI / torus[axis]
        s = co = 0.0
        for i in range(width):
            s += sums[axis, i] * math.sin(unit * (i - radius))
            co += sums[axis, i] * math.cos(unit * (i - radius))
        found[axis] = (origin[axis] + peaks[axis] + math.atan2(s, co) / unit) % torus[axis]
    return found[2], found[1], found[0]


@compiled
def inject_window(
    values: np.ndarray,
    sizes: Cell,
    origin: Cell,
    torus: Cell,
    at: tuple[float, float, float],
    energy: float,
) -> tuple[np.ndarray, Cell, Cell]:
    """Add activity at theta, y, x: :func:`inject`; arguments and window of :func:`advance`."""
    low = (math.floor(at[0]), math.floor(at[1]), math.floor(at[2]))
    before, after = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for axis in range(3):
        size, n = sizes[axis], torus[axis]
        ahead = (low[axis] - origin[axis]) % n
        after[axis] = max(0, ahead + 2 - size) if size < n else 0
        if after[axis] and n - ahead <= after[axis]:  # fewer cells if the window grows backward
            before[axis] = n - ahead
            after[axis] = max(0, 2 - before[axis] - size)
        after[axis] = min(after[axis], n - size - before[axis])
    a, b, c = sizes
    wide = (before[0] + a + after[0], before[1] + b + after[1], before[2] + c + after[2])
    first = (
        (origin[0] - before[0]) % torus[0],
        (origin[1] - before[1]) % torus[1],
        (origin[2] - before[2]) % torus[2],
    )
    out = np.zeros(wide[0] * wide[1] * wide[2])
    for i in range(a):
        for j in range(b):
            to = ((before[0] + i) * wide[1] + before[1] + j) * wide[2] + before[2]
            for k in range(c):
                out[to + k] = values[(i * b + j) * c + k]
    for corner in range(8):
        weight, cell = energy, 0
        for axis in range(3):
            up = corner >> axis & 1
            ahead = at[axis] - low[axis]
            weight *= ahead if up else 1.0 - ahead
            cell = cell * wide[axis] + (low[axis] + up - first[axis]) % torus[axis]
        if weight != 0.0:
            out[cell] += weight
    return out, wide, first
