"""Boundary cells: a population whose rates encode distance and bearing of walls."""

import math
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.compiled import compiled
from neuroslam.config import BoundaryCellConfig
from neuroslam.errors import BadFrame
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.frames import checked_array
from neuroslam.state.mergeable import Arrays, BufferModule

INHIBITION, ATTENUATION, GROWTH = 0, 1, 2
"""Zones of the activity of boundary cells, from far to near."""

_FAR_M = 1e3  # where no cell responds; infinity would give NaN gradients


def boundary_zone(distance_m: Tensor, reach_m: float) -> Tensor:
    r"""Return the zone of an animal by its distance :math:`R` to the nearest wall.

    .. math:: S = \text{inhibition } (R > b), \quad
              \text{attenuation } (b/2 < R \le b), \quad \text{growth } (R \le b/2)

    (SLRB, Eq. 1).

    Example:
        >>> boundary_zone(torch.tensor([0.5, 0.2, 0.1]), 0.3).tolist()
        [0, 1, 2]
    """
    return (distance_m <= reach_m).long() + (distance_m <= reach_m / 2).long()


def boundary_activity(
    activity: Tensor, distance_m: Tensor, reach_m: float, rate_per_s: float, dt_s: float
) -> Tensor:
    r"""Return the activity after a step: it grows near a wall, decays farther off, 0 beyond reach.

    .. math:: \dot h = \pm\tau\,\frac{b - R}{b}, \qquad 0 \le h \le 1

    plus in the growth zone, minus in the attenuation zone; 0 in the inhibition zone (SLRB, Eq. 5,
    as a rate and bounded: the printed recursion is unbounded, and takes the distance straight ahead
    for that to the wall).

    Args:
        activity: :math:`h`, any shape.
        distance_m: :math:`R` to the nearest wall, the same shape.
        reach_m: :math:`b`.
        rate_per_s: :math:`\tau`.
        dt_s: Time since the last step.

    Example:
        >>> round(boundary_activity(torch.tensor(0.2), torch.tensor(0.1), 0.3, 0.8, 0.5).item(), 3)
        0.467
    """
    near = (reach_m - distance_m).clamp_min(0.0) * (rate_per_s * dt_s / reach_m)
    grown = activity + torch.where(distance_m <= reach_m / 2, near, -near)
    return grown.clamp(0.0, 1.0).where(distance_m <= reach_m, 0.0)


def boundary_tuning(
    distance_m: Tensor,
    bearing_rad: Tensor,
    preferred_m: Tensor,
    preferred_rad: Tensor,
    sigma_m: Tensor,
    beta_m: Tensor,
    sigma_rad: Tensor,
) -> Tensor:
    r"""Return the rates of boundary cells for the walls around.

    .. math:: f_{kl} = \sum_\text{walls} \exp\!\Big(-\frac{(R - d_l)^2}{2\sigma_r^2(d_l)}\Big)
              \exp\!\Big(-\frac{(\alpha - \varphi_k)^2}{2\sigma_a^2}\Big), \qquad
              \sigma_r(d) = \sigma_0 (d/\beta + 1)

    (SLRB, Eqs. 6 to 9, in the form of Hartley et al. 2000; the printed Eq. 6 has the activity in
    the exponent, where an inactive cell would respond most.) Each factor peaks at 1.

    Args:
        distance_m: :math:`R`, ``(..., n_walls)``; ``inf`` for none.
        bearing_rad: :math:`\alpha` in the world, ``(..., n_walls)``.
        preferred_m: :math:`d_l`, ``(n_distances,)``.
        preferred_rad: :math:`\varphi_k`, ``(n_bearings,)``.
        sigma_m: :math:`\sigma_0`.
        beta_m: :math:`\beta`.
        sigma_rad: :math:`\sigma_a`.

    Returns:
        ``(..., n_bearings, n_distances)``, non-negative.
    """
    half = math.sqrt(0.5)
    far = distance_m.clamp_max(_FAR_M).unsqueeze(-1) - preferred_m
    apart = (bearing_rad.unsqueeze(-1) - preferred_rad + math.pi).remainder(TWO_PI) - math.pi
    by_distance = (far * (half / (sigma_m * (preferred_m / beta_m + 1.0)))).square().neg().exp()
    by_bearing = (apart * (half / sigma_rad)).square().neg().exp()
    return by_bearing.mT @ by_distance


@compiled
def respond_step(
    speed_m_s: float, heading_rad: float, distance_m: np.ndarray, relative_rad: np.ndarray,
    bearing_rad: np.ndarray, reach_m: float, rate_per_s: float, dt_s: float, sigma_m: np.ndarray,
    beta_m: np.ndarray, sigma_rad: np.ndarray, preferred_m: np.ndarray, preferred_rad: np.ndarray,
    activity: np.ndarray, rates: np.ndarray,
) -> float:  # fmt: skip
    """Do as :func:`boundary_activity` and :func:`boundary_tuning` for one animal, in place.

    Returns:
        Distance to the nearest wall; NaN if a number is not one that senses can measure: then
        nothing but ``bearing_rad`` has changed.
    """
    nearest, total = np.inf, speed_m_s + heading_rad
    for w in range(distance_m.shape[0]):
        bearing_rad[w] = relative_rad[w] + heading_rad
        total += bearing_rad[w]
        if not distance_m[w] >= 0.0:
            return np.nan
        nearest = min(nearest, distance_m[w])
    if not np.isfinite(total):
        return np.nan
    grown = 0.0
    if nearest <= reach_m:
        near = (reach_m - nearest) * (rate_per_s * dt_s / reach_m)
        grown = activity[()] + (near if nearest <= reach_m / 2 else -near)
        grown = min(max(grown, 0.0), 1.0)
    activity[()] = grown
    gate = activity[()]
    half, turn, two_pi = np.float32(math.sqrt(0.5)), np.float32(math.pi), np.float32(TWO_PI)
    for k in range(preferred_rad.shape[0]):
        for d in range(preferred_m.shape[0]):
            rates[k, d] = 0.0
    if gate == 0.0:
        return nearest
    by_distance = np.empty(preferred_m.shape[0], np.float32)
    for w in range(distance_m.shape[0]):
        away = np.float32(min(distance_m[w], _FAR_M))
        for d in range(preferred_m.shape[0]):
            width = sigma_m[()] * (preferred_m[d] / beta_m[()] + np.float32(1.0))
            far = (away - preferred_m[d]) * (half / width)
            by_distance[d] = math.exp(-far * far)
        for k in range(preferred_rad.shape[0]):
            apart = (np.float32(bearing_rad[w]) - preferred_rad[k] + turn) % two_pi - turn
            apart *= half / sigma_rad[()]
            by_bearing = math.exp(-apart * apart)
            for d in range(preferred_m.shape[0]):
                rates[k, d] += by_bearing * by_distance[d]
    for k in range(preferred_rad.shape[0]):
        for d in range(preferred_m.shape[0]):
            rates[k, d] *= gate
    return nearest


class BoundaryCells(BufferModule):
    """Population of ``n_bearings`` by ``n_distances`` boundary cells.

    :func:`boundary_tuning` has the mathematics; :func:`boundary_activity` gates all cells. The
    state is that ``activity`` and the last ``rates``; the widths are parameters.

    Args:
        config: Sizes and widths.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> cells = BoundaryCells(BoundaryCellConfig())
        >>> rates = cells(torch.tensor([0.1]), torch.tensor([0.0]), dt_s=1.0)
        >>> divmod(rates.argmax().item(), cells.config.n_distances)  # bearing 0, nearest distance
        (0, 2)
    """

    activity: Tensor
    rates: Tensor
    preferred_m: Tensor
    preferred_rad: Tensor

    def __init__(self, config: BoundaryCellConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        lead = () if batch is None else (batch,)
        n, m = config.n_bearings, config.n_distances
        spacing = config.reach_m / (m + 1)
        self.register_buffer("preferred_m", spacing * torch.arange(1, m + 1), persistent=False)
        self.register_buffer("preferred_rad", torch.arange(n) * (TWO_PI / n), persistent=False)
        self.register_buffer("activity", torch.zeros(lead))
        self.register_buffer("rates", torch.zeros((*lead, n, m)))
        self.sigma_m = nn.Parameter(torch.tensor(config.sigma_m))
        self.beta_m = nn.Parameter(torch.tensor(config.beta_m))
        self.sigma_rad = nn.Parameter(torch.tensor(config.sigma_bearing_rad))

    def forward(self, distance_m: Tensor, bearing_rad: Tensor, dt_s: float) -> Tensor:
        """Return the rates for the walls in sight.

        Args:
            distance_m: Distance to the foot of the perpendicular on each wall,
                ``([batch,] n_walls)``; ``inf`` where there is none.
            bearing_rad: Its bearing in the world, the same shape.
            dt_s: Time since the last step.

        Returns:
            ``([batch,] n_bearings, n_distances)``, non-negative.

        Raises:
            BadFrame: If a distance is negative or NaN, or a bearing of a wall not finite.
        """
        check_walls(distance_m, bearing_rad)
        return self.respond(distance_m, bearing_rad, dt_s)

    def respond(self, distance_m: Tensor, bearing_rad: Tensor, dt_s: float) -> Tensor:
        """Do as :meth:`forward`, without checking the walls."""
        c = self.config
        distance_m, bearing_rad = distance_m.to(self.activity), bearing_rad.to(self.activity)
        self.activity = boundary_activity(
            self.activity, _nearest(distance_m), c.reach_m, c.rate_per_s, dt_s
        ).detach()
        tuned = boundary_tuning(
            distance_m,
            bearing_rad,
            self.preferred_m,
            self.preferred_rad,
            self.sigma_m,
            self.beta_m,
            self.sigma_rad,
        )
        rates = self.activity[..., None, None] * tuned
        self.rates = rates.detach()
        return rates

    def tuned_to(self, distance_m: Tensor, bearing_rad: Tensor) -> Tensor:
        """Return the rates for walls with an open gate; the state does not change.

        Args:
            distance_m: Distances of walls, ``(..., n_walls)``; ``inf`` for none.
            bearing_rad: Bearings in the world, the same shape.

        Returns:
            ``(..., n_bearings, n_distances)``.
        """
        return boundary_tuning(
            distance_m.to(self.rates), bearing_rad.to(self.rates), self.preferred_m,
            self.preferred_rad, self.sigma_m, self.beta_m, self.sigma_rad,
        )  # fmt: skip

    def respond_compiled(
        self, speed_m_s: float, heading_rad: float, distance_m: np.ndarray,
        relative_rad: np.ndarray, dt_s: float,
    ) -> tuple[float, np.ndarray]:  # fmt: skip
        """Do as :meth:`forward` for one animal, in place, by bearings relative to the heading.

        Returns:
            Distance to the nearest wall, and bearings of the walls in the world.

        Raises:
            BadFrame: If motion or walls cannot be measured; nothing has changed then.
        """
        sigma_m, beta_m, sigma_rad, preferred_m, preferred_rad, activity, rates = cast(
            Arrays, self.arrays()
        )
        c, bearing = self.config, np.empty(len(relative_rad))
        nearest = respond_step(
            speed_m_s, heading_rad, distance_m, relative_rad, bearing, c.reach_m, c.rate_per_s,
            dt_s, sigma_m, beta_m, sigma_rad, preferred_m, preferred_rad, activity, rates,
        )  # fmt: skip
        if nearest != nearest:  # NaN
            check_motion(*torch.tensor([speed_m_s, heading_rad], dtype=torch.float64))
            check_walls(torch.from_numpy(distance_m), torch.from_numpy(relative_rad))
        return nearest, bearing

    def rest(self) -> None:
        """Set all activity to 0, as without a wall in reach."""
        self.activity = torch.zeros_like(self.activity)
        self.rates = torch.zeros_like(self.rates)


def _nearest(distance_m: Tensor) -> Tensor:
    if distance_m.shape[-1] == 0:
        return distance_m.new_full(distance_m.shape[:-1], math.inf)
    return distance_m.amin(-1)


def checked_walls(walls: object) -> np.ndarray:
    """Return the walls of a frame as ``float64``, after checking them.

    Args:
        walls: Distance (m) and bearing (rad) of each, ``(n, 2)``.

    Returns:
        Array of shape ``(n, 2)``.

    Raises:
        BadFrame: If they have another shape or type, or :func:`check_walls` refuses them.

    Example:
        >>> checked_walls(["left"])  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: walls are an array of text of shape (1,); expected ...
    """
    array = checked_array(walls, "walls", (None, 2), "distance in m and bearing in rad of each")
    if not ((array[:, 0] >= 0.0).all() and np.isfinite(array[:, 1]).all()):  # NaN too
        check_walls(*torch.from_numpy(np.ascontiguousarray(array)).unbind(-1))
    return array


def check_walls(distance_m: Tensor, bearing_rad: Tensor) -> None:
    """Raise on distances and bearings that no sensor can measure.

    Raises:
        BadFrame: If shapes differ, a distance is negative or NaN, or a bearing not finite.

    Example:
        >>> check_walls(torch.tensor([-0.1]), torch.tensor([0.0]))
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: walls: distance -0.1 m; expected 0 or more, inf for none
    """
    if distance_m.shape != bearing_rad.shape:
        raise BadFrame(
            f"walls: distances have shape {tuple(distance_m.shape)}, bearings "
            f"{tuple(bearing_rad.shape)}; expected the same"
        )
    right = (distance_m >= 0) & bearing_rad.isfinite()
    if bool(right.all()):
        return
    negative = distance_m[~(distance_m >= 0)]
    if len(negative):
        raise BadFrame(
            f"walls: distance {negative[0].item():.6} m; expected 0 or more, inf for none"
        )
    wrong = bearing_rad[~bearing_rad.isfinite()][0].item()
    raise BadFrame(f"walls: bearing {wrong:.6} rad; expected a finite number")


def check_motion(speed_m_s: Tensor, heading_rad: Tensor) -> None:
    """Raise on speeds and headings that are not finite.

    Raises:
        BadFrame: If one is not.

    Example:
        >>> check_motion(torch.tensor(0.1), torch.tensor(float("nan")))
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: motion: speed 0.1 m/s, heading nan rad; expected finite numbers
    """
    finite = speed_m_s.isfinite() & heading_rad.isfinite()
    if not bool(finite.all()):
        speeds, headings = torch.broadcast_tensors(speed_m_s, heading_rad)
        raise BadFrame(
            f"motion: speed {speeds[~finite][0].item():.6} m/s, heading "
            f"{headings[~finite][0].item():.6} rad; expected finite numbers"
        )
