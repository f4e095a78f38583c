"""Holographic reduced representations: binding by circular convolution, and what undoes it."""

import torch
from torch import Tensor

_LEAST_MODULUS = 1e-8


def bind(a: Tensor, b: Tensor) -> Tensor:
    r"""Bind two vectors, :math:`A \circledast B = F^{-1}\{F\{A\} \odot F\{B\}\}` (Eq. 1).

    Args:
        a: ``(..., n_features)``.
        b: The same, or what broadcasts with it.

    Example:
        >>> bind(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([1.0, 2.0, 3.0])).tolist()
        [3.0, 1.0, 2.0]
    """
    return torch.fft.irfft(torch.fft.rfft(a) * torch.fft.rfft(b), n=a.shape[-1])


def invert(a: Tensor) -> Tensor:
    """Return the approximate inverse, ``[a1, ad, ..., a2]``; exact for unitary vectors.

    Example:
        >>> invert(torch.tensor([1.0, 2.0, 3.0])).tolist()
        [1.0, 3.0, 2.0]
    """
    return a.flip(-1).roll(1, -1)


def unbind(a: Tensor, b: Tensor) -> Tensor:
    """Take ``b`` out of ``a``: bind with its inverse."""
    return bind(a, invert(b))


def identity(n_features: int) -> Tensor:
    """Return the vector that binding leaves everything as it is with."""
    return torch.nn.functional.one_hot(torch.tensor(0), n_features).to(torch.get_default_dtype())


def make_unitary(a: Tensor) -> Tensor:
    """Give all Fourier coefficients the modulus 1: then the inverse is exact, the length 1.

    Example:
        >>> a = make_unitary(torch.tensor([1.0, 2.0, 4.0]))
        >>> bool(torch.allclose(unbind(bind(a, a), a), a))
        True
    """
    z = torch.fft.rfft(a)
    return torch.fft.irfft(z / z.abs().clamp_min(_LEAST_MODULUS), n=a.shape[-1])


def similarity(a: Tensor, b: Tensor) -> Tensor:
    """Return the cosine of the angle between vectors; 0 if one of them is nothing."""
    return torch.nn.functional.cosine_similarity(a, b, dim=-1)
