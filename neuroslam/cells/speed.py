r"""Speed cells: rates that rise linearly with running speed, at any heading and position.

One population in one file: its config section, its pure steps with their equations, the module,
and the merge of two sessions. After Kropff et al. (2015, *Nature* 523:
419): a positive, linear response that anticipates by 50 to 80 ms.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar, NamedTuple, Self, cast

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import BrainConfig, Section
from neuroslam.config.bounds import LARGEST_SEED, MOST_NEURONS
from neuroslam.state.mergeable import Arrays, about_now, without_gradients
from neuroslam.state.pickling import Calls
from neuroslam.state.population import Population, StepInput
from neuroslam.state.registry import register
from neuroslam.types import Motion

_SAMPLES = 64
"""Number of speeds at which the read-out is fitted."""


class SpeedCellConfig(Section):
    """Speed cells: a population of linear rates, and the read-out of a speed from them."""

    n: int = Field(
        default=32,
        ge=2,
        le=MOST_NEURONS,
        description="number of cells; larger: the read-out averages more noise",
    )
    max_speed_m_s: float = Field(
        default=2.0,
        gt=0,
        description="speed above which rates stay constant; larger: less rate for each m/s",
    )
    rest_hz: tuple[float, float] = Field(
        default=(1.0, 10.0), description="range of the cells' rates at rest"
    )
    top_hz: tuple[float, float] = Field(
        default=(15.0, 60.0),
        description="range of the cells' rates at max_speed_m_s; larger: noise counts less",
    )
    lead_s: tuple[float, float] = Field(
        default=(0.05, 0.08), description="range of times by which cells anticipate the speed"
    )
    smooth_s: float = Field(
        default=0.05,
        gt=0,
        description="time constant in which acceleration is measured; larger: less noise, more "
        "delay",
    )
    noise_hz: float = Field(
        default=0.0,
        ge=0,
        description="standard deviation of the noise of each rate in each step; larger: noisier "
        "speed",
    )
    seed: int = Field(
        default=0, ge=0, le=LARGEST_SEED, description="seed of the tuning and of the noise"
    )

    @model_validator(mode="after")
    def _bands_are_bands(self) -> Self:
        for name in ("rest_hz", "top_hz", "lead_s"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ValueError(f"{name} is {low}, {high}; expected 0 <= first <= second")
        if self.rest_hz[1] >= self.top_hz[0]:
            raise ValueError(
                f"rest_hz goes up to {self.rest_hz[1]}, top_hz begins at {self.top_hz[0]}; "
                "expected every rate to rise with speed"
            )
        return self


class SpeedTuning(NamedTuple):
    """Tuning of speed cells, one entry for each, ``(n,)``.

    Attributes:
        rest_hz: Rate at rest.
        slope_hz_s_m: Rise of the rate, in Hz for a m/s.
        lead_s: Time by which the cell anticipates the speed.
    """

    rest_hz: Tensor
    slope_hz_s_m: Tensor
    lead_s: Tensor


# --------------------------------------------------------------------------------- pure steps


def draw_tuning(config: SpeedCellConfig, draw: torch.Generator) -> SpeedTuning:
    """Draw the tuning of each cell uniformly from the ranges of the config."""
    share = torch.rand(3, config.n, generator=draw, dtype=torch.float64)
    bands = torch.tensor([config.rest_hz, config.top_hz, config.lead_s], dtype=torch.float64)
    rest, top, lead = bands[:, :1] + (bands[:, 1:] - bands[:, :1]) * share
    return SpeedTuning(rest, (top - rest) / config.max_speed_m_s, lead)


def acceleration(
    smoothed_m_s: Tensor, speed_m_s: Tensor, smooth_s: float, dt_s: float
) -> tuple[Tensor, Tensor]:
    r"""Estimate acceleration from the deviation of speed from its running mean.

    .. math:: q = e^{-dt/\tau}, \qquad \dot v \approx (v - \bar v)\,\frac{1 - q}{dt}, \qquad
              \bar v \leftarrow v + q\,(\bar v - v)

    For a steadily rising speed it is exact at any time step.

    Args:
        smoothed_m_s: :math:`\bar v`, shape ``(...,)``.
        speed_m_s: :math:`v`, the same shape.
        smooth_s: :math:`\tau`.
        dt_s: Time since the last step, above 0.

    Returns:
        Acceleration in m/s² and the new running mean.
    """
    kept = math.exp(-dt_s / smooth_s)
    off = speed_m_s - smoothed_m_s
    return off * ((1.0 - kept) / dt_s), speed_m_s - kept * off


def speed_rates(
    speed_m_s: Tensor, acceleration_m_s2: Tensor, tuning: SpeedTuning, max_speed_m_s: float
) -> Tensor:
    r"""Return rates that are linear in the anticipated speed.

    .. math:: r_c = b_c + a_c \, \min(\max(v + \ell_c \dot v,\, 0),\, v_\text{max})

    Args:
        speed_m_s: :math:`v \ge 0`, shape ``(...,)``.
        acceleration_m_s2: :math:`\dot v`, the same shape.
        tuning: :math:`b_c`, :math:`a_c` and :math:`\ell_c`.
        max_speed_m_s: :math:`v_\text{max}`.

    Returns:
        Rates in Hz, ``(..., n)``.

    Example:
        >>> one = SpeedTuning(*torch.tensor([[2.0], [10.0], [0.05]]))
        >>> speed_rates(torch.tensor(0.5), torch.tensor(0.0), one, 1.0).tolist()
        [7.0]
    """
    ahead = speed_m_s[..., None] + tuning.lead_s * acceleration_m_s2[..., None]
    return tuning.rest_hz + tuning.slope_hz_s_m * ahead.clamp(0.0, max_speed_m_s)


@compiled
def rates_step(
    speed_m_s: float, dt_s: float, smooth_s: float, max_speed_m_s: float, rest_hz: np.ndarray,
    slope_hz_s_m: np.ndarray, lead_s: np.ndarray, smoothed_m_s: np.ndarray, rates_hz: np.ndarray,
) -> None:  # fmt: skip
    """Do as :func:`acceleration` and :func:`speed_rates` for one animal, in place."""
    change, kept = 0.0, 0.0
    if dt_s > 0.0:
        kept = math.exp(-dt_s / smooth_s)
        change = (speed_m_s - smoothed_m_s[()]) * ((1.0 - kept) / dt_s)
    smoothed_m_s[()] = speed_m_s - kept * (speed_m_s - smoothed_m_s[()])
    for c in range(rates_hz.shape[0]):
        ahead = min(max(speed_m_s + lead_s[c] * change, 0.0), max_speed_m_s)
        rates_hz[c] = rest_hz[c] + slope_hz_s_m[c] * ahead


def fit_readout(tuning: SpeedTuning, max_speed_m_s: float) -> Tensor:
    r"""Fit the weights that decode speed from rates, by least squares.

    .. math:: w = \arg\min_w \sum_v \Big(\sum_c w_c\, r_c(v) - v\Big)^2

    which is not unique, as the rates have two degrees of freedom; the solution of least norm
    averages the cells' noise best.

    Returns:
        Shape ``(n,)``, in m/s for a Hz.
    """
    speeds = torch.linspace(0.0, max_speed_m_s, _SAMPLES, dtype=torch.float64)
    rates = speed_rates(speeds, torch.zeros_like(speeds), tuning, max_speed_m_s)
    return torch.linalg.pinv(rates, rtol=1e-9) @ speeds


def decode_speed(rates_hz: Tensor, readout: Tensor) -> Tensor:
    r"""Decode the speed from the rates: :math:`\hat v = \sum_c w_c r_c`, shape ``(...,)``."""
    return rates_hz @ readout


def speed_score(rates_hz: np.ndarray, speed_m_s: np.ndarray) -> np.ndarray:
    """Correlate each cell's rate with speed (Pearson; the speed score of Kropff et al. 2015).

    Args:
        rates_hz: ``(t, n)``.
        speed_m_s: ``(t,)``.

    Returns:
        In [-1, 1], ``(n,)``; NaN for a rate that never changes.

    Example:
        >>> speed_score(np.array([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]), np.arange(3.0)).round(9)
        array([ 1., -1.])
    """
    rates = rates_hz - rates_hz.mean(0)
    speed = speed_m_s - speed_m_s.mean()
    with np.errstate(invalid="ignore"):
        return speed @ rates / np.sqrt((rates**2).sum(0) * (speed**2).sum())


# ------------------------------------------------------------------------------------- module


@register("speed")
class SpeedCells(Population):
    """Linear rates of running speed, and the speed decoded from them; see :func:`speed_rates`.

    The tuning is drawn from ``config.seed`` and is part of the state, as is the generator of the
    noise: a population that is saved, loaded and continued is bit-equal to one that was not.

    Args:
        config: Ranges of the tuning, and the noise.
        batch: Number of animals side by side, all with the same tuning; ``None`` for one.

    Example:
        >>> cells = SpeedCells()
        >>> for _ in range(40):
        ...     cells.advance(Motion(v_m_s=0.5, w_rad_s=0.0, dt_s=0.05))
        >>> round(cells.speed_m_s, 6)
        0.5
    """

    config_section = SpeedCellConfig
    # Nothing is learnt: the tuning follows from the config, which is the same in both sessions.
    merge_rules = dict.fromkeys(
        ("rest_hz", "slope_hz_s_m", "lead_s", "smoothed_m_s", "rates_hz", "draws"), about_now
    )

    rate_units: ClassVar[Mapping[str, str]] = {"speed": "Hz"}

    rates_hz: Tensor
    smoothed_m_s: Tensor
    rest_hz: Tensor
    slope_hz_s_m: Tensor
    lead_s: Tensor
    draws: Tensor

    def __init__(self, config: SpeedCellConfig | None = None, batch: int | None = None) -> None:
        super().__init__()
        self.config = config or SpeedCellConfig()
        self.batch = batch
        self._draw = torch.Generator().manual_seed(self.config.seed)
        tuning = draw_tuning(self.config, self._draw)
        for name, value in tuning._asdict().items():
            self.register_buffer(name, value)
        animals = () if batch is None else (batch,)
        self.register_buffer("smoothed_m_s", torch.zeros(animals, dtype=torch.float64))
        self.register_buffer("rates_hz", tuning.rest_hz.repeat(*animals, 1).view(*animals, -1))
        self.register_buffer("draws", self._draw.get_state())
        self.readout = fit_readout(tuning, self.config.max_speed_m_s)
        self.register_state_dict_pre_hook(Calls("_write_draws"))
        self.register_load_state_dict_post_hook(Calls("_read"))

    @property
    def tuning(self) -> SpeedTuning:
        """Tuning of every cell."""
        return SpeedTuning(self.rest_hz, self.slope_hz_s_m, self.lead_s)

    @property
    def speed_m_s(self) -> float | Tensor:
        """Speed decoded from the rates, in m/s; in a batch ``(batch,)``."""
        speed = decode_speed(self.rates_hz, self.readout)
        return speed.item() if self.batch is None else speed

    @without_gradients
    def advance(self, motion: Motion) -> None:
        """Update the rates by self-motion; backward motion counts as running.

        Args:
            motion: Speed in m/s (in a batch ``(batch,)``) for how many seconds.
        """
        c = self.config
        if self.batch is None and c.noise_hz == 0.0 and runs_compiled(self.rates_hz):
            rest, slope, lead, smoothed, rates, _ = cast(Arrays, self.arrays())
            rates_step(
                abs(float(motion.v_m_s)), motion.dt_s, c.smooth_s, c.max_speed_m_s, rest, slope,
                lead, smoothed, rates,
            )  # fmt: skip
            return
        speed = torch.as_tensor(motion.v_m_s, dtype=torch.float64, device=self.rates_hz.device)
        speed = speed.abs().expand_as(self.smoothed_m_s)
        if motion.dt_s > 0.0:
            change, smoothed = acceleration(self.smoothed_m_s, speed, c.smooth_s, motion.dt_s)
        else:  # the first frame of a source
            change, smoothed = torch.zeros_like(speed), speed.clone()
        rates = speed_rates(speed, change, self.tuning, c.max_speed_m_s)
        if c.noise_hz > 0.0:
            noise = torch.randn(rates.shape, generator=self._draw, dtype=rates.dtype)
            rates = (rates + c.noise_hz * noise.to(rates.device)).clamp_min(0.0)
        self.smoothed_m_s, self.rates_hz = smoothed, rates

    def forward(self, motion: Motion) -> float | Tensor:
        """Advance one frame and return the decoded speed."""
        self.advance(motion)
        return self.speed_m_s

    def _write_draws(self) -> None:
        self.draws = self._draw.get_state()

    def _read(self) -> None:
        self._draw.set_state(self.draws.cpu())
        self.readout = fit_readout(self.tuning, self.config.max_speed_m_s)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "SpeedCells":
        super()._apply(fn, recurse)
        self.readout = self.readout.to(self.rates_hz)
        return self

    # ------------------------------------------------------- protocol of a population

    def step(self, now: StepInput, observation: None) -> None:
        """Advance by a frame of the brain."""
        self.advance(now.motion)

    def inform(self, now: StepInput) -> StepInput:
        """Say which speed the cells represent, with the direction of the measured one."""
        if self.batch is not None:
            return now
        speed = math.copysign(cast(float, self.speed_m_s), now.motion.v_m_s)
        return now._replace(cells_speed_m_s=speed)

    @property
    def rates(self) -> np.ndarray:
        """Rate of every cell in Hz, ``([batch,] n)``."""
        return self.rates_hz.numpy(force=True).copy()

    def rates_at(
        self, position_m: np.ndarray, heading_rad: np.ndarray, speed_m_s: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Compute the rates at each speed, without noise and acceleration."""
        speed = torch.as_tensor(speed_m_s).abs().to(self.rates_hz)
        rates = speed_rates(speed, torch.zeros_like(speed), self.tuning, self.config.max_speed_m_s)
        return {self.kind: rates.numpy(force=True).astype(np.float32)}

    def counts(self) -> dict[str, float]:
        """Return the number of cells."""
        return {"speed_cells": self.config.n}

    def scalars(self) -> dict[str, float]:
        """Return the decoded speed, and the mean rate."""
        if self.batch is not None:
            return {}
        return {
            "speed/speed_m_s": cast(float, self.speed_m_s),
            "speed/rate_hz": float(self.rates_hz.mean()),
        }

    def images(self) -> dict[str, np.ndarray]:
        """Draw the rates of the cells as a row."""
        return {"cells/speed": np.atleast_2d(self.rates)[:1]}

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield rates, slopes and times that are negative."""
        for name in ("rates_hz", "smoothed_m_s", "rest_hz", "slope_hz_s_m", "lead_s"):
            if (state[name] < 0).any():
                yield f"speed.{name}: negative"
