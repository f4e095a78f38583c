"""Rounding of weights to a few bits."""

import torch
from torch import Tensor

WEIGHT_BITS = 8


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
