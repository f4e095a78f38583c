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
# # Cells of a rat
# An animal knows how fast it runs, where it heads, and how far the walls around are. It has no camera.
# Boundary cells, grid cells and place cells make a map from these. The arena and the animal are made here,
# so the truth is known and nothing has to be downloaded; the last cell reads a recording.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import NavigationBrain, open_source
from neuroslam.cells import LAHNGridCells, NavigationCells, VelocityOscillators
from neuroslam.cells.boundary import boundary_activity, boundary_zone
from neuroslam.config import BrainConfig, GridCellConfig, build_config, read_preset
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.experiments.animals import path_integration, position_errors, simulate
from neuroslam.figures.cells import Firing, draw_arena, plot_firing_maps, plot_grids
from neuroslam.figures.maps import plot_map
from neuroslam.figures.style import INK, LOOP, MAP, ODOMETRY, ROBOT, STYLE
from neuroslam.runs.merge import join_brains
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam

torch.set_num_threads(1)
plt.rcParams.update(STYLE)

arena = named_arena("pentagon")
walk = roam(arena, 5.0, np.random.default_rng(1), speed_m_s=0.15)
print(f"{walk.duration_s / 60:.0f} minutes, {len(walk.positions)} samples")

# %% [markdown]
# ## Walls
# A wall is the foot of the perpendicular on it. Where that lies beyond the wall's end there is no
# wall: corners are none.
#
# **What to see:** dashes run from places of the track to the walls that are felt there, within 0.3 m.
# None ends in a corner; near one there are two.

# %%
some = walk.positions[::60]
distance, bearing = arena.nearest_walls(some, reach_m=0.3, k=2)
figure, axes = plt.subplots(figsize=(5.4, 5.2), layout="constrained")
axes.plot(*walk.positions.T, color=ODOMETRY, lw=0.4)
for place, r, a in zip(some, distance, bearing, strict=True):
    for one, angle in zip(r[np.isfinite(r)], a[np.isfinite(r)], strict=True):
        foot = place + one * np.array([np.cos(angle), np.sin(angle)])
        axes.plot(*np.column_stack([place, foot]), color=LOOP, lw=0.9, ls=(0, (3, 2)))
draw_arena(axes, arena)
axes.set_title("The track, and the walls felt along it")
plt.show()

# %% [markdown]
# ## Boundary cells
# Their activity grows within half their reach of a wall, fades farther off, and ends beyond:
# $\dot h = \pm\tau\,(b - R)/b$. It gates a population of 24 bearings by 7 distances.
#
# **What to see:** the animal walks to a wall and back. The activity (blue) rises while the distance
# (black) is below 0.15 m, falls until 0.3 m, and is 0 then.

# %%
time_s = np.arange(0.0, 4.0, 0.02)
to_wall = np.abs(time_s - 2.0) * 0.25 + 0.02
activity, h = [], torch.tensor(0.0)
for r in to_wall:
    h = boundary_activity(h, torch.tensor(r), reach_m=0.3, rate_per_s=0.8, dt_s=0.02)
    activity.append(h.item())
zone = boundary_zone(torch.from_numpy(to_wall), 0.3).numpy()
figure, axes = plt.subplots(figsize=(7.5, 2.8), layout="constrained")
for number, name, colour in ((1, "attenuation", "#fbe3b0"), (2, "growth", "#b9e2d2")):
    axes.fill_between(time_s, 0, 0.8, where=zone == number, color=colour, lw=0, label=name)
axes.plot(time_s, to_wall, color=INK, label="distance to the wall (m)")
axes.plot(time_s, activity, color=MAP, label="activity of the cells")
axes.set(xlabel="time (s)", ylabel="metres; activity", ylim=(0, 0.8), xlim=(0, 4))
axes.set_title("To a wall and back")
figure.legend(loc="outside lower center", ncols=4)
plt.show()

# %% [markdown]
# ## A walk
# `NavigationCells` composes everything. Four animals take one walk as a batch, each with its own noise: 10 %
# in speed and 3° in the compass, at every sample.

# %%
rates, boundary = [], []


def note(i, here, cells):
    if i % 2 == 0:
        rates.append(cells.grid.rates[0].flatten().numpy().copy())
        boundary.append(cells.boundary.rates[0].flatten().numpy().copy())


life = simulate(walk, seeds=range(4), hook=note)
bins = Bins.around(arena.outlines[0], 0.06)
seen = walk.positions[::2]
print(position_errors(life.estimate_m, walk.positions).mean_m.round(3), "m with walls")
print(position_errors(path_integration(life.senses), walk.positions).mean_m.round(3), "m without")

# %% [markdown]
# **What to see:** three boundary cells, of other bearings and distances, fire in bands along the walls that
# lie in their direction; none fires in the middle. White bins were not visited in five minutes.

# %%
maps = rate_map(seen, np.array(boundary), bins)
n = life.cells.boundary.config.n_distances
chosen = {"north, 7.5 cm": 6 * n + 1, "north, 19 cm": 6 * n + 4, "south-west, 11 cm": 15 * n + 2}
firing = [Firing(name, "", maps[k], bins, arena) for name, k in chosen.items()]
plot_firing_maps([firing], "Where three boundary cells fire", "mean rate")

# %% [markdown]
# ## Grid cells
# Six oscillators a module turn by $\mathbf k_j\cdot\Delta x$. A lateral anti-Hebbian network learns from
# their phases at random positions, before the first step, without hexagons in its input.
#
# **What to see:** rate maps of one cell from each module, and their autocorrelograms: six peaks around
# the middle, farther apart from left to right. Scores near 1.3 are clean hexagons.

# %%
maps = rate_map(seen, np.array(rates), bins)
score = gridness(maps)
spacings = life.cells.grid.config.spacings_m
fires = [
    Firing(f"{spacing:.2f} m", f"score {score[24 * m]:.2f}", maps[24 * m], bins, arena)
    for m, spacing in enumerate(spacings[:3])
]
plot_grids({"one cell a module": fires}, "Grid cells of three modules")

# %% [markdown]
# It is the 60° between the directions that makes hexagons, not the learning: with twelve directions there are
# none.

# %%
at = np.stack(np.meshgrid(*2 * [np.arange(-1, 1, 0.04)]), axis=-1).reshape(-1, 2)
for directions in (6, 12):
    config = GridCellConfig(directions=directions)
    grid, oscillators = LAHNGridCells(config), VelocityOscillators(config)
    with torch.no_grad():
        fired = [grid(oscillators.place_at(torch.from_numpy(x))).flatten().numpy() for x in at]
    scores = gridness(rate_map(at, np.array(fired), Bins.around(at, 0.04)))
    print(f"{directions} directions: median score {np.nanmedian(scores):.2f}")

# %% [markdown]
# Gradients reach what is learnt, and the spacings.

# %%
config = GridCellConfig(development_steps=100)
grid, oscillators = LAHNGridCells(config), VelocityOscillators(config)
grid(oscillators(torch.tensor([0.2, 0.1]), dt_s=0.5)).sum().backward()
print("d rates / d spacings:", oscillators.spacing_m.grad.numpy().round(1))
print("d rates / d Q:", tuple(grid.feedforward.grad.shape))

# %% [markdown]
# ## Place cells
# Where no place cell is within 6 cm a new one is recruited. Cells that win one after the other are linked:
# a map to plan on.
#
# **What to see:** place cells of the first animal and their links fill the arena; squares are the feet of
# remembered walls and lie on its outline; the orange path was planned from corner to corner.


# %%
def explore(seed, minutes):
    brain = NavigationBrain(build_config(read_preset("slrb")))
    brain.about = (f"session {seed}", "slrb", "")
    source = open_source(f"arena:pentagon?minutes={minutes}&noise=1&seed={seed}&speed=0.15")
    for frame in source:
        brain(frame)
    return brain, np.array(next(iter(source)).truth[:2])


brain, start = explore(seed=1, minutes=5)
centres, links = (part.numpy() for part in brain.navigation.place.graph())
centres = centres + start
goal, here = int(centres[:, 1].argmax()), int(centres[:, 0].argmin())
path = brain.map.plan(goal, start=here).path
wall = brain.navigation.walls.remembered()[0]
feet = np.column_stack([wall.x_m + wall.distance_m * wall.bearing_rad.cos(),
                        wall.y_m + wall.distance_m * wall.bearing_rad.sin()]) + start  # fmt: skip
figure, axes = plt.subplots(figsize=(5.4, 5.6), layout="constrained")
axes.plot(*centres[links].transpose(2, 1, 0), color=MAP, lw=0.6, alpha=0.6)
axes.plot(*centres.T, ".", color=MAP, ms=4, label=f"{len(centres)} place cells")
axes.plot(*feet.T, "s", color=LOOP, ms=4, label=f"{len(feet)} wall segments")
axes.plot(*centres[path].T, color=ROBOT, lw=3, label="planned path")
draw_arena(axes, arena)
axes.set_title("Place cells, links, walls, and a planned path")
figure.legend(loc="outside lower center", ncols=3)
plt.show()

# %% [markdown]
# ## Drift, and walls that correct it
# A wall measures the position perpendicular to it, and nothing along it. Met again, it corrects the phases of
# all modules by one displacement.
#
# **What to see:** without walls the error grows; with them it stays near 2 to 4 cm from the first minutes on.
# Bands are the least and the largest of four animals.

# %%
figure, axes = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
minutes = walk.times_s / 60
for name, track, colour in (
    ("path integration", path_integration(life.senses), ODOMETRY),
    ("with walls", life.estimate_m, MAP),
):
    off = 100 * np.linalg.norm(track - walk.positions, axis=-1)
    axes.fill_between(minutes, off.min(0), off.max(0), color=colour, alpha=0.2, lw=0)
    axes.plot(minutes, off.mean(0), color=colour, label=name)
axes.set(xlabel="time (min)", ylabel="position error (cm)", ylim=(0, None), xlim=(0, 5))
axes.set_title("Error over time, four animals")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# ## A kidnapped animal
# After 3.5 minutes the animal is moved to another position. It has no camera; but it meets walls where the map
# has none, or misses walls of the map.
#
# **What to see:** doubt, the time for which walls disagree with the map, is 0 until the animal is kidnapped
# (dashed), and grows when it meets walls then. Beyond 4 s the animal is lost, and learns nothing more.

# %%
frames = list(open_source("arena:triangle?minutes=6&noise=1&seed=1&speed=0.15"))
lift, down = 4200, 5400
animal = NavigationBrain(build_config(read_preset("slrb")))
doubt = []
for i, frame in enumerate(frames[:lift] + frames[down:]):
    result = animal(frame._replace(index=i, time_s=0.05 * i))
    doubt.append(animal.navigation.familiarity.doubt_s.item())
figure, axes = plt.subplots(figsize=(7.5, 2.6), layout="constrained")
axes.plot(np.arange(len(doubt)) / 1200, doubt, color=LOOP)
axes.axvline(lift / 1200, color=INK, ls="--", lw=1, label="kidnapped")
limit_s = animal.config.wall_memory.lost_after_s
axes.axhline(limit_s, color=ROBOT, lw=1, label=f"threshold: lost above {limit_s:g} s")
axes.set(xlabel="time (min)", ylabel="doubt (s)", xlim=(0, len(doubt) / 1200), ylim=(0, None))
axes.legend(loc="upper left")
axes.set_title("Kidnapped at 3.5 min: " + ("lost" if result.lost else "not detected"))
plt.show()

# %% [markdown]
# A camera helps: with the preset `ratslam_slrb` templates store the position where they were learnt, and a view
# match relocalises the robot (`docs/navigation_cells.md`).
#
# ## Two sessions, one map
# A second animal in the same arena starts elsewhere, with other noise. The two maps are aligned by their walls.
#
# **What to see:** the report counts the matched wall segments; the merged map is one pentagon of place
# cells, not two shifted ones.

# %%
other, _ = explore(seed=2, minutes=5)
merged, reports = join_brains(brain, other)
print("\n".join(reports[0].lines()))
links = merged.map.links
plot_map(merged.map.poses, np.column_stack([links.source, links.target]))

# %% [markdown]
# ## Your own animal
# An `.npz` with `t`, `pos` and `arena_radius` or `vertices` is a source like an arena:
# `neuroslam run rat.npz -o out --preset slrb`, or in Python
# `read_walk("rat.npz").lasting(30)` in place of `roam(...)` above. Many animals at once:

# %%
cells = NavigationCells(BrainConfig(), batch=32)
wall_m, bearing_rad = torch.full((32, 1), 0.1), torch.zeros(32, 1)
here = cells(torch.full((32,), 0.2), torch.zeros(32), 0.05, wall_m, bearing_rad)
print(here.position_m.shape, here.lost.sum().item(), "lost")
