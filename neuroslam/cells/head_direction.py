r"""Head-direction cells: a ring attractor that integrates turns and is held by compass and views.

One population in one file: its section of the config, its pure steps with their equations, the
module, and what becomes of it when two sessions merge. The model is that of Skaggs et al. (1995,
*Advances in Neural Information Processing Systems* 7) and Zhang (1996, *J. Neurosci.* 16: 2112).
"""

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from neuroslam.cells.convolve import ring_convolve
from neuroslam.config import BrainConfig, Section
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.sensors.frames import checked_number
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State, renamed, without_gradients
from neuroslam.state.population import Belief, Correction, Population, StepInput
from neuroslam.state.registry import register
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, Frame, Motion, ViewMatch

_RELAXATIONS = 400
"""Full relaxations from a bump nearly right to one that no longer changes."""


class HeadDirectionConfig(Section):
    """Head-direction cells: a continuous attractor on a ring of directions."""

    n: int = Field(
        default=120,
        ge=24,
        description="number of cells, preferred directions evenly over the full turn; larger: "
        "slower, not more exact",
    )
    excite_deg: float = Field(
        default=30.0,
        ge=10,
        le=60,
        description="standard deviation of the excitation kernel; larger: broader tuning",
    )
    inhibition: float = Field(
        default=0.3,
        ge=0.1,
        le=0.6,
        description="inhibition by all other cells, as a share of the strongest excitation; "
        "larger: narrower tuning",
    )
    gain: float = Field(
        default=10.0, gt=0, description="gain of the response function; larger: a sharper threshold"
    )
    exponent: float = Field(
        default=2.0, ge=1, description="exponent of the response function; larger: narrower tuning"
    )
    settle_s: float = Field(
        default=2.0,
        gt=0,
        description="time constant in which the weaker of two bumps fades; larger: a cue needs "
        "longer to win against the present heading",
    )
    compass_s: float = Field(
        default=2.0,
        gt=0,
        description="time constant in which a compass corrects the heading; larger: slower, "
        "averages more noise",
    )
    view_s: float = Field(
        default=0.5,
        gt=0,
        description="time constant in which a known view corrects the heading; larger: slower",
    )
    fatigue_s: float = Field(
        default=0.5,
        gt=0,
        description="time constant in which a view that stays in sight loses its effect; larger: "
        "it corrects longer",
    )
    inject_after: int = Field(
        default=10,
        ge=0,
        description="number of newest views that never correct; larger: the robot must be away "
        "longer before a view corrects the heading",
    )
    precision: Literal["float32", "float64"] = Field(
        default="float64", description="number type of the activity"
    )


class Ring(NamedTuple):
    r"""What follows from the config: kernels by their Fourier coefficients, and the settled bump.

    Attributes:
        order: :math:`k = 0 \dots n/2`, twice, shape ``(2 K,)``.
        quarter: :math:`\pi/2` for the even parts, 0 for the odd ones, ``(2 K,)``.
        kernels: Even and odd parts of two kernels, ``(2 K, 2 n)``: one that only turns, and
            excitation minus inhibition.
        bump: Even and odd parts of the settled bump, ``(2 K, n)``.
        windows: Cosines and sines within a quarter turn of every cell, ``(n, 2, n)``.
        peak: Activity of the most active cell of a settled bump.
        gain: :math:`b` of :func:`respond`.
        exponent: :math:`\beta` of :func:`respond`.
    """

    order: Tensor
    quarter: Tensor
    kernels: Tensor
    bump: Tensor
    windows: Tensor
    peak: float
    gain: float
    exponent: float


class Heard(NamedTuple):
    """What a frame has for head-direction cells: the heading measured by a compass, in radians."""

    compass_rad: float


# --------------------------------------------------------------------------------- pure steps


def turned_kernels(ring: Ring, turn_rad: float | Tensor) -> Tensor:
    r"""Return the ring's two kernels, shifted by a turn: even and odd parts, exactly.

    .. math:: w(\theta - \Delta) = \sum_k \hat w_k \cos k\Delta \, \cos k\theta
              + \sum_k \hat w_k \sin k\Delta \, \sin k\theta

    The first sum is even in :math:`\theta` and holds the bump, the second is odd and moves it. To
    first order in :math:`\Delta` this is :math:`w - \Delta\, w'`, as in Zhang (1996), where the odd
    part is the derivative of the even one; all orders together have a gain of exactly 1.

    Args:
        ring: Of :func:`make_ring`.
        turn_rad: :math:`\Delta`, a number or ``(...,)``.

    Returns:
        Shape ``(..., 2, n)``: the kernel that only turns, and excitation minus inhibition.
    """
    return (_waves(ring, turn_rad) @ ring.kernels).unflatten(-1, (2, -1))


def bump_at(ring: Ring, heading_rad: float | Tensor) -> Tensor:
    """Return the settled bump at a direction between cells, shape ``(..., n)``, sum 1.

    Example:
        >>> ring = make_ring(HeadDirectionConfig())
        >>> round(float(decode_heading(bump_at(ring, 0.123), ring)), 6)
        0.123
    """
    return _waves(ring, heading_rad) @ ring.bump


def respond(drive: Tensor, gain: float, exponent: float) -> Tensor:
    r"""Turn input into activity of sum 1: a soft threshold, a power, divisive normalisation.

    .. math:: F(u)_i = \frac{\ln^\beta (1 + e^{b u_i})}{\sum_j \ln^\beta (1 + e^{b u_j})}

    (The response function of Zhang 1996.) It is smooth, so that a bump lies between cells as well
    as on them: a threshold with a corner would draw it to the cells.

    Args:
        drive: :math:`u`, excitation minus inhibition, shape ``(..., n)``.
        gain: :math:`b`.
        exponent: :math:`\beta`.

    Example:
        >>> respond(torch.tensor([0.5, -5.0]), gain=10.0, exponent=2.0).tolist()
        [1.0, 0.0]
    """
    rate = F.softplus(drive, beta=gain)
    rate = rate * rate if exponent == 2.0 else rate**exponent
    return rate / rate.sum(-1, keepdim=True)


def ring_step(
    activity: Tensor, turn_rad: float | Tensor, settle_share: float, ring: Ring
) -> Tensor:
    r"""Turn the activity and let it settle: one step of the ring attractor.

    .. math:: \tau \frac{\partial r}{\partial t} + \omega \frac{\partial r}{\partial \theta}
              = -r + F(w * r)

    with :math:`w` local excitation minus global inhibition, :math:`*` the circular convolution, and
    :math:`F` of :func:`respond`. The turn :math:`\Delta = \omega\,dt` is exact, and the rest decays
    exponentially:

    .. math:: r \leftarrow (1 - a)\, \delta_\Delta * r + a\, F(w_\Delta * r),
              \qquad a = 1 - e^{-dt/\tau}

    Both convolutions are one ``conv1d`` with kernels shifted by the turn.

    Args:
        activity: :math:`r`, shape ``(..., n)``.
        turn_rad: :math:`\Delta`, a number or ``(...,)``; counter-clockwise positive.
        settle_share: :math:`a`.
        ring: Of :func:`make_ring`.

    Returns:
        Non-negative activity of the same shape, sum 1.
    """
    moved, drive = ring_convolve(activity, turned_kernels(ring, turn_rad)).unbind(-2)
    settled = respond(drive, ring.gain, ring.exponent)
    mixed = torch.lerp(moved, settled, settle_share).clamp_min(0.0)
    return mixed / mixed.sum(-1, keepdim=True)


def inject(activity: Tensor, heading_rad: float | Tensor, share: float, ring: Ring) -> Tensor:
    r"""Let a cue add a bump of activity at its direction, at the cost of all other activity.

    .. math:: r \leftarrow (1 - g)\, r + g\, B(\theta - \theta_\text{cue}),
              \qquad g = 1 - e^{-dt/\tau_\text{cue}}

    Near the bump, it moves by the share :math:`g` of the difference. Far from it a second bump
    grows, which :func:`ring_step` weakens until it is the stronger one: then the heading jumps.

    Args:
        activity: :math:`r`, shape ``(..., n)``, sum 1.
        heading_rad: :math:`\theta_\text{cue}`, a number or ``(...,)``.
        share: :math:`g`, in [0, 1].
        ring: Of :func:`make_ring`.
    """
    return torch.lerp(activity, bump_at(ring, heading_rad), share)


def turned(activity: Tensor, turn_rad: float | Tensor) -> Tensor:
    r"""Turn activity by any angle, exactly: :math:`\hat r_k \leftarrow \hat r_k e^{-ik\Delta}`.

    Args:
        activity: Shape ``(..., n)``.
        turn_rad: :math:`\Delta`, a number or ``(...,)``.

    Example:
        >>> turned(torch.tensor([1.0, 0.0, 0.0, 0.0]), math.pi / 2).round(decimals=5).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    n = activity.shape[-1]
    k = torch.arange(n // 2 + 1, dtype=activity.dtype, device=activity.device)
    phase = -k * torch.as_tensor(turn_rad, dtype=k.dtype, device=k.device)[..., None]
    wave = torch.polar(torch.ones_like(phase), phase)
    return torch.fft.irfft(torch.fft.rfft(activity) * wave, n=n).clamp_min(0.0)


def decode_heading(activity: Tensor, ring: Ring) -> Tensor:
    r"""Find the direction of the dominant bump: the population vector around the peak.

    .. math:: \hat\theta = \operatorname{atan2}\Big(\sum_i r_i^2 \sin\theta_i,
              \sum_i r_i^2 \cos\theta_i\Big), \quad |\theta_i - \theta_\text{peak}| \le \pi/2

    A second bump on the other side of the ring has no part in it. Squares, so that where the sum
    ends does not matter: with :math:`r_i` the heading is off by some 0.0005 degrees.

    Args:
        activity: Shape ``(..., n)``.
        ring: Of :func:`make_ring`.

    Returns:
        Radians in [-pi, pi], shape ``(...,)``.
    """
    weights = (activity * activity)[..., None]
    x, y = (ring.windows[activity.argmax(-1)] @ weights).squeeze(-1).unbind(-1)
    return torch.atan2(y, x)


def tuning_width(curve: np.ndarray, level: float = 0.5) -> float:
    """Measure how wide a tuning curve is, in degrees, between where it crosses a level.

    Args:
        curve: Rates at directions evenly over the full turn, one peak, ``(n,)``.
        level: Share of the peak, above the smallest rate; between 0 and 1.

    Example:
        >>> angle = np.arange(360) * np.pi / 180.0
        >>> round(tuning_width(1.0 + np.cos(angle)), 6)
        180.0
    """
    curve = np.asarray(curve, dtype=np.float64)
    n = len(curve)
    fine = np.fft.irfft(np.fft.rfft(curve), n=n * 64) * 64.0
    middle = len(fine) // 2
    fine = np.roll(fine, middle - int(fine.argmax()))
    height = fine.min() + level * (fine.max() - fine.min())
    below = np.flatnonzero(fine < height)  # the nearest to either side of the peak
    left_of, right_of = below[below < middle], below[below > middle]
    i = int(left_of[-1]) if len(left_of) else -1
    j = int(right_of[0]) if len(right_of) else len(fine)
    left, right = (
        k
        + step
        * (height - fine[k % len(fine)])
        / (fine[(k + step) % len(fine)] - fine[k % len(fine)])
        for k, step in ((i, 1), (j, -1))
    )
    return float((right - left) * 360.0 / len(fine))


def _waves(ring: Ring, angle_rad: float | Tensor) -> Tensor:
    """Cosines, then sines, of the multiples of an angle, shape ``(..., 2 K)``."""
    if isinstance(angle_rad, Tensor):
        angle = angle_rad.to(ring.order)[..., None]
        return torch.sin(ring.quarter + ring.order * angle)
    return torch.sin(torch.add(ring.quarter, ring.order, alpha=angle_rad))


@lru_cache(maxsize=16)
@torch.inference_mode(mode=False)
@torch.no_grad()
def make_ring(config: HeadDirectionConfig) -> Ring:
    r"""Make the kernels of a config and find the bump that they settle to.

    Excitation is a wrapped Gaussian, :math:`\hat w_k = e^{-k^2\sigma^2/2}`, scaled to a peak of 1;
    inhibition is the same for all cells, so that the kernel is :math:`w - \varphi`.
    """
    n, like = config.n, {"dtype": torch.float64}
    k = torch.arange(n // 2 + 1, **like)
    angles = torch.arange(n, **like) * TWO_PI / n
    excite = torch.exp(-0.5 * (k * math.radians(config.excite_deg)) ** 2)
    excite = excite / torch.fft.irfft(excite.to(torch.complex128), n=n)[0]
    excite[0] -= n * config.inhibition
    both = torch.stack([torch.ones_like(excite), excite])
    order = torch.cat([k, k])
    quarter = torch.cat([torch.full_like(k, math.pi / 2), torch.zeros_like(k)])
    kernels = torch.cat([_parts(both, angles, np.cos), _parts(both, angles, np.sin)])
    kernels = kernels.flatten(1)
    away = (torch.arange(n)[:, None] - torch.arange(n)).remainder(n)
    near = torch.minimum(away, n - away) <= n // 4
    windows = torch.stack([angles.cos(), angles.sin()]) * near[:, None]
    ring = Ring(order, quarter, kernels, kernels, windows, 0.0, config.gain, config.exponent)
    bump = torch.softmax(8.0 * angles.cos(), 0)
    for _ in range(_RELAXATIONS):
        bump = ring_step(bump, 0.0, 1.0, ring)
    spectrum = torch.fft.rfft(bump).real  # even, as it was begun
    parts = [_parts(spectrum[None], angles, wave)[:, 0] for wave in (np.cos, np.sin)]
    dtype = getattr(torch, config.precision)
    tensors = (order, quarter, kernels, torch.cat(parts), windows)
    return Ring(
        *(t.to(dtype).contiguous() for t in tensors),
        float(bump.max()),
        config.gain,
        config.exponent,
    )


def _parts(coefficients: Tensor, angles: Tensor, wave: np.ufunc) -> Tensor:
    """Even (cosine) or odd (sine) waves of each order, by coefficients: ``(K, kernels, n)``."""
    n = len(angles)
    k = torch.arange(n // 2 + 1, dtype=angles.dtype)
    twice = torch.full_like(k, 2.0)
    twice[0] = 1.0
    if n % 2 == 0:
        twice[-1] = 1.0
    waves = torch.from_numpy(wave((k[:, None] * angles).numpy()))
    return (coefficients * twice / n).T[:, :, None] * waves[:, None, :]


# ------------------------------------------------------------------------------------- module


@register("head_direction")
class HeadDirectionCells(Population):
    """A bump of activity on a ring of cells is the heading; :func:`ring_step` has the equation.

    Turns move it, by exactly their angle. A compass and known views inject activity where they
    say the heading is, and landmarks or other populations turn it (:meth:`follow`). The first
    compass reading says how the ring lies in the world: before it, heading 0 is where the session
    began. State: the activity, the heading at which every view was learnt (``views``), and the
    last view and for how long it was seen (``last``).

    Args:
        config: Size, dynamics, and how strong the cues are.
        batch: Number of animals side by side; ``None`` for one. A batch integrates turns and
            hears a compass; it learns no views.

    Example:
        >>> cells = HeadDirectionCells()
        >>> for _ in range(20):
        ...     _ = cells.advance(Motion(0.0, math.pi / 2, 0.05))
        >>> round(cells.heading_rad, 6) == round(math.pi / 2, 6)
        True
    """

    config_section = HeadDirectionConfig
    compass = "corrects"

    activity: Tensor

    def __init__(self, config: HeadDirectionConfig | None = None, batch: int | None = None) -> None:
        super().__init__()
        self.config = config or HeadDirectionConfig()
        self.batch = batch
        self.ring = make_ring(self.config)
        start = 0.0 if batch is None else torch.zeros(batch, dtype=torch.float64)
        self.register_buffer("activity", bump_at(self.ring, start))
        self.views = GrowingTable({"heading_rad": ((), torch.float64)})
        self.last = Scalars(view=NO_TEMPLATE, seen_s=0.0, anchored=0)
        self._decoded: tuple[Tensor | None, float | Tensor] = (None, 0.0)
        self.register_load_state_dict_post_hook(_forget_decoded)

    @property
    def heading_rad(self) -> float | Tensor:
        """Heading in radians, in [-pi, pi); in a batch ``(batch,)``."""
        activity, heading = self._decoded
        if activity is not self.activity:
            heading = decode_heading(self.activity, self.ring)
            heading = wrap_angle(heading.item()) if self.batch is None else heading
            self._decoded = self.activity, heading
        return heading

    @property
    def preferred_rad(self) -> np.ndarray:
        """Direction at which each cell fires most, ``(n,)``."""
        return np.arange(self.config.n) * TWO_PI / self.config.n

    @without_gradients
    def place(self, heading_rad: float | Tensor) -> None:
        """Put a settled bump at a heading, and forget all other activity."""
        self.activity = bump_at(self.ring, heading_rad).expand_as(self.activity).contiguous()

    @without_gradients
    def take(self, activity: Tensor) -> None:
        """Take over activity of any shape, normalised to sum 1.

        Raises:
            MapError: If it has another size, is negative anywhere, or nothing is active.
        """
        if activity.shape != self.activity.shape:
            raise MapError(
                f"HeadDirectionCells: activity has shape {tuple(activity.shape)}, expected "
                f"{tuple(self.activity.shape)}"
            )
        activity = activity.to(self.activity)
        total = activity.sum(-1, keepdim=True)
        if not bool((activity >= 0).all() and (total > 0).all() and total.isfinite().all()):
            raise MapError(
                "HeadDirectionCells: activity must be finite and non-negative, with some above 0"
            )
        self.activity = activity / total

    @without_gradients
    def advance(self, motion: Motion, heard: Heard | None = None) -> float:
        """Turn by self-motion, settle, and let the compass correct.

        Args:
            motion: Turn rate in rad/s (in a batch ``(batch,)``) for how many seconds.
            heard: What :meth:`observe` found.

        Returns:
            By how much the compass turned the heading, in radians; 0 in a batch.
        """
        dt = motion.dt_s
        turn = motion.w_rad_s * dt
        share = -math.expm1(-dt / self.config.settle_s)
        self.activity = ring_step(self.activity, turn, share, self.ring)
        if heard is None:
            return 0.0
        if not self.last.anchored:
            self._anchor(heard.compass_rad)
            return 0.0
        return self.correct(heard.compass_rad, self.config.compass_s, dt)

    @without_gradients
    def correct(self, heading_rad: float | Tensor, time_s: float, dt_s: float) -> float:
        """Inject activity at a heading, as strong as a cue that corrects within ``time_s``.

        Returns:
            By how much the heading turned, in radians; 0 in a batch.
        """
        share = -math.expm1(-dt_s / time_s)
        before = self.heading_rad if self.batch is None else 0.0
        self.activity = inject(self.activity, heading_rad, share, self.ring)
        return wrap_angle(self.heading_rad - before) if self.batch is None else 0.0

    def see(self, view: ViewMatch, dt_s: float) -> float:
        """Bind a new view to the heading; let a known one correct it.

        Returns:
            By how much the view turned the heading, in radians.

        Raises:
            MapError: If the view is new, but not the next, or known, but was never learnt.
        """
        if view.is_new:
            self.bind(view)
        return self.correct_by_view(view, dt_s)

    @without_gradients
    def correct_by_view(self, view: ViewMatch, dt_s: float) -> float:
        r"""Let a known view correct the heading; returns by how much it turned, in radians.

        A view corrects within :math:`\tau_v e^{t/\tau_f}` after it has been seen for :math:`t`, so
        that one that is still recognised while the animal turns does not hold it back.
        """
        now = self.last
        if view.template == NO_TEMPLATE:
            now.view, now.seen_s = NO_TEMPLATE, 0.0
            return 0.0
        now.seen_s = now.seen_s + dt_s if view.template == now.view else 0.0
        now.view = view.template
        away = self.turn_of(view)
        if away is None:
            return 0.0
        c = self.config
        fresh = math.exp(-now.seen_s / c.fatigue_s)
        return self.correct(self.heading_rad + away, c.view_s, dt_s * fresh)

    def forward(
        self, motion: Motion, view: ViewMatch | None = None, compass_rad: float | None = None
    ) -> float | Tensor:
        """Advance one frame: turn, settle, hear the compass, see the view; returns the heading."""
        self.advance(motion, None if compass_rad is None else Heard(compass_rad))
        if view is not None:
            self.see(view, motion.dt_s)
        return self.heading_rad

    def _anchor(self, compass_rad: float | Tensor) -> None:
        """Turn the whole frame, learnt headings too, so that it is that of the compass."""
        if self.batch is not None:
            self.activity = turned(self.activity, compass_rad - self.heading_rad)
        else:
            turn = wrap_angle(compass_rad - self.heading_rad)
            self.activity = turned(self.activity, turn)
            old = self.views["heading_rad"]
            self.views.replace(heading_rad=(old + turn + math.pi) % TWO_PI - math.pi)
        self.last.anchored = 1

    def _apply(self, fn: object, recurse: bool = True) -> "HeadDirectionCells":
        super()._apply(fn, recurse)
        like, self._decoded = self.activity, (None, 0.0)
        self.ring = Ring(*(v.to(like) if isinstance(v, Tensor) else v for v in self.ring))
        return self

    @without_gradients
    def turn_by(self, turn_rad: float) -> None:
        """Turn the activity by an angle, exactly."""
        self.activity = turned(self.activity, turn_rad)

    def bind(self, view: ViewMatch) -> None:
        """Bind a new view to the present heading.

        Raises:
            MapError: If it is not the next view.
        """
        if view.template != self.views.n:
            raise MapError(
                f"HeadDirectionCells: new view {view.template}, expected {self.views.n}; "
                "views and headings must come from the same session"
            )
        self.views.append(heading_rad=self.heading_rad)

    def turn_of(self, view: ViewMatch) -> float | None:
        """Return by how much a view would have the heading turn; changes nothing.

        Returns:
            Radians in [-pi, pi); ``None`` for no view, or one of the newest.

        Raises:
            MapError: If the view was never learnt.
        """
        if view.template == NO_TEMPLATE:
            return None
        if not 0 <= view.template < self.views.n:
            raise MapError(
                f"HeadDirectionCells: view {view.template} was never learnt, "
                f"there are {self.views.n}"
            )
        if view.is_new or view.template >= self.views.n - self.config.inject_after:
            return None
        learnt = self.views["heading_rad"][view.template].item()
        return wrap_angle(learnt + view.relative_heading_rad - self.heading_rad)

    # ------------------------------------------------------- its part in a brain of populations

    def observe(self, frame: Frame) -> Heard | None:
        """Take the heading of the compass from a frame, if it has one.

        Raises:
            BadFrame: If it is not a finite number.
        """
        if frame.heading_rad is None:
            return None
        return Heard(checked_number(frame.heading_rad, "heading", "rad"))

    def step(self, now: StepInput, observation: Heard | None) -> Correction:
        """Advance by a frame of the brain; all others turn as the compass has turned the ring."""
        return Correction(turn_rad=self.advance(now.motion, observation))

    def follow(self, correction: Correction) -> None:
        """Turn as a landmark or another population has corrected the heading."""
        if correction.turn_rad:
            self.turn_by(correction.turn_rad)

    def learn(self, now: StepInput, observation: Heard | None) -> None:
        """Bind a new view to the present heading; a known one stays as it is."""
        if now.view.is_new:
            self.bind(now.view)

    def recall(self, now: StepInput, observation: Heard | None, belief: Belief | None) -> None:
        """Let a known view correct the ring; the map corrects its own heading by it already."""
        self.correct_by_view(now.view, now.motion.dt_s)

    @property
    def rates(self) -> np.ndarray:
        """Activity of every cell, 1 at the peak of a settled bump, ``([batch,] n)``."""
        return (self.activity / self.ring.peak).numpy(force=True)

    def counts(self) -> dict[str, float]:
        """Return how many cells there are, and views that they know."""
        return {"head_direction_cells": self.config.n, "head_direction_views": self.views.n}

    def scalars(self) -> dict[str, float]:
        """Return the heading, and how much of the activity is in its bump."""
        if self.batch is not None:
            return {}
        bump = self.ring.windows[int(self.activity.argmax())] @ self.activity
        settled = self.ring.windows[0] @ bump_at(self.ring, 0.0)
        return {
            "head_direction/heading_rad": decode_heading(self.activity, self.ring).item(),
            "head_direction/bump_share": (bump.norm() / settled.norm()).item(),
        }

    def images(self) -> dict[str, np.ndarray]:
        """Draw the activity as a ring, ``(65, 65)``, in [0, 1]; heading 0 points to the right."""
        at = np.arange(65) - 32.0
        radius = np.hypot(at[:, None], at)
        cell = np.round(np.arctan2(at[:, None], at) * self.config.n / TWO_PI).astype(int)
        rates = self.rates if self.batch is None else self.rates[0]
        picture = rates[cell % self.config.n].clip(0.0, 1.0)
        return {"cells/head_direction": np.where((radius > 18) & (radius <= 32), picture, 0.0)}

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Say where activity is no bump, or views are not those of the brain."""
        activity, views = state["activity"], state["views.heading_rad"]
        if (activity < 0).any():
            yield "head_direction.activity: negative"
        elif abs(float(activity.sum()) - 1.0) > 1e-4:
            yield f"head_direction.activity: adds up to {activity.sum():.6g}, expected 1"
        if len(views) != n_views:
            yield f"{n_views} views, {len(views)} of them with a heading"
        if not -1 <= state["last.view"] < n_views:
            yield f"head_direction.last.view: is {state['last.view']}, expected -1 to {n_views - 1}"

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Turn the partial session's bump and headings into the loaded frame; join the views.

        The frame is that of the compass, if either session heard one; :func:`frame_turn` says how
        the frames lie. A view that both know keeps the heading of the loaded one.
        """
        turn = frame_turn(loaded, partial, join)
        onto_partial = bool(partial["last.anchored"]) and not bool(loaded["last.anchored"])
        old, new = (-turn, 0.0) if onto_partial else (0.0, turn)
        kept = torch.from_numpy(join.kept_views)
        columns = [
            _turned_headings(loaded["views.heading_rad"], old),
            _turned_headings(partial["views.heading_rad"][kept], new),
        ]
        return {
            "activity": turned(partial["activity"], new) if new else partial["activity"],
            "views.heading_rad": torch.cat(columns),
            "last.view": renamed(partial["last.view"], join.views),
            "last.seen_s": partial["last.seen_s"],
            "last.anchored": torch.maximum(loaded["last.anchored"], partial["last.anchored"]),
        }


def _forget_decoded(cells: HeadDirectionCells, _keys: object) -> None:
    cells._decoded = (None, 0.0)  # a state is copied into the very tensor that was decoded


def frame_turn(loaded: State, partial: State, join: Join) -> float:
    r"""Say by how much headings of the partial session turn to be those of the loaded one.

    Not at all, where both heard the compass. Else by the mean difference of the views both know,

    .. math:: \Delta = \arg \sum_v e^{i(\theta_v - \theta'_v + \rho_v)}

    with :math:`\rho_v` the heading with which the partial view was learnt minus that of the merged
    one; and where there is none such, as the cells turn.
    """
    if int(loaded["last.anchored"]) and int(partial["last.anchored"]):
        return 0.0
    same = np.flatnonzero(join.views < join.n_views)
    if not len(same):
        return join.cells_turn_rad
    apart = (
        loaded["views.heading_rad"].numpy()[join.views[same]]
        - partial["views.heading_rad"].numpy()[same]
        + join.view_turns_rad[same]
    )
    return math.atan2(np.sin(apart).sum(), np.cos(apart).sum())


def _turned_headings(headings: Tensor, turn: float) -> Tensor:
    if not turn:
        return headings
    return torch.from_numpy(wrap_angles(headings.numpy() + turn))
