"""Boundary cells as a sheet of bearing by warped distance, whose responses are read as walls."""

import math
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from neuroslam.cells.convolve import (
    GaussianDifference,
    circulant,
    convolve_axes,
    excite_and_inhibit,
    gaussian_difference,
)
from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import BoundaryCellConfig
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.scan import checked_ranges

_CELLS_PER_SIGMA = 3.0  # on the axis of distance
_MARGIN = 3.0  # of the axis of distance beyond 0 and reach_m, in widths
_SURROUND = 2.0  # width of the inhibition over that of the tuning
_CUT = 6.0  # half the size of a tuning kernel, in widths
_ROUNDS = 4  # of the population vector
_WINDOW = 5  # cells on either side that the population vector takes
_SIDE_M = 0.2  # of a wall on either side of its foot, whose beams a cell takes
_MOST_RAD = math.radians(75.0)  # angle to them at most
_RINGS = (True, False)  # bearing, distance
_REFINES = 4  # rounds of the fit to the beams of a wall
_WITHIN = 3.0  # residual, in widths of the tuning, above which a beam is of another wall
_FEWEST = 8  # beams of such a fit
_LEAST_BEND = 0.2  # 1 minus distance over radius, below which the foot is not sure
_APART_RAD = math.radians(25.0)  # bearing within which two feet at one distance are one
_MOST_TURN_RAD, _BEND_PER_M = math.radians(15.0), 2.0  # largest turn, sd of the curvature
_BEAM_M = 0.03  # residual at which a beam weighs as much as that sd


def warp(distance_m: Tensor, beta_m: float) -> Tensor:
    r"""Return the warped distance, on which the distance tuning has one width.

    .. math:: \xi = \beta \ln(d / \beta + 1), \qquad
              \frac{d\xi}{dd}\,\sigma_0 (d / \beta + 1) = \sigma_0

    Example:
        >>> round(warp(torch.tensor(0.3), 0.15).item(), 4)
        0.1648
    """
    return beta_m * torch.log1p(distance_m / beta_m)


def unwarp(xi_m: Tensor, beta_m: float) -> Tensor:
    """Return the distance of a warped one; the inverse of :func:`warp`."""
    return beta_m * torch.expm1(xi_m / beta_m)


def warped_tuning(
    distance_m: Tensor, bearing_rad: Tensor, axes: tuple[Tensor, Tensor], config: BoundaryCellConfig
) -> Tensor:
    r"""Return the responses of the sheet's cells to walls by their tuning curves, cell by cell.

    .. math:: f_{kl} = \sum_\text{walls} e^{-(\alpha - \varphi_k)^2 / 2 \sigma_a^2}
              e^{-(\xi(R) - \xi_l)^2 / 2 \sigma_0^2}

    (SLRB, Eqs. 6 to 9, on the warped axis.) The definition: the sheet convolves instead.

    Args:
        distance_m: :math:`R`, ``(..., n_walls)``; ``inf`` for none.
        bearing_rad: :math:`\alpha`, the same shape.
        axes: :math:`\varphi_k` in radians, :math:`\xi_l` in metres.
        config: Widths.

    Returns:
        ``(..., n_bearings, n_distances)``.
    """
    widths = config.sheet_sigma_bearing_rad, config.sigma_m
    return _bumps(distance_m, bearing_rad, axes, widths, config.beta_m)


def _bumps(
    distance_m: Tensor,
    bearing_rad: Tensor,
    axes: tuple[Tensor, Tensor],
    widths: tuple[float, float],
    beta_m: float,
) -> Tensor:
    there = distance_m.isfinite()
    far = warp(distance_m.where(there, 0.0), beta_m).unsqueeze(-1) - axes[1]
    apart = (bearing_rad.unsqueeze(-1) - axes[0] + math.pi).remainder(TWO_PI) - math.pi
    by_bearing = (apart / widths[0]).square().mul(-0.5).exp() * there.unsqueeze(-1)
    return by_bearing.mT @ (far / widths[1]).square().mul(-0.5).exp()


@compiled
def respond_step(
    distance_m: np.ndarray, bearing_rad: np.ndarray, bearings_rad: np.ndarray,
    warped_m: np.ndarray, widths: tuple[float, float], beta_m: float,
    gains: tuple[float, float], excite_a: np.ndarray, excite_d: np.ndarray,
    inhibit_a: np.ndarray, inhibit_d: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the responses to walls, as :meth:`BoundarySheet.forward` does.

    A wall's bump is the product of a bearing's and a distance's, and so is what it spreads to.
    """
    n, m = bearings_rad.shape[0], warped_m.shape[0]
    out = np.zeros((n, m))
    a, d, spread_a, spread_d = np.empty(n), np.empty(m), np.empty((2, n)), np.empty((2, m))
    for w in range(distance_m.shape[0]):
        if not np.isfinite(distance_m[w]):
            continue
        xi = beta_m * math.log1p(distance_m[w] / beta_m)
        for i in range(n):
            spread_a[0, i] = spread_a[1, i] = 0.0
        for i in range(m):
            spread_d[0, i] = spread_d[1, i] = 0.0
        for k in range(n):
            apart = (bearing_rad[w] - bearings_rad[k] + math.pi) % TWO_PI - math.pi
            a[k] = math.exp(-0.5 * (apart / widths[0]) ** 2)
            for i in range(n):  # the matrices are symmetric
                spread_a[0, i] += a[k] * excite_a[k, i]
                spread_a[1, i] += a[k] * inhibit_a[k, i]
        for k in range(m):
            d[k] = math.exp(-0.5 * ((xi - warped_m[k]) / widths[1]) ** 2)
            for i in range(m):
                spread_d[0, i] += d[k] * excite_d[k, i]
                spread_d[1, i] += d[k] * inhibit_d[k, i]
        for k in range(n):
            excite, inhibit = gains[0] * spread_a[0, k], gains[1] * spread_a[1, k]
            for i in range(m):
                out[k, i] += a[k] * d[i] + excite * spread_d[0, i] - inhibit * spread_d[1, i]
    for k in range(n):
        for i in range(m):
            out[k, i] = max(out[k, i], 0.0)
    return out


@compiled
def read_step(
    rates: np.ndarray, lowest: float, sigmas: tuple[float, float], step_m: float, beta_m: float,
    bearings_rad: np.ndarray, warped_m: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Read walls as :meth:`BoundarySheet.read` does for one animal.

    Returns:
        Distance, bearing and standard deviation of distance, ``(n, 3)``, nearest first.
    """
    n, m, count, size = rates.shape[0], rates.shape[1], 0, 2 * _WINDOW + 1
    found = np.empty((n * m // 4 + n + m, 3))  # maxima touch only where they are equal
    patch, by_a, by_d = np.empty((size, size)), np.empty(size), np.empty(size)
    for k in range(n):
        for d in range(m):
            here, is_peak = rates[k, d], rates[k, d] > lowest
            for i in range(-1, 2):
                for j in range(max(d - 1, 0), min(d + 2, m)):
                    is_peak &= here >= rates[(k + i) % n, j]
            if not is_peak or count == found.shape[0]:
                continue
            for i in range(size):
                row = (k + i - _WINDOW) % n
                for j in range(size):
                    column = d + j - _WINDOW
                    patch[i, j] = rates[row, column] if 0 <= column < m else 0.0
            to_a = to_d = spread = 0.0
            for _ in range(_ROUNDS):
                total = mean_a = mean_d = spread = 0.0
                for j in range(size):
                    off = j - _WINDOW - to_d
                    by_d[j] = math.exp(-0.5 * (off / sigmas[1]) ** 2)
                    off = j - _WINDOW - to_a
                    by_a[j] = math.exp(-0.5 * (off / sigmas[0]) ** 2)
                for i in range(size):
                    for j in range(size):
                        weight = patch[i, j] * by_a[i] * by_d[j]
                        total += weight
                        mean_a += weight * (i - _WINDOW)
                        mean_d += weight * (j - _WINDOW)
                mean_a, mean_d = mean_a / total, mean_d / total
                for i in range(size):
                    for j in range(size):
                        off = j - _WINDOW - mean_d
                        spread += patch[i, j] * by_a[i] * by_d[j] * off * off
                spread /= total
                to_a = min(max(to_a + 2.0 * (mean_a - to_a), -1.0), 1.0)
                to_d = min(max(to_d + 2.0 * (mean_d - to_d), -1.0), 1.0)
            distance = beta_m * math.expm1((warped_m[d] + to_d * step_m) / beta_m)
            distance = max(distance, 0.0)
            angle = (bearings_rad[k] + to_a * (TWO_PI / n)) % TWO_PI
            square = sigmas[1] * sigmas[1]
            narrow = 1.0 / (1.0 / min(spread, 0.99 * square) - 1.0 / square)
            at = count
            while at > 0 and found[at - 1, 0] > distance:
                for i in range(3):
                    found[at, i] = found[at - 1, i]
                at -= 1
            found[at, 0], found[at, 1] = distance, angle
            found[at, 2] = math.sqrt(narrow) * step_m * (distance / beta_m + 1.0)
            count += 1
    return found[:count]


class BoundarySheet(nn.Module):
    r"""Boundary cells on a ring of bearings and an axis of warped distances.

    What is felt is rasterised on the sheet, convolved with the tuning kernel, and shaped by mutual
    excitation and by inhibition of the surround, which are convolutions as well (SLRB, Section 2:
    mutual excitation and inhibition):

    .. math:: u = G * s, \qquad r = [u + g_E\, G_E * u - g_I\, G_I * u]_+

    Its local maxima are read as walls. The sheet has no state.

    Args:
        config: Sizes, widths and gains.

    Example:
        >>> sheet = BoundarySheet(BoundaryCellConfig())
        >>> felt = torch.tensor([0.1, 0.25]), torch.tensor([0.3, 2.0])
        >>> distance, bearing, _ = sheet.read(sheet(*felt))
        >>> distance.round(decimals=2).tolist(), bearing.round(decimals=2).tolist()
        ([0.1, 0.25], [0.3, 2.0])
    """

    bearings_rad: Tensor
    warped_m: Tensor

    def __init__(self, config: BoundaryCellConfig) -> None:
        super().__init__()
        self.config = c = config
        self._kept: tuple[Any, ...] | None = None
        kind = torch.float64
        self.step_m = c.sigma_m / _CELLS_PER_SIGMA
        low = _MARGIN * min(c.sigma_m, c.beta_m / (_MARGIN + 1.0))
        top = c.beta_m * math.log1p(c.reach_m / c.beta_m) + _MARGIN * c.sigma_m
        cells = math.ceil((top + low) / self.step_m) + 1
        xi = self.step_m * torch.arange(cells, dtype=kind) - low
        phi = torch.arange(c.sheet_bearings, dtype=kind) * (TWO_PI / c.sheet_bearings)
        self.register_buffer("warped_m", xi, persistent=False)
        self.register_buffer("bearings_rad", phi, persistent=False)
        # Half of the variance of the tuning is in the raster, so that no wall falls between cells.
        self.sigmas = (c.sheet_sigma_bearing_rad * c.sheet_bearings / TWO_PI, _CELLS_PER_SIGMA)
        tuned = [(self._size(s, i), s) for i, s in enumerate(self.sigmas)]
        half = [(size, s * math.sqrt(0.5)) for size, s in tuned]
        wide = [
            (self._size(_SURROUND * s, i, 3.0), _SURROUND * s) for i, s in enumerate(self.sigmas)
        ]
        made = gaussian_difference(tuned, wide)
        halves = gaussian_difference(half, half).excite
        for i in range(2):
            self.register_buffer(f"_excite_{i}", made.excite[i], persistent=False)
            self.register_buffer(f"_inhibit_{i}", made.inhibit[i], persistent=False)
            self.register_buffer(f"_half_{i}", halves[i], persistent=False)
            for name, sigma_kernel in (
                ("excite", made.excite[i]), ("inhibit", made.inhibit[i]), ("half", halves[i]),
            ):  # fmt: skip
                n = (c.sheet_bearings, cells)[i]
                ring = n if _RINGS[i] else n + len(sigma_kernel)
                by = circulant(sigma_kernel, n, ring, reach=0)
                self.register_buffer(f"_{name}_matrix_{i}", by, persistent=False)
        middle = torch.tensor([c.reach_m / 2.0], dtype=kind)
        self.clear = float(self(middle, torch.zeros(1, dtype=kind)).max())
        beams = TWO_PI * np.arange(360) / 360
        ahead = np.full(360, np.inf)
        ahead[np.cos(beams) > 0.2] = c.reach_m / 2.0 / np.cos(beams)[np.cos(beams) > 0.2]
        self.clear_scan = float(self.respond_to_scan(ahead).max())

    def _size(self, sigma: float, axis: int, cut: float = _CUT) -> int:
        n = (self.config.sheet_bearings, len(self.warped_m))[axis]
        return min(2 * math.ceil(cut * sigma) + 1, n - 1 + n % 2)

    def _kernels(self, name: str) -> tuple[Tensor, Tensor]:
        return self.get_buffer(f"_{name}_0"), self.get_buffer(f"_{name}_1")

    def forward(self, distance_m: Tensor, bearing_rad: Tensor) -> Tensor:
        """Return the responses to walls, ``(..., n_bearings, n_distances)``, non-negative.

        Args:
            distance_m: Distance to the foot of the perpendicular, ``(..., n_walls)``; ``inf`` for
                none.
            bearing_rad: Its bearing, the same shape.
        """
        if distance_m.dim() == 1 and runs_compiled(distance_m, bearing_rad, self.warped_m):
            felt_m = distance_m.to(self.warped_m).contiguous().numpy()
            felt_rad = bearing_rad.to(self.warped_m).contiguous().numpy()
            return torch.from_numpy(respond_step(felt_m, felt_rad, *self._numbers()))
        axes = self.bearings_rad, self.warped_m
        walls = distance_m.to(self.warped_m), bearing_rad.to(self.warped_m)
        return self.interact(warped_tuning(*walls, axes, self.config))

    def _numbers(self) -> tuple[Any, ...]:
        """Return what :func:`respond_step` takes besides walls."""
        if self._kept is None:
            c = self.config
            names = ("excite_matrix_0", "excite_matrix_1", "inhibit_matrix_0", "inhibit_matrix_1")
            self._kept = (
                self.bearings_rad.numpy(), self.warped_m.numpy(),
                (c.sheet_sigma_bearing_rad, c.sigma_m), c.beta_m,
                (c.sheet_excitation, c.sheet_inhibition),
                *(self.get_buffer(f"_{name}").contiguous().numpy() for name in names),
            )  # fmt: skip
        return self._kept

    def _apply(self, fn: Any, recurse: bool = True) -> Self:  # noqa: ANN401 - as nn.Module has it
        self._kept = None
        return super()._apply(fn, recurse)

    def tuned(self, distance_m: Tensor, bearing_rad: Tensor) -> Tensor:
        """Return the raster convolved with the tuning kernel; equal to :func:`warped_tuning`.

        A step evaluates the latter, which is faster for a few walls.
        """
        c = self.config
        root = math.sqrt(0.5)
        reach = len(self._kernels("half")[1]) // 2  # walls beyond the ends drive cells within
        beyond = self.step_m * torch.arange(1, reach + 1).to(self.warped_m)
        axis = [self.warped_m[0] - beyond.flip(0), self.warped_m, self.warped_m[-1] + beyond]
        raster = _bumps(
            distance_m.to(self.warped_m),
            bearing_rad.to(self.warped_m),
            (self.bearings_rad, torch.cat(axis)),
            (root * c.sheet_sigma_bearing_rad, root * c.sigma_m),
            c.beta_m,
        )
        # Two factors of sqrt 2 keep the peak of one wall at 1.
        spread = convolve_axes(raster, self._kernels("half"), _RINGS)
        return 2.0 * spread[..., reach:-reach]

    def interact(self, tuned: Tensor) -> Tensor:
        """Do as :meth:`interact_by_convolution`, by matrices: faster on a small sheet."""
        c, out = self.config, tuned
        for name, gain in (("excite", c.sheet_excitation), ("inhibit", -c.sheet_inhibition)):
            if gain:
                out = out + gain * self._multiply(tuned, name, name)
        return out.clamp_min(0.0)

    def interactions(self, tuned: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return mutual excitation and the inhibition of the surround.

        .. math:: g_E\, G_E * u, \qquad g_I\, G_I * u

        Args:
            tuned: :math:`u`, ``(..., n_bearings, n_distances)``.
        """
        c = self.config
        excitation = c.sheet_excitation * self._multiply(tuned, "excite", "excite")
        return excitation, c.sheet_inhibition * self._multiply(tuned, "inhibit", "inhibit")

    def _multiply(self, values: Tensor, bearing: str, distance: str) -> Tensor:
        ring = self.get_buffer(f"_{bearing}_matrix_0")
        return ring @ (values @ self.get_buffer(f"_{distance}_matrix_1").mT)

    def interact_by_convolution(self, tuned: Tensor) -> Tensor:
        """Let neighbours excite each other, the surround inhibit, and rectify: the definition."""
        c = self.config
        pair = GaussianDifference(self._kernels("excite"), self._kernels("inhibit"))
        return excite_and_inhibit(tuned, pair, (c.sheet_excitation, c.sheet_inhibition), _RINGS)

    def respond_to_scan(self, ranges: np.ndarray) -> Tensor:
        r"""Return the responses to the beams of a scan, at bearings relative to the heading.

        A cell sums the beams to the 0.2 m of a wall on either side of its foot, but none beyond 75
        degrees, each by the distance of its point along the cell's bearing,
        :math:`r \cos(\theta - \varphi_k)`, the integral of Hartley et al. 2000. So a near wall is
        felt over a wide angle: its slanting beams tell the bearing, and their noise counts less,
        by the cosine. A wall is felt on both sides of its foot, so that corners are none: the
        response is the geometric mean of the two sides.

        Args:
            ranges: As for :func:`~neuroslam.sensors.scan.walls_in_scan`, ``(n,)``.
        """
        return self.interact(self.tuned_to_scan(ranges))

    def tuned_to_scan(self, ranges: np.ndarray) -> Tensor:
        """Return the responses to the beams of a scan before cells interact."""
        sides = torch.from_numpy(self._rasterise(checked_ranges(ranges)))
        scale = math.sqrt(TWO_PI) * self.sigmas[1]
        left, right = self._multiply(sides.to(self.warped_m), "half", "excite").unbind(0)
        return scale * (left * right).clamp_min(0.0).sqrt()

    def _rasterise(self, ranges: np.ndarray) -> np.ndarray:
        n, c = len(ranges), self.config
        bins, cells = c.sheet_bearings, len(self.warped_m)
        farthest = c.beta_m * math.expm1(float(self.warped_m[-1]) / c.beta_m)
        used = np.flatnonzero(ranges < math.hypot(farthest, _SIDE_M))
        theta = used * (TWO_PI / n)
        reach = int(_MOST_RAD * bins / TWO_PI)
        nearest = np.rint(theta * (bins / TWO_PI)).astype(np.int64)
        k = nearest[:, None] + np.arange(-reach, reach + 1)
        apart = theta[:, None] - k * (TWO_PI / bins)
        distance_m = ranges[used, None] * np.cos(apart)
        side_rad = np.minimum(np.arctan2(_SIDE_M, distance_m), _MOST_RAD)
        at = c.beta_m * np.log1p(distance_m / c.beta_m)
        at = (at - float(self.warped_m[0])) / self.step_m
        low = np.floor(at).astype(np.int64)
        share = at - low
        flat = (k % bins) * cells + low
        sides = np.zeros((2, bins * cells))
        each = (np.abs(apart) <= side_rad) * (TWO_PI / n) / side_rad
        for side, sign in enumerate((1.0, -1.0)):
            weight = each * (0.5 + 0.5 * np.sign(np.where(np.abs(apart) < 1e-9, 0, sign * apart)))
            for cell, part in ((0, 1.0 - share), (1, share)):
                good = low + cell < cells
                sides[side] += np.bincount((flat + cell)[good], (weight * part)[good], bins * cells)
        return sides.reshape(2, bins, cells)

    def read(self, rates: Tensor, clear: float | None = None) -> tuple[Tensor, Tensor, Tensor]:
        r"""Read walls from the responses: each local maximum is one, by its population vector.

        .. math:: m \leftarrow m + 2 \Big(\frac{\sum_i w_i q_i}{\sum_i w_i} - m\Big), \qquad
                  w_i = r_i \, e^{-|q_i - m|^2 / 2 \sigma^2}

        with :math:`q_i` the places of the cells around the maximum, in widths :math:`\sigma` of
        the tuning.

        Args:
            rates: Responses, ``([batch,] n_bearings, n_distances)``.
            clear: Response to one clear wall; of walls if not given.

        Returns:
            Distance in metres (``inf`` for none), bearing in radians in [0, 2 pi), and standard
            deviation of distance in metres, ``([batch,] n)`` each, nearest first.
        """
        lowest = self.config.sheet_share * (self.clear if clear is None else clear)
        if rates.dim() == 2 and runs_compiled(rates) and rates.dtype == torch.float64:
            axes, beta_m = self._numbers()[:2], self.config.beta_m
            found = read_step(
                rates.contiguous().numpy(), lowest, self.sigmas, self.step_m, beta_m, *axes
            )
            distance, bearing, width = torch.from_numpy(found.T.copy())
            return distance, bearing, width
        batch = rates if rates.dim() == 3 else rates[None]
        w = _WINDOW
        padded = F.pad(F.pad(batch, (0, 0, w, w), mode="circular"), (w, w))
        inner = padded[:, w - 1 : 1 - w, w - 1 : 1 - w].unsqueeze(1)
        peaks = (batch >= F.max_pool2d(inner, 3, 1)[:, 0]) & (batch > lowest)
        row, k, d = peaks.nonzero(as_tuple=True)
        count = torch.bincount(row, minlength=len(batch))
        shape = len(batch), int(count.max()) if len(row) else 0
        distance = batch.new_full(shape, math.inf)
        bearing, width = batch.new_zeros(shape), batch.new_zeros(shape)
        if len(row):
            offset = torch.arange(-w, w + 1, device=batch.device)
            patch = padded[
                row[:, None, None], (k[:, None] + w + offset)[:, :, None],
                (d[:, None] + w + offset)[:, None, :],
            ]  # fmt: skip
            off = offset.to(batch)
            by, bd = batch.new_zeros(len(row)), batch.new_zeros(len(row))
            s_a, s_d = self.sigmas
            for _ in range(_ROUNDS):
                wa = ((off - by[:, None]) / s_a).square().mul(-0.5).exp()
                wd = ((off - bd[:, None]) / s_d).square().mul(-0.5).exp()
                weights = patch * wa[:, :, None] * wd[:, None, :]
                total = weights.sum((1, 2))
                ma = (weights.sum(2) @ off) / total
                md = (weights.sum(1) @ off) / total
                spread = (weights.sum(1) * (off - md[:, None]).square()).sum(1) / total
                by = (by + 2.0 * (ma - by)).clamp(-1.0, 1.0)
                bd = (bd + 2.0 * (md - bd)).clamp(-1.0, 1.0)
            xi = self.warped_m[d] + bd * self.step_m
            found = unwarp(xi, self.config.beta_m).clamp_min(0.0)
            angle = (self.bearings_rad[k] + by * (TWO_PI / self.config.sheet_bearings)) % TWO_PI
            narrow = 1.0 / (1.0 / spread.clamp_max(0.99 * s_d**2) - 1.0 / s_d**2)
            sd = narrow.sqrt() * self.step_m * (found / self.config.beta_m + 1.0)
            slot = torch.arange(len(row), device=batch.device) - (count.cumsum(0) - count)[row]
            distance[row, slot], bearing[row, slot], width[row, slot] = found, angle, sd
            distance, order = distance.sort(1)
            bearing, width = bearing.gather(1, order), width.gather(1, order)
        if rates.dim() == 3:
            return distance, bearing, width
        return distance[0], bearing[0], width[0]

    def walls_in_scan(self, ranges: np.ndarray) -> np.ndarray:
        """Read the walls of a scan: distance (m) and bearing relative to the heading, ``(n, 2)``.

        Cells are tuned to straight walls, so a concave one reads too near, the more the farther it
        is, and around the middle of a round room a wall has several maxima. Each is therefore
        refined by its beams (:func:`foot_of_beams`); what is no foot, or a foot twice, is left out.

        Raises:
            BadFrame: If the ranges are invalid.
        """
        with torch.inference_mode():
            distance, bearing, _ = self.read(self.respond_to_scan(ranges), self.clear_scan)
        walls = torch.stack([distance, bearing], dim=1).numpy()
        ranges = checked_ranges(ranges)
        widths_m = self.config.sigma_m * (walls[:, 0] / self.config.beta_m + 1.0)
        found: list[tuple[float, float]] = []
        for wall, width_m in zip(walls, widths_m, strict=True):
            foot = foot_of_beams(ranges, float(wall[0]), float(wall[1]), float(width_m))
            if foot is not None and not any(_same_foot(foot, one, width_m) for one in found):
                found.append(foot)
        return np.array(sorted(found)).reshape(-1, 2)


def _same_foot(one: tuple[float, float], other: tuple[float, float], width_m: float) -> bool:
    turn = (one[1] - other[1] + math.pi) % TWO_PI - math.pi
    return abs(turn) < _APART_RAD and abs(one[0] - other[0]) < width_m


def foot_of_beams(
    ranges: np.ndarray, distance_m: float, bearing_rad: float, width_m: float
) -> tuple[float, float] | None:
    r"""Refine distance and bearing of the foot of a wall by a parabola through its beams.

    .. math:: p_i = r_i \cos \Delta_i, \qquad p \approx a + s t + \tfrac{1}{2} k t^2, \qquad
              t_i = \hat p_i \tan \Delta_i

    with :math:`\Delta` the angle from the bearing that was read. The foot is the nearest point of
    the parabola, :math:`t = -a s / (1 + s^2 + a k)`. Beams weigh by Tukey's biweight, for outliers,
    and by :math:`1 / \cos^2 \Delta`, for the noise of :math:`p`.

    Args:
        ranges: Ranges, ``(n,)``; ``inf`` for none.
        distance_m: Distance that was read.
        bearing_rad: Bearing that was read.
        width_m: Width of the tuning at that distance.

    Returns:
        Distance and bearing; those that were read if too few beams are of that wall; ``None`` if
        the foot lies elsewhere, so that none was read.

    Example:
        A wall at 0.25 m, from within a circle of radius 0.5 m:

        >>> angle = TWO_PI * np.arange(180) / 180
        >>> to_middle = -0.25 * np.cos(angle)
        >>> ranges = to_middle + np.sqrt(to_middle**2 + 0.5**2 - 0.25**2)
        >>> [round(x, 2) for x in foot_of_beams(ranges, 0.24, 0.03, 0.06)]
        [0.25, 0.0]
    """
    angle = (TWO_PI / len(ranges)) * np.arange(len(ranges)) - bearing_rad
    angle = (angle + math.pi) % TWO_PI - math.pi
    side_rad = min(math.atan2(_SIDE_M, distance_m), _MOST_RAD)
    near = (np.abs(angle) <= side_rad) & (ranges < math.inf)
    angle = angle[near]
    cosine, tangent = np.cos(angle), np.tan(angle)
    across = ranges[near] * cosine
    prior = np.diag([0.0, 0.0, (_BEAM_M / _BEND_PER_M) ** 2])
    fit, fitted = np.array([distance_m, 0.0, 0.0]), np.full(len(angle), distance_m)
    for _ in range(_REFINES):
        # The noise of a range is not in t, else noise would bend the parabola.
        along = fitted * tangent
        terms = np.stack([np.ones_like(along), along, 0.5 * along * along])
        off = (across - fitted) / (_WITHIN * width_m)
        weight = np.where(np.abs(off) < 1.0, (1.0 - off * off) ** 2, 0.0) / (cosine * cosine)
        if (weight > 0.0).sum() < _FEWEST:
            return distance_m, bearing_rad
        weighted = terms * weight
        fit = np.linalg.solve(weighted @ terms.T + prior, weighted @ across)
        fitted = fit @ terms
    a, s, k = fit
    if not (a > 0.0 and 1.0 + s * s + a * k > _LEAST_BEND):
        return distance_m, bearing_rad
    t = -a * s / (1.0 + s * s + a * k)
    p = a + s * t + 0.5 * k * t * t
    turn, foot_m = math.atan2(t, p), math.hypot(t, p)
    if abs(turn) > _MOST_TURN_RAD or abs(foot_m - distance_m) > width_m:
        return None
    return foot_m, (bearing_rad + turn) % TWO_PI
