"""Local rules by which populations learn: prescribed error sensitivity, and Voja's."""

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled

NOTHING = 1e-20
"""Activity and change of a weight that compiled steps take for none."""


def pes_step(decoders: Tensor, error: Tensor, activity: Tensor, rate: float) -> Tensor:
    r"""Move what each neuron contributes against the error, as much as it was active.

    .. math:: \Delta d_i = -\frac{\kappa\,\Delta t}{N}\, E\, a_i

    (prescribed error sensitivity; SSP-SLAM, Eq. 13, whose sign is lost in print).

    Args:
        decoders: ``(batch, neurons, outputs)``.
        error: :math:`E`, what is decoded minus what should be, ``(batch, outputs)``.
        activity: :math:`a`, filtered rates in Hz, ``(batch, neurons)``.
        rate: :math:`\kappa \Delta t / N`.
    """
    return decoders.addcmul(activity.unsqueeze(-1), error.unsqueeze(-2), value=-rate)


def voja_step(encoders: Tensor, gain: Tensor, spikes: Tensor, key: Tensor, rate: Tensor) -> Tensor:
    r"""Move the encoders of neurons that fire towards what made them fire.

    .. math:: \Delta \hat e_i = \kappa\, s_i\, (\alpha_i x - \hat e_i)

    (Voelker et al. 2014; SSP-SLAM, Eq. 15) with encoders :math:`\hat e` that hold the gain. Few
    neurons fire in a step: theirs are changed in place, as a copy of all weights would cost more
    than all else.

    Args:
        encoders: ``(batch, neurons, dimensions)``.
        gain: :math:`\alpha`, ``(neurons,)``.
        spikes: In this step, 0 or 1, ``(batch, neurons)``.
        key: :math:`x`, ``(batch, dimensions)``.
        rate: :math:`\kappa`, for each animal, ``(batch, 1)``.
    """
    animal, neuron = torch.nonzero(spikes * rate, as_tuple=True)
    moved = (spikes * rate)[animal, neuron].unsqueeze(-1)
    towards = gain[neuron].unsqueeze(-1) * key[animal]
    rows = torch.lerp(encoders[animal, neuron], towards, moved)
    if torch.is_grad_enabled():
        encoders = encoders.clone()
    return encoders.index_put_((animal, neuron), rows)


@compiled
def drive_by_keys(
    key: np.ndarray,
    encoders: np.ndarray,
    bias: np.ndarray,
    spikes: np.ndarray,
    same: np.ndarray,
    rates: np.ndarray,
    said: np.ndarray,
    drive: np.ndarray,
) -> None:
    """Encode keys; ``AssociativeMap.forward`` is the definition.

    If a key is that of the step before, only encoders of neurons that fired in it have moved.

    Args:
        key: ``(batch, n_key)``.
        encoders: ``(batch, neurons, n_key)``.
        bias: ``(neurons,)``.
        spikes: In the step before, ``(batch, neurons)``.
        same: Whether the key is that of the step before, ``(batch,)``.
        rates: See ``AssociativeMap._constants``.
        said: Products of encoders and keys, ``(batch, neurons)``; changed.
        drive: See ``NeuronArray.fire``, ``(batch, neurons)``; written.
    """
    batch, neurons, n = encoders.shape
    share, one, none = rates[6], rates[7], rates[9]
    for b in range(batch):
        for i in range(neurons):
            if same[b] and spikes[b, i] == none:
                continue
            row, name = encoders[b, i], key[b]
            first = second = third = fourth = none
            for j in range(n // 4):
                first += row[4 * j] * name[4 * j]
                second += row[4 * j + 1] * name[4 * j + 1]
                third += row[4 * j + 2] * name[4 * j + 2]
                fourth += row[4 * j + 3] * name[4 * j + 3]
            for j in range(n - n % 4, n):
                first += row[j] * name[j]
            said[b, i] = (first + second) + (third + fourth)
        for i in range(neurons):
            drive[b, i] = share * (one - bias[i] - said[b, i])


@compiled
def memorise(
    spikes: np.ndarray,
    key: np.ndarray,
    plasticity: np.ndarray,
    voja: np.ndarray,
    gain: np.ndarray,
    encoders: np.ndarray,
    decoders: np.ndarray,
    activity: np.ndarray,
    filters: tuple[np.ndarray, ...],
    values: tuple[np.ndarray, ...],
    rates: np.ndarray,
    after: tuple[np.ndarray, ...],
) -> None:
    """Decode, learn in place, and filter, in one pass; ``AssociativeMap.forward`` defines it.

    Its :func:`pes_step` is that of neurons that have been active, :func:`voja_step` of those that
    fire.

    Args:
        spikes: In this step, ``(batch, neurons)``.
        key: ``(batch, n_key)``.
        plasticity: Share of the rate of learning, ``(batch,)``.
        voja: The same of the encoders.
        gain: Of the encoders, ``(neurons,)``.
        encoders: ``(batch, neurons, n_key)``.
        decoders: ``(batch, neurons, n_value)``.
        activity: Filtered rates in Hz, ``(batch, neurons)``.
        filters: ``rule``, ``recalled``, ``relayed`` and ``taught``, each ``(batch, n_value)``.
        values: What goes into the first, and into the last two; the same shape.
        rates: Rate of a spike in a step, rates of PES and Voja, and how much is kept of activity
            and recall, of the rule and what is relayed, and of what is taught.
        after: ``filters`` after the step, and room for one row of them; written.
    """
    batch, neurons, n_value = decoders.shape
    n_key = encoders.shape[2]
    per_spike, pes, move, recalls, errs, teaches = (
        rates[0], rates[1], rates[2], rates[3], rates[4], rates[5],
    )  # fmt: skip
    rule, recalled, relayed, taught = filters
    error_now, passed, value = values
    new_rule, new_recalled, new_relayed, new_taught, wrong = after
    for b in range(batch):
        said, name = new_recalled[b], key[b]
        largest, moves = 0.0, move * voja[b]
        for o in range(n_value):
            said[o] = 0.0
            wrong[o] = pes * (plasticity[b] * rule[b, o])
            largest = abs(wrong[o]) if abs(wrong[o]) > largest else largest
        for i in range(neurons):
            spike, row = spikes[b, i], decoders[b, i]
            rate = spike * per_spike
            activity[b, i] = rate + recalls * (activity[b, i] - rate)
            if activity[b, i] < NOTHING:
                activity[b, i] = 0.0
            active = activity[b, i]
            if spike != 0.0:
                for o in range(n_value):
                    said[o] += rate * row[o]
            if active * largest > NOTHING:
                for o in range(n_value):
                    row[o] -= active * wrong[o]
            if spike != 0.0 and moves != 0.0:
                moved, far, mine = spike * moves, gain[i], encoders[b, i]
                for j in range(n_key):
                    mine[j] += moved * (far * name[j] - mine[j])
        for o in range(n_value):
            said[o] += recalls * (recalled[b, o] - said[o])
            if abs(said[o]) < NOTHING:
                said[o] = 0.0
            new_rule[b, o] = error_now[b, o] + errs * (rule[b, o] - error_now[b, o])
            new_relayed[b, o] = passed[b, o] + errs * (relayed[b, o] - passed[b, o])
            new_taught[b, o] = value[b, o] + teaches * (taught[b, o] - value[b, o])
