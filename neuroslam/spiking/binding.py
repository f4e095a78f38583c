"""Binding in neurons: circular convolution as products of Fourier coefficients."""

import math

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled
from neuroslam.config.semantic import NeuronConfig
from neuroslam.spiking.ensemble import (
    NeuronArray,
    Stepper,
    lowpass,
    replace,
    sample_tuning,
    synapse,
    view,
)
from neuroslam.state.mergeable import BufferModule

_SOLVER_POINTS = 1000
_RADIUS = math.sqrt(2.0)  # of a sum or difference of two numbers of at most 1, over root 2
TAU_S = 0.03  # filters noise of few neurons; signals compared with it need the same delay


class SpikingBinding(BufferModule):
    r"""Multiplies Fourier coefficients with populations that square numbers.

    .. math:: ab = \tfrac12 \Bigl[\Bigl(\tfrac{a+b}{\sqrt2}\Bigr)^2 -
              \Bigl(\tfrac{a-b}{\sqrt2}\Bigr)^2\Bigr]

    Four products of real numbers make one of two complex ones, eight populations each. Bound
    vectors are the product of their coefficients (Eq. 1); unbinding is binding with the conjugate.

    Args:
        n_frequencies: Coefficients of each vector.
        neurons: Of one product of real numbers; half of them square the sum.
        config: Their model.
        time_step_s: Length of a step.
        seed: Of the neurons.
        batch: Animals side by side.

    Example:
        >>> bind = SpikingBinding(2, 200, NeuronConfig(), time_step_s=1e-3)
        >>> a, b = torch.tensor([[1.0, 1.0j]]), torch.tensor([[1.0j, 1.0j]])
        >>> for _ in range(300):
        ...     product = bind(a, b)
        >>> bool((product - a * b).abs().max() < 0.15)
        True
    """

    decoders: Tensor
    product: Tensor

    def __init__(
        self,
        n_frequencies: int,
        neurons: int,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.time_step_s = time_step_s
        draw = torch.Generator().manual_seed(seed)
        groups = 8 * n_frequencies
        tuning = sample_tuning(groups, max(1, neurons // 2), 1, config, draw, _RADIUS)
        # On a line there are two directions only.
        tuning = tuning._replace(encoders=tuning.encoders.sign())
        self.neurons = NeuronArray(tuning, config, time_step_s, draw, batch)
        points = torch.linspace(-_RADIUS, _RADIUS, _SOLVER_POINTS).expand(groups, -1).unsqueeze(-1)
        decoders = self.neurons.solve(points, points.square(), noise=0.01)
        self.register_buffer("decoders", (decoders / time_step_s).mT.contiguous())
        self.register_buffer("product", torch.zeros(batch, n_frequencies, 2))

    @property
    def n_neurons(self) -> int:
        """Of one animal."""
        return self.neurons.n_neurons

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Step with two vectors of coefficients; return their filtered product.

        Args:
            a: Complex, ``(batch, n_frequencies)``, parts in [-1, 1].
            b: The same.
        """
        if self.neurons.runs_compiled(a, b, self.product, self.decoders):
            left, right = (
                torch.view_as_real(z.resolve_conj()).to(self.product).contiguous().numpy()
                for z in (a, b)
            )
            return torch.view_as_complex(torch.from_numpy(self.advance(left, right)))
        # Rows: real·real, imaginary·imaginary, real·imaginary, imaginary·real.
        left = torch.stack([a.real, a.imag, a.real, a.imag])
        right = torch.stack([b.real, b.imag, b.imag, b.real])
        inputs = torch.stack([left + right, left - right]) / _RADIUS
        inputs = inputs.permute(0, 1, 3, 2).reshape(-1, len(a), 1)
        fired = self.neurons.fire(self.neurons.drive_on_line(inputs))
        squares = (fired * self.decoders).sum(-1).reshape(2, 4, a.shape[-1], len(a))
        rr, ii, ri, ir = 0.5 * (squares[0] - squares[1])
        product = torch.stack([rr - ii, ri + ir], dim=-1).transpose(0, 1)
        self.product = lowpass(self.product, product, synapse(TAU_S, self.time_step_s))
        return torch.view_as_complex(self.product)

    def advance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Step as :meth:`forward` does, compiled; arrays ``(batch, n_frequencies, 2)``."""
        step, keep = self.stepper()
        product = step(a, b)
        keep()
        return product

    def stepper(self) -> Stepper:
        """Return a function that steps as :meth:`advance` does, and one that keeps the state.

        The array that the first returns is changed by its next call.
        """
        product, kept = view(self, "product").copy(), synapse(TAU_S, self.time_step_s)
        batch, n = product.shape[:2]
        answer = self.neurons.responder(view(self, "decoders").reshape(8 * n, -1, 1))
        x = np.empty((8 * n, batch, 1), dtype=product.dtype)
        before, after = sums_and_differences.dispatcher(), products_of.dispatcher()

        def step(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            before(a, b, x)
            after(answer(x, None), product, kept, product)
            return product

        return step, lambda: replace(self, product=product)


@compiled
def sums_and_differences(a: np.ndarray, b: np.ndarray, x: np.ndarray) -> None:
    """Write what the populations square into ``x``, ``(8 n_frequencies, batch, 1)``."""
    batch, n = a.shape[0], a.shape[1]
    for i in range(batch):
        for k in range(n):
            for row in range(4):
                left = a[i, k, row % 2] / _RADIUS
                right = b[i, k, (row + row // 2) % 2] / _RADIUS
                x[row * n + k, i, 0] = left + right
                x[(4 + row) * n + k, i, 0] = left - right


@compiled
def products_of(squares: np.ndarray, before: np.ndarray, kept: float, product: np.ndarray) -> None:
    """Write the filtered products, as those before ``(batch, n_frequencies, 2)``."""
    batch, n = before.shape[0], before.shape[1]
    for i in range(batch):
        for k in range(n):
            rr = 0.5 * (squares[k, i, 0] - squares[4 * n + k, i, 0])
            ii = 0.5 * (squares[n + k, i, 0] - squares[5 * n + k, i, 0])
            ri = 0.5 * (squares[2 * n + k, i, 0] - squares[6 * n + k, i, 0])
            ir = 0.5 * (squares[3 * n + k, i, 0] - squares[7 * n + k, i, 0])
            product[i, k, 0] = (rr - ii) + kept * (before[i, k, 0] - (rr - ii))
            product[i, k, 1] = (ri + ir) + kept * (before[i, k, 1] - (ri + ir))
