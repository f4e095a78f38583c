"""Local rules by which populations learn: prescribed error sensitivity, and Voja's."""

import torch
from torch import Tensor


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
