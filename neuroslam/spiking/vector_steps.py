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


class Scratch(NamedTuple):
    """Results of steps of the algebraic tier, and room for what they compute.

    Attributes:
        position: Results, ``(steps, batch, dimension)``.
        z: Coefficients, ``(steps, batch, n_frequencies, 2)``.
        says: Strength, agreement, gate and lost, ``(steps, batch, 4)``.
        room: For one animal: three times coefficients, two vectors, a key, and numbers.
    """

    position: np.ndarray
    z: np.ndarray
    says: np.ndarray
    room: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, inputs: Sights, n_features: int) -> "Scratch":
        """Make room for some steps."""
        (steps, batch, m), n, kind = inputs.velocity.shape, n_features // 2, inputs.velocity.dtype
        shapes = [(n, 2)] * 3 + [(n_features,)] * 2 + [inputs.key.shape[2:], (5,), (3,)]
        return cls(
            np.empty((steps, batch, m), dtype=kind),
            np.empty((steps, batch, n, 2), dtype=kind),
            np.empty((steps, batch, 4), dtype=kind),
            tuple(np.zeros(shape, dtype=kind) for shape in shapes),
        )


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
    system = np.empty((m, m + 1), dtype=np.float64)
    for d in range(m):
        for e in range(m + 1):
            system[d, e] = 0.0
    for k in range(waves.shape[0]):
        angle = 0.0
        for d in range(m):
            angle += waves[k, d] * x[d]
        c, s = math.cos(angle), math.sin(angle)
        here, ahead = z[k, 0] * c + z[k, 1] * s, z[k, 1] * c - z[k, 0] * s
        here = here if here > LEAST_CURVATURE else LEAST_CURVATURE
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
        step, low, high = system[d, m], bounds[d, 0], bounds[d, 1]
        step = -longest[d] if step < -longest[d] else step
        at = x[d] + (longest[d] if step > longest[d] else step)
        at = low if at < low else at
        x[d] = high if at > high else at


@compiled
def search(space: tuple[np.ndarray, ...], z: np.ndarray, x: np.ndarray) -> float:
    """Decode a position over the whole space into ``x``; ``PositionDecoder`` is the definition.

    Returns:
        Its similarity.
    """
    waves, bounds, longest, points, cosines, sines = (
        space[0], space[1], space[2], space[4], space[5], space[6],
    )  # fmt: skip
    coarse = np.empty(points.shape[0], dtype=z.dtype)
    for p in range(points.shape[0]):
        coarse[p] = 0.0
    for k in range(waves.shape[0]):
        real, imaginary, c, s = z[k, 0], z[k, 1], cosines[k], sines[k]
        for p in range(points.shape[0]):
            coarse[p] += real * c[p] + imaginary * s[p]
    best, at = -np.inf, np.empty(x.shape[0], dtype=z.dtype)
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
            even, odd = 1.0, 0.0
            for j in range(modules.shape[1]):
                c, s = z[modules[i, j], 0], z[modules[i, j], 1]
                even, odd = even * c - odd * s, even * s + odd * c
            turn = -math.atan2(odd, even) / modules.shape[1]
            c, s = math.cos(turn), math.sin(turn)
            for j in range(modules.shape[1]):
                k = modules[i, j]
                real, imaginary = z[k, 0], z[k, 1]
                pull[k, 0] += gain * (c * real - s * imaginary - real)
                pull[k, 1] += gain * (s * real + c * imaginary - imaginary)


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
    square = square if square > 1e-6 else 1e-6
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
        share = 1.0 - now[0] * now[0]
        now[4] = share if share > model[2] else model[2]


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
        said[2] = said[0] / (strength if strength > KNOWN else KNOWN)
        if said[2] < model[3]:
            contradicted[0] += model[4]
        if said[2] > model[9]:
            contradicted[0] = 0.0
    else:
        left = contradicted[0] - model[10]
        contradicted[0] = left if left > 0.0 else 0.0
    gain = model[8] if lost and known else model[7] * said[1]
    size = strength_of(implied)
    size = size if size > 1e-3 else 1e-3
    for k in range(here.shape[0]):
        pull[k, 0] = gain * (implied[k, 0] / size - here[k, 0])
        pull[k, 1] = gain * (implied[k, 1] / size - here[k, 1])


@compiled
def advance(
    space: tuple[np.ndarray, ...],
    inputs: tuple[np.ndarray, ...],
    state: tuple[np.ndarray, ...],
    scratch: tuple[np.ndarray, ...],
    walk: np.ndarray,
    model: np.ndarray,
    flags: np.ndarray,
) -> None:
    """Advance SSP-SLAM of the algebraic tier by some steps; ``SSPSLAM._step`` is the definition.

    Args:
        space: ``SpaceTables`` as a tuple.
        inputs: ``Sights`` as a tuple.
        state: ``VectorState`` as a tuple; advanced in place.
        scratch: ``Scratch`` as a tuple; written.
        walk: Time step, gain of the coupling, share of a correction in a step, share of the error
            that the map learns in one.
        model: See ``SSPSLAM._gate_constants``.
        flags: The same; then number of the coupling, steps of the path integrator so far, steps
            between two decodings of the position, and which half of a step is made: 0 both, 1 path
            integration, 2 the map.
    """
    velocity, key, vector, seen, held, noise = inputs
    phasor, position, weights, places, recalled, pull, familiar, contradicted = state
    positions, zs, says, here, place, implied, value, recall, named, now, said = scratch
    waves, even, odd = space[0], space[7], space[8]
    steps, batch, m = velocity.shape
    n = waves.shape[0]
    dt, coupling, corrected, learnt = walk[0], walk[1], walk[2], walk[3]
    for b in range(batch):
        x, z = position[b], phasor[b]
        encode(waves, x, here)
        for t in range(steps):
            sees, v = seen[t, b], velocity[t, b]
            if flags[6] != 2:
                couple(space[3], z, here, flags[3], coupling, pull[b])
            for k in range(n if flags[6] != 2 else 0):
                real = z[k, 0] + corrected * pull[b, k, 0]
                imaginary = z[k, 1] + corrected * pull[b, k, 1]
                turn = 0.0
                for d in range(m):
                    turn += waves[k, d] * (v[d] * dt)
                if noise.shape[0] > 0:
                    turn += noise[t, b, k]
                size = math.sqrt(real * real + imaginary * imaginary)
                size = size if size > 1e-6 else 1e-6
                c, s = math.cos(turn) / size, math.sin(turn) / size
                z[k, 0], z[k, 1] = c * real - s * imaginary, c * imaginary + s * real
            if flags[6] != 2:
                for d in range(m):
                    x[d] += dt * v[d]
                if (flags[4] + t + 1) % flags[5] == 0:
                    track(waves, space[1], space[2], z, x)
                encode(waves, x, here)
            if flags[6] == 1:
                copy(x, positions[t, b])
                for k in range(n):
                    zs[t, b, k, 0], zs[t, b, k, 1] = z[k, 0], z[k, 1]
                    pull[b, k, 0] = pull[b, k, 1] = 0.0
                continue
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


@compiled
def oscillators_before(
    waves: np.ndarray,
    output: np.ndarray,
    recurrent: np.ndarray,
    external: np.ndarray,
    fastest: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    pull: np.ndarray,
    manifold: bool,
    walk: np.ndarray,
    x: np.ndarray,
    later: np.ndarray,
) -> None:
    """Make the inputs of oscillators; ``PathIntegrator.forward`` and ``drive`` are the definition.

    Args:
        waves: Wave vectors.
        output: ``(n_frequencies, batch, 2)``.
        recurrent: The same shape.
        external: The same.
        fastest: Highest rate of each, ``(n_frequencies,)``.
        position: ``(batch, dimension)``.
        velocity: The same shape.
        pull: Correction, ``(batch, n_frequencies, 2)``.
        manifold: Whether all oscillators agree on one position; for the other coupling see
            :func:`couple`.
        walk: Gain of the coupling, share that is kept of ``external``, of ``recurrent`` and of
            ``output``, time step.
        x: The inputs, ``(n_frequencies, batch, 3)``; written.
        later: ``external`` after the step; written.
    """
    for b in range(output.shape[1]):
        for k in range(output.shape[0]):
            angle = share = 0.0
            for d in range(waves.shape[1]):
                angle += waves[k, d] * position[b, d]
                share += velocity[b, d] * (waves[k, d] / fastest[k])
            even, odd = pull[b, k, 0], pull[b, k, 1]
            if manifold:
                even += walk[0] * (math.cos(angle) - output[k, b, 0])
                odd += walk[0] * (math.sin(angle) - output[k, b, 1])
            x[k, b, 0] = recurrent[k, b, 0] + external[k, b, 0]
            x[k, b, 1] = recurrent[k, b, 1] + external[k, b, 1]
            share = -1.0 if share < -1.0 else share
            x[k, b, 2] = 1.0 if share > 1.0 else share
            later[k, b, 0] = even + walk[1] * (external[k, b, 0] - even)
            later[k, b, 1] = odd + walk[1] * (external[k, b, 1] - odd)


@compiled
def oscillators_after(
    decoded: np.ndarray,
    recurrent: np.ndarray,
    output: np.ndarray,
    walk: np.ndarray,
    again: np.ndarray,
    read: np.ndarray,
    z: np.ndarray,
) -> None:
    """Filter what oscillators say; see :func:`oscillators_before`.

    Args:
        decoded: ``(n_frequencies, batch, 4)``.
        recurrent: See :func:`oscillators_before`.
        output: The same.
        walk: The same.
        again: ``recurrent`` after the step; written.
        read: ``output`` after the step; written.
        z: The same, ``(batch, n_frequencies, 2)``; written.
    """
    for k in range(output.shape[0]):
        for b in range(output.shape[1]):
            for i in range(2):
                value = decoded[k, b, i]
                again[k, b, i] = value + walk[2] * (recurrent[k, b, i] - value)
                value = decoded[k, b, 2 + i]
                read[k, b, i] = z[b, k, i] = value + walk[3] * (output[k, b, i] - value)


@compiled
def times(a: np.ndarray, b: np.ndarray, product: np.ndarray) -> None:
    """Multiply coefficients, ``(batch, n_frequencies, 2)``, into a third array: bind vectors."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            product[i, k, 0] = a[i, k, 0] * b[i, k, 0] - a[i, k, 1] * b[i, k, 1]
            product[i, k, 1] = a[i, k, 0] * b[i, k, 1] + a[i, k, 1] * b[i, k, 0]


@compiled
def encode_each(waves: np.ndarray, position: np.ndarray, z: np.ndarray) -> None:
    """Encode positions, ``(batch, dimension)``, as :func:`encode` does each."""
    for b in range(position.shape[0]):
        encode(waves, position[b], z[b])


@compiled
def before_recalls(
    even: np.ndarray,
    odd: np.ndarray,
    place: np.ndarray,
    recalled: np.ndarray,
    held: np.ndarray,
    contradicted: np.ndarray,
    seen: np.ndarray,
    model: np.ndarray,
    flags: np.ndarray,
    value: np.ndarray,
    now: np.ndarray,
    learns: np.ndarray,
    plasticity: np.ndarray,
) -> None:
    """Do :func:`to_features` and :func:`before_recall` for each animal; all arrays lead with them.

    ``value`` is of ``place``; ``learns`` and ``plasticity`` are written besides ``now``.
    """
    for b in range(place.shape[0]):
        to_features(even, odd, place[b], value[b])
        before_recall(recalled[b], held[b], contradicted[b], seen[b], model, flags, now[b])
        learns[b], plasticity[b] = now[b, 3], now[b, 4]


@compiled
def fourier_of_recalls(
    even: np.ndarray,
    odd: np.ndarray,
    recall: np.ndarray,
    vector: np.ndarray,
    recalled: np.ndarray,
    back: np.ndarray,
) -> None:
    """Do :func:`to_fourier` for the recall of each animal, and write the conjugates of vectors."""
    for b in range(recall.shape[0]):
        to_fourier(even, odd, recall[b], recalled[b])
        for k in range(vector.shape[1]):
            back[b, k, 0], back[b, k, 1] = vector[b, k, 0], -vector[b, k, 1]


@compiled
def after_recalls(
    implied: np.ndarray,
    here: np.ndarray,
    seen: np.ndarray,
    familiar: np.ndarray,
    contradicted: np.ndarray,
    now: np.ndarray,
    model: np.ndarray,
    flags: np.ndarray,
    pull: np.ndarray,
    says: np.ndarray,
) -> None:
    """Do :func:`after_recall` for each animal; strength, agreement, gate and lost to ``says``."""
    said = np.zeros(3, dtype=pull.dtype)
    for b in range(implied.shape[0]):
        after_recall(
            implied[b], here[b], seen[b], familiar[b : b + 1], contradicted[b : b + 1], now[b],
            model, flags[1] != 0, said, pull[b],
        )  # fmt: skip
        says[b, 0], says[b, 1], says[b, 2], says[b, 3] = now[b, 0], said[0], said[1], now[b, 1]
