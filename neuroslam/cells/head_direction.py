r"""Head-direction cells: a ring attractor that integrates turns, corrected by compass and views.

One population in one file: its config section, its pure steps with their equations, the module,
and the merge of two sessions. The model is that of Skaggs et al. (1995,
*Advances in Neural Information Processing Systems* 7) and Zhang (1996, *J. Neurosci.* 16: 2112).
"""

import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from functools import lru_cache
from typing import Literal, NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from neuroslam.cells.convolve import ring_convolve
from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import BrainConfig, Section
from neuroslam.config.bounds import MOST_CELLS, MOST_COUNT
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.sensors.frames import checked_number
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State, renamed, without_gradients
from neuroslam.state.population import Belief, Correction, Population, StepInput
from neuroslam.state.registry import register
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, Frame, Motion, ViewMatch

_RELAXATIONS = 400
"""Relaxations after which the initial bump no longer changes."""


class HeadDirectionConfig(Section):
    """Head-direction cells: a continuous attractor on a ring of directions."""

    n: int = Field(
        default=120,
        ge=24,
        le=MOST_CELLS,
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
        le=MOST_COUNT,
        description="number of newest views that never correct; larger: the robot must be away "
        "longer before a view corrects the heading",
    )
    precision: Literal["float32", "float64"] = Field(
        default="float64", description="number type of the activity"
    )


class Ring(NamedTuple):
    r"""Constants of a config: kernels by their Fourier coefficients, and the settled bump.

    Attributes:
        order: :math:`k = 0 \dots n/2`, twice, shape ``(2 K,)``.
        quarter: :math:`\pi/2` for the even parts, 0 for the odd ones, ``(2 K,)``.
        kernels: Even and odd parts of two kernels, ``(2 K, 2 n)``: one that only rotates,
            and excitation minus inhibition.
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


class CompassReading(NamedTuple):
    """Heading measured by a compass, in radians."""

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
        Shape ``(..., 2, n)``: the kernel that only rotates, and excitation minus inhibition.
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
    r"""Return activity of sum 1 for an input: soft threshold, power, divisive normalisation.

    .. math:: F(u)_i = \frac{\ln^\beta (1 + e^{b u_i})}{\sum_j \ln^\beta (1 + e^{b u_j})}

    (The response function of Zhang 1996.) It is smooth, so that bumps between cells are as
    stable as bumps on cells; a threshold with a corner would attract them to cells.

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
    r"""Rotate the activity and let it settle: one step of the ring attractor.

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
    r"""Mix a bump at the direction of a cue into the activity.

    .. math:: r \leftarrow (1 - g)\, r + g\, B(\theta - \theta_\text{cue}),
              \qquad g = 1 - e^{-dt/\tau_\text{cue}}

    A cue near the bump moves it by the share :math:`g` of the difference. A cue far from it makes a
    second bump grow; :func:`ring_step` weakens the smaller of the two, so that the heading jumps
    once the second is larger.

    Args:
        activity: :math:`r`, shape ``(..., n)``, sum 1.
        heading_rad: :math:`\theta_\text{cue}`, a number or ``(...,)``.
        share: :math:`g`, in [0, 1].
        ring: Of :func:`make_ring`.
    """
    return torch.lerp(activity, bump_at(ring, heading_rad), share)


def turned(activity: Tensor, turn_rad: float | Tensor) -> Tensor:
    r"""Rotate activity by any angle, exactly: :math:`\hat r_k \leftarrow \hat r_k e^{-ik\Delta}`.

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
    r"""Return the direction of the dominant bump: the population vector around the peak.

    .. math:: \hat\theta = \operatorname{atan2}\Big(\sum_i r_i^2 \sin\theta_i,
              \sum_i r_i^2 \cos\theta_i\Big), \quad |\theta_i - \theta_\text{peak}| \le \pi/2

    A second bump on the other side of the ring does not count. With squares the ends of the sum do
    not matter; with :math:`r_i` the error would be some 0.0005 degrees.

    Args:
        activity: Shape ``(..., n)``.
        ring: Of :func:`make_ring`.

    Returns:
        Radians in [-pi, pi], shape ``(...,)``.
    """
    weights = (activity * activity)[..., None]
    x, y = (ring.windows[activity.argmax(-1)] @ weights).squeeze(-1).unbind(-1)
    return torch.atan2(y, x)


@compiled
def turn_step(
    activity: np.ndarray, turn_rad: float, settle_share: float, order: np.ndarray,
    kernels: np.ndarray, gain: float, exponent: float,
) -> np.ndarray:  # fmt: skip
    """Do as :func:`ring_step` for one ring; return the new activity."""
    n = activity.shape[0]
    both = np.zeros(2 * n)
    half = order.shape[0] // 2
    for k in range(half):  # an even part, and the odd one of the same order
        even, odd = math.cos(order[k] * turn_rad), math.sin(order[k] * turn_rad)
        for i in range(2 * n):
            both[i] += even * kernels[k, i] + odd * kernels[half + k, i]
    move, drive = np.empty(2 * n), np.empty(2 * n)  # twice around
    for i in range(n):
        move[i] = move[n + i] = both[i]
        drive[i] = drive[n + i] = both[n + i]
    moved, settled = np.zeros(n), np.zeros(n)
    for j in range(n):
        rate = activity[j]
        for i in range(n):
            moved[i] += rate * move[n - j + i]
            settled[i] += rate * drive[n - j + i]
    total = 0.0
    for i in range(n):
        steep = settled[i] * gain
        rate = settled[i] if steep > 20.0 else math.log1p(math.exp(steep)) / gain
        rate = rate * rate if exponent == 2.0 else rate**exponent
        settled[i] = rate
        total += rate
    mass = 0.0
    for i in range(n):
        moved[i] = max(moved[i] + settle_share * (settled[i] / total - moved[i]), 0.0)
        mass += moved[i]
    for i in range(n):
        moved[i] /= mass
    return moved


@compiled
def inject_step(
    activity: np.ndarray, heading_rad: float, share: float, order: np.ndarray, bump: np.ndarray
) -> np.ndarray:
    """Do as :func:`inject` for one ring; return the new activity."""
    n = activity.shape[0]
    cue, mixed = np.zeros(n), np.empty(n)
    half = order.shape[0] // 2
    for k in range(half):
        even, odd = math.cos(order[k] * heading_rad), math.sin(order[k] * heading_rad)
        for i in range(n):
            cue[i] += even * bump[k, i] + odd * bump[half + k, i]
    for i in range(n):
        mixed[i] = activity[i] + share * (cue[i] - activity[i])
    return mixed


@compiled
def decode_step(activity: np.ndarray, windows: np.ndarray) -> float:
    """Do as :func:`decode_heading` for one ring."""
    peak, x, y = 0, 0.0, 0.0
    for i in range(activity.shape[0]):
        if activity[i] > activity[peak]:
            peak = i
    for i in range(activity.shape[0]):
        weight = activity[i] * activity[i]
        x += windows[peak, 0, i] * weight
        y += windows[peak, 1, i] * weight
    return math.atan2(y, x)


def _waves(ring: Ring, angle_rad: float | Tensor) -> Tensor:
    """Return cosines, then sines, of the multiples of an angle, shape ``(..., 2 K)``."""
    if isinstance(angle_rad, Tensor):
        angle = angle_rad.to(ring.order)[..., None]
        return torch.sin(ring.quarter + ring.order * angle)
    return torch.sin(torch.add(ring.quarter, ring.order, alpha=angle_rad))


@lru_cache(maxsize=16)
@torch.inference_mode(mode=False)
@torch.no_grad()
def make_ring(config: HeadDirectionConfig) -> Ring:
    r"""Compute the kernels of a config and the bump that they settle to.

    Excitation is a wrapped Gaussian, :math:`\hat w_k = e^{-k^2\sigma^2/2}`, scaled to a peak of 1;
    inhibition :math:`\varphi` is uniform, so the kernel is :math:`w - \varphi`.
    """
    n = config.n
    k = torch.arange(n // 2 + 1, dtype=torch.float64)
    angles = torch.arange(n, dtype=torch.float64) * TWO_PI / n
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
    spectrum = torch.fft.rfft(bump).real  # even, as at the start
    parts = [_parts(spectrum[None], angles, wave)[:, 0] for wave in (np.cos, np.sin)]
    dtype = getattr(torch, config.precision)
    return Ring(
        order.to(dtype).contiguous(),
        quarter.to(dtype).contiguous(),
        kernels.to(dtype).contiguous(),
        torch.cat(parts).to(dtype).contiguous(),
        windows.to(dtype).contiguous(),
        float(bump.max()),
        config.gain,
        config.exponent,
    )


def _parts(coefficients: Tensor, angles: Tensor, wave: np.ufunc) -> Tensor:
    """Return even (cosine) or odd (sine) waves times coefficients, ``(K, kernels, n)``."""
    n = len(angles)
    k = torch.arange(n // 2 + 1, dtype=angles.dtype)
    twice = torch.full_like(k, 2.0)
    twice[0] = 1.0
    if n % 2 == 0:
        twice[-1] = 1.0
    waves = torch.from_numpy(wave((k[:, None] * angles).numpy()))
    return (coefficients * twice / n).T[:, :, None] * waves[:, None, :]


# ------------------------------------------------------------------------------------- module


class LastView(Scalars):
    """Last view, time for which it has been in sight, and whether a compass aligned the ring."""

    view: int
    seen_s: float
    anchored: int

    def __init__(self) -> None:
        super().__init__(view=NO_TEMPLATE, seen_s=0.0, anchored=0)


@register("head_direction")
class HeadDirectionCells(Population):
    """A bump of activity on a ring of cells encodes the heading; see :func:`ring_step`.

    A turn moves it by exactly its angle. A compass and known views inject activity at the heading
    that they imply; corrections of landmarks or other populations rotate it (:meth:`follow`). The
    first compass reading aligns the ring with the world; before it, heading 0 is that of the
    start. State: the activity, the heading at which every view was learnt (``views``), and the
    last view and the time for which it was in sight (``last``).

    Args:
        config: Size, dynamics, and strength of the cues.
        batch: Number of animals side by side; ``None`` for one. A batch integrates turns and
            uses a compass; it learns no views.

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
        self.ring: Ring = make_ring(cast(Hashable, self.config))
        start = 0.0 if batch is None else torch.zeros(batch, dtype=torch.float64)
        self.register_buffer("activity", bump_at(self.ring, start))
        self.views = GrowingTable({"heading_rad": ((), torch.float64)})
        self.last = LastView()
        self._decoded: tuple[Tensor | None, float | Tensor] = (None, 0.0)
        self._arrays_of: tuple[Ring | None, tuple[np.ndarray, ...]] = (None, ())
        self.register_load_state_dict_post_hook(_forget_decoded)

    @property
    def heading_rad(self) -> float | Tensor:
        """Heading in radians, in [-pi, pi); in a batch ``(batch,)``."""
        activity, heading = self._decoded
        if activity is not self.activity:
            if self._compiles():
                heading = wrap_angle(decode_step(self.activity.numpy(), self._ring_arrays()[4]))
            else:
                heading = decode_heading(self.activity, self.ring)
                heading = wrap_angle(heading.item()) if self.batch is None else heading
            self._decoded = self.activity, heading
        return heading

    def _compiles(self) -> bool:
        """Return whether steps of this ring are compiled."""
        activity = self.activity
        return self.batch is None and activity.dtype == torch.float64 and runs_compiled(activity)

    def _ring_arrays(self) -> tuple[np.ndarray, ...]:
        """Return order, quarter, kernels, bump and windows of the ring as arrays."""
        ring, arrays = self._arrays_of
        if ring is not self.ring:
            arrays = tuple(part.numpy() for part in self.ring[:5])
            self._arrays_of = self.ring, arrays
        return arrays

    @property
    def preferred_rad(self) -> np.ndarray:
        """Direction at which each cell fires most, ``(n,)``."""
        return np.arange(self.config.n) * TWO_PI / self.config.n

    @without_gradients
    def set_heading(self, heading_rad: float | Tensor) -> None:
        """Replace all activity by a settled bump at a heading."""
        self.activity = bump_at(self.ring, heading_rad).expand_as(self.activity).contiguous()

    @without_gradients
    def set_activity(self, activity: Tensor) -> None:
        """Replace the activity, normalised to sum 1.

        Raises:
            MapError: If it has another shape, a negative cell, or no active one.
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
    def advance(self, motion: Motion, compass: CompassReading | None = None) -> float:
        """Rotate by self-motion, settle, and correct by the compass.

        Args:
            motion: Turn rate in rad/s (in a batch ``(batch,)``) for how many seconds.
            compass: Reading of the compass; ``None``: none in this frame.

        Returns:
            Correction of the heading by the compass, in radians; 0 in a batch.
        """
        dt = motion.dt_s
        turn = motion.w_rad_s * dt
        share = -math.expm1(-dt / self.config.settle_s)
        if self._compiles():
            order, _, kernels, *_ = self._ring_arrays()
            self.activity = torch.from_numpy(
                turn_step(
                    self.activity.numpy(), float(turn), share, order, kernels,
                    self.ring.gain, self.ring.exponent,
                )
            )  # fmt: skip
        else:
            self.activity = ring_step(self.activity, turn, share, self.ring)
        if compass is None:
            return 0.0
        if not self.last.anchored:
            self._anchor(compass.compass_rad)
            return 0.0
        return self.correct(compass.compass_rad, self.config.compass_s, dt)

    @without_gradients
    def correct(self, heading_rad: float | Tensor, time_s: float, dt_s: float) -> float:
        """Inject activity at a heading, so that it corrects with the time constant ``time_s``.

        Returns:
            Correction of the heading, in radians; 0 in a batch.
        """
        share = -math.expm1(-dt_s / time_s)
        before = cast(float, self.heading_rad) if self.batch is None else 0.0
        if self._compiles():
            order, _, _, bump, _ = self._ring_arrays()
            mixed = inject_step(self.activity.numpy(), float(heading_rad), share, order, bump)
            self.activity = torch.from_numpy(mixed)
        else:
            self.activity = inject(self.activity, heading_rad, share, self.ring)
        return wrap_angle(cast(float, self.heading_rad) - before) if self.batch is None else 0.0

    def update_from_view(self, view: ViewMatch, dt_s: float) -> float:
        """Bind a new view to the heading; correct the heading by a known one.

        Returns:
            Correction of the heading, in radians.

        Raises:
            MapError: If a new view is not the next, or a known one was never learnt.
        """
        if view.is_new:
            self.bind(view)
        return self.correct_by_view(view, dt_s)

    @without_gradients
    def correct_by_view(self, view: ViewMatch, dt_s: float) -> float:
        r"""Correct the heading by a known view; return the correction in radians.

        After a time :math:`t` in sight a view corrects with the time constant
        :math:`\tau_v e^{t/\tau_f}`, so that a view that still matches while the animal turns does
        not hold the heading back.
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
        """Advance one frame: rotate, settle, correct by compass and view; return the heading."""
        self.advance(motion, None if compass_rad is None else CompassReading(compass_rad))
        if view is not None:
            self.update_from_view(view, motion.dt_s)
        return self.heading_rad

    def _anchor(self, compass_rad: float | Tensor) -> None:
        """Rotate activity and learnt headings into the frame of the compass."""
        if self.batch is not None:
            self.activity = turned(self.activity, compass_rad - self.heading_rad)
        else:
            turn = wrap_angle(cast(float, compass_rad) - cast(float, self.heading_rad))
            self.activity = turned(self.activity, turn)
            old = self.views["heading_rad"]
            self.views.replace(heading_rad=(old + turn + math.pi) % TWO_PI - math.pi)
        self.last.anchored = 1

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "HeadDirectionCells":
        super()._apply(fn, recurse)
        like, self._decoded = self.activity, (None, 0.0)
        moved = {k: v.to(like) for k, v in self.ring._asdict().items() if isinstance(v, Tensor)}
        self.ring = self.ring._replace(**moved)
        return self

    @without_gradients
    def turn_by(self, turn_rad: float) -> None:
        """Rotate the activity by an angle, exactly."""
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
        """Return the heading difference that a view implies, without correcting it.

        Returns:
            Radians in [-pi, pi); ``None`` without a view, or for one of the newest.

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
        heading = cast(float, self.heading_rad)
        return wrap_angle(learnt + view.relative_heading_rad - heading)

    # ------------------------------------------------------- protocol of a population

    def observe(self, frame: Frame) -> CompassReading | None:
        """Return the compass reading of a frame, if it has one.

        Raises:
            BadFrame: If it is not a finite number.
        """
        if frame.heading_rad is None:
            return None
        return CompassReading(checked_number(frame.heading_rad, "heading", "rad"))

    def step(self, now: StepInput, observation: CompassReading | None) -> Correction:
        """Advance by a frame of the brain; return the correction of the heading by the compass."""
        return Correction(turn_rad=self.advance(now.motion, observation))

    def inform(self, now: StepInput) -> StepInput:
        """Say which heading the ring represents."""
        if self.batch is not None:
            return now
        return now._replace(cells_heading_rad=cast(float, self.heading_rad))

    def follow(self, correction: Correction) -> None:
        """Rotate by the heading correction of a landmark or another population."""
        if correction.turn_rad:
            self.turn_by(correction.turn_rad)

    def learn(self, now: StepInput, observation: CompassReading | None) -> None:
        """Bind a new view to the present heading."""
        if now.view.is_new:
            self.bind(now.view)

    def recall(
        self, now: StepInput, observation: CompassReading | None, belief: Belief | None
    ) -> None:
        """Correct the ring by a known view; the map corrects its own heading itself."""
        self.correct_by_view(now.view, now.motion.dt_s)

    @property
    def rates(self) -> np.ndarray:
        """Activity of every cell, 1 at the peak of a settled bump, ``([batch,] n)``."""
        return (self.activity / self.ring.peak).numpy(force=True)

    def rates_at(
        self, position_m: np.ndarray, heading_rad: np.ndarray, speed_m_s: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Compute the settled bump at each heading."""
        settled = bump_at(self.ring, torch.as_tensor(heading_rad).to(self.activity))
        return {self.kind: (settled / self.ring.peak).numpy(force=True).astype(np.float32)}

    def cell_properties(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the preferred direction of each cell."""
        return {self.kind: {"preferred_rad": self.preferred_rad}}

    def counts(self) -> dict[str, float]:
        """Return the number of cells and of known views."""
        return {"head_direction_cells": self.config.n, "head_direction_views": self.views.n}

    def scalars(self) -> dict[str, float]:
        """Return the heading, and the share of activity in its bump."""
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
        """Yield activity that is not normalised, and views that are not those of the brain."""
        activity, views = state["activity"], state["views.heading_rad"]
        if (activity < 0).any():
            yield "head_direction.activity: negative"
        elif abs(float(activity.sum()) - 1.0) > 1e-4:
            yield f"head_direction.activity: adds up to {activity.sum():.6g}, expected 1"
        if len(views) != n_views:
            yield f"{n_views} views, {len(views)} of them with a heading"
        if not -1 <= state["last.view"] < n_views:
            yield f"head_direction.last.view: is {state['last.view']}, expected -1 to {n_views - 1}"

    def renumber(self, change: Renumbering) -> None:
        """Drop the headings of views that are not kept."""
        self.views.replace(heading_rad=change.rows_of_views(self.views["heading_rad"]))
        self.last.view = change.view(self.last.view)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Rotate the partial session's bump and headings into the loaded frame; merge the views.

        The frame is that of the compass, if either session had one; :func:`frame_turn` has the
        rotation. A view that both know keeps the heading of the loaded session.
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
    cells._decoded = (None, 0.0)  # a state is copied into the same tensor


def frame_turn(loaded: State, partial: State, join: Join) -> float:
    r"""Return the rotation of the partial session's headings into the loaded frame.

    It is 0 if both sessions had a compass; else the mean difference of the views that both know,

    .. math:: \Delta = \arg \sum_v e^{i(\theta_v - \theta'_v + \rho_v)}

    with :math:`\rho_v` the heading at which the partial view was learnt minus that of the merged
    one; without such views it is the rotation of the cells.
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
