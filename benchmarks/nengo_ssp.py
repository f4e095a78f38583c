"""The reference's networks of SSP-SLAM in Nengo, to be timed beside ours; never imported by these.

Built after the description of the model: as many populations, neurons and connections.
"""

import nengo
import numpy as np

TAU_S, FAST_S = 0.05, 0.005
D, K = 55, 27


def path_integrator(neurons: int, rng: np.random.RandomState):
    """28 populations of three dimensions, 27 of them oscillators; SSP in, SSP out."""
    dft = rng.standard_normal((3 * (K + 1), D)) / np.sqrt(D)
    start, speed = nengo.Node(np.zeros(D)), nengo.Node([0.1, 0.1])
    out = nengo.Node(size_in=D)
    constant = nengo.Node([1.0, 0.0, 0.0])

    def turn(x):
        r = max(np.hypot(x[0], x[1]), 1e-9)
        pull, w = (1.0 - r * r) / r, 4.0 * x[2]
        return (
            x[0] + TAU_S * (x[0] * pull - x[1] * w),
            x[1] + TAU_S * (x[1] * pull + x[0] * w),
            0.0,
        )

    array = nengo.networks.EnsembleArray(neurons, K + 1, ens_dimensions=3, radius=np.sqrt(2))
    for k, population in enumerate(array.ea_ensembles):
        if k == 0:
            nengo.Connection(constant, population, synapse=None)
            continue
        nengo.Connection(population, population, function=turn, synapse=TAU_S)
        nengo.Connection(speed, population[2], transform=rng.standard_normal((1, 2)), synapse=None)
    nengo.Connection(start, array.input, transform=dft, synapse=FAST_S)
    nengo.Connection(array.output, out, transform=dft.T, synapse=FAST_S)
    return start, out


def whole(neurons: int, memory: int, product: int, rng: np.random.RandomState):
    """Path integrator, object-vector cells, two circular convolutions, associative memory."""
    start, out = path_integrator(neurons, rng)
    grid = rng.standard_normal((10_000, D))
    grid /= np.linalg.norm(grid, axis=1, keepdims=True)
    key, vector = (nengo.Node(v / np.linalg.norm(v)) for v in rng.standard_normal((2, D)))
    away = nengo.Node([0.0])
    clean = nengo.Node(lambda _t, x: grid[np.argmax(grid @ x)], size_in=D, size_out=D)
    nengo.Connection(out, clean, synapse=0.01)
    objects = nengo.Ensemble(memory, D)
    nengo.Connection(vector, objects, synapse=None)
    place = nengo.networks.CircularConvolution(product, D)
    nengo.Connection(clean, place.input_a, synapse=None)
    nengo.Connection(objects, place.input_b, synapse=0.01)
    store = nengo.Ensemble(memory, D, intercepts=nengo.dists.Choice([0.1]))
    recall, error = nengo.Ensemble(memory, D), nengo.Ensemble(memory, D)
    nengo.Connection(
        key, store, synapse=None, learning_rule_type=nengo.Voja(1e-4, post_synapse=None)
    )
    learnt = nengo.Connection(
        store, recall, function=lambda _x: np.zeros(D), learning_rule_type=nengo.PES(5e-3)
    )
    nengo.Connection(recall, error, synapse=TAU_S)
    nengo.Connection(place.output, error, transform=-1, synapse=TAU_S)
    nengo.Connection(error, learnt.learning_rule, synapse=TAU_S)
    nengo.Connection(away, error.neurons, transform=-2.5 * np.ones((memory, 1)), synapse=None)
    told = nengo.networks.CircularConvolution(product, D, invert_b=True)
    nengo.Connection(recall, told.input_a, synapse=0.01)
    nengo.Connection(objects, told.input_b, synapse=0.01)

    def gate(_t, x):
        a, b = x[:D], x[D:]
        return 0.2 * (a - b) if a @ b > 0.2 else np.zeros(D)

    corrected = nengo.Node(gate, size_in=2 * D, size_out=D)
    nengo.Connection(told.output, corrected[:D], synapse=0.01)
    nengo.Connection(out, corrected[D:], synapse=0.01)
    array_input = start  # corrections enter where the start does
    adder = nengo.Node(size_in=D)
    nengo.Connection(corrected, adder, synapse=None)
    return array_input, adder


def simulator(build, *sizes, seed: int = 0) -> nengo.Simulator:
    rng = np.random.RandomState(seed)
    with nengo.Network(seed=seed) as network:
        build(*sizes, rng)
    return nengo.Simulator(network, dt=1e-3, progress_bar=False, optimize=True)
