"""Compiled steps of SSP-SLAM on vectors: coupling, tracking, the map of vectors, and the gate.

Each names its definition. They stand in one file because compiled steps call only those of their
own file, and one step of the algebraic tier is all of them. Fourier coefficients are arrays
``(..., n_frequencies, 2)``, real and imaginary part. Constants of a model are one array each, of
the type of the state, so that comparisons with them are those of the definitions.
"""

import math
from typing import NamedTuple

import numpy as np

from neuroslam.compiled import compiled

CANDIDATES = 4
REFINEMENTS = 6
LEAST_CURVATURE = 0.02  # least curvature of a wave, as a share of one in phase
CLEARLY_BETTER = 0.05  # excess of similarity at which another position is taken
COUPLINGS = ("none", "modules", "manifold")
KNOWN = 0.5  # strength of recall above which a landmark is known


class SpaceTables(NamedTuple):
    """What compiled steps take of a space.

    Attributes:
        waves: Wave vectors, ``(n_frequencies, dimension)``.
        bounds: ``(dimension, 2)``.
        longest: Longest step of Newton's method, ``(dimension,)``.
        modules: Frequencies of each module, ``(modules, n)``; none: ``(0, 0)``.
        points: Of the coarse search, ``(points, dimension)``.
        cosines: Waves at them, ``(n_frequencies, points)``.
        sines: The same.
        even: Discrete Fourier transform, cosines ``(n_frequencies, n_features)``.
        odd: Sines.
    """

    waves: np.ndarray
    bounds: np.ndarray
    longest: np.ndarray
    modules: np.ndarray
    points: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    even: np.ndarray
    odd: np.ndarray


class Sights(NamedTuple):
    """Inputs of some steps.

    Attributes:
        velocity: ``(steps, batch, dimension)``.
        key: Pointers of what is attended to, ``(steps, batch, n_key)``.
        vector: Where it is, ``(steps, batch, n_frequencies, 2)``.
        seen: Whether anything is, ``(steps, batch)``.
        held: For how long it has been attended to, the same shape.
        noise: Turns of the phases in rad, ``(steps, batch, n_frequencies)``; ``(0, 0, 0)``: none.
    """

    velocity: np.ndarray
    key: np.ndarray
    vector: np.ndarray
    seen: np.ndarray
    held: np.ndarray
    noise: np.ndarray


class VectorState(NamedTuple):
    """State of the algebraic tier, advanced in place; its buffers, with ``places`` empty or not."""

    phasor: np.ndarray
    position: np.ndarray
    weights: np.ndarray
    places: np.ndarray
    recalled: np.ndarray
    pull: np.ndarray
    familiar: np.ndarray
    contradicted: np.ndarray


def fourier_tables(n_features: int, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return the cosines and sines of the Fourier transform of vectors, without the constant."""
    k, j = np.arange(1, n_features // 2 + 1), np.arange(n_features)
    angle = 2.0 * np.pi * (np.outer(k, j) % n_features) / n_features
    return np.cos(angle).astype(dtype), np.sin(angle).astype(dtype)


@compiled
def copy(values: np.ndarray, into: np.ndarray) -> None:
    """Copy an array ``(n,)``: an assignment to a slice takes a second longer to compile."""
    for i in range(len(into)):
        into[i] = values[i]


@compiled
def encode(waves: np.ndarray, x: np.ndarray, z: np.ndarray) -> None:
    """Encode a position, ``(dimension,)``; ``SSPSpace.encode_fourier`` is the definition."""
    for k in range(waves.shape[0]):
        angle = 0.0
        for d in range(waves.shape[1]):
            angle += waves[k, d] * x[d]
        z[k, 0] = math.cos(angle)
        z[k, 1] = math.sin(angle)


@compiled
def similarity(waves: np.ndarray, z: np.ndarray, x: np.ndarray) -> float:
    """Return the similarity at a position; ``PositionDecoder.similarity`` is the definition."""
    total = 0.0
    for k in range(waves.shape[0]):
        angle = 0.0
        for d in range(waves.shape[1]):
            angle += waves[k, d] * x[d]
        total += z[k, 0] * math.cos(angle) + z[k, 1] * math.sin(angle)
    return total / waves.shape[0]


@compiled
def track(
    waves: np.ndarray, bounds: np.ndarray, longest: np.ndarray, z: np.ndarray, x: np.ndarray
) -> None:
    """Move a position by a step of Newton's method; ``PositionDecoder.track`` is the definition."""
    m = waves.shape[1]
    system = np.zeros((m, m + 1))
    for k in range(waves.shape[0]):
        angle = 0.0
        for d in range(m):
            angle += waves[k, d] * x[d]
        c, s = math.cos(angle), math.sin(angle)
        here, ahead = z[k, 0] * c + z[k, 1] * s, z[k, 1] * c - z[k, 0] * s
        here = max(here, LEAST_CURVATURE)
        for d in range(m):
            for e in range(m):
                system[d, e] += here * waves[k, d] * waves[k, e]
            system[d, m] += ahead * waves[k, d]
    for d in range(m):  # positive definite: no rows to exchange
        for e in range(d + 1, m):
            share = system[e, d] / system[d, d]
            for f in range(d, m + 1):
                system[e, f] -= share * system[d, f]
    for d in range(m - 1, -1, -1):
        step = system[d, m]
        for e in range(d + 1, m):
            step -= system[d, e] * system[e, m]
        step /= system[d, d]
        system[d, m] = step
    for d in range(m):
        step = min(max(system[d, m], -longest[d]), longest[d])
        x[d] = min(max(x[d] + step, bounds[d, 0]), bounds[d, 1])


@compiled
def search(space: tuple[np.ndarray, ...], z: np.ndarray, x: np.ndarray) -> float:
    """Decode a position over the whole space into ``x``; ``PositionDecoder`` is the definition.

    Returns:
        Its similarity.
    """
    waves, bounds, longest, points, cosines, sines = (
        space[0], space[1], space[2], space[4], space[5], space[6],
    )  # fmt: skip
    coarse = np.zeros(points.shape[0], dtype=z.dtype)
    for k in range(waves.shape[0]):
        real, imaginary, c, s = z[k, 0], z[k, 1], cosines[k], sines[k]
        for p in range(points.shape[0]):
            coarse[p] += real * c[p] + imaginary * s[p]
    best, at = -np.inf, np.empty_like(x)
    for _ in range(min(CANDIDATES, points.shape[0])):
        top = 0
        for p in range(points.shape[0]):
            if coarse[p] > coarse[top]:
                top = p
        coarse[top] = -np.inf
        copy(points[top], at)
        for _again in range(REFINEMENTS):
            track(waves, bounds, longest, z, at)
        alike = similarity(waves, z, at)
        if alike > best:
            best = alike
            copy(at, x)
    return best


@compiled
def couple(
    modules: np.ndarray,
    z: np.ndarray,
    here: np.ndarray,
    coupling: int,
    gain: float,
    pull: np.ndarray,
) -> None:
    """Add the coupling of the oscillators to ``pull``; ``path_integrator.coupled`` defines it.

    Args:
        modules: Frequencies of each module.
        z: Coefficients, ``(n_frequencies, 2)``.
        here: Those of the position.
        coupling: Number in ``COUPLINGS``.
        gain: Of the coupling.
        pull: Of the map; changed.
    """
    if coupling == 2:
        for k in range(z.shape[0]):
            pull[k, 0] += gain * (here[k, 0] - z[k, 0])
            pull[k, 1] += gain * (here[k, 1] - z[k, 1])
    elif coupling == 1:
        for i in range(modules.shape[0]):
            product = complex(1.0, 0.0)
            for j in range(modules.shape[1]):
                k = modules[i, j]
                product *= complex(z[k, 0], z[k, 1])
            turn = -math.atan2(product.imag, product.real) / modules.shape[1]
            c, s = math.cos(turn), math.sin(turn)
            for j in range(modules.shape[1]):
                k = modules[i, j]
                real, imaginary = z[k, 0], z[k, 1]
                pull[k, 0] += gain * (c * real - s * imaginary - real)
                pull[k, 1] += gain * (s * real + c * imaginary - imaginary)


@compiled
def locate(
    space: tuple[np.ndarray, ...],
    z: np.ndarray,
    x: np.ndarray,
    velocity: np.ndarray,
    dt: float,
    looks: bool,
    rereads: bool,
) -> None:
    """Track a position, in place; ``Packet.locate`` is the definition.

    Args:
        space: Its tables.
        z: Coefficients, ``(n_frequencies, 2)``.
        x: Position, ``(dimension,)``.
        velocity: ``(dimension,)``.
        dt: Length of a step.
        looks: Whether it is decoded nearby.
        rereads: Whether it is decoded over the whole space.
    """
    for d in range(x.shape[0]):
        x[d] += dt * velocity[d]
    if looks:
        track(space[0], space[1], space[2], z, x)
    if rereads:
        found = np.empty_like(x)
        best = search(space, z, found)
        if best > similarity(space[0], z, x) + CLEARLY_BETTER:
            copy(found, x)


@compiled
def to_features(even: np.ndarray, odd: np.ndarray, z: np.ndarray, features: np.ndarray) -> None:
    """Turn coefficients into a vector; ``SSPSpace.from_fourier`` is the definition."""
    n = features.shape[0]
    for j in range(n):
        features[j] = 0.5
    for k in range(z.shape[0]):
        real, imaginary, c, s = z[k, 0], z[k, 1], even[k], odd[k]
        for j in range(n):
            features[j] += real * c[j] - imaginary * s[j]
    for j in range(n):
        features[j] *= 2.0 / n


@compiled
def to_fourier(even: np.ndarray, odd: np.ndarray, features: np.ndarray, z: np.ndarray) -> None:
    """Turn a vector into coefficients; ``SSPSpace.to_fourier`` is the definition."""
    n, half = features.shape[0], z.shape[0]
    real, imaginary = np.empty(half, dtype=z.dtype), np.empty(half, dtype=z.dtype)
    for k in range(half):
        real[k], imaginary[k] = features[0], 0.0
    for j in range(1, half + 1):  # a cosine is even, a sine odd, and both alike in j and k
        both, apart = features[j] + features[n - j], features[n - j] - features[j]
        c, s = even[j - 1, 1:], odd[j - 1, 1:]
        for k in range(half):
            real[k] += both * c[k]
            imaginary[k] += apart * s[k]
    for k in range(half):
        z[k, 0], z[k, 1] = real[k], imaginary[k]


@compiled
def associate(
    weights: np.ndarray, key: np.ndarray, value: np.ndarray, rate: float, recall: np.ndarray
) -> None:
    """Recall a key's value, and learn in place; ``AlgebraicMap.forward`` is the definition.

    Args:
        weights: ``(n_value, n_key)``.
        key: ``(n_key,)``.
        value: ``(n_value,)``.
        rate: Share of the error that is learnt.
        recall: ``(n_value,)``; written.
    """
    square, n, change = 0.0, key.shape[0], np.empty(1, dtype=weights.dtype)
    for j in range(n):
        square += key[j] * key[j]
    square = max(square, 1e-6)
    for i in range(weights.shape[0]):
        row = weights[i]
        one = two = three = four = 0.0
        for j in range(n // 4):
            one += row[4 * j] * key[4 * j]
            two += row[4 * j + 1] * key[4 * j + 1]
            three += row[4 * j + 2] * key[4 * j + 2]
            four += row[4 * j + 3] * key[4 * j + 3]
        for j in range(n - n % 4, n):
            one += row[j] * key[j]
        recall[i] = (one + two) + (three + four)
        if rate != 0.0:
            change[0] = (value[i] - recall[i]) * rate / square
            for j in range(n):
                row[j] += change[0] * key[j]


@compiled
def strength_of(z: np.ndarray) -> float:
    """Return the root of the mean square of coefficients."""
    total = 0.0
    for k in range(z.shape[0]):
        total += z[k, 0] * z[k, 0] + z[k, 1] * z[k, 1]
    return math.sqrt(total / z.shape[0])


@compiled
def before_recall(
    recalled: np.ndarray,
    held: float,
    contradicted: float,
    seen: bool,
    model: np.ndarray,
    flags: np.ndarray,
    now: np.ndarray,
) -> None:
    """Decide how much an animal learns; ``SSPSLAM._step`` is the definition.

    Args:
        recalled: Coefficients of the last recall, ``(n_frequencies, 2)``.
        held: For how long the landmark has been attended to.
        contradicted: For how long known landmarks have contradicted.
        seen: Whether a landmark is in view.
        model: See ``SSPSLAM._gate_constants``.
        flags: See ``SSPSLAM._gate_constants``.
        now: Strength, lost, settled, learns and plasticity, ``(5,)``; written.
    """
    novelty, never, quantised = flags[0], flags[1], flags[2]
    now[0] = strength_of(recalled)
    lost = contradicted > model[1] and not never
    settled = held > model[0]
    learns = settled and (contradicted <= 0.0 or never)
    if quantised:
        learns = seen
    now[1], now[2], now[3], now[4] = lost, settled, learns, learns
    if novelty and learns:
        now[4] = min(max(1.0 - now[0] * now[0], model[2]), 1.0)


@compiled
def after_recall(
    implied: np.ndarray,
    here: np.ndarray,
    seen: bool,
    familiar: np.ndarray,
    contradicted: np.ndarray,
    now: np.ndarray,
    model: np.ndarray,
    never: bool,
    said: np.ndarray,
    pull: np.ndarray,
) -> None:
    """Open the gate, and make the correction; ``SSPSLAM._step`` is the definition.

    Args:
        implied: Position that the recall implies, ``(n_frequencies, 2)``.
        here: Estimated position, the same shape.
        seen: Whether a landmark is in view.
        familiar: Of each animal of one, ``(1,)``; changed.
        contradicted: The same.
        now: See :func:`before_recall`.
        model: See ``SSPSLAM._gate_constants``.
        never: Whether an animal is never lost.
        said: Agreement and gate, ``(2,)``; written.
        pull: ``(n_frequencies, 2)``; written.
    """
    total = 0.0
    for k in range(here.shape[0]):
        total += implied[k, 0] * here[k, 0] + implied[k, 1] * here[k, 1]
    said[0] = total / here.shape[0]
    strength, lost, settled = now[0], now[1] != 0.0, now[2] != 0.0
    if not settled:
        familiar[0] = strength > KNOWN
    known = familiar[0] and settled and seen
    said[1] = 1.0 / (1.0 + math.exp((model[5] - said[0]) / model[6])) if known else 0.0
    if known:
        said[2] = said[0] / max(strength, KNOWN)
        if said[2] < model[3]:
            contradicted[0] += model[4]
        if said[2] > model[9]:
            contradicted[0] = 0.0
    gain = model[8] if lost and known else model[7] * said[1]
    size = max(strength_of(implied), 1e-3)
    for k in range(here.shape[0]):
        pull[k, 0] = gain * (implied[k, 0] / size - here[k, 0])
        pull[k, 1] = gain * (implied[k, 1] / size - here[k, 1])


@compiled
def advance(
    space: tuple[np.ndarray, ...],
    inputs: tuple[np.ndarray, ...],
    state: tuple[np.ndarray, ...],
    age: int,
    walk: np.ndarray,
    model: np.ndarray,
    flags: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Advance SSP-SLAM of the algebraic tier by some steps; ``SSPSLAM._step`` is the definition.

    Args:
        space: ``SpaceTables`` as a tuple.
        inputs: ``Sights`` as a tuple.
        state: ``VectorState`` as a tuple; advanced in place.
        age: Steps of the path integrator so far.
        walk: Time step, gain of the coupling, share of a correction in a step, share of the error
            that the map learns in one.
        model: See ``SSPSLAM._gate_constants``.
        flags: The same; then number of the coupling, and steps between two decodings nearby and
            over the whole space.

    Returns:
        Position, coefficients, and strength, agreement, gate and lost of each step.
    """
    velocity, key, vector, seen, held, noise = inputs
    phasor, position, weights, places, recalled, pull, familiar, contradicted = state
    waves, even, odd = space[0], space[7], space[8]
    steps, batch, m = velocity.shape
    n, n_features = waves.shape[0], even.shape[1]
    kind = position.dtype
    positions = np.empty((steps, batch, m), dtype=kind)
    zs = np.empty((steps, batch, n, 2), dtype=kind)
    says = np.zeros((steps, batch, 4), dtype=kind)  # strength, agreement, gate, lost
    here, place = np.empty((n, 2), dtype=kind), np.empty((n, 2), dtype=kind)
    implied = np.empty((n, 2), dtype=kind)
    value, recall = np.empty(n_features, dtype=kind), np.empty(n_features, dtype=kind)
    named = np.empty(places.shape[1], dtype=kind)
    now, said = np.zeros(5, dtype=kind), np.zeros(3, dtype=kind)
    dt, coupling, corrected, learnt = walk[0], walk[1], walk[2], walk[3]
    for b in range(batch):
        x, z = position[b], phasor[b]
        encode(waves, x, here)
        for t in range(steps):
            sees, v = seen[t, b], velocity[t, b]
            couple(space[3], z, here, flags[3], coupling, pull[b])
            for k in range(n):
                real = z[k, 0] + corrected * pull[b, k, 0]
                imaginary = z[k, 1] + corrected * pull[b, k, 1]
                turn = 0.0
                for d in range(m):
                    turn += waves[k, d] * (v[d] * dt)
                if noise.shape[0] > 0:
                    turn += noise[t, b, k]
                size = max(math.sqrt(real * real + imaginary * imaginary), 1e-6)
                c, s = math.cos(turn) / size, math.sin(turn) / size
                z[k, 0], z[k, 1] = c * real - s * imaginary, c * imaginary + s * real
            passed = age + t + 1
            locate(space, z, x, v, dt, passed % flags[4] == 0, passed % flags[5] == 0)
            encode(waves, x, here)
            before_recall(recalled[b], held[t, b], contradicted[b], sees, model, flags, now)
            if sees:
                for k in range(n):
                    c, s = vector[t, b, k, 0], vector[t, b, k, 1]
                    place[k, 0] = here[k, 0] * c - here[k, 1] * s
                    place[k, 1] = here[k, 0] * s + here[k, 1] * c
                to_features(even, odd, place, value)
                associate(weights[b], key[t, b], value, now[4] * learnt, recall)
                to_fourier(even, odd, recall, recalled[b])
                if places.shape[0] > 0:
                    associate(places[b], value, key[t, b], now[3] * learnt, named)
                for k in range(n):
                    c, s = vector[t, b, k, 0], vector[t, b, k, 1]
                    implied[k, 0] = recalled[b, k, 0] * c + recalled[b, k, 1] * s
                    implied[k, 1] = recalled[b, k, 1] * c - recalled[b, k, 0] * s
            else:  # the key is zero
                for k in range(n):
                    recalled[b, k, 0] = recalled[b, k, 1] = 0.0
                    implied[k, 0] = implied[k, 1] = 0.0
            after_recall(
                implied, here, sees, familiar[b : b + 1], contradicted[b : b + 1], now, model,
                flags[1] != 0, said, pull[b],
            )  # fmt: skip
            copy(x, positions[t, b])
            for k in range(n):
                zs[t, b, k, 0], zs[t, b, k, 1] = z[k, 0], z[k, 1]
            says[t, b, 0], says[t, b, 1], says[t, b, 2], says[t, b, 3] = (
                now[0], said[0], said[1], now[1],
            )  # fmt: skip
    return positions, zs, says


@compiled
def oscillators_before(
    waves: np.ndarray,
    modules: np.ndarray,
    output: np.ndarray,
    recurrent: np.ndarray,
    external: np.ndarray,
    fastest: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    pull: np.ndarray,
    coupling: int,
    walk: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Make the inputs of oscillators; ``PathIntegrator.forward`` and ``drive`` are the definition.

    Args:
        waves: Wave vectors.
        modules: Frequencies of each module.
        output: ``(n_frequencies, batch, 2)``.
        recurrent: The same shape.
        external: The same.
        fastest: Highest rate of each, ``(n_frequencies,)``.
        position: ``(batch, dimension)``.
        velocity: The same shape.
        pull: Correction, ``(batch, n_frequencies, 2)``.
        coupling: Number in ``COUPLINGS``.
        walk: Gain of the coupling, share that is kept of ``external``, of ``recurrent`` and of
            ``output``, time step.

    Returns:
        The inputs, ``(n_frequencies, batch, 3)``, and ``external`` after the step.
    """
    n, batch = output.shape[0], output.shape[1]
    x = np.empty((n, batch, 3), dtype=output.dtype)
    later = np.empty_like(external)
    z, here = np.empty((n, 2), dtype=output.dtype), np.empty((n, 2), dtype=output.dtype)
    inner = np.empty((n, 2), dtype=output.dtype)
    for b in range(batch):
        for k in range(n):
            inner[k, 0], inner[k, 1] = pull[b, k, 0], pull[b, k, 1]
            z[k, 0], z[k, 1] = output[k, b, 0], output[k, b, 1]
        if coupling > 0:
            encode(waves, position[b], here)
            couple(modules, z, here, coupling, walk[0], inner)
        for k in range(n):
            share = 0.0
            for d in range(waves.shape[1]):
                share += velocity[b, d] * (waves[k, d] / fastest[k])
            x[k, b, 0] = recurrent[k, b, 0] + external[k, b, 0]
            x[k, b, 1] = recurrent[k, b, 1] + external[k, b, 1]
            x[k, b, 2] = min(max(share, -1.0), 1.0)
            for i in range(2):
                later[k, b, i] = inner[k, i] + walk[1] * (external[k, b, i] - inner[k, i])
    return x, later


@compiled
def oscillators_after(
    decoded: np.ndarray,
    recurrent: np.ndarray,
    output: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    walk: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Filter what oscillators say, and move the position; see :func:`oscillators_before`.

    Args:
        decoded: ``(n_frequencies, batch, 4)``.
        recurrent: See :func:`oscillators_before`.
        output: The same.
        position: The same.
        velocity: The same.
        walk: The same.

    Returns:
        ``recurrent``, ``output``, coefficients ``(batch, n_frequencies, 2)`` and ``position`` after
        the step.
    """
    n, batch = output.shape[0], output.shape[1]
    again, read = np.empty_like(recurrent), np.empty_like(output)
    z, x = np.empty((batch, n, 2), dtype=output.dtype), np.empty_like(position)
    for k in range(n):
        for b in range(batch):
            for i in range(2):
                value = decoded[k, b, i]
                again[k, b, i] = value + walk[2] * (recurrent[k, b, i] - value)
                value = decoded[k, b, 2 + i]
                read[k, b, i] = z[b, k, i] = value + walk[3] * (output[k, b, i] - value)
    for b in range(batch):
        for d in range(position.shape[1]):
            x[b, d] = position[b, d] + walk[4] * velocity[b, d]
    return again, read, z, x


@compiled
def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply coefficients, ``(batch, n_frequencies, 2)``: bind their vectors."""
    product = np.empty_like(a)
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            product[i, k, 0] = a[i, k, 0] * b[i, k, 0] - a[i, k, 1] * b[i, k, 1]
            product[i, k, 1] = a[i, k, 0] * b[i, k, 1] + a[i, k, 1] * b[i, k, 0]
    return product
