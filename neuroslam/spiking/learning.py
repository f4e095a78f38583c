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
def memorise(spikes, key, error, voja, gain, encoders, decoders, activity, rates):  # noqa: ANN001, ANN202
    """Decode, and learn in place, in one pass; ``AssociativeMap.forward`` is the definition.

    :func:`pes_step` and :func:`voja_step`, of neurons that have been active or fire alone.

    Args:
        spikes: In this step, ``(batch, neurons)``.
        key: ``(batch, n_key)``.
        error: Times the rate of learning, ``(batch, n_value)``.
        voja: Rate of the encoders, ``(batch,)``.
        gain: Of the encoders, ``(neurons,)``.
        encoders: ``(batch, neurons, n_key)``.
        decoders: ``(batch, neurons, n_value)``.
        activity: Filtered rates in Hz, ``(batch, neurons)``.
        rates: Rate of a spike in a step, and how much of its activity is kept.

    Returns:
        What the spikes say, ``(batch, n_value)``.
    """
    batch, neurons, n_value = decoders.shape
    n_key = encoders.shape[2]
    decoded = np.zeros((batch, n_value), dtype=decoders.dtype)
    for b in range(batch):
        said, wrong, name = decoded[b], error[b], key[b]
        largest = 0.0
        for o in range(n_value):
            largest = max(largest, abs(wrong[o]))
        for i in range(neurons):
            spike, row = spikes[b, i], decoders[b, i]
            rate = spike * rates[0]
            active = rate + rates[1] * (activity[b, i] - rate)
            if active < NOTHING:
                active = 0.0
            activity[b, i] = active
            active = activity[b, i]  # of the type of the arrays
            if spike != 0.0:
                for o in range(n_value):
                    said[o] += rate * row[o]
            if active * largest > NOTHING:
                for o in range(n_value):
                    row[o] -= active * wrong[o]
            if spike != 0.0 and voja[b] != 0.0:
                moved, far, mine = spike * voja[b], gain[i], encoders[b, i]
                for j in range(n_key):
                    mine[j] += moved * (far * name[j] - mine[j])
    return decoded
