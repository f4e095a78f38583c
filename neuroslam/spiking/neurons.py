"""Neuron models: leaky integrate-and-fire, its rates, and the same on a chip."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import leaky_relu, threshold

from neuroslam.compiled import compiled

LEAST_EXCESS = 1e-9
"""Current above threshold below which a rate is that of this much; keeps its logarithm finite."""

_IN_CACHE = 512  # neurons that are advanced together


class LIFState(NamedTuple):
    """What a neuron carries from one step to the next.

    Attributes:
        deficit: Threshold minus voltage, in (0, 1].
        asleep: Steps until it wakes, with a share of a step as that of the charge which the step
            will not bring; 0 if it is awake.
    """

    deficit: Tensor
    asleep: Tensor


class Membrane(NamedTuple):
    """Constants of a membrane.

    Attributes:
        tau_rc_s: Time constant of the leak.
        tau_ref_s: Refractory time after a spike.
    """

    tau_rc_s: float = 0.02
    tau_ref_s: float = 0.002

    def keeps(self, time_step_s: float) -> float:
        """Share of a voltage that a step leaves."""
        return math.exp(-time_step_s / self.tau_rc_s)


def resting(voltage: Tensor) -> LIFState:
    """Return the state of neurons that are not refractory, at voltages in [0, 1)."""
    return LIFState(1.0 - voltage, torch.zeros_like(voltage))


def lif_step(
    state: LIFState, drive: Tensor, membrane: Membrane, time_step_s: float
) -> tuple[LIFState, Tensor]:
    r"""Advance leaky integrate-and-fire neurons by one step; a spike falls at its exact time.

    .. math:: v \leftarrow v + (J - v)(1 - e^{-\delta/\tau_{rc}}), \qquad
              t_s = \Delta t + \tau_{rc} \log\Bigl(1 - \frac{v-1}{J-1}\Bigr) \text{ if } v > 1

    :math:`\delta` is the part of the step in which a neuron is not refractory; after a spike it is,
    until :math:`t_s + \tau_{ref}` (the conventions of Nengo).

    No exponential or logarithm is left to be taken. A refractory voltage is zero, so what it has
    gained when it wakes is a share, :math:`1 - e^{-\delta/\tau}` over
    :math:`1 - e^{-\Delta t/\tau}`, of what a whole step brings. As
    :math:`e^{-(\Delta t - t_s)/\tau} = 1 - (v-1)/(J-1)`, it follows from the overshoot.

    Args:
        state: Of the step before.
        drive: :math:`(1 - J)(1 - e^{-\Delta t/\tau_{rc}})`, any shape.
        membrane: Time constants.
        time_step_s: Length of the step.

    Returns:
        The state after the step, and the spikes, 0 or 1.

    Example:
        >>> state, current = resting(torch.zeros(1)), torch.full((1,), 2.0)
        >>> drive = (1.0 - current) * (1.0 - Membrane().keeps(1e-3))
        >>> spikes = 0
        >>> for _ in range(1000):
        ...     state, fired = lif_step(state, drive, Membrane(), 1e-3)
        ...     spikes += int(fired)
        >>> spikes, round(lif_rate(current).item())
        (63, 63)
    """
    deficit, asleep = state
    c, pause = membrane.keeps(time_step_s), membrane.tau_ref_s / time_step_s
    whole = math.floor(pause + 1e-9)
    part = math.exp((pause - whole) * time_step_s / membrane.tau_rc_s)
    one = torch.ones((), dtype=drive.dtype, device=drive.device)
    charged = torch.add(drive, deficit, alpha=c)
    deficit = torch.lerp(charged, one, asleep.clamp(0.0, 1.0))
    # Arithmetic on numbers instead of a choice by booleans, which is ten times slower.
    fired = torch.lt(deficit, 0.0, out=torch.empty_like(deficit))
    share = torch.addcdiv(one * (1.0 - part) / (1.0 - c), deficit, drive, value=part)
    if part > 1.0 + 1e-9:
        share = leaky_relu(share, c)  # it wakes a step later, with the time of this one
    pause = share.clamp_(-1.0, 1.0).neg_().add_(float(whole))
    asleep = asleep.sub(1.0).clamp_min_(0.0).addcmul_(fired, pause)
    return LIFState(threshold(deficit, 0.0, 1.0).clamp_max_(1.0), asleep), fired


def lif_rate(current: Tensor, membrane: Membrane = Membrane()) -> Tensor:  # noqa: B008 - immutable
    r"""Return the rate at which a neuron fires under a constant current, in Hz.

    .. math:: a(J) = \frac{1}{\tau_{ref} + \tau_{rc} \log(1 + 1/(J - 1))}, \quad J > 1

    Example:
        >>> lif_rate(torch.tensor([0.5, 2.0])).round().tolist()
        [0.0, 63.0]
    """
    excess = (current - 1.0).clamp_min(LEAST_EXCESS)
    rate = 1.0 / (membrane.tau_ref_s + membrane.tau_rc_s * torch.log1p(1.0 / excess))
    return torch.where(current > 1.0, rate, 0.0)


def stepped_lif(
    state: LIFState, drive: Tensor, membrane: Membrane, time_step_s: float
) -> tuple[LIFState, Tensor]:
    """Advance neurons of a chip that knows no time between its steps.

    A voltage is reset at the end of a step, whenever in it the threshold was crossed, and the pause
    is a whole number of steps (the discretised neurons of Loihi; Davies et al. 2018). Arguments and
    returns are those of :func:`lif_step`.
    """
    deficit, asleep = state
    pause = round(membrane.tau_ref_s / time_step_s)
    charged = torch.add(drive, deficit, alpha=membrane.keeps(time_step_s))
    deficit = torch.lerp(charged, torch.ones_like(deficit), asleep.clamp(0.0, 1.0))
    fired = torch.lt(deficit, 0.0, out=torch.empty_like(deficit))
    asleep = asleep.sub(1.0).clamp_min_(0.0).add_(fired, alpha=float(pause))
    return LIFState(threshold(deficit, 0.0, 1.0).clamp_max_(1.0), asleep), fired


def stepped_lif_rate(current: Tensor, membrane: Membrane, time_step_s: float) -> Tensor:
    r"""Return the rate of :func:`stepped_lif` neurons, in Hz: one over a whole number of steps.

    .. math:: a(J) = \frac{1}{\Delta t\,(\lceil \tau_{ref}/\Delta t \rfloor +
              \lfloor \tau_{rc} \log(1 + 1/(J-1)) / \Delta t \rfloor + 1)}
    """
    excess = (current - 1.0).clamp_min(LEAST_EXCESS)
    rise = torch.log1p(1.0 / excess) * (membrane.tau_rc_s / time_step_s)
    steps = round(membrane.tau_ref_s / time_step_s) + rise.floor() + 1.0
    return torch.where(current > 1.0, 1.0 / (time_step_s * steps), 0.0)


def lif_constants(
    membrane: Membrane, time_step_s: float, stepped: bool, dtype: np.dtype
) -> np.ndarray:
    """Return the numbers of :func:`fire_row`, of the type of its arrays.

    With them it is :func:`lif_step`, or, if ``stepped``, :func:`stepped_lif`.

    Example:
        >>> lif_constants(Membrane(), 1e-3, True, np.dtype(np.float64))[4:].tolist()
        [2.0, 0.0, 0.0, 0.0, 0.5, 1.0]
    """
    c, pause = membrane.keeps(time_step_s), membrane.tau_ref_s / time_step_s
    if stepped:
        numbers = (c, 0.0, 0.0, 1.0, float(round(pause)), 0.0, 0.0)
    else:
        whole = math.floor(pause + 1e-9)
        part = math.exp((pause - whole) * time_step_s / membrane.tau_rc_s)
        slope = c if part > 1.0 + 1e-9 else 1.0
        numbers = (c, part, (1.0 - part) / (1.0 - c), slope, float(whole), -1.0, 1.0)
    return np.array([*numbers, 0.0, 0.5, 1.0], dtype=dtype)


@compiled
def fire_row(
    drive: np.ndarray,
    deficit: np.ndarray,
    asleep: np.ndarray,
    spikes: np.ndarray,
    constants: np.ndarray,
) -> None:
    """Advance neurons in place, arrays ``(neurons,)``; :func:`lif_step` is the definition.

    Choices are between numbers, so that several neurons are advanced at once; all numbers have the
    type of the arrays.
    """
    c, part, rest, slope, whole = (
        constants[0], constants[1], constants[2], constants[3], constants[4],
    )  # fmt: skip
    low, high, zero, half, one = (
        constants[5], constants[6], constants[7], constants[8], constants[9],
    )  # fmt: skip
    for i in range(drive.shape[0]):
        d = drive[i]
        charged = d + c * deficit[i]
        a = asleep[i]
        share = a if a > zero else zero
        share = share if share < one else one
        gap = one - charged
        x = charged + share * gap if share < half else one - gap * (one - share)
        fired = x < zero
        early = rest + part * (x / d)
        early = early if early > zero else early * slope
        early = early if early > low else low
        early = early if early < high else high
        a = a - one
        a = a if a > zero else zero
        asleep[i] = a + (whole - early) if fired else a
        x = x if x > zero else one
        deficit[i] = x if x < one else one
        spikes[i] = one if fired else zero


@compiled
def respond(
    x: np.ndarray,
    more: np.ndarray,
    slopes: np.ndarray,
    rest: np.ndarray,
    deficit: np.ndarray,
    asleep: np.ndarray,
    spikes: np.ndarray,
    decoders: np.ndarray,
    constants: np.ndarray,
    decoded: np.ndarray,
) -> None:
    """Encode, fire and decode in one pass; only neurons that fire are decoded.

    Args:
        x: Inputs, ``(groups, batch, dimensions)``.
        more: Added to the drive of all neurons of an animal, ``(batch,)``.
        slopes: Drive for each input, ``(groups, dimensions, neurons)``.
        rest: Drive without any, ``(groups, neurons)``.
        deficit: State, as the next two, ``(groups, batch, neurons)``.
        asleep: The same.
        spikes: The same; written alone.
        decoders: ``(groups, neurons, outputs)``.
        constants: See :func:`lif_constants`.
        decoded: What the spikes say, ``(groups, batch, outputs)``; written.
    """
    groups, batch, n = deficit.shape
    outputs = decoders.shape[2]
    block = max(1, _IN_CACHE // n)  # rows that are advanced together
    drive = np.empty(block * n, dtype=deficit.dtype)
    who = np.empty(n + 1, dtype=np.int64)
    owing, paused, fired = deficit.reshape(-1), asleep.reshape(-1), spikes.reshape(-1)
    for first in range(0, groups * batch, block):
        last = min(first + block, groups * batch)
        for r in range(first, last):
            g, b = r // batch, r % batch
            own, base, added = drive[(r - first) * n : (r - first + 1) * n], rest[g], more[b]
            for i in range(n):
                own[i] = base[i] + added
            for d in range(x.shape[2]):
                value, slope = x[g, b, d], slopes[g, d]
                for i in range(n):
                    own[i] += value * slope[i]
        part = slice(first * n, last * n)
        fire_row(drive[: (last - first) * n], owing[part], paused[part], fired[part], constants)
        for r in range(first, last):
            g, b, m = r // batch, r % batch, 0
            own, into = fired[r * n : (r + 1) * n], decoded[g, b]
            for o in range(outputs):
                into[o] = 0.0
            for i in range(n):
                who[m] = i
                m += 1 if own[i] != 0.0 else 0
            if outputs == 4:  # in registers
                one, two, three, four = into[0], into[1], into[2], into[3]
                for k in range(m):
                    row = decoders[g, who[k]]
                    one += row[0]
                    two += row[1]
                    three += row[2]
                    four += row[3]
                into[0], into[1], into[2], into[3] = one, two, three, four
            else:
                for k in range(m):
                    row = decoders[g, who[k]]
                    for o in range(outputs):
                        into[o] += row[o]
