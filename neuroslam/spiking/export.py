"""Path integrators for other simulators and chips: the Neuromorphic Intermediate Representation."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from neuroslam.errors import ConfigError
from neuroslam.spiking.path_integrator import PathIntegrator


def export_nir(walk: PathIntegrator, path: str | Path) -> Path:
    r"""Write the oscillators of a path integrator as a NIR graph (extra ``spiking-export``).

    Each oscillator is five nodes: its input ``(2 + 1)`` (pull and rate) as an affine map to the
    currents of its neurons, leaky integrate-and-fire neurons, decoders to a synapse that comes back
    (``tau_s``) and to one that is read (``output_tau_s``). In NIR's terms a neuron obeys

    .. math:: \tau \dot v = v_{leak} - v + R I, \qquad v \ge 1 \Rightarrow v \leftarrow 0

    so :math:`R = 1` and :math:`I = J`. NIR knows no refractory time; a simulator that has none
    fires a little faster.

    Args:
        walk: Its weights; those of all animals of a batch are the same.
        path: Usually ends in ``.nir``.

    Returns:
        The path.

    Raises:
        ConfigError: If ``nir`` is not installed, or the neurons do not spike.
    """
    try:
        import nir
    except ImportError:
        raise ConfigError(
            "export_nir: NIR cannot be imported; pip install neuroslam[spiking-export]"
        ) from None
    model = walk.neurons.config.model
    if model not in ("lif", "stepped_lif"):
        raise ConfigError(f"export_nir: neurons are {model!r}, NIR takes spiking ones ('lif')")
    c, dt = walk.config, walk.time_step_s
    n = c.neurons
    tau = np.full(n, walk.neurons.membrane.tau_rc_s)
    one, nothing = np.ones(n), np.zeros(n)
    nodes: dict[str, nir.NIRNode] = {}
    edges: list[tuple[str, str]] = []
    for k in range(walk.space.n_frequencies):
        weights = walk.neurons.weights[k].double().numpy(force=True)
        bias = walk.neurons.bias[k].double().numpy(force=True)
        # A spike of NIR is an impulse; ours are 1 in a step, and decoders are in that unit.
        decoders = walk.decoders[k].double().numpy(force=True).T * dt
        name = f"oscillator_{k}"
        nodes |= {
            f"{name}_input": nir.Input(input_type={"input": np.array([3])}),
            f"{name}_encode": nir.Affine(weight=weights, bias=bias),
            f"{name}_neurons": nir.LIF(
                tau=tau, r=one, v_leak=nothing, v_threshold=one, v_reset=nothing
            ),
            f"{name}_recur": nir.Linear(weight=np.vstack([decoders[:2], np.zeros((1, n))])),
            f"{name}_synapse": nir.LI(tau=np.full(3, c.tau_s), r=np.ones(3), v_leak=np.zeros(3)),
            f"{name}_read": nir.Linear(weight=decoders[2:]),
            f"{name}_filter": nir.LI(
                tau=np.full(2, c.output_tau_s), r=np.ones(2), v_leak=np.zeros(2)
            ),
            f"{name}_output": nir.Output(output_type={"output": np.array([2])}),
        }
        chain = ("input", "encode", "neurons", "read", "filter", "output")
        loop = ("neurons", "recur", "synapse", "encode")
        for part in (chain, loop):
            edges += [(f"{name}_{a}", f"{name}_{b}") for a, b in pairwise(part)]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    nir.write(path, nir.NIRGraph(nodes=nodes, edges=edges))
    return path
