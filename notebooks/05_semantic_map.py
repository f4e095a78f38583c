# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A semantic map
# An animal walks among landmarks with attributes: a blue square, an orange triangle, a wall. Its position
# is a vector whose phases rotate with its velocity; each landmark in sight is bound to that vector and
# learnt. Afterwards the map answers queries: where are the blue objects, what is in this area, how far is it?
# (SSP-SLAM; Dumont, Furlong, Orchard and Eliasmith 2023.)

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam.config.semantic import PathIntegratorConfig, SemanticMapConfig, SSPSLAMConfig
from neuroslam.experiments.ssp_map import similarity_map
from neuroslam.experiments.ssp_simulation import integrate, pointers_of, simulate, slam_in, views
from neuroslam.figures.landmarks import Query, plot_area, plot_queries
from neuroslam.figures.spikes import plot_errors, plot_rasters, plot_signals, plot_trials
from neuroslam.figures.style import INK, MAP, STYLE
from neuroslam.spiking import PositionDecoder, SSPSpace, bind, queries, unbind
from neuroslam.spiking.joining import merge_semantic_maps
from neuroslam.worlds.landmark_paths import band_limited_path
from neuroslam.worlds.landmarks import paper_world, random_world

torch.set_num_threads(1)
plt.rcParams.update(STYLE)

# %% [markdown]
# ## Positions as vectors
# Binding two vectors adds their positions, so a map can be moved without being decoded. The similarity of two
# vectors falls with distance, with ripples; its width is the spatial resolution.
#
# **What to see:** one peak, half as high 0.14 m away, and ripples below 0.2.

# %%
space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)
here, step = torch.tensor([0.2, -0.1]), torch.tensor([0.3, 0.4])
moved = bind(space.encode(here), space.encode(step))
found = PositionDecoder(space)(space.to_fourier(moved).unsqueeze(0)).position_m[0]
print("moved to", [round(x, 3) for x in found.tolist()])

offset = torch.linspace(-1, 1, 201)
across = torch.stack([offset, torch.zeros_like(offset)], dim=-1)
figure, axes = plt.subplots(figsize=(6.5, 2.8), layout="constrained")
axes.plot(offset, space.kernel(across), color=MAP)
axes.axhline(0, color=INK, lw=0.6)
axes.set(
    xlabel="distance (m)", ylabel="similarity", title="Similarity of two positions", xlim=(-1, 1)
)
plt.show()

# %% [markdown]
# ## A world, a walk, a map
# The tier `algebraic` uses vectors only; `rate` and `spiking` implement the same parts with neurons.

# %%
world = paper_world()
path = band_limited_path(60.0, 0.06, seed=4, time_step_s=0.01, reach_m=0.95)
config = SSPSLAMConfig(
    tier="algebraic",
    time_step_s=0.01,
    space={"n_rotations": 5, "n_scales": 5, "reach_m": 1.2},
    places=True,
)
slam = slam_in(config, world)
life = simulate(slam, [world], [path])
print(f"error {1000 * life.ate_m[0]:.2f} mm; seen for", life.seen_s[0].round(1).tolist(), "s")

# %% [markdown]
# ## Queries
# Sums of pointers recall sums of positions; a wall is a region.
#
# **What to see:** the peaks lie in the rings, and the wall is warm along its whole length.

# %%
words = pointers_of(world, slam.space.n_features)
asked = {
    "BLUE * TRIANGLE": ["BLUE_TRIANGLE"],
    "BLUE * (SQUARE + TRIANGLE)": ["BLUE_SQUARE", "BLUE_TRIANGLE"],
    "WALL": ["WALL"],
}
answers = [
    Query(said, similarity_map(slam, queries.recall(slam, words.parse(said))), names)
    for said, names in asked.items()
]
plot_queries(world, path.position_m, answers, "What the map answers")

# %% [markdown]
# A second memory maps positions to pointers; the vector of an area is its key.
#
# **What to see:** the square and the orange triangle are in the area, the blue triangle is not. The wall is
# not in it either, yet scores just above the threshold: it is long and was in view for 6.8 s (the square for
# 2.1 s), and the memory answers "wall" a little (0.05 to 0.09) at every position of the box. One vector for the
# whole area adds this up over 1.3 m².

# %%
low, high = np.array([-0.45, -0.45]), np.array([0.9, 0.5])
plot_area(world, low, high, queries.what(slam, low, high), "What is in the area?")

# %% [markdown]
# A weak answer everywhere and a strong answer at one position differ if the positions are asked one by one:
# the largest answer at any of 560 positions of the box, relative to that at the landmark's own positions.
#
# **What to see:** the wall is far below the threshold; the blue triangle, 0.15 m outside of the area, is just
# below it.

# %%
x, y = np.meshgrid(np.linspace(low[0], high[0], 28), np.linspace(low[1], high[1], 20))
grid = torch.from_numpy(np.column_stack([x.ravel(), y.ravel()])).float()


def strongest(name, positions):
    """Return the largest answer of a pointer at some positions."""
    said = slam.places.read(slam.space.encode(positions)).reshape(len(positions), -1)
    pointer = slam.pointers[slam.names.index(name)]
    return (said @ pointer / pointer.square().sum()).max().item()


amounts = {}
for landmark in world.landmarks:
    if landmark.is_point:
        own = torch.tensor(np.array([landmark.position_m])).float()
    else:
        own = torch.tensor(np.array([np.mean(box, axis=0) for box in landmark.boxes_m])).float()
    amounts[landmark.name] = strongest(landmark.name, grid) / strongest(landmark.name, own)
plot_area(world, low, high, amounts, "What is in the area, position by position?")

# %% [markdown]
# One vector can hold the whole map: the sum of all pointers, each bound to its position.
#
# **What to see:** unbound by a pointer, the vector is similar to the position of that landmark, with noise.

# %%
whole = queries.whole_map(slam)
parts = []
for landmark in world.landmarks:
    place = unbind(whole, words.parse(landmark.pointer))
    parts.append(
        Query(landmark.pointer, similarity_map(slam, slam.space.to_fourier(place)), [landmark.name])
    )
plot_queries(world, None, parts, "The whole map in one vector, unbound")

# %% [markdown]
# ## Noise, and correction by landmarks
# Phase noise makes the position estimate drift; coupled oscillators drift less, and landmarks that are seen
# again correct the estimate.
#
# **What to see:** uncoupled, the estimate jumps about; coupled, it drifts; with a map, it drifts less.

# %%
noisy = {"tier": "algebraic", "time_step_s": 0.01}
alone = PathIntegratorConfig(phase_noise_rad=0.3, coupling="none")
coupled = PathIntegratorConfig(phase_noise_rad=0.3)
ten = random_world(10, seed=1)
walk = band_limited_path(60.0, 0.08, seed=3, time_step_s=0.01)
drift = integrate(slam_in(SSPSLAMConfig(**noisy, integrator=alone), ten), [walk])
kept = integrate(slam_in(SSPSLAMConfig(**noisy, integrator=coupled), ten), [walk])
closed = simulate(slam_in(SSPSLAMConfig(**noisy, integrator=coupled), ten), [ten], [walk])
at = np.array([landmark.position_m for landmark in ten.landmarks])
plot_trials(
    {
        f"{name}|ATE {each.ate_m[0]:.3f} m": (
            each.truth_m[:, 0],
            at,
            {"estimate": each.position_m[:, 0]},
        )
        for name, each in {"uncoupled": drift, "coupled": kept, "with a map": closed}.items()
    },
    "Phase noise 0.3 rad/√s",
)

# %% [markdown]
# **What to see:** errors grow until landmarks are seen again.

# %%
panels = {
    "distance error (m)": {
        "uncoupled": drift.error_m,
        "coupled": kept.error_m,
        "with a map": closed.error_m,
    }
}
plot_errors(drift.time_s, panels, "The same over time")

# %% [markdown]
# ## The same in spikes
# Each oscillator is a population; an associative memory of neurons learns the position of each pointer.
#
# **What to see:** the object-vector cells and the memory are silent until something comes into view.

# %%
spiking = SSPSLAMConfig(
    integrator=PathIntegratorConfig(neurons=200),
    map=SemanticMapConfig(neurons=200),
    binding="exact",
)
animal = slam_in(spiking, ten)
fired = {"oscillators": [], "object-vector cells": [], "memory": []}


def watch(_step, _said):
    parts = (animal.integrator.neurons, animal.vectors.neurons, animal.map.memory)
    for kept_spikes, part in zip(fired.values(), parts, strict=True):
        kept_spikes.append(
            part.spikes[:, 0].flatten()[:: max(1, part.n_neurons // 100)].numpy().copy()
        )


seen = ten.observe(walk.position_m).in_view.any(-1)
enters = np.flatnonzero(seen[1:] & ~seen[:-1])[0]  # steps of 10 ms
short = walk.resampled(1e-3)
first = max(0, 10 * int(enters) - 300)
steps = slice(first, first + 2000)
animal.start(torch.from_numpy(short.position_m[first : first + 1]))
said = animal.run(
    torch.from_numpy(short.velocity_m_s[steps, None]),
    views([ten], short.position_m[steps, None]),
    watch,
)
error = np.linalg.norm(said.position_m[:, 0].numpy() - short.position_m[steps], axis=-1)
print(f"{animal.n_neurons} neurons, error {1000 * error.mean():.1f} mm over two seconds")
plot_rasters(
    {name: np.stack(spikes) for name, spikes in fired.items()},
    1e-3,
    0.0,
    "A landmark comes into view",
)

# %% [markdown]
# **What to see:** the recall of the memory grows from zero; the gate stays shut, because a position learnt
# during this visit adds no information to the estimate.

# %%
names = ("recall", "agreement", "gate")
plot_signals(
    1e-3 * np.arange(len(error)),
    {name: getattr(said, name)[:, 0].numpy() for name in names},
    "A landmark is learnt",
)

# %% [markdown]
# ## Two sessions, one map
# Another animal starts elsewhere, with its own origin, and knows some of the same landmarks. The maps are
# aligned by the landmarks known to both.

# %%
shift = np.array([0.15, -0.1])
first_map, second_map = (slam_in(SSPSLAMConfig(**noisy), ten) for _ in range(2))
simulate(first_map, [ten], [walk.first(35.0)])
later = walk._replace(position_m=walk.position_m[3000:])
start = torch.from_numpy(later.position_m[:1] + shift).clamp(-1, 1)
second_map.start(start)
second_map.run(
    torch.from_numpy(later.velocity_m_s[:, None]), views([ten], later.position_m[:, None])
)
merged, report = merge_semantic_maps(first_map, second_map)
print(report.reason, "· moved by", [round(x, 3) for x in report.offset_m], "· added", report.added)
