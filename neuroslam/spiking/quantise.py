"""Weights of 8 bits and filters of 12, as a neuromorphic chip has them."""

import copy
from typing import TypeVar

from torch import nn

from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking.ensemble import NeuronArray
from neuroslam.spiking.rounding import WEIGHT_BITS, rounded

_WEIGHTS = ("weights", "bias", "decoders", "encoders", "error_decoders", "relay_decoders")

_TUNED_TO_KEYS = 20.0  # ratio of the squared rates of neurons tuned to a key, to others

Module = TypeVar("Module", bound=nn.Module)


def quantised(module: Module, bits: int = WEIGHT_BITS) -> Module:
    """Return a copy of a module of neurons whose weights have a few bits.

    Encoders with their gain, biases and decoders are rounded, each population's with its own
    power of two. Weights that are learnt afterwards are not. Decoders should be solved for rounded
    neurons: make these with ``weight_bits``, and only decoders are left to round.

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
            "neurons": config.neurons.model_copy(
                update={"model": "stepped_lif", "weight_bits": WEIGHT_BITS}
            ),
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
