"""Weights of 8 bits and filters of 12, as a neuromorphic chip has them."""

import copy
from typing import TypeVar

import torch
from torch import Tensor, nn

from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking.ensemble import NeuronArray

WEIGHT_BITS = 8
_WEIGHTS = ("weights", "bias", "decoders", "encoders", "error_decoders", "relay_decoders")

_TUNED_TO_KEYS = 20.0  # ratio of the squared rates of neurons tuned to a key, to others

Module = TypeVar("Module", bound=nn.Module)


def rounded(weights: Tensor, bits: int = WEIGHT_BITS) -> Tensor:
    r"""Round weights to signed integers times one power of two for each population.

    .. math:: w \leftarrow 2^{e} \operatorname{round}(w / 2^{e}), \qquad
              \max |w| \le 2^{e} (2^{b-1} - 1)

    (Loihi; Davies et al. 2018).

    Args:
        weights: Of some populations, which lead, ``(groups, ...)``.
        bits: Of a weight, its sign among them.

    Example:
        >>> rounded(torch.tensor([[0.3, -1.0, 0.004]])).tolist()
        [[0.296875, -1.0, 0.0]]
    """
    most = weights.abs().flatten(1).amax(1).clamp_min(torch.finfo(weights.dtype).tiny)
    step = torch.exp2(torch.ceil(torch.log2(most / (2 ** (bits - 1) - 1))))
    step = step.reshape(-1, *[1] * (weights.ndim - 1))
    return (weights / step).round() * step


def quantised(module: Module, bits: int = WEIGHT_BITS) -> Module:
    """Return a copy of a module of neurons whose weights have a few bits.

    Encoders with their gain, biases and decoders are rounded, each population's with its own
    power of two. Weights that are learnt afterwards are not.

    Args:
        module: Anything made of :class:`~neuroslam.spiking.ensemble.NeuronArray`.
        bits: Of a weight.
    """
    module = copy.deepcopy(module)
    for part in module.modules():
        own = isinstance(part, NeuronArray) or any(
            isinstance(child, NeuronArray) for child in part.children()
        )
        for name in _WEIGHTS if own else ():
            value = part._buffers.get(name)
            if value is not None and value.ndim > 1:
                setattr(part, name, rounded(value, bits))
    return module


def on_chip(config: SSPSLAMConfig) -> SSPSLAMConfig:
    """Return a config for a neuromorphic chip: no function outside of neurons.

    Raises:
        SpaceError: If the tier is not ``spiking``.
    """
    if config.tier != "spiking":
        raise SpaceError(
            f"SSPSLAM: quantised neurons spike, but the tier is {config.tier!r}; set tier to "
            "'spiking'"
        )
    return config.model_copy(
        update={
            "neurons": config.neurons.model_copy(update={"model": "stepped_lif"}),
            "integrator": config.integrator.model_copy(update={"coupling": "none"}),
            "map": config.map.model_copy(
                update={
                    "voja_rate": 0.0,
                    "plasticity": "constant",
                    "pes_rate": config.map.pes_rate / _TUNED_TO_KEYS,
                }
            ),
            "binding": "neurons",
            "vector_neurons": config.vector_neurons or config.map.neurons,
            "relocalise_after_s": 0.0,
        }
    )
